"""A live 3D view of an acquisition in the browser, which shows and never moves anything.

    feed     in the acquisition: ten times a second what is known goes into a pipe, or is left out
    server   a process of its own at the other end: one page on 127.0.0.1, by viser
    page     what the page shows

Nothing comes back from the server but its address, and it ignores what browsers send it.
"""
