"""A live 3D view of an acquisition in the browser, which shows and never moves anything.

    feed     in the acquisition: sends its state into a pipe ten times a second, or skips a turn
    server   a separate process at the other end: one page on 127.0.0.1, by viser
    page     what the page shows

Nothing comes back from the server but its address, and it ignores what browsers send it.
"""
