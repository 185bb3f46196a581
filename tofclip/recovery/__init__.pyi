# The public names of this package and their homes; they are imported on first use.

from .plan import RecoveryPlan as RecoveryPlan
from .plan import make_method as make_method
from .plan import plan_recovery as plan_recovery
from .plan import recover as recover
from .shot import DepthLockedFocus as DepthLockedFocus
from .shot import FixedFocus as FixedFocus
from .shot import Focus as Focus
from .shot import FrameSegment as FrameSegment
from .shot import SharpestFocus as SharpestFocus
from .shot import Shot as Shot
from .shot import ShotParallax as ShotParallax
from .shot import compute_view_delays_bins as compute_view_delays_bins
from .shot import count_parallax_work as count_parallax_work
from .shot import fit_camera_to_shot as fit_camera_to_shot
from .shot import fit_parallax_to_shot as fit_parallax_to_shot
from .shot import open_shot as open_shot
from .shot import parse_focus as parse_focus
from .shot import require_plausible_rows as require_plausible_rows
from .surfaces import SurfaceRecovery as SurfaceRecovery
