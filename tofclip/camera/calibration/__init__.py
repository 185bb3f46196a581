"""How a camera's numbers are found: from pictures of a point source, and from the shot itself."""

from tofclip.camera.calibration.focus_pictures import FocusCalibration, calibrate
from tofclip.camera.calibration.parallax import (
    Parallax,
    parallax_from_centres,
    parallax_from_shears,
    sharpest_shears,
    sharpness,
)
from tofclip.camera.calibration.registration import Registration, register
from tofclip.camera.calibration.skew import SkewEstimate, estimate_skew

__all__ = [
    "FocusCalibration",
    "Parallax",
    "Registration",
    "SkewEstimate",
    "calibrate",
    "estimate_skew",
    "parallax_from_centres",
    "parallax_from_shears",
    "register",
    "sharpest_shears",
    "sharpness",
]
