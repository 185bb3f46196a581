"""Letters in front of a wall, lit from the side by a round, uneven beam: their shadows lie on the
wall.

A twin of the paper's Supplementary Figure 22, where a visible laser replaced the infrared one.
"""

from __future__ import annotations

import numpy as np

from tofclip.simulate.demo import FOCAL_LENGTH_PX
from tofclip.simulate.scene import Plate, Scene, Vector
from tofclip.simulate.shapes import TEXELS, Pattern, cut_pattern, make_letter, make_plain_pattern

WALL_DEPTH_M = 2.8
WALL_SIDE_PX = 112
BEAM_RADIUS_FRACTION = 0.46  # of the wall's side
RIM_BRIGHTNESS_FRACTION = 0.45  # of the middle's
LAMP_POSITION_M: Vector = (-0.14, -0.1, 0.0)
LETTERS = (("U", (-22, -18), 2.2), ("L", (24, -14), 2.35), ("C", (2, 22), 2.25))
LETTER_SIDE_PX = 30


def make_shadow_scene() -> Scene:
    """Return the scene: three letters between 2.2 and 2.35 m, a wall at 2.8 m, a lamp 0.17 m up and
    to the left.

    The beam's profile is printed on the wall, where it matters; the letters are evenly bright.
    """
    letters = tuple(
        _make_facing_plate(
            cut_pattern(make_letter(name), make_plain_pattern(0.7)), place, LETTER_SIDE_PX, z
        )
        for name, place, z in LETTERS
    )
    return Scene(
        (*letters, _make_facing_plate(_make_beam(), (0, 0), WALL_SIDE_PX, WALL_DEPTH_M)),
        LAMP_POSITION_M,
    )


def _make_facing_plate(
    pattern: Pattern, place_px: tuple[float, float], side_px: float, depth: float
) -> Plate:
    pixel = depth / FOCAL_LENGTH_PX
    return Plate(
        (place_px[0] * pixel, place_px[1] * pixel, depth),
        (side_px * pixel, side_px * pixel),
        pattern,
    )


def _make_beam() -> Pattern:
    """Brightness of a round beam that falls off towards its rim; nothing beyond."""
    across = (np.arange(TEXELS) + 0.5) / TEXELS - 0.5
    radius = np.hypot(across[:, np.newaxis], across) / BEAM_RADIUS_FRACTION
    brightness = 0.9 * RIM_BRIGHTNESS_FRACTION ** (radius**2)
    return np.where(radius <= 1, brightness, 0).astype(np.float32)
