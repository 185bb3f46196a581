from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes

from nlos import Capture
from tofclip.errors import FileFormatError, InputError, ShapeError
from tofclip.units import SPEED_OF_LIGHT

WALL = np.random.default_rng(1).normal(size=(3, 4, 3))
SIGNAL = np.random.default_rng(2).normal(size=(5, 3, 4))


def test_points_and_traces_agree_and_leave_masked_points_out() -> None:
    wall = WALL.copy()
    wall[1, 2, 0] = np.nan
    signal = SIGNAL.copy()
    signal[:, 1, 2] = np.inf
    capture = Capture(signal, wall, [0, 0, 0], 1e-12)
    assert capture.valid.sum() == 11
    assert capture.points.shape == (11, 3)
    assert np.array_equal(capture.points[6], wall[1, 3])
    assert np.array_equal(capture.traces()[6], signal[:, 1, 3].astype(np.float32))
    assert np.array_equal(capture.traces(slice(6, 8)), capture.traces()[6:8])
    assert capture.traces().dtype == np.float32
    assert capture.traces().flags.c_contiguous


@pytest.mark.parametrize("start", [0.0, 0.2, -1.3])
def test_the_first_bin_is_at_the_start_of_the_record(start: float) -> None:
    capture = Capture(SIGNAL, WALL, [0, 0, 0], 1e-10, start)
    assert capture.axis.paths[0] == start
    assert np.diff(capture.axis.paths) == pytest.approx(SPEED_OF_LIGHT * 1e-10)


def test_lasers_follow_the_points() -> None:
    laser = WALL + 0.1
    laser[0, 0, 1] = np.nan
    paired = Capture(SIGNAL, WALL, laser, 1e-12)
    assert paired.points.shape == paired.lasers.shape == (11, 3)
    assert paired.lasers == pytest.approx(paired.points + 0.1)
    assert Capture(SIGNAL, WALL, [1, 2, 3], 1e-12).lasers.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("dtype", [np.uint16, np.int32, np.float64, bool])
def test_counts_of_any_type_become_float32(dtype: type) -> None:
    capture = Capture(np.ones((5, 3, 4), dtype), WALL, WALL, 1e-12)
    assert capture.signal.dtype == np.float32
    assert np.all(capture.signal == 1)


@pytest.mark.parametrize(
    ("signal", "wall", "laser"),
    [
        (SIGNAL, WALL[..., :2], [0, 0, 0]),
        (SIGNAL, np.float64(3), [0, 0, 0]),
        (SIGNAL[:, :2], WALL, [0, 0, 0]),
        (SIGNAL.reshape(5, 12), WALL, [0, 0, 0]),
        (SIGNAL[0], WALL, [0, 0, 0]),
        (SIGNAL, WALL, [0, 0]),
        (SIGNAL, WALL, WALL[0]),
    ],
)
def test_shapes_that_disagree_are_refused(signal: object, wall: object, laser: object) -> None:
    with pytest.raises(ShapeError):
        Capture(signal, wall, laser, 1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"signal": np.where(SIGNAL > 1, np.nan, SIGNAL)}, "samples of the signal are NaN"),
        ({"signal": SIGNAL * 1j}, "real numbers"),
        ({"wall": np.full_like(WALL, np.nan)}, "every wall point is NaN"),
        ({"laser": [0, np.nan, 0]}, "laser spot must be finite"),
        ({"bin_width": 0.0}, "bin width"),
        ({"bin_width": -1e-12}, "bin width"),
        ({"start": np.nan}, "path length of bin 0"),
        ({"signal": SIGNAL[:1]}, "at least 2 time bins"),
    ],
)
def test_unusable_numbers_are_refused(changes: dict[str, object], message: str) -> None:
    arguments = {"signal": SIGNAL, "wall": WALL, "laser": [0, 0, 0], "bin_width": 1e-12, **changes}
    with pytest.raises(InputError, match=message):
        Capture(**arguments)


@given(
    wall_shape=array_shapes(min_dims=0, max_dims=3, max_side=4),
    bins=st.integers(2, 5),
    confocal=st.booleans(),
    start=st.floats(-10, 10),
    bin_width=st.floats(1e-13, 1e-9),
    compressed=st.booleans(),
)
def test_files_give_back_what_was_saved(
    tmp_path_factory: pytest.TempPathFactory,
    wall_shape: tuple[int, ...],
    bins: int,
    confocal: bool,
    start: float,
    bin_width: float,
    compressed: bool,
) -> None:
    random = np.random.default_rng(0)
    wall = random.normal(size=(*wall_shape, 3))
    signal = random.normal(size=(bins, *wall_shape))
    saved = Capture(
        signal, wall, wall if confocal else [1, 2, 3], bin_width, start, {"made": "here"}
    )
    path = tmp_path_factory.mktemp("capture") / "wall.h5"
    saved.save(path, compressed)
    loaded = Capture.load(path)
    for name in ("signal", "wall", "laser"):
        assert np.array_equal(getattr(loaded, name), getattr(saved, name))
    assert (loaded.bin_width, loaded.start, loaded.provenance) == (
        bin_width,
        start,
        {"made": "here"},
    )


def test_a_file_without_a_wall_says_so(tmp_path: Path) -> None:
    record = Capture(SIGNAL, WALL, WALL, 1e-12).to_record()
    del record.fields["wall"]
    record.save(tmp_path / "broken.h5")
    with pytest.raises(FileFormatError, match="no field 'wall'"):
        Capture.load(tmp_path / "broken.h5")
