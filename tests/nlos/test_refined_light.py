"""What refinement promises of known light: brightness, sharpness, and a judge that is fair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from relay_walls import planar_wall

from nlos import Capture, Grid, Hybrid, Refinement
from nlos.capture import TimeAxis
from nlos.refinement.photons import (
    HELD_OUT_FRACTION,
    CountedPhotons,
    PhotonFit,
    build_response,
    compute_beam,
    judge,
)
from nlos.refinement.time_of_flight import TimeOfFlight
from nlos.simulate import PointScene
from tofclip.solvers import Sparse

pytestmark = pytest.mark.filterwarnings("ignore::nlos.illumination.AliasingWarning")
AXIS = TimeAxis(256, 32e-12)
WALL = planar_wall(8, 8)
SIDE = np.linspace(-0.4, 0.4, 9)
GRID = Grid(SIDE, SIDE, np.linspace(0.5, 1.0, 6))


def make_fit(wall: np.ndarray, grid: Grid, albedo: np.ndarray, sigma: float = 0.0) -> PhotonFit:
    """A fit that explains the photons of this albedo, without noise, and of a background."""
    capture = Capture(np.ones((AXIS.bins, *wall.shape[:2])), wall, wall, AXIS.bin_width)
    model = TimeOfFlight(capture, grid, build_response(sigma))
    voxels, everyone = np.arange(grid.size), np.arange(len(capture.points))
    light = model.compute_light(albedo, voxels, everyone)
    counts = (1000 * light / light.sum(axis=1).mean() + 0.5).astype(np.float32)
    photons = CountedPhotons(capture, counts, np.ones(counts.shape, bool))
    return PhotonFit(photons, model, voxels, np.maximum(albedo, 1e-3), 0.0)


def point_albedo(grid: Grid, *places: tuple[float, float, float]) -> np.ndarray:
    albedo = np.zeros(grid.shape)
    for place in places:
        albedo[grid.find_nearest(place)] = 1
    return albedo.ravel()


def test_photons_set_aside_prefer_the_fit_that_is_as_bright_as_the_scene() -> None:
    fit = make_fit(WALL, GRID, point_albedo(GRID, (0.1, 0.0, 0.7), (-0.2, 0.2, 0.9)))
    fit.improve(1)
    # What the kept photons are of is what this fit expects; of all photons a tenth was set aside.
    fit.photons = replace(fit.photons, counts=fit.expect())
    held = fit.photons.counts * HELD_OUT_FRACTION / (1 - HELD_OUT_FRACTION)
    light = fit.model.compute_light(np.ones(GRID.size), fit.voxels, np.arange(64))
    albedo, background, gains = fit.albedo, fit.background, {}
    for scale in (0.8, 0.9, 0.95, 1.0, 1.05, 1.1, 1.2):
        fit.albedo, fit.background = albedo * np.float32(scale), background * np.float32(scale)
        gains[scale] = judge(fit, light, held).nats
    assert max(gains, key=lambda scale: gains[scale]) == 1.0


def test_what_voxels_pay_does_not_depend_on_the_parts_of_the_wall() -> None:
    """Subsets are quicker, and end at the same light."""
    ends = []
    for subsets in (1, 4):
        fit = make_fit(WALL, GRID, point_albedo(GRID, (0.1, 0.0, 0.7)))
        for _ in range(40):
            fit.improve(subsets, prior_weight=20.0)
        ends.append(fit)
    one, four = (float(fit.expected_photons.sum()) for fit in ends)
    free = make_fit(WALL, GRID, point_albedo(GRID, (0.1, 0.0, 0.7)))
    for _ in range(40):
        free.improve(1, prior_weight=0.0)
    paid = float(free.expected_photons.sum()) - one
    assert four == pytest.approx(one, abs=0.2 * paid)


@pytest.mark.parametrize("sigma", [0.0, 2.0])
def test_a_point_is_as_sharp_as_response_bin_and_wall_make_it(sigma: float) -> None:
    """Two rings of wall points about a point's foot, each lit where it is seen: paths of 2 *
    hypot(radius, depth), whose light falls with the fourth power of the distance.
    """
    depth, radii = 0.5, np.array([0.1, 1.0])
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(24)], axis=-1)
    wall = radii[:, np.newaxis, np.newaxis] * circle
    step = np.array([-1e-3, 0.0, 1e-3])
    grid = Grid(step, step, depth + step)
    fit = make_fit(wall, grid, point_albedo(grid, (0, 0, depth)))
    fit.albedo = point_albedo(grid, (0, 0, depth)).astype(np.float32)
    fit.response_sigma = sigma
    distance = np.hypot(radii, depth)
    weights = distance**-4 / np.sum(distance**-4)
    along = np.sqrt(np.sum(weights * (2 * depth / distance) ** 2))
    across = np.sqrt(np.sum(weights * (2 * radii / distance) ** 2) / 2)
    # An even spread over a bin has the standard deviation 1 / sqrt(12).
    path = AXIS.spacing * np.sqrt(sigma**2 + 1 / 12)
    assert compute_beam(fit) == pytest.approx(
        [path / along, path / across, path / across], rel=1e-3
    )


def test_equal_points_near_the_laser_and_far_from_it_are_equally_bright() -> None:
    """Light that reaches one of them has gone 1.8 times as far as that to the other."""
    grid = Grid.box((-0.4, 0.4), (-0.32, 0.32), (0.48, 0.92), (0.05, 0.05, 0.04))
    places = [(grid.x[9], grid.y[7], grid.z[1]), (grid.x[2], grid.y[2], grid.z[9])]
    capture = PointScene(np.array(places)).simulate_capture(
        planar_wall(14, 16), np.array([0.1, 0.0, 0.0]), TimeAxis(300, 24e-12, 0.3), 60e-12
    )
    made = Refinement(Hybrid(0.2, 4.0), Sparse(weight=2e-3, iterations=60))
    values = made.reconstruct(capture, grid).values
    sums = []
    for place in places:
        z, y, x = grid.find_nearest(place)
        sums.append(values[max(z - 1, 0) : z + 2, y - 1 : y + 2, x - 1 : x + 2].sum())
    # The model's falls with distance differ from the true ones by less than 8 %.
    assert sums[1] / sums[0] == pytest.approx(1.0, abs=0.1)
