"""Shadows on a wall come out as holes in its part of the cloud, as in the paper's Supplementary
Figure 22.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from tofclip import depth, recover
from tofclip.lidar import Detection
from tofclip.recovery import DepthLockedFocus
from tofclip.simulate import make_default_instrument, simulate_shot
from tofclip.simulate.shadows import (
    BEAM_RADIUS_FRACTION,
    WALL_DEPTH_M,
    WALL_SIDE_PX,
    make_shadow_scene,
)
from tofclip.solvers import TotalVariation
from tofclip.units import SPEED_OF_LIGHT


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
    hits = scene.cast_rays(np.zeros(3), ways)
    wall = (hits.plate == 3) & (np.hypot(right, down) < 0.9 * BEAM_RADIUS_FRACTION * WALL_SIDE_PX)
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
