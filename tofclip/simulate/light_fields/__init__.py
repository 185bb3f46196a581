"""Light fields of scenes with a known answer: solid bodies in 3D, ray-cast for each view, with
their exact shears.
"""

from tofclip.simulate.bodies import Body, Box, Hits, Lambertian, Rectangle, Shape, Specular, Sphere
from tofclip.simulate.light_fields.array import CameraArray
from tofclip.simulate.light_fields.pulsed import (
    PulsedScene,
    TimeAxis,
    render_flash,
    render_flash_view,
)
from tofclip.simulate.light_fields.render import (
    RenderedLightField,
    Scene,
    render_light_field,
    render_shear_map,
    render_view,
)
from tofclip.simulate.light_fields.scenes import SCENES, make_scene

__all__ = [
    "SCENES",
    "Body",
    "Box",
    "CameraArray",
    "Hits",
    "Lambertian",
    "PulsedScene",
    "Rectangle",
    "RenderedLightField",
    "Scene",
    "Shape",
    "Specular",
    "Sphere",
    "TimeAxis",
    "make_scene",
    "render_flash",
    "render_flash_view",
    "render_light_field",
    "render_shear_map",
    "render_view",
]
