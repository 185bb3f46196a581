"""A small scene of surfaces, the instrument before it, and a model of two plates in it."""

from __future__ import annotations

import numpy as np

from tofclip.camera import Camera, SkewSweep
from tofclip.recovery.surfaces.model import SurfaceModel
from tofclip.recovery.surfaces.points import SurfaceState
from tofclip.recovery.surfaces.shapes import SmoothBasis
from tofclip.shots import Streak
from tofclip.simulate import Instrument, Scene, StreakDetector, make_plate
from tofclip.simulate.patterns import make_checkerboard, make_plain_pattern

BIN = 20e-12
BIN_M = 3e-3
SHAPE = (48, 48)
FOCAL = 210.0
CENTRES = 45.0 + 62 * np.arange(7)
ANGLES = np.radians([-43.3, -25.7, -12.7, 0.6, 22.9, 37.5, 48.0])
CAMERA = Camera(
    CENTRES,
    ANGLES,
    SHAPE,
    462,
    gains=np.array([0.92, 1.08, 1.02, 0.90, 1.02, 0.96, 1.10]),
    sweep=SkewSweep(CENTRES, np.linspace(-8.0, 8.0, 7), np.linspace(5e-3, -5e-3, 7)),
    time_zero=-8e-9,
    focal_length_px=FOCAL,
    lenslet_pitch=2.3e-3,
    focus_distance=1.6,
)
INSTRUMENT = Instrument(CAMERA, StreakDetector(270))


def place(name: str, middle: tuple[float, float], side: float, distance: float, **turned: float):
    pixel = distance / FOCAL
    pattern = {"plain": make_plain_pattern(0.8), "board": make_checkerboard(3, 0.3, 0.9)}[name]
    return make_plate(
        (middle[0] * pixel, middle[1] * pixel, distance),
        (side * pixel, side * pixel),
        pattern,
        **turned,
    )


SCENE = Scene(
    (
        place("plain", (-9, -8), 15, 1.4),
        place("board", (8, 6), 19, 1.65, yaw=0.3),
        place("plain", (0, 0), 40, 1.9),
    )
)


def make_model(streak: Streak, overlap: bool = False) -> SurfaceModel:
    """Two plates; the further one reaches behind the whole of the nearer one, if asked for."""
    masks = np.zeros((2, *SHAPE), bool)
    masks[0, 8:30, 5:25] = masks[1, 20:40, 18:44] = True
    if overlap:
        masks[1, 4:40, 2:44] = True
    coefficients = np.zeros((2, 6))
    coefficients[:, 0] = 1 / 1.4, 1 / 1.7
    coefficients[:, 1] = 0.02, -0.03
    state = SurfaceState.start(list(coefficients), CAMERA)
    return SurfaceModel(streak, CAMERA, masks, [SmoothBasis(SHAPE)] * 2, state)
