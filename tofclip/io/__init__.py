"""Files of the instruments, turned once, at this border, into the objects that the other rooms work
with.
"""

from tofclip.io.streaks import read_streak

__all__ = ["read_streak"]
