"""Frames keep their axes, camera and attachments; a streak image is checked once, at construction."""

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tofclip.camera import Camera, SkewSweep
from tofclip.errors import FileFormatError, InputError, MissingTimeAxisError, ShapeError
from tofclip.shots import Frames, Returns, Streak
from tofclip.storage import Field, Record

CAMERA = Camera(
    [8.0, 21.5], [0.1, -0.2], (5, 6), 30, gains=[0.9, 1.1], sweep=SkewSweep([8.0], [0.5], [0.01])
)
VALUES = np.random.default_rng(2).normal(size=(4, 5, 6)).astype(np.float32)
# Steps of 1, 2 and 3 ps: a real sweep is not even.
TIMES = np.array([10.0, 11.0, 13.0, 16.0]) * 1e-12


def test_frames_survive_their_file(tmp_path):
    figures = {"relative_residual": 0.08, "method": "tv", "iterations": 60}
    wall = {"relay_wall": Record("relay_wall", {"laser": Field(np.ones(3), "m", ("xyz",))})}
    past = {"settings": {"seed": 1}}
    expected = Frames(VALUES, TIMES, CAMERA, figures, attachments=wall, provenance=past)
    expected.save(tmp_path / "frames.h5")
    got = Frames.load(tmp_path / "frames.h5")
    np.testing.assert_array_equal(got.values, VALUES)
    assert got.values.dtype == np.float32
    np.testing.assert_array_equal(got.times, TIMES)
    assert got.figures == expected.figures
    np.testing.assert_array_equal(got.camera.gains, [0.9, 1.1])
    assert got.camera.image_shape == (5, 6)
    laser = got.attachments["relay_wall"].array("laser", np.float64, 1, "m")
    np.testing.assert_array_equal(laser, np.ones(3))
    assert list(got.attachments) == ["relay_wall"]
    assert got.provenance == {"settings": {"seed": 1}}
    fields = Record.load(tmp_path / "frames.h5", "frames").fields
    assert (fields["values"].units, fields["values"].axes) == ("count", ("time", "y", "x"))
    assert (fields["times"].units, fields["times"].axes) == ("s", ("time",))
    np.testing.assert_array_equal(Camera.load(tmp_path / "frames.h5").centres_px, CAMERA.centres_px)


def test_the_mean_bin_width():
    assert Frames(VALUES, TIMES, CAMERA).bin_width == pytest.approx(2e-12, rel=1e-12)
    with pytest.raises(InputError, match="single frame"):
        _ = Frames(VALUES[:1], TIMES[:1], CAMERA).bin_width


@pytest.mark.parametrize(
    ("changes", "fault", "problem"),
    [
        ({"values": VALUES[:, :4]}, ShapeError, r"\(time, y, x\) = \(4, 5, 6\), got \(4, 4, 6\)"),
        ({"values": VALUES[0]}, ShapeError, "frames must have shape"),
        ({"times": TIMES[:3]}, ShapeError, r"= \(3, 5, 6\)"),
        ({"times": TIMES[::-1]}, InputError, "finite and increase"),
        ({"times": np.array([0, 1, np.inf, 3])}, InputError, "finite and increase"),
        ({"times": 1e12 * TIMES}, InputError, "not credible"),  # ps in place of s
        ({"times": np.empty(0), "values": VALUES[:0]}, InputError, "finite and increase"),
        ({"values": np.where(VALUES > 1, np.nan, VALUES)}, InputError, "NaN or infinity"),
    ],
)
def test_frames_that_disagree_are_refused(changes, fault, problem):
    with pytest.raises(fault, match=problem):
        Frames(**({"values": VALUES, "times": TIMES, "camera": CAMERA} | changes))


def test_a_file_without_a_camera_is_refused(tmp_path):
    record = Frames(VALUES, TIMES, CAMERA).to_record()
    Record("frames", record.fields).save(tmp_path / "frames.h5")
    with pytest.raises(FileFormatError, match=r"frames\.h5: frames record carries no camera"):
        Frames.load(tmp_path / "frames.h5")


