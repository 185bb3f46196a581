"""A small instrument and its files: seven views of 32 x 32 pixels, two bright squares at two
ranges.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tofclip.shots import Streak
from tofclip.storage import Field, Record

CENTRES_PX = np.array([30.4, 70.0, 110.7, 150.0, 190.2, 230.0, 269.6])
ANGLES = np.deg2rad([-43.0, -26.0, -13.0, 0.5, 23.0, 37.0, 48.0])
SLIT_WIDTH_PX = 300
IMAGE_SHAPE = (32, 32)
ROWS = 96
BIN_WIDTH = 20e-12
SQUARE_ROWS = (30, 62)  # instants at which the two squares send their light back
BACKGROUND = 20.0


@dataclass(frozen=True)
class Outcome:
    """What a run of the program left behind."""

    status: int
    out: str
    err: str


Run = Callable[..., Outcome]


def wall_shot(streak: Streak) -> Streak:
    """The same light, taken for what a relay wall of 12 x 12 points sent back."""
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 12), np.linspace(-0.3, 0.3, 12))
    wall = Record(
        "relay_wall",
        {
            "wall": Field(np.stack([x, y, 0 * x], axis=-1), "m", ("y", "x", "xyz")),
            "camera": Field(np.array([0.5, 0.0, -1.0]), "m", ("xyz",)),
            "laser": Field(np.zeros(3), "m", ("xyz",)),
        },
        {"row_offset": 10, "column_offset": 10, "receive_delay_bins": 0.0},
    )
    return Streak(
        streak.counts, streak.row_times, camera=streak.camera, attachments={"relay_wall": wall}
    )


def focus_pictures() -> dict[str, np.ndarray]:
    """A point source through the slit open and closed, with backgrounds, in counts."""
    noise = np.random.default_rng(5)
    row, column = np.mgrid[:120, :SLIT_WIDTH_PX].astype(float)
    slit_row = 60.0
    lines = dots = np.zeros(row.shape)
    for centre, angle in zip(CENTRES_PX, ANGLES, strict=True):
        across = (column - centre - (row - slit_row) * np.tan(angle)) * np.cos(angle)
        along = (column - centre) * np.sin(angle) + (row - slit_row) * np.cos(angle)
        lines = lines + 900 * np.exp(-((across / 1.5) ** 2) / 2) * (np.abs(along) < 22)
        dots = dots + 900 * np.exp(
            -(((column - centre) / 1.5) ** 2 + ((row - slit_row) / 1.5) ** 2) / 2
        )
    light = {"line": lines, "line_background": 0 * lines, "dot": dots, "dot_background": 0 * dots}
    return {name: noise.poisson(picture + 100).astype(np.uint16) for name, picture in light.items()}
