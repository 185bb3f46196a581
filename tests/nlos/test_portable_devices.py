"""Nothing hides on the processor: a device of array-api-strict that mixes with no other, and gives
NumPy nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from portable_libraries import relative_error
from relay_walls import AXIS, HIDDEN, JITTER, curved_wall, planar_wall

import nlos.phasor.wall_to_plane_arrays
from nlos import Backprojection, Capture, Grid, Hybrid, PlanarRSD
from nlos.backprojection import Weighting
from nlos.phasor import wall_to_plane
from nlos.preparation import rebin_capture, remove_first_bounce
from nlos.simulate import PointScene
from tofclip.arrays import ComputeDevice

pytestmark = pytest.mark.filterwarnings(
    "ignore::nlos.illumination.AliasingWarning"
)  # small walls are coarse ones

GRID = Grid(np.arange(-0.3, 0.3, 0.1), np.arange(-0.2, 0.3, 0.1), [0.5, 0.6, 0.75])
SPOT = np.array([0.12, 0.05, 0.02])

strict = pytest.importorskip("array_api_strict")
OTHER_DEVICE = ComputeDevice("array_api_strict", strict.Device("device1"))


def brought_here(array: Any) -> np.ndarray:
    return np.asarray(array.to_device(strict.Device("CPU_DEVICE")))


@pytest.fixture
def fetched(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Sizes of what is fetched on purpose: the sample of phasors that terms are chosen by."""
    sizes: list[int] = []

    def fetch(array: Any) -> np.ndarray:
        sizes.append(array.size)
        return brought_here(array)

    monkeypatch.setattr(nlos.phasor.wall_to_plane_arrays, "to_numpy", fetch)
    return sizes


def seen(wall: np.ndarray, laser: np.ndarray) -> Capture:
    capture = PointScene([HIDDEN]).simulate_capture(wall, laser, AXIS, JITTER)
    masked = wall.copy()
    masked[2, 3] = np.nan
    return replace(capture, wall=masked)


def test_the_device_is_as_strict_as_it_is_meant_to_be() -> None:
    there = OTHER_DEVICE.put(np.ones(3, np.float32))
    with pytest.raises(ValueError, match="different devices"):
        _ = there + strict.ones(3, dtype=strict.float32)
    with pytest.raises(RuntimeError, match="convert array on the 'array_api_strict"):
        np.asarray(there)


@pytest.mark.parametrize(
    ("image", "laser"),
    [
        (PlanarRSD(0.2).phasor_field, SPOT),
        (PlanarRSD(0.2).phasor_field, None),
        (Backprojection(0.2, weighting=Weighting(1, 1)).phasor_field, SPOT),
    ],
)
def test_planar_walls(image: Callable[[Capture, Grid], Any], laser: np.ndarray | None) -> None:
    wall = planar_wall(9, 11)
    capture = seen(wall, wall if laser is None else laser)
    found = image(capture.on(OTHER_DEVICE), GRID).values
    assert relative_error(brought_here(found), image(capture, GRID).values) < 2e-5


@pytest.mark.parametrize("layered", [True, False])
def test_curved_walls(layered: bool, monkeypatch: pytest.MonkeyPatch, fetched: list[int]) -> None:
    monkeypatch.setattr(wall_to_plane, "is_faster_than_direct", lambda *_: layered)
    capture, method = seen(curved_wall(9, 11), SPOT), Hybrid(0.3)
    found = method.phasor_field(capture.on(OTHER_DEVICE), GRID).values
    assert relative_error(brought_here(found), method.phasor_field(capture, GRID).values) < 5e-5
    assert len(fetched) == 1
    assert fetched[0] < 1024 * 100


def test_preparation() -> None:
    capture = seen(planar_wall(9, 11), SPOT)
    for prepare in (lambda one: rebin_capture(one, 2), lambda one: remove_first_bounce(one, 0.1)):
        np.testing.assert_allclose(
            brought_here(prepare(capture.on(OTHER_DEVICE)).signal),
            prepare(capture).signal,
            rtol=1e-6,
            atol=1e-7,
        )
