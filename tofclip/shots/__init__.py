"""The two pictures of a transient: the streak image that was measured and the frames recovered from
it.
"""

from tofclip.shots.frames import Frames
from tofclip.shots.streak import Streak

__all__ = ["Frames", "Streak"]
