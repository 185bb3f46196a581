"""Light fields: one picture for each view, refocusing, other viewpoints, depth from focus,
everything in focus.
"""

from tofclip.light_field.depth import (
    FocalStack,
    compute_image_energy,
    compute_modified_laplacian,
    estimate_depth_from_focus,
    find_smooth_labels,
    make_focal_stack,
)
from tofclip.light_field.views import LightField

__all__ = [
    "FocalStack",
    "LightField",
    "compute_image_energy",
    "compute_modified_laplacian",
    "estimate_depth_from_focus",
    "find_smooth_labels",
    "make_focal_stack",
]
