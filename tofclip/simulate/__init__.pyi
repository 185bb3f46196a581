# The public names of this package and their homes; they are imported on first use.

from .bodies import Body as Body
from .bodies import Box as Box
from .bodies import Hits as Hits
from .bodies import Lambertian as Lambertian
from .bodies import Rectangle as Rectangle
from .bodies import Shape as Shape
from .bodies import Specular as Specular
from .bodies import Sphere as Sphere
from .streak import GroundTruth as GroundTruth
from .streak import Instrument as Instrument
from .streak import RayCast as RayCast
from .streak import Scene as Scene
from .streak import SimulatedShot as SimulatedShot
from .streak import StreakDetector as StreakDetector
from .streak import make_default_camera as make_default_camera
from .streak import make_default_instrument as make_default_instrument
from .streak import make_default_scene as make_default_scene
from .streak import make_nominal_camera as make_nominal_camera
from .streak import make_plate as make_plate
from .streak import render_true_frames as render_true_frames
from .streak import score_returns as score_returns
from .streak import simulate_shot as simulate_shot
