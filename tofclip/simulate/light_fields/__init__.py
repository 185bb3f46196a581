"""Light fields of scenes with a known answer: solid bodies in 3D, ray-cast for each view, with their exact shears."""

from tofclip.simulate.light_fields.array import CameraArray
from tofclip.simulate.light_fields.bodies import Body, Box, Rectangle, Sphere
from tofclip.simulate.light_fields.materials import Lambertian, Specular
from tofclip.simulate.light_fields.pulsed import Clock, PulsedScene, flash, flash_view
from tofclip.simulate.light_fields.render import RenderedLightField, Scene, render, render_view, shear_map
from tofclip.simulate.light_fields.scenes import SCENES, known_scene

__all__ = [
    "SCENES",
    "Body",
    "Box",
    "CameraArray",
    "Clock",
    "Lambertian",
    "PulsedScene",
    "Rectangle",
    "RenderedLightField",
    "Scene",
    "Specular",
    "Sphere",
    "flash",
    "flash_view",
    "known_scene",
    "render",
    "render_view",
    "shear_map",
]
