"""Light fields: one picture for each view, refocusing, other viewpoints, depth from focus, everything in focus."""

from tofclip.light_field.focus import (
    FocalStack,
    depth_from_focus,
    focal_stack,
    image_energy,
    sum_modified_laplacian,
)
from tofclip.light_field.labels import smoothest_labels
from tofclip.light_field.views import LightField

__all__ = [
    "FocalStack",
    "LightField",
    "depth_from_focus",
    "focal_stack",
    "image_energy",
    "smoothest_labels",
    "sum_modified_laplacian",
]
