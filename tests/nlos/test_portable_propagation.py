from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from portable_libraries import LIBRARIES, find_device, relative_error
from refusals import find_refusal
from scene_shapes import shaped_capture, shaped_wall

from nlos import Capture, Grid, Hybrid, propagate
from nlos.phasor import wall_to_plane
from nlos.phasor.arrays import ArrayLibrary
from tofclip.arrays import ComputeDevice, to_numpy
from tofclip.errors import InputError

pytestmark = pytest.mark.filterwarnings(
    "ignore::nlos.illumination.AliasingWarning"
)  # small walls are coarse ones

GRID = Grid.box((-0.7, 0.6), (-0.5, 0.5), (0.7, 1.1), (0.13, 0.11, 0.1))
METHOD = Hybrid(wavelength=0.4)
AGREEMENT = 5e-5
"""Both ways compute the same sums in single precision; measured 2e-6."""


def scene(shape: str, laser: str = "single", count: int = 12) -> Capture:
    return shaped_capture(shape, count, shaped_wall(shape, count) if laser == "confocal" else None)


@pytest.fixture
def by_transforms(monkeypatch: pytest.MonkeyPatch) -> None:
    """Walls as small as those of these tests would go by direct sums."""
    monkeypatch.setattr(wall_to_plane, "is_faster_than_direct", lambda *_: True)


@pytest.mark.usefixtures("by_transforms")
@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.parametrize(
    ("shape", "laser"), [("wavy", "single"), ("plates", "confocal"), ("cylinder", "confocal")]
)
def test_terms_of_relief_give_the_field_of_the_compiled_loops(
    shape: str, laser: str, library: str
) -> None:
    capture = scene(shape, laser)
    expected = METHOD.phasor_field(capture, GRID)
    found = METHOD.phasor_field(capture.on(find_device(library)), GRID)
    assert found.device == find_device(library)
    assert found.provenance == expected.provenance
    assert relative_error(found.values, expected.values) < AGREEMENT


@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.parametrize("laser", ["single", "confocal"])
def test_direct_sums_give_the_field_of_the_compiled_loops(
    laser: str, library: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Scattered points stand above no lattice."""
    monkeypatch.setattr(wall_to_plane, "is_faster_than_direct", lambda *_: False)
    capture = scene("relief", laser)
    wall = capture.wall.copy()
    wall[..., :2] += np.random.default_rng(1).uniform(-0.05, 0.05, (*wall.shape[:-1], 2))
    scattered = replace(capture, wall=wall, laser=wall if laser == "confocal" else capture.laser)
    found = METHOD.phasor_field(scattered.on(find_device(library)), GRID).values
    assert relative_error(found, METHOD.phasor_field(scattered, GRID).values) < AGREEMENT


def test_the_field_on_a_plane_is_that_of_the_compiled_loops(by_transforms: None) -> None:
    capture = scene("cylinder")
    plane = METHOD.plan(capture, GRID).plane
    # A lattice that suits the plane no better than the wall.
    uneven = replace(plane, x=plane.x * 1.01)
    for tolerance in (1e-2, 1e-3):
        expected = propagate(capture, uneven, METHOD.pulse, tolerance=tolerance)
        found = propagate(
            capture.on(find_device("torch")), uneven, METHOD.pulse, tolerance=tolerance
        )
        assert np.array_equal(found.wavenumbers, expected.wavenumbers)
        # At the stricter tolerance rounding decides which of the last terms is taken.
        agreement = AGREEMENT if tolerance == 1e-2 else 0.2 * tolerance
        assert relative_error(found.values, expected.values) < agreement


def test_little_memory_means_smaller_pieces(
    by_transforms: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = scene("wavy").on(find_device("array_api_strict"))
    plane = METHOD.plan(capture, GRID).plane
    whole = propagate(capture, plane, METHOD.pulse).values
    monkeypatch.setattr(ArrayLibrary, "chunk_bytes", 1 << 16)
    assert relative_error(propagate(capture, plane, METHOD.pulse).values, to_numpy(whole)) < 1e-6


@pytest.mark.parametrize("chosen", [True, False])
def test_walls_of_many_laser_spots_and_many_captures(
    chosen: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wall_to_plane, "is_faster_than_direct", lambda *_: chosen)
    first = scene("cylinder")
    walls = np.stack([first.wall, first.wall])
    lasers = np.broadcast_to(
        np.array([[0.1, 0.05, 0.02], [-0.4, 0.1, 0.05]])[:, None, None], walls.shape
    )
    first = Capture(
        np.stack([first.signal, 0.7 * first.signal], axis=1),
        walls,
        lasers,
        first.bin_width,
        first.start,
    )
    other = replace(first, signal=first.signal[:, ::-1])
    device = find_device("torch")
    plan = METHOD.plan(first.on(device), GRID)
    for one in (first, other):
        expected = METHOD.reconstruct(one, GRID)
        found = plan.image(one.on(device))
        assert relative_error(found.magnitude, expected.magnitude) < AGREEMENT
        assert found.provenance == expected.provenance


def test_propagation_in_time_is_for_numpy() -> None:
    capture = scene("cylinder").on(find_device("torch"))
    method = replace(METHOD, propagation="time")
    assert "propagation in time works on NumPy arrays only" in find_refusal(method, capture, GRID)
    with pytest.raises(InputError, match="propagation in time works on NumPy arrays"):
        propagate(capture, METHOD.plan(capture, GRID).plane, METHOD.pulse, "time")
    assert not find_refusal(method, capture.on(ComputeDevice()), GRID)
