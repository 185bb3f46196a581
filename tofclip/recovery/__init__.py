"""From a streak image and a camera to transient frames."""

from tofclip.recovery.focus import (
    DepthLockedFocus,
    FixedFocus,
    Focus,
    FrameSegment,
    SharpestFocus,
    ShotParallax,
    count_parallax_work,
    fit_parallax_to_shot,
    parse_focus,
)
from tofclip.recovery.plan import RecoveryPlan, make_method, plan_recovery, recover
from tofclip.recovery.shot import (
    Shot,
    compute_view_delays_bins,
    fit_camera_to_shot,
    open_shot,
    require_plausible_rows,
)
from tofclip.recovery.surfaces import SurfaceRecovery

__all__ = [
    "DepthLockedFocus",
    "FixedFocus",
    "Focus",
    "FrameSegment",
    "RecoveryPlan",
    "SharpestFocus",
    "Shot",
    "ShotParallax",
    "SurfaceRecovery",
    "compute_view_delays_bins",
    "count_parallax_work",
    "fit_camera_to_shot",
    "fit_parallax_to_shot",
    "make_method",
    "open_shot",
    "parse_focus",
    "plan_recovery",
    "recover",
    "require_plausible_rows",
]
