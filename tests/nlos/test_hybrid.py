from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from exact_phasor_field import compute_exact_phasor_field
from refusals import find_refusal
from scene_shapes import JITTER, POINTS, SHAPES, SPOT, shaped_capture, shaped_wall

from nlos import Backprojection, Capture, Grid, Hybrid, PlanarRSD
from nlos.capture import TimeAxis
from nlos.simulate import PointScene
from tofclip.errors import InputError

COUNT = 25  # wall points along a side, 8 cm apart
GRID = Grid(np.linspace(-0.9, 0.9, 13), np.linspace(-0.8, 0.85, 12), [0.62, 0.8, 1.0, 1.1, 1.45])
METHOD = Hybrid(wavelength=0.25, cycles=4.24)
pytestmark = pytest.mark.filterwarnings("ignore::nlos.illumination.AliasingWarning")


def scaled_error(found: np.ndarray, expected: np.ndarray) -> float:
    """Relative difference after one scale factor."""
    scale = np.vdot(found, expected) / np.vdot(found, found)
    return float(np.linalg.norm(scale * found - expected) / np.linalg.norm(expected))


@cache
def truth(shape: str) -> tuple[Capture, np.ndarray]:
    capture = shaped_capture(shape, COUNT)
    return capture, compute_exact_phasor_field(capture, GRID, METHOD.pulse).values


@pytest.mark.parametrize("shape", SHAPES)
def test_the_image_is_that_of_the_exact_sum(shape: str) -> None:
    capture, exact = truth(shape)
    for allowed in (1e-2, 1e-3):
        volume = replace(METHOD, tolerance=allowed).reconstruct(capture, GRID)
        assert volume.values.dtype == np.float32
        assert scaled_error(volume.values, np.abs(exact)) < allowed
        # Not even a scale factor is needed, nor is the phase lost.
        found = replace(METHOD, tolerance=allowed).phasor_field(capture, GRID).values
        assert np.linalg.norm(found - exact) < allowed * np.linalg.norm(exact)


def test_a_planar_wall_gives_what_planar_diffraction_gives() -> None:
    capture, _ = truth("planar")
    found = METHOD.phasor_field(capture, GRID).values
    assert scaled_error(found, PlanarRSD(0.25, 4.24).phasor_field(capture, GRID).values) < 1e-2


@pytest.mark.parametrize("laser", ["confocal", "two spots"])
def test_other_scans_of_a_curved_wall(laser: str) -> None:
    wall = shaped_wall("wavy", 17)
    scene, axis = PointScene(POINTS), TimeAxis(640, 32e-12)
    if laser == "confocal":
        capture = scene.simulate_capture(wall, wall, axis, JITTER)
    else:
        walls = np.stack([wall, wall])
        spots = np.broadcast_to(np.array([SPOT, [-0.4, 0.3, 0.0]])[:, None, None], walls.shape)
        capture = scene.simulate_capture(walls, spots, axis, JITTER)
    exact = compute_exact_phasor_field(capture, GRID, METHOD.pulse).values
    assert scaled_error(METHOD.phasor_field(capture, GRID).values, exact) < 1e-2


def test_a_scattered_list_of_wall_points_is_as_good() -> None:
    random = np.random.default_rng(3)
    wall = random.uniform([-1, -1, 0], [1, 1, 0.2], (400, 3))
    capture = PointScene(POINTS).simulate_capture(wall, SPOT, TimeAxis(512, 32e-12), JITTER)
    exact = compute_exact_phasor_field(capture, GRID, METHOD.pulse).values
    assert scaled_error(METHOD.phasor_field(capture, GRID).values, exact) < 1e-2


def test_the_hidden_points_stand_out() -> None:
    """Energy within 4 cm of hidden points and contrast, as sharp as by the exact sum."""
    capture, exact = truth("cylinder")
    image = METHOD.reconstruct(capture, GRID).values
    z, y, x = np.meshgrid(GRID.z, GRID.y, GRID.x, indexing="ij")
    distance = np.linalg.norm(np.stack([x, y, z], -1)[..., None, :] - POINTS, axis=-1).min(axis=-1)
    near = distance < 0.1
    shares = [np.sum(volume[near] ** 2) / np.sum(volume**2) for volume in (image, np.abs(exact))]
    assert shares[0] == pytest.approx(shares[1], rel=5e-3)
    assert image[near].mean() > 3 * image[~near].mean()


