"""The viewer: clouds, transients and hidden volumes on a page of the browser, in a window, or as a
picture.

::

    source  ->  session (clock, filters, colouring, picks)  ->  page | desktop | picture, film

Everything left of the last arrow knows no screen, no server and no graphics library.
"""
