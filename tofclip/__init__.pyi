# The public names of this package and their homes; they are imported on first use.

from .camera import Camera as Camera
from .designs import design as design
from .errors import TofclipError as TofclipError
from .io import read_streak as read_streak
from .lidar import PointCloud as PointCloud
from .lidar import depth as depth
from .lidar import point_cloud as point_cloud
from .loading import load as load
from .metrics import nmse as nmse
from .plugins import register_denoiser as register_denoiser
from .plugins import register_method as register_method
from .plugins import register_reader as register_reader
from .recovery import recover as recover
from .shots import Frames as Frames
from .shots import Streak as Streak
from .version import __version__ as __version__
