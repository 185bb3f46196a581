"""The camera: where each view lies on the slit, how its lenslet projects, how the sweep bends time."""

from tofclip.camera.measurement import (
    Measurement,
    Rectifier,
    estimate_dark_level,
    measure,
    require_width,
)
from tofclip.camera.model import Camera
from tofclip.camera.range_calibration import RangeCalibration
from tofclip.camera.sweep import PolynomialSweep, ProjectiveSweep, SkewSweep, Sweep

__all__ = [
    "Camera",
    "Measurement",
    "PolynomialSweep",
    "ProjectiveSweep",
    "RangeCalibration",
    "Rectifier",
    "SkewSweep",
    "Sweep",
    "estimate_dark_level",
    "measure",
    "require_width",
]
