# The public names of this package and their homes; they are imported on first use.

from .focus_pictures import FocusCalibration as FocusCalibration
from .focus_pictures import calibrate_views as calibrate_views
from .model import Camera as Camera
from .model import PolynomialSweep as PolynomialSweep
from .model import ProjectiveSweep as ProjectiveSweep
from .model import SkewSweep as SkewSweep
from .model import Sweep as Sweep
from .range_calibration import RangeCalibration as RangeCalibration
from .rectifier import Measurement as Measurement
from .rectifier import Rectifier as Rectifier
from .rectifier import estimate_dark_level as estimate_dark_level
from .rectifier import measure as measure
from .rectifier import require_width as require_width
from .registration import FocusCurve as FocusCurve
from .registration import Parallax as Parallax
from .registration import Registration as Registration
from .registration import SkewEstimate as SkewEstimate
from .registration import estimate_skew as estimate_skew
from .registration import find_sharpest_shears as find_sharpest_shears
from .registration import fit_parallax_to_centres as fit_parallax_to_centres
from .registration import fit_parallax_to_shears as fit_parallax_to_shears
from .registration import register_views as register_views
