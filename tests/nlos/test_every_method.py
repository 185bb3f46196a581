"""What all methods promise alike: masked points, the order of points, linearity, progress and
history; and what none can image is refused by all of them, in one line that says what to do.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from refusals import find_refusal
from relay_walls import AXIS, HIDDEN, JITTER, planar_wall

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
from nlos.simulate import PointScene
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


PULSE = {"wavelength_m": 0.125, "cycles": 3.0}
SETTINGS: dict[str, tuple[Any, dict[str, Any]]] = {
    "backprojection": (Backprojection(0.125), PULSE),
    "rsd": (PlanarRSD(0.125), {**PULSE, "tolerance": 1e-2}),
    "hybrid": (
        Hybrid(0.125, plane_z=0.1),
        {**PULSE, "tolerance": 1e-2, "propagation": "spectral", "plane_z_m": 0.1},
    ),
    "filtered backprojection": (FilteredBackprojection(0.05), {"sigma_m": 0.05}),
    "lightcone": (LightCone(), {"falloff": 4.0, "signal_to_noise": 0.8}),
    "fk": (FKMigration(), {"falloff": 4.0}),
}
"""Methods and what their volumes say of how they were made, by the name that they say."""
imagers = pytest.mark.parametrize("name", SETTINGS)
coarse_walls = pytest.mark.filterwarnings("ignore::nlos.illumination.AliasingWarning")


def see_point(name: str) -> Capture:
    """A hidden point before a planar wall."""
    wall = planar_wall()
    laser = wall if isinstance(SETTINGS[name][0], LightCone | FKMigration) else np.array(SPOT)
    return PointScene([HIDDEN]).simulate_capture(wall, laser, AXIS, JITTER)


@coarse_walls
@imagers
def test_masked_points_and_the_order_of_the_others_do_not_matter(name: str) -> None:
    method, capture = SETTINGS[name][0], see_point(name)
    wall, signal = capture.wall.copy(), capture.signal.copy()
    wall[3, 5] = wall[0, 0, 1] = np.nan
    signal[:, 3, 5] = 1e6
    laser = wall if capture.laser.ndim > 1 else capture.laser
    masked = replace(capture, wall=wall, signal=signal, laser=laser)
    order = np.random.default_rng(5).permutation(len(masked.points))
    points = masked.points[order]
    laser = points if capture.laser.ndim > 1 else capture.laser
    listed = replace(masked, wall=points, laser=laser, signal=masked.traces().T[:, order])
    found, expected = (method.reconstruct(one, GRID).values for one in (listed, masked))
    # Sums of float32 in another order.
    assert np.linalg.norm(found - expected) < 1e-5 * np.linalg.norm(expected)


@coarse_walls
@pytest.mark.parametrize("name", ["backprojection", "rsd", "hybrid"])
def test_fields_are_linear_in_the_signal(name: str) -> None:
    method, capture, random = SETTINGS[name][0], see_point(name), np.random.default_rng(4)
    first, second = (
        replace(capture, signal=random.normal(size=capture.signal.shape)) for _ in range(2)
    )
    both = replace(capture, signal=2 * first.signal - 3 * second.signal)
    # What a method leaves out follows from the first signals that it sees: one plan for all.
    plan = method.plan(first, GRID)
    fields = [plan.field(one).values for one in (first, second, both)]
    difference = fields[2] - (2 * fields[0] - 3 * fields[1])
    assert np.linalg.norm(difference) < 1e-5 * np.linalg.norm(fields[2])


@coarse_walls
@imagers
def test_progress_counts_the_cost_and_may_interrupt_and_the_volume_remembers(name: str) -> None:
    (method, settings), capture = SETTINGS[name], replace(see_point(name), provenance={"shot": 7})
    done: list[int] = []
    volume = method.reconstruct(capture, GRID, done.append)
    assert sum(done) == method.plan(capture, GRID).cost
    assert volume.provenance == {"shot": 7, "imaging": {"method": name, **settings}}

    def interrupt(_: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        method.reconstruct(capture, GRID, interrupt)


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
