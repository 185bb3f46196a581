from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_shapes import SHAPES, SPOT, shaped_capture, shaped_wall

from nlos import Capture, Grid, propagate
from nlos.band import Band, VirtualPulse
from nlos.capture import TimeAxis
from nlos.phasor import wall_to_plane
from nlos.phasor.transfer import SphericalWaves
from nlos.phasor.wall_to_plane import WallBeforePlane, plan_transforms
from nlos.plane import Plane, WallLattice, choose_virtual_plane
from nlos.simulate import PointScene
from tofclip.errors import InputError

PULSE = VirtualPulse(0.25, 4.24)
PLANE = Plane(np.linspace(-1.4, 1.5, 14), np.linspace(-1.5, 1.3, 11), 0.4)


def definition(capture: Capture, plane: Plane, pulse: VirtualPulse) -> np.ndarray:
    """The field on the plane, summed term by term in float64."""
    band = Band(pulse, capture.axis)
    passes = 2 if len(capture.lasers) > 1 else 1
    phasors = band.compute_phasors(capture.traces().astype(np.float64))
    distance = np.linalg.norm(plane.points[..., np.newaxis, :] - capture.points, axis=-1)
    waves = (
        np.exp(1j * passes * distance[..., np.newaxis] * band.wavenumbers)
        / distance[..., np.newaxis]
    )
    return np.einsum("yxpk,pk->yxk", waves, phasors)


def relative_error(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize("shape", SHAPES)
def test_the_spectral_way_is_the_direct_sum(shape: str) -> None:
    capture = shaped_capture(shape, 17)
    field = propagate(capture, PLANE, PULSE)
    assert field.values.shape == (11, 14, field.wavenumbers.size)
    assert field.values.dtype == np.complex64
    # float32: distances of 3 m at 42 rad/m are good to 2e-5, and sums of 289 terms to 1e-6.
    assert relative_error(field.values, definition(capture, PLANE, PULSE)) < 2e-5


def test_confocal_waves_run_at_doubled_wavenumbers() -> None:
    wall = shaped_wall("wavy", 13)
    capture = shaped_capture("wavy", 13, wall)
    field = propagate(capture, PLANE, PULSE)
    assert field.wavenumbers == pytest.approx(2 * Band(PULSE, capture.axis).wavenumbers)
    assert relative_error(field.values, definition(capture, PLANE, PULSE)) < 4e-5


@pytest.mark.parametrize("confocal", [False, True])
def test_the_way_in_time_arrives_at_the_same_field(confocal: bool) -> None:
    wall = shaped_wall("relief", 13)
    fine = TimeAxis(1024, 16e-12)
    capture = PointScene([[0.2, 0.1, 1.0]]).simulate_capture(
        wall, wall if confocal else SPOT, fine, 60e-12
    )
    exact = definition(capture, PLANE, PULSE)
    error = relative_error(propagate(capture, PLANE, PULSE, "time").values, exact)
    # Linear interpolation loses (k * bin)^2 / 12 in the mean: 1.2 % at the carrier, 4 % at the
    # shortest wave.
    assert 1e-3 < error < 2e-2


def test_the_way_in_time_grows_exact_with_finer_bins() -> None:
    wall = shaped_wall("cylinder", 9)
    errors = []
    for bin_width in (32e-12, 16e-12, 8e-12):
        axis = TimeAxis(round(512 * 32e-12 / bin_width), bin_width)
        capture = PointScene([[0.2, 0.1, 1.0]]).simulate_capture(wall, SPOT, axis, 60e-12)
        field = propagate(capture, PLANE, PULSE, "time")
        errors.append(relative_error(field.values, definition(capture, PLANE, PULSE)))
    # Errors of linear interpolation fall with the square of the bins' width.
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.2)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.2)


@pytest.mark.parametrize("propagation", ["spectral", "time"])
def test_pieces_of_a_wall_add_up(propagation: str) -> None:
    capture = shaped_capture("plates", 15)
    left, right = (
        replace(capture, wall=np.where((capture.wall[..., :1] < 0) == side, capture.wall, np.nan))
        for side in (True, False)
    )
    whole, *parts = (
        propagate(some, PLANE, PULSE, propagation).values for some in (capture, left, right)
    )
    assert relative_error(parts[0] + parts[1], whole) < 1e-5


def test_the_number_of_points_on_the_plane_does_not_matter() -> None:
    """Fewer than the loops take at once."""
    capture = shaped_capture("relief", 7)
    whole = propagate(capture, PLANE, PULSE).values
    corner = Plane(PLANE.x[:2], PLANE.y[:2], PLANE.z)
    assert (
        relative_error(propagate(capture, corner, PULSE).values, whole[:2, :2]) < 4e-5
    )  # float32 distances


