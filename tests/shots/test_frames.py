"""Frames keep their axes, camera and attachments."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tofclip.camera import Camera, SkewSweep
from tofclip.errors import FileFormatError, InputError, ShapeError
from tofclip.shots import Frames, Returns
from tofclip.storage import Field, Record

CAMERA = Camera(
    [8.0, 21.5], [0.1, -0.2], (5, 6), 30, gains=[0.9, 1.1], sweep=SkewSweep([8.0], [0.5], [0.01])
)
VALUES = np.random.default_rng(2).normal(size=(4, 5, 6)).astype(np.float32)
# Steps of 1, 2 and 3 ps: a real sweep is not even.
TIMES = np.array([10.0, 11.0, 13.0, 16.0]) * 1e-12


def test_frames_survive_their_file(tmp_path: Path) -> None:
    expected = Frames(
        VALUES,
        TIMES,
        CAMERA,
        figures={"relative_residual": 0.08, "method": "tv", "iterations": 60},
        attachments={
            "relay_wall": Record("relay_wall", {"laser": Field(np.ones(3), "m", ("xyz",))})
        },
        provenance={"settings": {"seed": 1}},
    )
    expected.save(tmp_path / "frames.h5")
    got = Frames.load(tmp_path / "frames.h5")
    np.testing.assert_array_equal(got.values, VALUES)
    assert got.values.dtype == np.float32
    np.testing.assert_array_equal(got.times, TIMES)
    assert got.figures == expected.figures
    np.testing.assert_array_equal(got.camera.gains, [0.9, 1.1])
    assert got.camera.image_shape == (5, 6)
    np.testing.assert_array_equal(
        got.attachments["relay_wall"].array("laser", np.float64, 1, "m"), np.ones(3)
    )
    assert list(got.attachments) == ["relay_wall"]
    assert got.provenance == {"settings": {"seed": 1}}
    np.testing.assert_array_equal(Camera.load(tmp_path / "frames.h5").centres_px, CAMERA.centres_px)


def test_the_file_names_axes_and_units(tmp_path: Path) -> None:
    Frames(VALUES, TIMES, CAMERA).save(tmp_path / "frames.h5")
    fields = Record.load(tmp_path / "frames.h5", "frames").fields
    assert (fields["values"].units, fields["values"].axes) == ("count", ("time", "y", "x"))
    assert (fields["times"].units, fields["times"].axes) == ("s", ("time",))


def test_the_mean_bin_width() -> None:
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
def test_frames_that_disagree_are_refused(
    changes: dict[str, Any], fault: type[InputError], problem: str
) -> None:
    with pytest.raises(fault, match=problem):
        Frames(**({"values": VALUES, "times": TIMES, "camera": CAMERA} | changes))


def test_a_file_without_a_camera_is_refused(tmp_path: Path) -> None:
    record = Frames(VALUES, TIMES, CAMERA).to_record()
    Record("frames", record.fields).save(tmp_path / "frames.h5")
    with pytest.raises(FileFormatError, match=r"frames\.h5: frames record carries no camera"):
        Frames.load(tmp_path / "frames.h5")


def test_frames_take_their_returns_along() -> None:
    times = np.array([5.0, 10.4, 11.9, 12.1, 15.0, 30.0]) * 1e-12
    numbers = np.zeros(times.size, np.int32)
    returns = Returns(
        numbers, numbers, 1.5e8 * times, *([numbers + np.float32(1)] * 3), times, CAMERA
    )
    frames = Frames(VALUES, TIMES, CAMERA, returns=returns)

    def left(part: Frames) -> list[float]:
        assert part.returns is not None
        return list(np.round(part.returns.time * 1e12, 3))

    assert left(frames[1:3]) == [11.9, 12.1]
    assert left(frames.sel(time=(10.5e-12, 11.5e-12))) == [11.9]
    # Every return is in one part of a whole.
    assert left(frames[:2]) + left(frames[2:]) == left(frames[:]) == left(frames)
