"""What no method can image is refused by all of them, in one line that says what to do."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from refusals import find_refusal
from relay_walls import AXIS, planar_wall

from nlos import (
    Backprojection,
    Capture,
    FilteredBackprojection,
    FKMigration,
    Grid,
    Hybrid,
    LightCone,
    PlanarRSD,
    Refinement,
    TransientImaging,
)
from nlos.illumination import AliasingWarning
from tofclip.errors import InputError

LONGEST_LINE = 260
SPOT = [0.1, 0.05, 0.0]
GRID = Grid.box((-0.2, 0.2), (-0.2, 0.2), (0.4, 0.6), 0.05)

PULSED: dict[str, Callable[[float], Any]] = {
    "backprojection": lambda wavelength: Backprojection(wavelength),
    "rsd": lambda wavelength: PlanarRSD(wavelength),
    "hybrid": lambda wavelength: Hybrid(wavelength),
    "refinement": lambda wavelength: Refinement(Hybrid(wavelength)),
    "gate": lambda wavelength: TransientImaging(Hybrid(wavelength)),
}
PLAIN = {"filtered": FilteredBackprojection(0.05), "light cone": LightCone(), "fk": FKMigration()}
EVERY = {**{name: make(0.4) for name, make in PULSED.items()}, **PLAIN}
every_method = pytest.mark.parametrize("method", EVERY.values(), ids=EVERY.keys())
pulsed_methods = pytest.mark.parametrize("make", PULSED.values(), ids=PULSED.keys())


def seen(method: Any, wall: np.ndarray | None = None) -> Capture:
    """A dark capture, confocal for those that need it."""
    wall = planar_wall(9, 11) if wall is None else wall
    confocal = isinstance(method, LightCone | FKMigration)
    return Capture(
        np.zeros((AXIS.bins, *wall.shape[:-1])),
        wall,
        wall if confocal else SPOT,
        AXIS.bin_width,
        AXIS.start,
    )


def imaging(method: Any) -> Callable[[Capture, Grid], Any]:
    """What a user calls to have an image."""
    if isinstance(method, TransientImaging):
        return lambda capture, grid: method.image_gate(capture, grid, 1e-9, 2e-9)
    return lambda capture, grid: method.reconstruct(capture, grid)


def refusal(method: Any, capture: Capture, grid: Grid) -> str:
    """The reason given, which has to be one line, and the same whether asked or not."""
    with pytest.raises(InputError) as caught:
        imaging(method)(capture, grid)
    reason = str(caught.value)
    if hasattr(method, "plan"):
        assert find_refusal(method, capture, grid) == reason
    assert "\n" not in reason
    assert len(reason) < LONGEST_LINE
    return str(reason)


@every_method
def test_a_single_wall_point(method: Any) -> None:
    assert "one wall point cannot locate anything" in refusal(
        method, seen(method, planar_wall(9, 11)[:1, :1]), GRID
    )


@every_method
def test_a_grid_behind_the_wall(method: Any) -> None:
    behind = Grid(GRID.x, GRID.y, GRID.z - 0.8)
    assert "behind the hindmost wall point" in refusal(method, seen(method), behind)


@every_method
def test_ten_gigabytes(method: Any) -> None:
    # 10 GiB at 12 bytes a voxel, evenly spaced, within the record.
    side = round((10 * 2**30 / 12) ** (1 / 3))
    large = Grid(
        np.linspace(-0.2, 0.2, side), np.linspace(-0.2, 0.2, side), np.linspace(0.4, 0.6, side)
    )
    reason = refusal(method, seen(method), large)
    assert "10.0 GiB" in reason
    assert "use larger voxels or a smaller box" in reason


@pulsed_methods
def test_an_empty_band(make: Callable[[float], Any]) -> None:
    method = make(2 * AXIS.spacing)
    reason = refusal(method, seen(method), Grid(GRID.x, GRID.y, [0.4]))
    assert reason.startswith("empty band: time bins of")
    assert "use more than" in reason


@pulsed_methods
def test_a_wall_that_is_too_coarse_is_warned_of_in_one_line(make: Callable[[float], Any]) -> None:
    method, grid = make(0.15), Grid.box((0, 0.05), (0, 0.05), (0.4, 0.45), 0.025)
    capture = seen(method)
    lit = Capture(
        np.ones_like(capture.signal), capture.wall, capture.laser, AXIS.bin_width, AXIS.start
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        imaging(method)(lit, grid)
    (warning,) = caught
    assert warning.category is AliasingWarning
    message = str(warning.message)
    assert "\n" not in message
    assert len(message) < LONGEST_LINE
    assert "use points at most" in message


def test_too_many_voxels_for_an_iteration() -> None:
    # A volume of 3 GiB is imaged at once, but not with the dozen volumes that a solver holds.
    side = round((3 * 2**30 / 12) ** (1 / 3))
    large = Grid(
        np.linspace(-0.2, 0.2, side), np.linspace(-0.2, 0.2, side), np.linspace(0.4, 0.6, side)
    )
    method = EVERY["refinement"]
    assert not find_refusal(Hybrid(0.4), seen(method), large)
    assert "to refine" in refusal(method, seen(method), large)


@pytest.mark.parametrize(
    ("laser", "message"),
    [
        ([0.1, 0.05, -1.0], "the laser spot lies 1 m behind the hindmost wall point"),
        (
            planar_wall(9, 11) - [0, 0, 1.0],
            "the laser spot lies 1 m behind the hindmost wall point",
        ),
        ([0.1, np.nan, 0.0], "the laser spot must be finite"),
    ],
)
def test_a_laser_behind_the_wall(laser: Any, message: str) -> None:
    wall = planar_wall(9, 11)
    with pytest.raises(InputError, match=message) as caught:
        Capture(np.zeros((AXIS.bins, *wall.shape[:-1])), wall, laser, AXIS.bin_width, AXIS.start)
    assert "\n" not in str(caught.value)


def test_samples_that_are_no_numbers() -> None:
    wall, signal = planar_wall(9, 11), np.zeros((AXIS.bins, 9, 11))
    signal[3, 2, 1] = np.nan
    with pytest.raises(
        InputError, match="1 samples of the signal are NaN or infinite; set them to 0"
    ):
        Capture(signal, wall, SPOT, AXIS.bin_width, AXIS.start)
