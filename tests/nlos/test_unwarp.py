from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nlos import Backprojection, Capture, Grid
from nlos.capture import remove_device_legs, unwarp_signal
from tofclip.camera import Camera
from tofclip.errors import FileFormatError, InputError, ShapeError
from tofclip.shots import Frames
from tofclip.storage import Field, Record
from tofclip.units import SPEED_OF_LIGHT

# These walls are coarser than the shortest of the pulse's waves wants; see test_sampling.py.
pytestmark = pytest.mark.filterwarnings("ignore::nlos.illumination.AliasingWarning")

BIN_WIDTH = 5e-12
LASER = np.array([0.1, -0.05, 0.02])
CAMERA = np.array([0.9, -0.3, 1.1])
ROW_OFFSET, COLUMN_OFFSET, DELAY_BINS = 2, 3, 40
HIDDEN = (-0.12, 0.08, 0.3)


def wall_of(rows: int, columns: int) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, columns), np.linspace(-0.25, 0.25, rows))
    return np.stack([x, y, 0.03 * np.sin(9 * x)], axis=-1)


def relay_wall(wall: np.ndarray, **changes: Any) -> Record:
    attributes = {
        "row_offset": ROW_OFFSET,
        "column_offset": COLUMN_OFFSET,
        "receive_delay_bins": DELAY_BINS,
        **changes,
    }
    fields = {"wall": Field(wall, "m"), "camera": Field(CAMERA, "m"), "laser": Field(LASER, "m")}
    return Record("relay_wall", fields, attributes)


def frames_of(
    values: np.ndarray, attachments: Mapping[str, Record], times: np.ndarray | None = None
) -> Frames:
    camera = Camera([50.0], [0.0], values.shape[1:], 100)
    times = BIN_WIDTH * np.arange(len(values)) if times is None else times
    return Frames(
        values.astype(np.float32), times, camera, attachments=attachments, provenance={"shot": 7}
    )


def seen_by_camera(wall: np.ndarray, bins: int = 800) -> np.ndarray:
    """Frames of the hidden point with every wall point late by its own way to the camera, drawn
    without any shifting.

    The record begins `DELAY_BINS` bins after light of path 0 would have arrived by way of the laser
    spot.
    """
    late = np.linalg.norm(wall - CAMERA, axis=-1) - np.linalg.norm(LASER - CAMERA)
    path = np.linalg.norm(LASER - HIDDEN) + np.linalg.norm(wall - HIDDEN, axis=-1) + late
    arrival_bins = path / (SPEED_OF_LIGHT * BIN_WIDTH) - DELAY_BINS
    rows, columns = wall.shape[:2]
    values = np.zeros((bins, rows + 5, columns + 6))
    window = (
        slice(None),
        slice(ROW_OFFSET, ROW_OFFSET + rows),
        slice(COLUMN_OFFSET, COLUMN_OFFSET + columns),
    )
    values[window] = np.exp(-0.5 * ((np.arange(bins)[:, None, None] - arrival_bins) / 4) ** 2)
    return values


def test_frames_become_a_capture_that_shows_the_hidden_point_where_it_is() -> None:
    wall = wall_of(15, 19)
    frames = frames_of(seen_by_camera(wall), {"relay_wall": relay_wall(wall)})
    capture = Capture.from_frames(frames)
    assert capture.signal.shape == (800, 15, 19)
    assert capture.start == pytest.approx(DELAY_BINS * BIN_WIDTH * SPEED_OF_LIGHT)
    assert capture.bin_width == pytest.approx(BIN_WIDTH)
    assert capture.provenance == {"shot": 7}
    volume = Backprojection(0.06).reconstruct(
        capture, Grid.box((-0.2, 0.2), (-0.2, 0.2), (0.2, 0.4), 0.02)
    )
    # The grid contains the point itself.
    assert volume.find_brightest() == pytest.approx(HIDDEN, abs=1e-9)


def test_time_zero_of_the_frames_moves_the_start() -> None:
    wall = wall_of(4, 4)
    times = 3e-10 + BIN_WIDTH * np.arange(800)
    capture = Capture.from_frames(
        frames_of(seen_by_camera(wall), {"relay_wall": relay_wall(wall)}, times)
    )
    assert capture.start == pytest.approx(SPEED_OF_LIGHT * (3e-10 + DELAY_BINS * BIN_WIDTH))


def test_arrivals_line_up_with_the_path_between_bins() -> None:
    wall = wall_of(9, 9)
    capture = Capture.from_frames(frames_of(seen_by_camera(wall), {"relay_wall": relay_wall(wall)}))
    path = np.linalg.norm(LASER - HIDDEN) + np.linalg.norm(wall - HIDDEN, axis=-1)
    centroid = np.einsum("trc,t->rc", capture.signal, capture.axis.paths) / capture.signal.sum(
        axis=0
    )
    # Linear interpolation keeps the centroid; float32 sums of 800 bins leave 1e-4 of a bin.
    assert np.max(np.abs(centroid - path)) < 1e-3 * capture.axis.spacing


