# The public names of this package and their homes; they are imported on first use.

from .streaks import StreakStack as StreakStack
from .streaks import read_streak as read_streak
from .streaks import save_stack as save_stack
