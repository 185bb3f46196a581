"""The camera: where each view lies on the slit, how its lenslet projects, how the sweep bends time."""

from tofclip.camera.model import Camera
from tofclip.camera.sweep import PolynomialSweep, ProjectiveSweep, SkewSweep, Sweep

__all__ = ["Camera", "PolynomialSweep", "ProjectiveSweep", "SkewSweep", "Sweep"]
