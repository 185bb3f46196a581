"""From a wall of any shape to a plane: directly, in time, and by Fourier transforms of few terms, all
against the definition or the direct sum; and the plane that the hybrid method chooses.
"""

from functools import cache

import numpy as np
import pytest
from scenes import (
    SHAPED_JITTER,
    SHAPED_POINTS,
    SHAPED_SPOT,
    relative_error,
    see,
    see_shaped,
)

import nlos.phasor.propagate
from nlos import propagate
from nlos.band import Band, VirtualPulse
from nlos.capture import TimeAxis
from nlos.phasor import wall_to_plane
from nlos.phasor.propagate import (
    estimate_strength,
    propagate_direct,
    propagate_low_rank,
)
from nlos.phasor.transfer import SphericalWaves
from nlos.phasor.wall_to_plane import WallBeforePlane, plan_transforms
from nlos.plane import Plane
from nlos.simulate import WALLS, build_relay_wall

PULSE = VirtualPulse(0.25, 4.24)
BAND = Band(PULSE, TimeAxis(512, 32e-12))
K = BAND.wavenumbers
WAVES = SphericalWaves(float(K[0]), float(K[1] - K[0]), K.size, continued=False)
PLANE = Plane(np.linspace(-1.4, 1.5, 14), np.linspace(-1.5, 1.3, 11), 0.4)
STEP = 2 / 31  # of walls with 32 points along a side
FITTING = Plane(STEP * np.arange(-20, 24), STEP * np.arange(-21, 18), 0.4)
OTHER = Plane(np.linspace(-1.3, 1.1, 37), np.linspace(-0.8, 1.5, 29), 0.42)
FINE = Plane(np.linspace(-1.2, 1.3, 40), np.linspace(-1.1, 1.0, 33), 0.4)
TOLERANCES = (1e-2, 3e-3, 1e-3, 5e-4)


@pytest.fixture
def always(monkeypatch):
    """Walls as small as those of these tests would go by direct sums."""
    monkeypatch.setattr(wall_to_plane, "is_faster_than_direct", lambda *_: True)


def definition(capture, plane=PLANE):
    """The field on the plane, summed term by term in float64."""
    band = Band(PULSE, capture.axis)
    legs = 2 if len(capture.lasers) > 1 else 1
    phasors = band.compute_phasors(capture.traces().astype(np.float64))
    distance = np.linalg.norm(plane.points[..., None, :] - capture.points, axis=-1)[..., None]
    waves = np.exp(1j * legs * distance * band.wavenumbers) / distance
    return np.einsum("yxpk,pk->yxk", waves, phasors)


@pytest.mark.parametrize("shape", WALLS)
def test_the_spectral_field_is_the_definition(shape):
    capture = see_shaped(shape, 17)
    field = propagate(capture, PLANE, PULSE)
    assert field.values.shape == (11, 14, field.wavenumbers.size)
    assert field.values.dtype == np.complex64
    # float32: distances of 3 m at 42 rad/m are good to 2e-5, and sums of 289 terms to 1e-6.
    assert relative_error(field.values, definition(capture)) < 2e-5
    corner = propagate(capture, Plane(PLANE.x[:2], PLANE.y[:2], PLANE.z), PULSE).values
    assert relative_error(corner, field.values[:2, :2]) < 4e-5  # fewer than the loops take at once


def test_confocal_waves_run_at_doubled_wavenumbers():
    capture = see_shaped("wavy", 13, "confocal")
    field = propagate(capture, PLANE, PULSE)
    assert field.wavenumbers == pytest.approx(2 * Band(PULSE, capture.axis).wavenumbers)
    assert relative_error(field.values, definition(capture)) < 4e-5


def error_in_time(shape, count, laser, bin_width):
    axis = TimeAxis(round(512 * 32e-12 / bin_width), bin_width)
    capture = see([[0.2, 0.1, 1.0]], build_relay_wall(shape, count), laser, axis, SHAPED_JITTER)
    return relative_error(propagate(capture, PLANE, PULSE, "time").values, definition(capture))


def test_propagation_in_time_arrives_at_the_same_field_and_grows_exact_with_finer_bins():
    for laser in (SHAPED_SPOT, "confocal"):
        # Linear interpolation loses (k * bin)^2 / 12 in the mean: 1.2 % at the carrier, 4 % at the
        # shortest wave.
        assert 1e-3 < error_in_time("relief", 13, laser, 16e-12) < 2e-2
    errors = [error_in_time("cylinder", 9, SHAPED_SPOT, width) for width in (32e-12, 16e-12, 8e-12)]
    # Errors of linear interpolation fall with the square of the bins' width.
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.2)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.2)


# --- by Fourier transforms


