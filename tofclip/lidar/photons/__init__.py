"""Range from counted photons, up to the limit that their number sets.

Two kinds of data have an estimator each. Recovered frames carry the nearly even errors of an
inverse problem: `tofclip.lidar.depth` fits the pulse to them by least squares. The bins of a
photon-counting detector are Poisson distributed: for them the log-matched filter and the weighted
fit of this room reach the maximum likelihood. Peaks, overlapping returns and positions below a bin
are found by the same compiled steps. `PhotonDetector` takes every pixel alone, `estimate_surface`
lets neighbours lend each other their photons.
"""

from tofclip.lidar.photons.detector import (
    Arrivals,
    PhotonDetector,
    correct_pile_up,
    estimate_pixels,
)
from tofclip.lidar.photons.image import PhotonCube, PhotonImage, SurfaceImage
from tofclip.lidar.photons.limits import Accuracy, compute_range_bound, measure_accuracy
from tofclip.lidar.photons.scene import learn_background
from tofclip.lidar.photons.surface import estimate_surface

__all__ = [
    "Accuracy",
    "Arrivals",
    "PhotonCube",
    "PhotonDetector",
    "PhotonImage",
    "SurfaceImage",
    "compute_range_bound",
    "correct_pile_up",
    "estimate_pixels",
    "estimate_surface",
    "learn_background",
    "measure_accuracy",
]
