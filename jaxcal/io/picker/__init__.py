"""Points placed by hand: a page on loopback that shows each frame and takes one click.

picks    the file of points, which is written after every click
frames   any frame of a sequence as PNG
server   the page, for this machine only
"""
