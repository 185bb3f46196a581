"""How a camera's numbers are found: from pictures of a point source, and from the shot itself."""

from tofclip.camera.calibration.focus_pictures import FocusCalibration, calibrate_views
from tofclip.camera.calibration.parallax import (
    FocusCurve,
    Parallax,
    find_sharpest_shears,
    fit_parallax_to_centres,
    fit_parallax_to_shears,
    measure_sharpness,
)
from tofclip.camera.calibration.registration import Registration, register_views
from tofclip.camera.calibration.skew import SkewEstimate, estimate_skew

__all__ = [
    "FocusCalibration",
    "FocusCurve",
    "Parallax",
    "Registration",
    "SkewEstimate",
    "calibrate_views",
    "estimate_skew",
    "find_sharpest_shears",
    "fit_parallax_to_centres",
    "fit_parallax_to_shears",
    "measure_sharpness",
    "register_views",
]