def test_frames_take_their_returns_along():
    times = np.array([5.0, 10.4, 11.9, 12.1, 15.0, 30.0]) * 1e-12
    numbers = np.zeros(times.size, np.int32)
    returns = Returns(
        numbers, numbers, 1.5e8 * times, *([numbers + np.float32(1)] * 3), times, CAMERA
    )
    frames = Frames(VALUES, TIMES, CAMERA, returns=returns)

    def left(part):
        assert part.returns is not None
        return list(np.round(part.returns.time * 1e12, 3))

    assert left(frames[1:3]) == [11.9, 12.1]
    assert left(frames.sel(time=(10.5e-12, 11.5e-12))) == [11.9]
    # Every return is in one part of a whole.
    assert left(frames[:2]) + left(frames[2:]) == left(frames[:]) == left(frames)


COUNTS = np.arange(12.0).reshape(3, 4)
texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=15)
shapes = hnp.array_shapes(min_dims=2, max_dims=2, max_side=6)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(shape=shapes, metadata=st.dictionaries(texts, texts, max_size=4), data=st.data())
def test_a_streak_survives_its_file(shape, metadata, data, tmp_path):
    counts = data.draw(
        hnp.arrays(np.float32, shape, elements=st.floats(-1000, 70000, width=32)).filter(np.any)
    )
    steps = data.draw(st.none() | hnp.arrays(np.float64, shape[0], elements=st.floats(1e-12, 1e-9)))
    saturated = data.draw(st.none() | hnp.arrays(bool, shape))
    expected = Streak(counts, None if steps is None else np.cumsum(steps), saturated, metadata)
    expected.save(tmp_path / "a.h5")
    got = Streak.load(tmp_path / "a.h5")
    np.testing.assert_array_equal(got.counts, expected.counts)
    for name in ("row_times", "saturated"):
        assert (getattr(got, name) is None) == (getattr(expected, name) is None)
        if getattr(expected, name) is not None:
            np.testing.assert_array_equal(getattr(got, name), getattr(expected, name))
    assert got.metadata == metadata
    assert got.source == str(tmp_path / "a.h5")


@pytest.mark.parametrize(
    ("changes", "fault", "problem"),
    [
        ({"counts": np.ones(5)}, ShapeError, r"\(rows, columns\), got \(5,\)"),
        ({"counts": np.ones((0, 5))}, ShapeError, r"got \(0, 5\)"),
        ({"counts": np.zeros((3, 4))}, InputError, "every pixel is zero"),
        ({"counts": np.full((3, 4), np.nan)}, InputError, "12 pixels are NaN or infinite"),
        ({"counts": np.full((3, 4), 1e300)}, InputError, "12 pixels are NaN or infinite"),
        ({"saturated": np.zeros((4, 3), bool)}, ShapeError, r"saturated must have shape \(3, 4\)"),
        (
            {"row_times": np.arange(4.0)},
            ShapeError,
            r"time axis must have shape \(3,\), got \(4,\)",
        ),
        ({"row_times": np.array([0.0, 2.0, 2.0])}, InputError, "must be finite and increase"),
        ({"row_times": np.array([0.0, np.nan, 2.0])}, InputError, "must be finite and increase"),
    ],
)
def test_unusable_streaks_are_refused(changes, fault, problem):
    with pytest.raises(fault, match=problem):
        Streak(**({"counts": COUNTS} | changes))


def test_negative_readings_are_kept():
    """A background taken off leaves noise on both sides of zero; clipping it would bias the
    picture.
    """
    np.testing.assert_array_equal(Streak(COUNTS - 5).counts, COUNTS - 5)


def test_the_time_axis_is_asked_for_by_name():
    streak = Streak(COUNTS, source="shot.tif")
    with pytest.raises(
        MissingTimeAxisError, match=r"shot\.tif has no time axis: give .*`bin_width`"
    ):
        _ = streak.times
    np.testing.assert_allclose(streak.with_bin_width(2e-12).times, [0, 2e-12, 4e-12], rtol=1e-15)
