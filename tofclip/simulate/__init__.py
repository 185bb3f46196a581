"""Simulated shots of known scenes: what a streak camera behind a row of lenslets would have
recorded, and the truth.
"""

from tofclip.simulate.bodies import Body, Box, Hits, Lambertian, Rectangle, Shape, Specular, Sphere
from tofclip.simulate.demo import (
    make_default_camera,
    make_default_instrument,
    make_default_scene,
    make_nominal_camera,
)
from tofclip.simulate.streak import (
    GroundTruth,
    Instrument,
    RayCast,
    Scene,
    SimulatedShot,
    StreakDetector,
    make_plate,
    render_true_frames,
    score_returns,
    simulate_shot,
)

__all__ = [
    "Body",
    "Box",
    "GroundTruth",
    "Hits",
    "Instrument",
    "Lambertian",
    "RayCast",
    "Rectangle",
    "Scene",
    "Shape",
    "SimulatedShot",
    "Specular",
    "Sphere",
    "StreakDetector",
    "make_default_camera",
    "make_default_instrument",
    "make_default_scene",
    "make_nominal_camera",
    "make_plate",
    "render_true_frames",
    "score_returns",
    "simulate_shot",
]