def test_the_virtual_plane_keeps_its_distance_and_samples_the_shortest_wave() -> None:
    points = shaped_wall("relief", 9).reshape(-1, 3)
    small = Grid([-0.5, 0.5], [-0.5, 0.5], [1.0])
    for shortest, gap in ((0.01, 0.05), (0.07, 0.07), (0.5, 0.1)):
        plane = choose_virtual_plane(
            points, small, SphericalWaves(2 * np.pi / shortest, 0.0, 1, True), 0.0
        )
        assert plane.z == pytest.approx(points[:, 2].max() + gap)
        assert max(plane.steps) <= shortest / 2
        # All straight ways to voxels within the wall's outline pass within it too.
        assert (plane.x[0], plane.x[-1], plane.y[-1]) == pytest.approx((-1, 1, 1))
    waves = SphericalWaves(2 * np.pi / 0.07, 0.0, 1, True)
    assert choose_virtual_plane(points, small, waves, 1.0, 0.9).z == 0.9
    gap = 0.07 + np.ptp(points[:, 2])
    roomy = choose_virtual_plane(points, small, waves, 2.0)
    assert roomy.x[-1] == pytest.approx(1 + 2 * np.sqrt(0.07 * gap))
    plane_z = points[:, 2].max() + 0.07
    wide = choose_virtual_plane(points, Grid([-3, 3], [-0.5, 0.5], [plane_z + gap]), waves, 0.0)
    assert wide.x[-1] == pytest.approx(2)  # half way to a voxel at 3 m


@pytest.mark.parametrize("shortest", [0.09, 0.52, 2.1])
def test_the_virtual_plane_suits_the_walls_lattice(
    shortest: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Finer and coarser than its points, 0.25 m apart: Fourier transforms lead there and back."""
    monkeypatch.setattr(wall_to_plane, "is_faster_than_direct", lambda *_: True)
    points = shaped_wall("relief", 9).reshape(-1, 3)
    waves = SphericalWaves(2 * np.pi / shortest, 0.0, 1, True)
    box = Grid([-0.5, 0.5], [-0.5, 0.5], [1.0])
    lattice = WallLattice.find(points)
    assert lattice is not None
    plane = choose_virtual_plane(points, box, waves, 1.0, wall=lattice)
    free = choose_virtual_plane(points, box, waves, 1.0)
    for axis, unfitted in ((plane.x, free.x), (plane.y, free.y)):
        step = axis[1] - axis[0]
        ratio = max(0.25 / step, step / 0.25)
        assert ratio == pytest.approx(round(ratio), abs=1e-9)
        assert shortest / 4 < step <= shortest / 2
        assert axis[0] <= unfitted[0] + 1e-9
        assert axis[-1] >= unfitted[-1] - 1e-9
        assert axis[0] + axis[-1] == pytest.approx(unfitted[0] + unfitted[-1], abs=1e-9)
    plan = plan_transforms(WallBeforePlane(points, plane, lattice), waves, np.ones(1), 1e-2)
    assert plan is not None
    assert plan.plane_lattice == tuple(map(round, plan.plane_lattice))


def test_the_field_fades_towards_the_rim_beside_the_straight_ways_only() -> None:
    points = shaped_wall("planar", 9).reshape(-1, 3)
    waves = SphericalWaves(2 * np.pi / 0.07, 0.0, 1, True)
    plane = choose_virtual_plane(points, Grid([-0.5, 1.5], [-0.5, 0.5], [0.5]), waves, 2.0)
    weights = plane.weights / np.prod(plane.steps)
    assert weights.shape == plane.shape
    assert weights.max() == pytest.approx(1)
    inside = weights[:, (plane.x > -1) & (plane.x < 1.07)][np.abs(plane.y) < 1]
    np.testing.assert_allclose(inside, 1, rtol=1e-6)
    assert weights[0].max() < 0.05  # half a step from where nothing is left
    # Voxels beside the wall along x ask for more room there than along y.
    assert plane.fade[1] > plane.fade[0] == pytest.approx(0.75 * 2 * 0.07)
    sharp = choose_virtual_plane(points, Grid([-0.5, 0.5], [-0.5, 0.5], [0.5]), waves, 0.0)
    np.testing.assert_allclose(sharp.weights, np.prod(sharp.steps), rtol=1e-6)


def test_what_cannot_be_propagated_is_refused() -> None:
    capture = shaped_capture("relief", 7)
    with pytest.raises(InputError, match="in front of the wall"):
        propagate(capture, Plane(PLANE.x, PLANE.y, 0.2), PULSE)
    with pytest.raises(InputError, match="one of spectral, time"):
        propagate(capture, PLANE, PULSE, "magic")  # type: ignore[arg-type]
    walls = np.stack([capture.wall, capture.wall])
    spots = np.broadcast_to(np.array([[0.1, 0, 0], [0.3, 0, 0]])[:, None, None], walls.shape)
    several = replace(
        capture, wall=walls, laser=spots, signal=np.stack([capture.signal] * 2, axis=1)
    )
    with pytest.raises(InputError, match="2 laser spots"):
        propagate(several, PLANE, PULSE)
    with pytest.raises(InputError, match="empty band"):
        propagate(capture, PLANE, VirtualPulse(1e-3))
