# The public names of this package and their homes; they are imported on first use.

from .detector import Accuracy as Accuracy
from .detector import Arrivals as Arrivals
from .detector import PhotonDetector as PhotonDetector
from .detector import compute_range_bound as compute_range_bound
from .detector import correct_pile_up as correct_pile_up
from .detector import estimate_pixels as estimate_pixels
from .detector import measure_accuracy as measure_accuracy
from .image import PhotonCube as PhotonCube
from .image import PhotonImage as PhotonImage
from .image import SurfaceImage as SurfaceImage
from .scene import learn_background as learn_background
from .surface import estimate_surface as estimate_surface
