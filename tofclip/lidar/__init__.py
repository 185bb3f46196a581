"""Flash LiDAR: from a transient cube to returns, and from returns to a point cloud."""

from tofclip.camera.model import compute_ray_directions
from tofclip.lidar.cloud import PointCloud, point_cloud
from tofclip.lidar.export import Column, save_depth
from tofclip.lidar.pulse import Pulse
from tofclip.lidar.search import depth
from tofclip.lidar.significance import Detection
from tofclip.shots import Returns

__all__ = [
    "Column",
    "Detection",
    "PointCloud",
    "Pulse",
    "Returns",
    "compute_ray_directions",
    "depth",
    "point_cloud",
    "save_depth",
]
