"""Simulated shots of known scenes: what a streak camera behind a row of lenslets would have
recorded, and the truth.
"""

from tofclip.simulate.demo import (
    make_default_camera,
    make_default_instrument,
    make_default_scene,
    make_nominal_camera,
)
from tofclip.simulate.ground_truth import GroundTruth, render_true_frames, score_returns
from tofclip.simulate.instrument import Instrument, StreakDetector
from tofclip.simulate.scene import RayCast, Scene, make_plate
from tofclip.simulate.shot import SimulatedShot, simulate_shot

__all__ = [
    "GroundTruth",
    "Instrument",
    "RayCast",
    "Scene",
    "SimulatedShot",
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
