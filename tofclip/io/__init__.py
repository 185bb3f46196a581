"""Files of the instruments, turned once, at this border, into the objects that the other rooms work
with.
"""

from tofclip.io.streaks import StreakStack, read_streak, save_stack

__all__ = ["StreakStack", "read_streak", "save_stack"]
