# The public names of this package and their homes; they are imported on first use.

from .views import FocalStack as FocalStack
from .views import LightField as LightField
from .views import compute_image_energy as compute_image_energy
from .views import compute_modified_laplacian as compute_modified_laplacian
from .views import estimate_depth_from_focus as estimate_depth_from_focus
from .views import find_smooth_labels as find_smooth_labels
from .views import make_focal_stack as make_focal_stack
