"""Frames keep their axes, camera and attachments; a streak image is checked once, at construction."""

import numpy as np
import pytest

from tofclip.camera import Camera, SkewSweep
from tofclip.errors import FileFormatError, InputError, MissingTimeAxisError, ShapeError
from tofclip.shots import Frames, Returns, Streak
from tofclip.storage import Record

CAMERA = Camera(
    [8.0, 21.5], [0.1, -0.2], (5, 6), 30, gains=[0.9, 1.1], sweep=SkewSweep([8.0], [0.5], [0.01])
)
VALUES = np.random.default_rng(2).normal(size=(4, 5, 6)).astype(np.float32)
# Steps of 1, 2 and 3 ps: a real sweep is not even.
TIMES = np.array([10.0, 11.0, 13.0, 16.0]) * 1e-12


def test_files_of_frames_say_units_and_axes_and_are_a_camera_s_too(tmp_path):
    Frames(VALUES, TIMES, CAMERA).save(tmp_path / "frames.h5")
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


def test_the_time_axis_is_asked_for_by_name():
    streak = Streak(COUNTS, source="shot.tif")
    with pytest.raises(
        MissingTimeAxisError, match=r"shot\.tif has no time axis: give .*`bin_width`"
    ):
        _ = streak.times
    np.testing.assert_allclose(streak.with_bin_width(2e-12).times, [0, 2e-12, 4e-12], rtol=1e-15)