def test_the_way_in_time_shows_the_same_points() -> None:
    wall = shaped_wall("relief", 11)
    capture = PointScene(POINTS[:1]).simulate_capture(wall, SPOT, TimeAxis(1024, 16e-12), JITTER)
    grid = Grid(np.linspace(0.1, 0.5, 5), np.linspace(-0.4, 0.0, 5), [0.9, 1.0, 1.1])
    in_time = replace(METHOD, propagation="time").reconstruct(capture, grid)
    assert in_time.find_brightest() == pytest.approx(tuple(POINTS[0]))
    assert scaled_error(in_time.values, METHOD.reconstruct(capture, grid).values) < 3e-2
    assert in_time.provenance["imaging"]["propagation"] == "time"


def test_the_plane_may_stand_elsewhere_and_before_it_voxels_stay_sensible() -> None:
    capture, exact = truth("planar")
    moved = replace(METHOD, plane_z=0.7)
    assert moved.plan(capture, GRID).plane.z == 0.7
    found = moved.phasor_field(capture, GRID).values
    # Behind the plane only what passes beside it is missing; before it, the steepest waves are.
    assert scaled_error(found[2:], exact[2:]) < 0.15
    assert scaled_error(found[:1], exact[:1]) < 0.5


def test_backprojection_agrees_at_the_acceptance_geometry() -> None:
    wall = shaped_wall("cylinder", 64)
    capture = PointScene(POINTS).simulate_capture(wall, SPOT, TimeAxis(512, 32e-12), JITTER)
    grid = Grid(np.linspace(0.18, 0.42, 9), np.linspace(-0.32, -0.08, 9), np.linspace(0.9, 1.1, 5))
    found = Hybrid(0.125, 4.24).reconstruct(capture, grid).values
    assert scaled_error(found, Backprojection(0.125, 4.24).reconstruct(capture, grid).values) < 1e-2


def test_what_cannot_be_imaged_is_refused() -> None:
    capture, _ = truth("relief")
    uneven = Grid([0.0, 0.1, 0.3], GRID.y, GRID.z)
    for method, grid, reason in (
        (METHOD, uneven, "evenly spaced along x"),
        (replace(METHOD, plane_z=0.1), GRID, "virtual plane must lie in front"),
    ):
        assert reason in find_refusal(method, capture, grid)
        with pytest.raises(InputError, match=reason):
            method.reconstruct(capture, grid)
    with pytest.raises(InputError, match="propagation must be"):
        replace(METHOD, propagation="fast")
    assert not find_refusal(METHOD, capture, GRID)


@pytest.mark.parametrize(
    "shape",
    ["cylinder", *(pytest.param(name, marks=pytest.mark.nightly) for name in ("planar", "relief"))],
)
def test_a_strict_tolerance_is_kept_at_the_acceptance_geometry(shape: str) -> None:
    """64 x 64 points over 2 m, at a wavelength of four points: within the tolerance itself."""
    wall = shaped_wall(shape, 64)
    capture = PointScene(POINTS).simulate_capture(wall, SPOT, TimeAxis(512, 32e-12), JITTER)
    grid = Grid([-0.6, -0.1, 0.4, 0.9], [-0.8, -0.2, 0.4], [0.62, 0.9, 1.4])
    method = Hybrid(wavelength=0.125, cycles=4.24, tolerance=1e-3)
    exact = compute_exact_phasor_field(capture, grid, method.pulse).values
    found = method.phasor_field(capture, grid).values
    assert np.linalg.norm(found - exact) < 1e-3 * np.linalg.norm(exact)


def test_the_rim_of_the_virtual_plane_keeps_every_tolerance() -> None:
    """A plane cut off sharply two or four Fresnel zones beside the wall errs by 1.0 and 0.6 %."""
    wall = 0.5 * shaped_wall("planar", 32)
    scene, axis = PointScene(0.5 * POINTS), TimeAxis(300, 32e-12)
    capture = scene.simulate_capture(wall, 0.5 * SPOT, axis, JITTER)
    grid = Grid([-0.3, -0.05, 0.2, 0.45], [-0.4, -0.1, 0.2], [0.31, 0.45, 0.7])
    method = Hybrid(wavelength=0.07, cycles=4.24)  # little more than two wall points
    exact = compute_exact_phasor_field(capture, grid, method.pulse).values
    for tolerance in (1e-2, 1e-3, 1e-4):
        found = replace(method, tolerance=tolerance).phasor_field(capture, grid).values
        assert np.linalg.norm(found - exact) < tolerance * np.linalg.norm(exact)
