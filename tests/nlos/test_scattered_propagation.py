"""From scattered wall points to a plane by transforms that ask for no lattice, against the direct
sum.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scene_shapes import POINTS, SPOT

import nlos.phasor.wall_to_plane_compiled
from nlos import propagate
from nlos.band import Band, VirtualPulse
from nlos.capture import TimeAxis
from nlos.phasor import wall_to_plane
from nlos.phasor.transfer import SphericalWaves
from nlos.phasor.wall_to_plane import WallBeforePlane, WallToPlanePlan, plan_transforms
from nlos.phasor.wall_to_plane_compiled import propagate_direct, propagate_low_rank
from nlos.plane import Plane
from nlos.simulate import PointScene

pytest.importorskip("finufft", reason="finufft is optional")

BAND = Band(VirtualPulse(0.25, 4.24), TimeAxis(512, 32e-12))
K = BAND.wavenumbers
WAVES = SphericalWaves(float(K[0]), float(K[1] - K[0]), K.size, continued=False)
FINE = Plane(np.linspace(-1.2, 1.3, 40), np.linspace(-1.1, 1.0, 33), 0.4)
COARSE = Plane(FINE.x[::3], FINE.y[::4], 0.42)
CLOUD = np.random.default_rng(5).uniform([-1, -0.7, 0], [1, 0.9, 0.3], (900, 3))


@cache
def phasors(count: int) -> np.ndarray:
    """Independent numbers: no symmetry of a scene hides an error."""
    random = np.random.default_rng(2)
    values = random.normal(size=(count, K.size)) + 1j * random.normal(size=(count, K.size))
    return (values * BAND.weights / BAND.weights.max()).astype(np.complex64)


def make_plan(points: np.ndarray, plane: Plane, tolerance: float) -> WallToPlanePlan:
    """Whether direct sums were faster or not."""
    wall = WallBeforePlane(points, plane, None)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(wall_to_plane, "is_faster_than_direct", lambda *_: True)
        found = plan_transforms(wall, WAVES, BAND.weights, tolerance, True)
    assert found is not None
    return found


def error_of(points: np.ndarray, plane: Plane, tolerance: float) -> float:
    values = phasors(len(points))
    found = propagate_low_rank(make_plan(points, plane, tolerance), values)
    exact = propagate_direct(points, values, plane, K)
    assert found.shape == exact.shape
    assert found.dtype == np.complex64
    return float(np.linalg.norm(found - exact) / np.linalg.norm(exact))


@pytest.mark.parametrize("plane", [FINE, COARSE], ids=["fine", "coarse"])
@pytest.mark.parametrize("tolerance", [1e-2, 1e-3])
def test_it_is_the_direct_sum_within_the_tolerance(plane: Plane, tolerance: float) -> None:
    assert error_of(CLOUD, plane, tolerance) < tolerance


def test_points_on_a_line_and_points_that_coincide() -> None:
    line = np.stack(
        [np.linspace(-1, 1, 60) ** 3, np.full(60, 0.2), np.linspace(0, 0.3, 60)], axis=1
    )
    assert error_of(line, FINE, 1e-2) < 1e-2
    assert error_of(np.concatenate([CLOUD[:80], CLOUD[:80]]), FINE, 1e-2) < 1e-2


def test_a_flat_cloud_takes_one_term() -> None:
    flat = CLOUD * [1, 1, 0]
    assert set(make_plan(flat, FINE, 1e-2).low_rank_transfer.term_counts) == {1}
    assert error_of(flat, FINE, 1e-2) < 1e-2


def test_it_is_taken_where_it_is_quicker_and_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the direct sum is, which the field shows by its accuracy."""
    capture = PointScene(POINTS).simulate_capture(CLOUD, SPOT, TimeAxis(512, 32e-12), 60e-12)
    errors = {}
    exact = propagate(capture, FINE, BAND.pulse, tolerance=1e-4).values
    for quicker, installed in ((True, True), (True, False), (False, True)):
        monkeypatch.setattr(wall_to_plane, "is_faster_than_direct", lambda *_, q=quicker: q)
        monkeypatch.setattr(
            nlos.phasor.wall_to_plane_compiled, "has_finufft", lambda there=installed: there
        )
        found = propagate(capture, FINE, BAND.pulse).values
        errors[quicker, installed] = np.linalg.norm(found - exact) / np.linalg.norm(exact)
    assert 1e-5 < errors[True, True] < 1e-2
    assert errors[True, False] == errors[False, True] == 0


def test_large_clouds_take_it_and_small_ones_do_not() -> None:
    random = np.random.default_rng(1)
    plane = Plane(np.linspace(-1, 1, 128), np.linspace(-1, 1, 128), 0.4)
    waves = SphericalWaves(40.0, 1.0, 100, continued=False)
    for count, expected in ((300, False), (20000, True)):
        points = random.uniform([-1, -1, 0], [1, 1, 0.3], (count, 3))
        wall = WallBeforePlane(points, plane, None)
        assert (plan_transforms(wall, waves, np.ones(100), 1e-2, True) is not None) == expected
    points = random.uniform([-1, -1, 0], [1, 1, 0.3], (20000, 3))
    assert plan_transforms(wall, waves, np.ones(100), 1e-4, True) is None
