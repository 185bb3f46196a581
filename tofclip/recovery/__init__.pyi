# The public names of this package and their homes; they are imported on first use.

from .focus import DepthLockedFocus as DepthLockedFocus
from .focus import FixedFocus as FixedFocus
from .focus import Focus as Focus
from .focus import FrameSegment as FrameSegment
from .focus import SharpestFocus as SharpestFocus
from .focus import ShotParallax as ShotParallax
from .focus import count_parallax_work as count_parallax_work
from .focus import fit_parallax_to_shot as fit_parallax_to_shot
from .focus import parse_focus as parse_focus
from .plan import RecoveryPlan as RecoveryPlan
from .plan import make_method as make_method
from .plan import plan_recovery as plan_recovery
from .plan import recover as recover
from .shot import Shot as Shot
from .shot import compute_view_delays_bins as compute_view_delays_bins
from .shot import fit_camera_to_shot as fit_camera_to_shot
from .shot import open_shot as open_shot
from .shot import require_plausible_rows as require_plausible_rows
from .surfaces import SurfaceRecovery as SurfaceRecovery
