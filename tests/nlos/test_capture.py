"""Captures: what they hold and refuse, how fine their walls are, and how frames become one."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes
from numpy.linalg import norm
from scenes import find_refusal, planar_wall

from nlos import Backprojection, Capture, Grid
from nlos.band import Band
from nlos.capture import remove_device_legs
from nlos.illumination import AliasingWarning, warn_of_aliasing
from tofclip.camera import Camera
from tofclip.errors import FileFormatError, InputError, ShapeError
from tofclip.shots import Frames
from tofclip.storage import Field, Record
from tofclip.units import SPEED_OF_LIGHT

WALL = np.random.default_rng(1).normal(size=(3, 4, 3))
SIGNAL = np.random.default_rng(2).normal(size=(5, 3, 4))
METHOD = Backprojection(0.2, 5)


def capture_of(wall, laser=(0.1, 0.0, 0.0)):
    return Capture(np.ones((300, *wall.shape[:-1])), wall, laser, 16e-12)


def test_points_and_traces_agree_and_leave_masked_points_out():
    wall, signal = WALL.copy(), SIGNAL.copy()
    wall[1, 2, 0], signal[:, 1, 2] = np.nan, np.inf
    capture = Capture(signal, wall, [0, 0, 0], 1e-12)
    assert capture.valid.sum() == 11
    assert capture.points.shape == (11, 3)
    assert np.array_equal(capture.points[6], wall[1, 3])
    assert np.array_equal(capture.traces()[6], signal[:, 1, 3].astype(np.float32))
    assert np.array_equal(capture.traces(slice(6, 8)), capture.traces()[6:8])
    assert capture.traces().dtype == np.float32
    assert capture.traces().flags.c_contiguous


def test_lasers_follow_the_points():
    laser = WALL + 0.1
    laser[0, 0, 1] = np.nan
    paired = Capture(SIGNAL, WALL, laser, 1e-12)
    assert paired.points.shape == paired.lasers.shape == (11, 3)
    assert paired.lasers == pytest.approx(paired.points + 0.1)
    assert Capture(SIGNAL, WALL, [1, 2, 3], 1e-12).lasers.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"wall": WALL[..., :2]}, "shape"),
        ({"wall": np.float64(3)}, "shape"),
        ({"signal": SIGNAL[:, :2]}, "shape"),
        ({"signal": SIGNAL.reshape(5, 12)}, "shape"),
        ({"signal": SIGNAL[0]}, "shape"),
        ({"laser": [0, 0]}, "shape"),
        ({"laser": WALL[0]}, "shape"),
        ({"signal": np.where(SIGNAL > 1, np.nan, SIGNAL)}, "samples of the signal are NaN"),
        ({"signal": SIGNAL * 1j}, "real numbers"),
        ({"signal": SIGNAL[:1]}, "at least 2 time bins"),
        ({"wall": np.full_like(WALL, np.nan)}, "every wall point is NaN"),
        ({"wall": planar_wall(3, 4) * 1e4}, "give its points in metres"),
        ({"laser": [0, np.nan, 0]}, "laser spot must be finite"),
        ({"laser": [0.1, 0.05, -1.0]}, "laser spot lies 1 m behind the hindmost wall point"),
        ({"laser": planar_wall(3, 4) - [0, 0, 1.0]}, "1 m behind the hindmost wall point"),
        ({"bin_width": 0.0}, "bin width must be a positive"),
        ({"bin_width": -1e-12}, "bin width must be a positive"),
        ({"bin_width": np.nan}, "bin width must be a positive"),
        ({"bin_width": 16.0}, "check the unit of `bin_width`"),
        ({"bin_width": 1e-16}, "check the unit of `bin_width`"),
        ({"start": np.nan}, "path length of bin 0"),
        ({"start": np.inf}, "path length of bin 0"),
    ],
)
def test_what_is_no_capture_is_refused_in_one_line(changes, message):
    given = {"signal": SIGNAL, "wall": planar_wall(3, 4), "laser": [0, 0, 0], "bin_width": 1e-12}
    with pytest.raises(InputError, match=message) as refused:
        Capture(**{**given, **changes})
    assert isinstance(refused.value, ShapeError) == (message == "shape")
    assert "\n" not in str(refused.value)


def test_a_laser_a_little_behind_a_curved_wall_is_no_fault():
    assert replace(capture_of(planar_wall()), laser=[0, 0, -0.3]).lasers[0, 2] == -0.3


@given(
    wall_shape=array_shapes(min_dims=0, max_dims=3, max_side=4),
    bins=st.integers(2, 5),
    confocal=st.booleans(),
    start=st.floats(-10, 10),
    bin_width=st.floats(1e-13, 1e-9),
    compressed=st.booleans(),
)
def test_files_give_back_what_was_saved(
    tmp_path_factory,
    wall_shape,
    bins,
    confocal,
    start,
    bin_width,
    compressed,
):
    random, made = np.random.default_rng(0), {"made": "here"}
    wall, signal = random.normal(size=(*wall_shape, 3)), random.normal(size=(bins, *wall_shape))
    saved = Capture(signal, wall, wall if confocal else [1, 2, 3], bin_width, start, made)
    path = tmp_path_factory.mktemp("capture") / "wall.h5"
    saved.save(path, compressed)
    loaded = Capture.load(path)
    for name in ("signal", "wall", "laser"):
        assert np.array_equal(getattr(loaded, name), getattr(saved, name))
    assert (loaded.bin_width, loaded.start, loaded.provenance) == (bin_width, start, made)


# --- how fine a wall is


def test_the_spacing_is_that_of_neighbours_however_they_are_listed():
    wall = planar_wall(11, 13)  # 10 cm by 10 cm
    assert capture_of(wall).spacing == pytest.approx(0.1)
    assert capture_of(wall.reshape(-1, 3)[::-1]).spacing == pytest.approx(0.1)
    lasers = np.array([[0.0, 0, 0], [0.2, 0, 0]])
    several = Capture.exhaustive(np.ones((20, 2, 11, 13)), wall, lasers, 16e-12)
    assert several.spacing == pytest.approx(0.1)
    lone = capture_of(wall[:1, 0])
    assert lone.spacing == np.inf
    warn_of_aliasing(lone, Band(METHOD.pulse, lone.axis))
    assert "one wall point" in find_refusal(METHOD, lone, Grid([0.0], [0.0], [0.5]))


@pytest.mark.parametrize(
    ("waves_apart", "confocal", "warned"),
    [(0.45, False, False), (0.55, False, True), (0.3, True, True), (0.2, True, False)],
)
def test_a_coarse_wall_is_warned_of(waves_apart, confocal, warned):
    shortest = 2 * np.pi / Band(METHOD.pulse, capture_of(planar_wall()).axis).wavenumbers[-1]
    wall = planar_wall() * (waves_apart * shortest / 0.06)
    wall[..., 1] *= 0.96  # rows are 6.25 cm apart, columns 6 cm
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        capture = capture_of(wall, wall if confocal else [0.0, 0, 0])
        METHOD.reconstruct(capture, Grid([0.0], [0.0], [0.5]))
    assert [w.category for w in caught] == [AliasingWarning] * warned
    assert all("too coarse for waves of" in str(w.message) for w in caught)


def test_an_exhaustive_capture_pairs_every_laser_with_every_point():
    wall, lasers = planar_wall(3, 4), np.arange(6.0).reshape(2, 3) / 10
    signal = np.random.default_rng(1).normal(size=(5, 2, 3, 4))
    capture = Capture.exhaustive(signal, wall, lasers, 16e-12, 0.3, {"shot": 7})
    assert capture.signal.shape == (5, 2, 3, 4)
    assert np.array_equal(capture.wall[1], wall)
    assert np.array_equal(capture.laser[1, 2, 3], lasers[1])
    assert (capture.start, capture.provenance) == (0.3, {"shot": 7})
    masked = wall.copy()
    masked[0, 0] = np.nan
    assert len(Capture.exhaustive(signal, masked, lasers, 16e-12).points) == 2 * 11
    for wrong, what in (
        ((signal, wall[..., :2], lasers), "shape"),
        ((signal, wall, lasers[:, :2]), "shape"),
        ((signal[:, :1], wall, lasers), "signal"),
    ):
        with pytest.raises(InputError, match=what):
            Capture.exhaustive(*wrong, 16e-12)


# --- frames of a camera that looks at the wall

BIN_WIDTH = 5e-12
LASER, CAMERA = np.array([0.1, -0.05, 0.02]), np.array([0.9, -0.3, 1.1])
HIDDEN = (-0.12, 0.08, 0.3)
ROW_OFFSET, COLUMN_OFFSET, DELAY_BINS = 2, 3, 40
SPACING = SPEED_OF_LIGHT * BIN_WIDTH


def wall_of(rows, columns):
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, columns), np.linspace(-0.25, 0.25, rows))
    return np.stack([x, y, 0.03 * np.sin(9 * x)], axis=-1)


def relay_wall(wall, without="", camera=CAMERA, **changes):
    offsets = {"row_offset": ROW_OFFSET, "column_offset": COLUMN_OFFSET}
    fields = {"wall": Field(wall, "m"), "camera": Field(camera, "m"), "laser": Field(LASER, "m")}
    fields.pop(without, None)
    return Record("relay_wall", fields, {**offsets, "receive_delay_bins": DELAY_BINS, **changes})


def frames_of(values, attachments, times=None):
    camera = Camera([50.0], [0.0], values.shape[1:], 100)
    times = BIN_WIDTH * np.arange(len(values)) if times is None else times
    shot = {"shot": 7}
    return Frames(
        values.astype(np.float32), times, camera, attachments=attachments, provenance=shot
    )


def see_by_camera(wall, bins=800):
    """Frames of the hidden point with every wall point late by its own leg to the
    camera, drawn without any shifting; the record begins `DELAY_BINS` bins after light of path 0
    would have arrived by way of the laser spot.
    """
    late = norm(wall - CAMERA, axis=-1) - norm(LASER - CAMERA)
    path = norm(LASER - HIDDEN) + norm(wall - HIDDEN, axis=-1) + late
    arrival_bins = path / (SPEED_OF_LIGHT * BIN_WIDTH) - DELAY_BINS
    rows, columns = wall.shape[:2]
    values = np.zeros((bins, rows + 5, columns + 6))
    shown = values[:, ROW_OFFSET : ROW_OFFSET + rows, COLUMN_OFFSET : COLUMN_OFFSET + columns]
    shown[:] = np.exp(-0.5 * ((np.arange(bins)[:, None, None] - arrival_bins) / 4) ** 2)
    return values


def test_frames_become_a_capture_that_shows_the_hidden_point_where_it_is():
    wall, late = wall_of(15, 19), 3e-10
    frames = frames_of(see_by_camera(wall), {"relay_wall": relay_wall(wall)})
    capture = Capture.from_frames(frames)
    assert capture.signal.shape == (800, 15, 19)
    assert capture.start == pytest.approx(DELAY_BINS * SPACING)
    assert capture.bin_width == pytest.approx(BIN_WIDTH)
    assert capture.provenance == {"shot": 7}
    grid = Grid.box((-0.2, 0.2), (-0.2, 0.2), (0.2, 0.4), 0.02)  # holds the point itself
    brightest = Backprojection(0.06).reconstruct(capture, grid).find_brightest()
    assert brightest == pytest.approx(HIDDEN, abs=1e-9)
    path = norm(LASER - brightest) + norm(wall - brightest, axis=-1)
    centroid = np.tensordot(capture.axis.paths, capture.signal, 1) / capture.signal.sum(axis=0)
    # Linear interpolation keeps the centroid; float32 sums of 800 bins leave 1e-4 of a bin.
    assert np.max(np.abs(centroid - path)) < 1e-3 * capture.axis.spacing
    moved = Capture.from_frames(replace(frames, times=frames.times + late))
    assert moved.start == pytest.approx(SPEED_OF_LIGHT * (late + DELAY_BINS * BIN_WIDTH))


@pytest.mark.parametrize("moving", [False, True])
def test_both_legs_to_the_device_are_taken_off(moving):
    wall = wall_of(9, 11)
    laser = wall[:, ::-1] if moving else LASER
    source, start = np.array([0.4, -0.2, 1.3]), 2.0
    legs = norm(laser - source, axis=-1) + norm(wall - CAMERA, axis=-1)
    path = norm(laser - HIDDEN, axis=-1) + norm(wall - HIDDEN, axis=-1)
    arrival = (path + legs - start) / SPACING
    signal = np.exp(-0.5 * ((np.arange(1500)[:, None, None] - arrival) / 5) ** 2)
    wall[0, 0] = np.nan  # must not decide what is common to all
    raw = Capture(signal, wall, laser, BIN_WIDTH, start)
    capture = remove_device_legs(raw, source, CAMERA)
    traces = capture.traces().astype(np.float64)
    centroid = traces @ capture.axis.paths / traces.sum(axis=1)
    # Linear interpolation keeps centroids; float32 leaves 1e-3 of a bin.
    assert np.max(np.abs(centroid - path[capture.valid])) < 5e-3 * SPACING
    with pytest.raises(InputError, match="source position"):
        remove_device_legs(raw, [0, np.nan, 0], CAMERA)


UNEVEN = BIN_WIDTH * np.array([0, 1, 2.1, 3])


@pytest.mark.parametrize(
    ("attached", "times", "error", "message"),
    [
        (None, None, InputError, "carry no relay wall"),
        (Record("shopping_list"), None, InputError, "carry no relay wall"),
        (relay_wall(wall_of(4, 4), without="camera"), None, FileFormatError, "no field 'camera'"),
        (relay_wall(wall_of(4, 4), camera=CAMERA * np.nan), None, InputError, "camera position"),
        (relay_wall(wall_of(4, 4)[..., :2]), None, ShapeError, "wall"),
        (relay_wall(wall_of(4, 4), row_offset=-1), None, InputError, "does not fit"),
        (relay_wall(wall_of(4, 4), row_offset=6), None, InputError, "does not fit"),
        (relay_wall(wall_of(4, 4), column_offset=7), None, InputError, "does not fit"),
        (relay_wall(wall_of(4, 4)), UNEVEN, InputError, "evenly"),
    ],
)
def test_frames_that_are_no_capture_say_why(attached, times, error, message):
    attachments = {} if attached is None else {"relay_wall": attached}
    with pytest.raises(error, match=message):
        Capture.from_frames(frames_of(np.ones((4, 9, 10)), attachments, times))
