"""From walls in relief to a plane by Fourier transforms, against the direct sum."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scene_shapes import SHAPES, shaped_wall

from nlos.band import Band, VirtualPulse
from nlos.capture import TimeAxis
from nlos.phasor import wall_to_plane
from nlos.phasor.depth_steps import find_fast_length
from nlos.phasor.transfer import SphericalWaves
from nlos.phasor.wall_to_plane import (
    WallBeforePlane,
    WallToPlanePlan,
    find_common_period,
    plan_transforms,
)
from nlos.phasor.wall_to_plane_compiled import (
    estimate_strength,
    propagate_direct,
    propagate_low_rank,
)
from nlos.plane import Plane

BAND = Band(VirtualPulse(0.25, 4.24), TimeAxis(512, 32e-12))
K = BAND.wavenumbers
WAVES = SphericalWaves(float(K[0]), float(K[1] - K[0]), K.size, continued=False)
STEP = 2 / 31  # of walls with 32 points along a side
FITTING = Plane(STEP * np.arange(-20, 24), STEP * np.arange(-21, 18), 0.4)
OTHER = Plane(np.linspace(-1.3, 1.1, 37), np.linspace(-0.8, 1.5, 29), 0.42)


def points_of(wall: np.ndarray) -> np.ndarray:
    return wall[np.isfinite(wall).all(axis=-1)]


@cache
def phasors(count: int) -> np.ndarray:
    """Independent numbers: no symmetry of a scene hides an error."""
    random = np.random.default_rng(2)
    values = random.normal(size=(count, K.size)) + 1j * random.normal(size=(count, K.size))
    return (values * BAND.weights / BAND.weights.max()).astype(np.complex64)


def make_plan(points: np.ndarray, plane: Plane, tolerance: float) -> WallToPlanePlan:
    found = plan_transforms(WallBeforePlane.of(points, plane), WAVES, BAND.weights, tolerance)
    assert found is not None
    return found


@pytest.fixture
def always(monkeypatch: pytest.MonkeyPatch) -> None:
    """Walls as small as those of these tests would go by direct sums."""
    monkeypatch.setattr(wall_to_plane, "is_faster_than_direct", lambda *_: True)


def relative_error(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@pytest.mark.usefixtures("always")
@pytest.mark.parametrize("plane", [FITTING, OTHER], ids=["fitting", "other"])
@pytest.mark.parametrize("shape", SHAPES)
def test_it_is_the_direct_sum_within_the_tolerance(shape: str, plane: Plane) -> None:
    points = points_of(shaped_wall(shape, 32))
    exact = propagate_direct(points, phasors(len(points)), plane, K)
    for tolerance in (1e-2, 1e-3):
        found = propagate_low_rank(make_plan(points, plane, tolerance), phasors(len(points)))
        assert found.dtype == np.complex64
        assert relative_error(found, exact) < tolerance


@pytest.mark.usefixtures("always")
def test_few_depths_take_few_terms() -> None:
    """One for a planar wall, two for two plates, whatever their distance; more for a smooth relief."""
    counts = {
        shape: make_plan(
            points_of(shaped_wall(shape, 32)), FITTING, 1e-2
        ).low_rank_transfer.term_counts
        for shape in SHAPES
    }
    assert set(counts["planar"]) == {1}
    assert max(counts["plates"]) == 2
    strict = make_plan(
        points_of(shaped_wall("relief", 32)), FITTING, 1e-3
    ).low_rank_transfer.term_counts
    assert sum(counts["cylinder"]) < sum(counts["relief"]) < sum(strict)


@pytest.mark.usefixtures("always")
def test_any_order_and_missing_points() -> None:
    random = np.random.default_rng(7)
    points = random.permutation(shaped_wall("relief", 32).reshape(-1, 3))[:900]
    found = propagate_low_rank(make_plan(points, FITTING, 1e-2), phasors(900))
    assert relative_error(found, propagate_direct(points, phasors(900), FITTING, K)) < 1e-2


@pytest.mark.usefixtures("always")
def test_coarse_walls_and_coarse_planes_repeat_their_spectra() -> None:
    """Points up to two wavelengths apart, on either side."""
    coarse = shaped_wall("wavy", 11).reshape(-1, 3)
    sparse = Plane(FITTING.x[::4], FITTING.y[::3], FITTING.z)
    fine = shaped_wall("wavy", 32).reshape(-1, 3)
    for points, plane in ((coarse, FITTING), (coarse, sparse), (fine, sparse)):
        values = phasors(len(points))
        found = propagate_low_rank(make_plan(points, plane, 1e-2), values)
        assert relative_error(found, propagate_direct(points, values, plane, K)) < 1e-2


@pytest.mark.usefixtures("always")
def test_it_is_linear() -> None:
    points = points_of(shaped_wall("cylinder", 32))
    plan, random = make_plan(points, FITTING, 1e-2), np.random.default_rng(1)
    first, second = (
        phasors(len(points)),
        random.normal(size=(len(points), K.size)).astype(np.complex64),
    )
    both = propagate_low_rank(plan, 2 * first - 3j * second)
    assert (
        relative_error(
            2 * propagate_low_rank(plan, first) - 3j * propagate_low_rank(plan, second), both
        )
        < 1e-5
    )


@pytest.mark.usefixtures("always")
def test_silence_and_a_single_frequency_pass() -> None:
    points = points_of(shaped_wall("relief", 32))
    values = np.zeros_like(phasors(len(points)))
    assert estimate_strength(values).tolist() == [1.0] * K.size
    assert not propagate_low_rank(make_plan(points, FITTING, 1e-2), values).any()
    values[:, 9] = phasors(len(points))[:, 9]
    assert np.flatnonzero(estimate_strength(values)).tolist() == [9]
    plan = plan_transforms(
        WallBeforePlane.of(points, FITTING), WAVES, estimate_strength(values), 1e-2
    )
    assert plan is not None
    assert (
        relative_error(
            propagate_low_rank(plan, values), propagate_direct(points, values, FITTING, K)
        )
        < 1e-2
    )


@pytest.mark.usefixtures("always")
def test_scattered_points_stand_above_no_lattice() -> None:
    random = np.random.default_rng(3)
    scattered = random.uniform([-1, -1, 0], [1, 1, 0.2], (100, 3))
    twice = np.concatenate([shaped_wall("wavy", 5).reshape(-1, 3)] * 2)
    for points in (scattered, twice):
        wall = WallBeforePlane.of(points, FITTING)
        assert plan_transforms(wall, WAVES, BAND.weights, 1e-2) is None


def test_large_problems_take_it_and_small_or_strict_ones_do_not() -> None:
    large, small = (shaped_wall("relief", count).reshape(-1, 3) for count in (64, 9))
    plane = Plane(np.linspace(-1, 1, 64), np.linspace(-1, 1, 64), 0.4)
    for points, tolerance, taken in (
        (large, 1e-2, True),
        (small, 1e-2, False),
        (large, 1e-4, False),
    ):
        wall = WallBeforePlane.of(points, plane)
        plan = plan_transforms(wall, WAVES, BAND.weights, tolerance)
        assert (plan is not None) == taken


def test_periods_suit_wall_and_plane() -> None:
    assert [find_fast_length(n) for n in (3, 17, 100, 129, 145, 161, 300, 321, 385, 481, 641)] == [
        16, 32, 128, 144, 160, 192, 320, 384, 400, 512, 1024,
    ]  # fmt: skip
    assert find_common_period(4.9, 0.1, 0.1, 30) == (64, 64.0)
    assert find_common_period(4.9, 0.1, 0.2, 30) == (64, 32.0)
    assert find_common_period(4.9, 0.1, 0.12, 30) == (64, pytest.approx(64 / 1.2))
    assert find_common_period(3.9, 0.1, 0.12, 30) == (48, 40.0)
    length, places = find_common_period(4.9, 0.1, 0.0777, 30)
    assert length == 64
    assert places == pytest.approx(6.4 / 0.0777)
