# The public names of this package and their homes; they are imported on first use.

from .depth import FocalStack as FocalStack
from .depth import compute_image_energy as compute_image_energy
from .depth import compute_modified_laplacian as compute_modified_laplacian
from .depth import estimate_depth_from_focus as estimate_depth_from_focus
from .depth import find_smooth_labels as find_smooth_labels
from .depth import make_focal_stack as make_focal_stack
from .views import LightField as LightField
