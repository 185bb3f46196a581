"""Simulated shots of known scenes: what a streak camera behind a row of lenslets would have recorded, and the truth."""

from tofclip.simulate.demo import default_camera, default_instrument, default_scene
from tofclip.simulate.instrument import Instrument, StreakDetector
from tofclip.simulate.scene import Plate, Scene
from tofclip.simulate.score import score
from tofclip.simulate.shot import SimulatedShot, simulate
from tofclip.simulate.truth import Truth, true_frames

__all__ = [
    "Instrument",
    "Plate",
    "Scene",
    "SimulatedShot",
    "StreakDetector",
    "Truth",
    "default_camera",
    "default_instrument",
    "default_scene",
    "score",
    "simulate",
    "true_frames",
]
