"""A camera of three views, and a shot of it with one lit row."""

import numpy as np

from tofclip.camera import Camera, SkewSweep
from tofclip.shots import Streak

CENTRES = np.array([20.0, 45.0, 70.0])
CAMERA = Camera(
    CENTRES,
    np.array([-0.5, 0.0, 0.5]),
    (16, 16),
    90,
    sweep=SkewSweep(CENTRES, np.zeros(3), np.zeros(3)),
    time_zero=1e-9,
)
COUNTS = np.random.default_rng(0).poisson(40.0, (12, 90)).astype(np.float32)


def make_streak():
    counts = COUNTS.copy()
    counts[5] += 100
    return Streak(counts, camera=CAMERA).with_bin_width(20e-12)
