"""From a streak image and a camera to transient frames."""

from tofclip.recovery.focus import DepthLocked, FixedFocus, Focus, Piece, SharpestFocus, focus_named
from tofclip.recovery.parallax import ShotParallax, parallax_from_shot
from tofclip.recovery.plan import Task, fitted_to_shot, method_named, prepare, recover, time_shift_bins

__all__ = [
    "DepthLocked",
    "FixedFocus",
    "Focus",
    "Piece",
    "SharpestFocus",
    "ShotParallax",
    "Task",
    "fitted_to_shot",
    "focus_named",
    "method_named",
    "parallax_from_shot",
    "prepare",
    "recover",
    "time_shift_bins",
]