@settings(max_examples=30, deadline=None)
@given(shift=st.floats(-30, 30))
def test_a_shifted_pulse_matches_the_analytic_one(shift: float) -> None:
    bins, width = np.arange(200), 6.0
    spacing = SPEED_OF_LIGHT * BIN_WIDTH
    # A camera on the axis behind the laser: a wall point further along the axis is late by its
    # distance.
    camera, laser = np.array([0.0, 0.0, -1.0]), np.zeros(3)
    wall = np.array([[0.0, 0.0, shift * spacing]])
    signal = np.exp(-0.5 * ((bins - 100.0 - shift) / width) ** 2)[:, None]
    expected = np.exp(-0.5 * ((bins - 100.0) / width) ** 2)
    found = unwarp_signal(signal, wall, camera, laser, BIN_WIDTH)[:, 0]
    # Linear interpolation errs by at most 1/8 of the second derivative, 1 / (8 * 36); the rest is
    # float32.
    assert np.max(np.abs(found - expected)) < 1 / (8 * width**2) + 1e-5


def test_whole_bins_are_moved_exactly_and_what_lies_outside_is_zero() -> None:
    spacing = SPEED_OF_LIGHT * BIN_WIDTH
    camera, laser = np.array([0.0, 0.0, -1.0]), np.zeros(3)
    wall = np.array(
        [
            [0, 0, 0],
            [0, 0, 2 * spacing],
            [0, 0, -3 * spacing],
            [np.nan, 0, 0],
            [0, 0, 100 * spacing],
        ]
    )
    signal = np.tile(np.arange(1.0, 9.0)[:, None], (1, 5))
    found = unwarp_signal(signal, wall, camera, laser, BIN_WIDTH)
    # Distances of 1 m in float64 place a sample to 1e-10 bins; at a record's edge that may fall
    # outside.
    assert found[:, 0] == pytest.approx(np.arange(1, 9))
    assert found[:5, 1] == pytest.approx([3, 4, 5, 6, 7])
    assert np.all(found[6:, 1] == 0)
    assert np.all(found[:3, 2] == 0)
    assert found[4:, 2] == pytest.approx([2, 3, 4, 5])
    assert np.all(found[:, 3:] == 0)


def test_frames_without_a_wall_say_what_is_missing() -> None:
    with pytest.raises(InputError, match="carry no relay wall"):
        Capture.from_frames(frames_of(np.ones((4, 3, 3)), {}))
    with pytest.raises(InputError, match="carry no relay wall"):
        Capture.from_frames(frames_of(np.ones((4, 3, 3)), {"relay_wall": Record("shopping_list")}))


def test_a_wall_record_without_its_camera_is_named() -> None:
    record = relay_wall(wall_of(4, 4))
    del record.fields["camera"]
    with pytest.raises(FileFormatError, match="no field 'camera'"):
        Capture.from_frames(frames_of(np.ones((4, 9, 9)), {"relay_wall": record}))


@pytest.mark.parametrize("offset", [{"row_offset": -1}, {"row_offset": 6}, {"column_offset": 7}])
def test_a_wall_that_does_not_fit_the_picture_is_refused(offset: dict[str, int]) -> None:
    wall = wall_of(4, 4)
    with pytest.raises(InputError, match="does not fit"):
        Capture.from_frames(
            frames_of(np.ones((4, 9, 10)), {"relay_wall": relay_wall(wall, **offset)})
        )


def test_uneven_frames_are_refused() -> None:
    wall = wall_of(4, 4)
    times = BIN_WIDTH * np.array([0, 1, 2.1, 3])
    with pytest.raises(InputError, match="evenly"):
        Capture.from_frames(frames_of(np.ones((4, 9, 10)), {"relay_wall": relay_wall(wall)}, times))


def test_unwarp_checks_what_it_is_given() -> None:
    with pytest.raises(ShapeError, match="wall"):
        unwarp_signal(np.ones((5, 2, 3)), np.zeros((2, 2, 3)), CAMERA, LASER, BIN_WIDTH)
    with pytest.raises(InputError, match="camera position"):
        unwarp_signal(np.ones((5, 2)), np.zeros((2, 3)), [0, np.nan, 0], LASER, BIN_WIDTH)
    with pytest.raises(InputError, match="laser position"):
        unwarp_signal(np.ones((5, 2)), np.zeros((2, 3)), CAMERA, [0, 0], BIN_WIDTH)


@pytest.mark.parametrize("moving", [False, True])
def test_both_ways_to_the_device_are_taken_off(moving: bool) -> None:
    wall = wall_of(9, 11)
    laser = wall[:, ::-1] if moving else LASER
    source, camera = np.array([0.4, -0.2, 1.3]), CAMERA
    legs = np.linalg.norm(laser - source, axis=-1) + np.linalg.norm(wall - camera, axis=-1)
    path = np.linalg.norm(laser - np.array(HIDDEN), axis=-1) + np.linalg.norm(
        wall - HIDDEN, axis=-1
    )
    spacing = SPEED_OF_LIGHT * BIN_WIDTH
    start = 2.0
    arrival = (path + legs - start) / spacing
    signal = np.exp(-0.5 * ((np.arange(1500)[:, None, None] - arrival) / 5) ** 2)
    # A masked wall point must not decide what is common to all.
    wall[0, 0] = np.nan
    raw = Capture(signal, wall, laser, BIN_WIDTH, start)
    capture = remove_device_legs(raw, source, camera)
    traces = capture.traces().astype(np.float64)
    centroid = traces @ capture.axis.paths / traces.sum(axis=1)
    # Linear interpolation keeps centroids; float32 leaves 1e-3 of a bin.
    assert np.max(np.abs(centroid - path[capture.valid])) < 5e-3 * spacing
    with pytest.raises(InputError, match="source position"):
        remove_device_legs(raw, [0, np.nan, 0], camera)
