"""Shadows on a wall come out as holes in its part of the cloud, as in the paper's Supplementary
Figure 22: letters in front of a wall, lit from the side by a round, uneven beam.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from tofclip import depth, recover
from tofclip.lidar import Detection
from tofclip.recovery import DepthLockedFocus
from tofclip.simulate import make_default_instrument, simulate_shot
from tofclip.simulate.bodies import Body, Vector
from tofclip.simulate.demo import FOCAL_LENGTH_PX
from tofclip.simulate.patterns import TEXELS, Pattern, cut_pattern, make_letter, make_plain_pattern
from tofclip.simulate.streak import Scene, make_plate
from tofclip.solvers import TotalVariation
from tofclip.units import SPEED_OF_LIGHT

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
) -> Body:
    pixel = depth / FOCAL_LENGTH_PX
    return make_plate(
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


@pytest.fixture(scope="module")
def pixels():
    """Pixels whose whole neighbourhood is lit wall, or wall in shadow, by the ray caster."""
    scene, made = make_shadow_scene(), make_default_instrument().camera
    rows, columns = np.indices(made.image_shape).reshape(2, -1)
    down, right = rows - made.optical_axis_px[0], columns - made.optical_axis_px[1]
    ways = (
        np.stack([right, down, np.full(rows.size, made.focal_length_px)], axis=-1)
        / made.focal_length_px
    )
    hits = scene.trace(np.zeros(3), ways)
    wall = (hits.body == 3) & (np.hypot(right, down) < 0.9 * BEAM_RADIUS_FRACTION * WALL_SIDE_PX)
    around = np.ones((3, 3))
    return [
        binary_erosion((wall & chosen).reshape(made.image_shape), around)
        for chosen in (hits.reflectance > 0, hits.reflectance == 0)
    ]


def test_shadows_are_recovered_as_holes_in_the_wall(pixels):
    lit, shadow = pixels
    assert lit.sum() > 1500
    assert shadow.sum() > 150
    shot = simulate_shot(make_shadow_scene(), make_default_instrument(), seed=0)
    frames = recover(
        shot.streak, shot.camera, TotalVariation(iterations=40), focus=DepthLockedFocus()
    )
    bright = (frames.values * frames.times[:, np.newaxis, np.newaxis].astype(np.float32) ** 2)[
        np.abs(frames.times * SPEED_OF_LIGHT / 2 - WALL_DEPTH_M) < 0.06
    ].sum(axis=0)
    # light of the lit wall leaks into the shadows, a few pixels wide, through the seven views' blur
    assert np.median(bright[shadow]) < 0.45 * np.median(bright[lit])
    # the beam's rim is 0.45 as bright as its middle, so that a quarter lies between it and the
    # shadows
    found = depth(frames, detection=Detection(min_time_bin_fraction=0.25))
    on_wall = np.zeros(lit.shape, bool)
    at_wall = np.abs(found.range - WALL_DEPTH_M) < 0.1
    on_wall[found.y[at_wall], found.x[at_wall]] = True
    assert on_wall[lit].mean() > 0.9
    assert on_wall[shadow].mean() < 0.3
