"""ToF-CLIP: compact light-field photography with time of flight.

Conventions, used everywhere: SI units in public signatures (pixels or bins only where a name ends
in ``_px`` or ``_bin``); float32 arrays unless float64 is asked for; transient cubes are ``(time, y,
x)`` with y pointing down; shear s in pixels per view step, negative for near objects.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from tofclip.version import __version__

if TYPE_CHECKING:
    from tofclip.camera import Camera
    from tofclip.errors import TofclipError
    from tofclip.io import read_streak
    from tofclip.lidar import PointCloud, depth, point_cloud
    from tofclip.metrics import nmse
    from tofclip.recovery import recover
    from tofclip.shots import Frames, Streak

__all__ = [
    "Camera",
    "Frames",
    "PointCloud",
    "Streak",
    "TofclipError",
    "__version__",
    "depth",
    "nmse",
    "point_cloud",
    "read_streak",
    "recover",
]

_HOMES = {
    "Camera": "tofclip.camera",
    "Frames": "tofclip.shots",
    "PointCloud": "tofclip.lidar",
    "Streak": "tofclip.shots",
    "TofclipError": "tofclip.errors",
    "depth": "tofclip.lidar",
    "nmse": "tofclip.metrics",
    "point_cloud": "tofclip.lidar",
    "read_streak": "tofclip.io",
    "recover": "tofclip.recovery",
}


def __getattr__(name: str) -> Any:
    """Import a public name on first use, so that ``import tofclip`` stays quick."""
    if name not in _HOMES:
        raise AttributeError(f"module 'tofclip' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names, imported or not."""
    return sorted({*globals(), *__all__})
