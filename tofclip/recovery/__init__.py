"""From a streak image and a camera to transient frames."""

from tofclip.recovery.focus import (
    DepthLockedFocus,
    FixedFocus,
    Focus,
    FrameSegment,
    SharpestFocus,
    parse_focus,
)
from tofclip.recovery.parallax import ShotParallax, fit_parallax_to_shot
from tofclip.recovery.plan import (
    RecoveryTask,
    compute_view_delays_bins,
    fit_camera_to_shot,
    make_method,
    prepare_recovery,
    recover,
    require_plausible_rows,
)

__all__ = [
    "DepthLockedFocus",
    "FixedFocus",
    "Focus",
    "FrameSegment",
    "RecoveryTask",
    "SharpestFocus",
    "ShotParallax",
    "compute_view_delays_bins",
    "fit_camera_to_shot",
    "fit_parallax_to_shot",
    "make_method",
    "parse_focus",
    "prepare_recovery",
    "recover",
    "require_plausible_rows",
]
