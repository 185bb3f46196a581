"""Straight ways through a virtual plane: how far they lead, and windows that hold little more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exact_phasor_field import compute_exact_phasor_field
from scene_shapes import JITTER, SPOT, shaped_wall

from nlos import Grid, Hybrid
from nlos.capture import TimeAxis
from nlos.illumination import build_waves, group_by_illumination
from nlos.phasor.transfer import Offsets, find_min_periods
from nlos.phasor.wall_to_plane import WallBeforePlane, plan_transforms
from nlos.plane import StraightPaths, VirtualPlane
from nlos.simulate import PointScene

METHOD = Hybrid(wavelength=0.25, cycles=4.24)
NEAR = Grid(np.linspace(-0.9, 0.9, 13), np.linspace(-0.8, 0.8, 9), [0.6, 0.7, 0.9])
FAR = Grid(np.linspace(-0.5, 0.7, 9), np.linspace(-0.6, 0.4, 7), [2.0, 2.3])
pytestmark = pytest.mark.filterwarnings("ignore::nlos.illumination.AliasingWarning")


def test_no_straight_way_leads_farther() -> None:
    points = shaped_wall("relief", 9).reshape(-1, 3)
    plane = VirtualPlane(np.linspace(-1.4, 1.4, 30), np.linspace(-1.3, 1.3, 28), 0.35, (0.2, 0.3))
    ways = StraightPaths.find(points, plane, NEAR, 0.1)
    assert ways is not None
    z, y, x = np.meshgrid(NEAR.z, NEAR.y, NEAR.x, indexing="ij")
    voxels = np.stack([x, y, z], axis=-1).reshape(-1, 1, 3)
    across = np.linalg.norm((voxels - points)[..., :2], axis=-1)
    before = (plane.z - points[:, 2]) / (voxels - points)[..., 2]
    for share, bound in ((before, ways.wall_to_plane), (1 - before, ways.plane_to_voxels)):
        farthest = (share * across).max()
        # points at the ends in depth need not stand in the corners
        assert farthest <= bound < 1.35 * farthest
    assert ways.rim == pytest.approx((0.14, 0.21))
    assert ways.first_depth == 0.6
    strict = StraightPaths.find(points, plane, NEAR, 1e-3)
    assert strict is not None
    assert strict.wall_to_plane > ways.wall_to_plane
    assert strict.rim < ways.rim


def test_voxels_before_the_plane_leave_no_way_out() -> None:
    points = shaped_wall("planar", 5).reshape(-1, 3)
    plane = VirtualPlane(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9), 0.65)
    assert StraightPaths.find(points, plane, NEAR, 1e-2) is None


@pytest.mark.parametrize("grid", [NEAR, FAR], ids=["near", "far"])
@pytest.mark.parametrize("shape", ["planar", "relief"])
def test_narrow_windows_keep_the_tolerance(shape: str, grid: Grid) -> None:
    """Close before a plane the windows are narrowest, and far from it the phases turn slowest."""
    wall = shaped_wall(shape, 32)
    hidden = [[grid.x[2], grid.y[-2], grid.z[0]], [grid.x[-1], grid.y[0], grid.z[1]]]
    capture = PointScene(hidden).simulate_capture(wall, SPOT, TimeAxis(700, 32e-12), JITTER)
    exact = compute_exact_phasor_field(capture, grid, METHOD.pulse).values
    for tolerance in (1e-2, 1e-3):
        found = replace(METHOD, tolerance=tolerance).phasor_field(capture, grid).values
        assert np.linalg.norm(found - exact) < 0.5 * tolerance * np.linalg.norm(exact)


def test_a_period_holds_a_plane_that_is_wider_than_the_windows() -> None:
    """Many zones beside a small wall: the plane's own width decides."""
    sources = VirtualPlane(np.linspace(-1, 1, 21), np.linspace(-1, 1, 21), 0.2, (1.4, 1.4))
    axis = np.linspace(-0.1, 0.1, 3)
    offsets = Offsets.between(sources, axis, axis).limit(0.2, (0.7, 0.7))
    assert find_min_periods(offsets, 1e-2) == pytest.approx((2.1, 2.1))


def test_lattices_are_as_short_as_the_ways_allow() -> None:
    """From the wall to a plane before it, and from there to depths as from a planar wall."""
    wall = shaped_wall("relief", 64)
    capture = PointScene(FAR.z[:1] * [[0, 0, 1]]).simulate_capture(
        wall, SPOT, TimeAxis(64, 32e-12), JITTER
    )
    axis = np.linspace(-1, 1, 64)
    plan = Hybrid(0.125, 4.24).plan(capture, Grid(axis, axis, np.linspace(0.6, 1.6, 4)))
    road = plan.groups[0].plane_to_depths
    whole = replace(road, paths=None)
    assert road.lattice == (160, 160)
    assert whole.lattice == (192, 192)
    assert road.plane_wave_count < 0.75 * whole.plane_wave_count
    group = group_by_illumination(capture)[0]
    waves = build_waves(group, plan.band, continued=False)
    geometry = replace(WallBeforePlane.of(capture.points, road.plane), paths=road.paths)
    narrow, wide = (
        plan_transforms(some, waves, np.ones(waves.count), 6e-3)
        for some in (geometry, replace(geometry, paths=None))
    )
    assert narrow is not None
    assert wide is not None
    assert narrow.lattice == (144, 144)
    assert wide.lattice == (192, 192)
    # What fades before it reaches a voxel is left out, which are many waves of low frequencies.
    assert narrow.lateral_limits[0] < 0.85 * wide.lateral_limits[0]
