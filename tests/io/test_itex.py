"""ITEX pictures: real ones, made-up ones, and damaged ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from itex_files import encode_itex

from tofclip.errors import FileFormatError, MissingTimeAxisError
from tofclip.io import read_streak
from tofclip.io.hamamatsu import decode_itex

TEXT = (
    '[Application],Software="HPD-TA"\r\n[Acquisition],NrExposure=1\r\n'
    '[Scaling],ScalingXUnit="nm",ScalingXScalingFile="",ScalingYUnit="ps",ScalingYScalingFile=""{}[Comment],UserComment=""'
)
# Shape, type, ends and steps of the time axis in s, and some of the text, as the data's notes state.
FACTS: dict[str, tuple[tuple[int, int], str, Any, dict[str, str]]] = {
    "operate_mode": (
        (512, 672),
        "uint32",
        ((0.0, 16.009e-6), (31.08e-9, 31.44e-9)),
        {
            "Camera/CameraName": "Orca R2",
            "Acquisition/NrExposure": "60",
            "Streak camera/Time Range": "20 us",
        },
    ),
    "focus_mode": (
        (512, 672),
        "uint32",
        None,
        {"Scaling/ScalingYScalingFile": "Focus mode", "Scaling/ScalingXUnit": "nm"},
    ),
    "photon_counting": (
        (512, 672),
        "uint16",
        ((0.0, 4.632e-9), (8.86e-12, 9.66e-12)),
        {"Acquisition/NrExposure": "10000", "Acquisition/ExposureTime": "200 ms"},
    ),
    "xaxis_other": (
        (508, 672),
        "uint16",
        None,
        {"Scaling/ScalingXScalingFile": "Other", "Camera/CameraName": "C13440-20C"},
    ),
}


@given(st.data())
def test_pictures_of_every_type_are_read_whatever_tables_they_have(data: st.DataObject) -> None:
    dtype = data.draw(st.sampled_from(["u1", "<u2", "<u4"]))
    pixels = data.draw(arrays(dtype, array_shapes(min_dims=2, max_dims=2, max_side=9)))
    axes = data.draw(st.sets(st.sampled_from("XY")))
    tables = {axis: np.ones(pixels.shape[axis == "X"], np.float32) for axis in axes}
    kept = st.characters(exclude_categories=["Cs"], exclude_characters='[]"=')
    words = data.draw(st.text(kept, max_size=20))
    content = encode_itex(pixels, TEXT.format(words), tables, data.draw(st.just((0, 65535))))
    got, metadata = decode_itex(content)
    np.testing.assert_array_equal(got, pixels)
    assert got.dtype == pixels.dtype
    assert metadata["Scaling/ScalingYUnit"] == "ps"


@pytest.mark.parametrize("name", FACTS)
def test_recorded_pictures(shared_data: Path, name: str) -> None:
    shape, dtype, axis, entries = FACTS[name]
    path = shared_data / "devices" / "streak" / f"{name}.img"
    streak, (pixels, _) = read_streak(path), decode_itex(path.read_bytes())
    assert (pixels.shape, pixels.dtype, streak.counts.shape) == (shape, np.dtype(dtype), shape)
    np.testing.assert_array_equal(streak.counts, pixels.astype(np.float32))
    if axis is None:
        with pytest.raises(MissingTimeAxisError):
            _ = streak.times
    else:
        np.testing.assert_allclose(streak.times[[0, -1]], axis[0], rtol=1e-4)
        found = np.diff(streak.times)
        np.testing.assert_allclose([found.min(), found.max()], axis[1], rtol=6e-4)
    assert entries.items() <= streak.metadata.items()
    assert streak.metadata["Comment/UserComment"] == ""  # its section starts without a line break


@pytest.fixture
def image() -> bytes:
    """Six rows of four pixels with a slowing sweep."""
    pixels = np.arange(24, dtype="<u2").reshape(6, 4)
    times = np.array([0, 1, 2.25, 3.5, 5, 6.5], np.float32)  # exact in float32
    return encode_itex(pixels, TEXT.format(""), {"X": np.arange(4, 0, -1.0), "Y": times}, (3, 2))


def test_a_file_is_read_as_a_streak(tmp_path: Path, image: bytes) -> None:
    (tmp_path / "shot.img").write_bytes(image)
    streak = read_streak(tmp_path / "shot.img")
    np.testing.assert_array_equal(streak.counts, np.arange(24).reshape(6, 4))
    expected = np.array([0, 1, 2.25, 3.5, 5, 6.5]) * 1e-12
    np.testing.assert_allclose(streak.times, expected, rtol=1e-15)


def test_text_of_old_versions_is_western_windows() -> None:
    text = '[Application],Software="HiPic",Unit="µs"'.encode("latin-1")
    data = encode_itex(np.ones((2, 3), "u1"), "x" * len(text))
    _, metadata = decode_itex(data.replace(b"x" * len(text), text))
    assert metadata["Application/Unit"] == "µs"


@pytest.mark.parametrize("keep", [0, 1, 10, 63, 64, 150, 290, -25, -1])
def test_truncated_files_are_refused_when_decoded(image: bytes, keep: int) -> None:
    with pytest.raises(FileFormatError):
        decode_itex(image[:keep])


@pytest.mark.parametrize(
    ("place", "value", "problem"),
    [
        (12, 1, "pixels of type 1"),
        (12, 77, "pixels of type 77"),
        (4, 65535, "truncated"),
        (6, 0, "truncated"),
    ],
)
def test_headers_that_cannot_be_are_refused(
    image: bytes, place: int, value: int, problem: str
) -> None:
    data = bytearray(image)
    data[place : place + 2] = value.to_bytes(2, "little")
    with pytest.raises(FileFormatError, match=problem):
        decode_itex(bytes(data))


def test_a_file_larger_than_any_picture_is_not_read(tmp_path: Path) -> None:
    with open(tmp_path / "huge.img", "wb") as file:
        file.write(b"IM")
        file.truncate(1 << 31)  # a hole: takes no room on the disk
    with pytest.raises(FileFormatError, match="larger than any streak image"):
        read_streak(tmp_path / "huge.img")