@cache
def phasors(count):
    """Independent numbers: no symmetry of a scene hides an error."""
    random = np.random.default_rng(2)
    values = random.normal(size=(count, K.size)) + 1j * random.normal(size=(count, K.size))
    return (values * BAND.weights / BAND.weights.max()).astype(np.complex64)


def points_of(shape, count=32):
    wall = build_relay_wall(shape, count)
    return wall[np.isfinite(wall).all(axis=-1)]


def make_plan(points, plane, tolerance, strength=BAND.weights):
    wall = WallBeforePlane.of(points, plane)
    found = plan_transforms(wall, WAVES, strength, tolerance, scattered=wall.lattice is None)
    assert found is not None
    return found


def list_clouds():
    """Points, planes and tolerances; the first on a lattice, which may repeat its spectrum."""
    for shape in WALLS:
        yield from ((points_of(shape), plane, TOLERANCES) for plane in (FITTING, OTHER))
    # Waves that fade are still there.
    yield points_of("planar"), Plane(OTHER.x, OTHER.y, 0.05), TOLERANCES
    sparse, coarse = Plane(FITTING.x[::4], FITTING.y[::3], FITTING.z), points_of("wavy", 11)
    # Points up to two wavelengths apart, on either side.
    yield from ((coarse, FITTING, (1e-2,)), (coarse, sparse, (1e-2,)))
    yield points_of("wavy"), sparse, (1e-2,)
    # In any order, some missing.
    yield np.random.default_rng(7).permutation(points_of("relief"))[:900], FITTING, (1e-2,)


def list_scattered():
    for plane in (FINE, Plane(FINE.x[::3], FINE.y[::4], 0.42)):
        yield CLOUD, plane, (1e-2, 1e-3)
    line = [np.linspace(-1, 1, 60) ** 3, np.full(60, 0.2), np.linspace(0, 0.3, 60)]
    yield np.stack(line, axis=1), FINE, (1e-2,)
    yield np.concatenate([CLOUD[:80], CLOUD[:80]]), FINE, (1e-2,)  # points that coincide
    yield CLOUD * [1, 1, 0], FINE, (1e-2,)


CLOUD = np.random.default_rng(5).uniform([-1, -0.7, 0], [1, 0.9, 0.3], (900, 3))
LATTICES, SCATTERED = list(list_clouds()), list(list_scattered())


@pytest.mark.usefixtures("always")
@pytest.mark.parametrize("number", range(len(LATTICES) + len(SCATTERED)))
def test_it_is_the_direct_sum_within_the_tolerance(number):
    points, plane, tolerances = [*LATTICES, *SCATTERED][number]
    if number >= len(LATTICES):
        pytest.importorskip("finufft", reason="finufft is optional")
    values = phasors(len(points))
    exact = propagate_direct(points, values, plane, K)
    for tolerance in tolerances:
        found = propagate_low_rank(make_plan(points, plane, tolerance), values)
        assert found.dtype == np.complex64
        assert relative_error(found, exact) < tolerance


def test_a_plane_nearer_than_half_a_step_of_the_wall_is_reached_directly(always):
    wall = WallBeforePlane.of(points_of("planar"), Plane(OTHER.x, OTHER.y, 0.45 * STEP))
    assert plan_transforms(wall, WAVES, BAND.weights, 1e-2) is None


def test_silence_and_a_single_frequency_pass(always):
    points = points_of("relief")
    values = np.zeros_like(phasors(len(points)))
    assert estimate_strength(values).tolist() == [1.0] * K.size
    assert not propagate_low_rank(make_plan(points, FITTING, 1e-2), values).any()
    values[:, 9] = phasors(len(points))[:, 9]
    assert np.flatnonzero(estimate_strength(values)).tolist() == [9]
    plan = make_plan(points, FITTING, 1e-2, estimate_strength(values))
    exact = propagate_direct(points, values, FITTING, K)
    assert relative_error(propagate_low_rank(plan, values), exact) < 1e-2


def test_scattered_points_take_it_where_it_is_faster_and_installed(
    monkeypatch,
):
    """Else the direct sum is, which the field shows by its accuracy."""
    pytest.importorskip("finufft", reason="finufft is optional")
    capture = see(SHAPED_POINTS, CLOUD, SHAPED_SPOT, TimeAxis(512, 32e-12), SHAPED_JITTER)
    exact = propagate(capture, FINE, PULSE, tolerance=1e-4).values
    errors = {}
    for faster, installed in ((True, True), (True, False), (False, True)):
        monkeypatch.setattr(wall_to_plane, "is_faster_than_direct", lambda *_, f=faster: f)
        monkeypatch.setattr(nlos.phasor.propagate, "has_finufft", lambda there=installed: there)
        errors[faster, installed] = relative_error(propagate(capture, FINE, PULSE).values, exact)
    assert 1e-5 < errors[True, True] < 1e-2
    assert errors[True, False] == errors[False, True] == 0
