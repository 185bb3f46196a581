"""ITEX pictures: real ones, made-up ones, and damaged ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray

from tofclip.errors import FileFormatError, InputError, MissingTimeAxisError, ShapeError
from tofclip.io import read_streak
from tofclip.io.hamamatsu import ItexImage, decode_itex, encode_itex, read_itex, write_itex

TEXT = (
    '[Application],Software="HPD-TA"\r\n[Acquisition],NrExposure=1\r\n'
    '[Scaling],ScalingXUnit="nm",ScalingXScalingFile="",ScalingYUnit="ps",ScalingYScalingFile=""{}[Comment],UserComment=""'
)

FACTS = {
    "operate_mode": (
        (512, 672),
        "uint32",
        (526.84, 472.25),
        (0.0, 16.009e-6),
        (31.08e-9, 31.44e-9),
    ),
    "focus_mode": ((512, 672), "uint32", None, None, None),
    "photon_counting": (
        (512, 672),
        "uint16",
        (364.97, 353.67),
        (0.0, 4.632e-9),
        (8.86e-12, 9.66e-12),
    ),
    "xaxis_other": ((508, 672), "uint16", None, None, None),
}
"""Shape, type, ends of the wavelength axis in nm, ends and steps of the time axis in s, as the
data's notes state.
"""


@st.composite
def images(draw: st.DrawFn) -> ItexImage:
    """Pictures of every type, with and without tables; the tables hold any float32 but NaN, which
    equals nothing.
    """
    pixels = draw(
        arrays(
            draw(st.sampled_from(["u1", "<u2", "<u4"])),
            array_shapes(min_dims=2, max_dims=2, max_side=9),
        )
    )
    lengths = {"X": pixels.shape[1], "Y": pixels.shape[0]}
    axes = draw(st.sets(st.sampled_from("XY")))
    tables = {
        axis: draw(arrays("<f4", lengths[axis], elements=st.floats(width=32, allow_nan=False)))
        for axis in axes
    }
    words = draw(
        st.text(st.characters(exclude_categories=["Cs"], exclude_characters='[]"='), max_size=20)
    )
    offsets = st.integers(0, 65535)
    return ItexImage(pixels, TEXT.format(words), (draw(offsets), draw(offsets)), tables)


@given(images())
def test_decoding_gives_back_what_was_encoded(image: ItexImage) -> None:
    data = encode_itex(image)
    got = decode_itex(data)
    np.testing.assert_array_equal(got.pixels, image.pixels)
    assert (got.pixels.dtype, got.offset_px) == (image.pixels.dtype, image.offset_px)
    assert got.tables.keys() == image.tables.keys()
    for axis, table in image.tables.items():
        np.testing.assert_array_equal(got.tables[axis], table)
    places = {f"Scaling/Scaling{axis}ScalingFile" for axis in image.tables}
    assert {k: v for k, v in got.metadata.items() if k not in places} == {
        k: v for k, v in image.metadata.items() if k not in places
    }
    assert encode_itex(got) == data


@pytest.mark.parametrize("name", FACTS)
def test_recorded_pictures(shared_data: Path, name: str) -> None:
    shape, dtype, wavelengths, times, steps = FACTS[name]
    path = shared_data / "devices" / "streak" / f"{name}.img"
    data = path.read_bytes()
    image, streak = decode_itex(data), read_streak(path)
    assert (image.pixels.shape, image.pixels.dtype, streak.counts.shape) == (
        shape,
        np.dtype(dtype),
        shape,
    )
    np.testing.assert_array_equal(streak.counts, image.pixels.astype(np.float32))
    # The file's own layout is ours: writing it again changes no byte.
    assert encode_itex(image) == data
    # Half of the last digit that the notes give.
    if wavelengths is not None:
        np.testing.assert_allclose(image.tables["X"][[0, -1]], wavelengths, atol=0.005)
    if times is None or steps is None:
        with pytest.raises(MissingTimeAxisError):
            _ = streak.times
    else:
        np.testing.assert_allclose(streak.times[[0, -1]], times, rtol=1e-4)
        found = np.diff(streak.times)
        np.testing.assert_allclose([found.min(), found.max()], steps, rtol=6e-4)


@pytest.mark.parametrize(
    ("name", "entries"),
    [
        (
            "operate_mode",
            {
                "Camera/CameraName": "Orca R2",
                "Acquisition/NrExposure": "60",
                "Streak camera/Time Range": "20 us",
            },
        ),
        ("focus_mode", {"Scaling/ScalingYScalingFile": "Focus mode", "Scaling/ScalingXUnit": "nm"}),
        (
            "photon_counting",
            {"Acquisition/NrExposure": "10000", "Acquisition/ExposureTime": "200 ms"},
        ),
        (
            "xaxis_other",
            {"Scaling/ScalingXScalingFile": "Other", "Camera/CameraName": "C13440-20C"},
        ),
    ],
)
def test_text_of_recorded_pictures(shared_data: Path, name: str, entries: dict[str, str]) -> None:
    found = read_streak(shared_data / "devices" / "streak" / f"{name}.img").metadata
    assert entries.items() <= found.items()
    assert found["Comment/UserComment"] == ""  # its section starts without a line break


@pytest.fixture
def image() -> ItexImage:
    """Six rows of four pixels with a slowing sweep."""
    pixels = np.arange(24, dtype="<u2").reshape(6, 4)
    times = np.array([0, 1, 2.25, 3.5, 5, 6.5], np.float32)  # exact in float32
    return ItexImage(
        pixels, TEXT.format(""), (3, 2), {"X": np.arange(4, 0, -1, dtype=np.float32), "Y": times}
    )


def test_a_written_file_is_read_back_as_a_streak(tmp_path: Path, image: ItexImage) -> None:
    write_itex(image, tmp_path / "shot.img")
    streak = read_itex(tmp_path / "shot.img")
    np.testing.assert_array_equal(streak.counts, image.pixels)
    np.testing.assert_allclose(
        streak.times, np.array([0, 1, 2.25, 3.5, 5, 6.5]) * 1e-12, rtol=1e-15
    )


def test_text_of_old_versions_is_western_windows() -> None:
    text = '[Application],Software="HiPic",Unit="µs"'.encode("latin-1")
    data = encode_itex(ItexImage(np.ones((2, 3), "u1"), "x" * len(text)))
    assert decode_itex(data.replace(b"x" * len(text), text)).metadata["Application/Unit"] == "µs"


@pytest.mark.parametrize("keep", [0, 1, 10, 63, 64, 150, 290, -25, -1])
def test_truncated_files_are_refused_when_decoded(image: ItexImage, keep: int) -> None:
    with pytest.raises(FileFormatError):
        decode_itex(encode_itex(image)[:keep])


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
    image: ItexImage, place: int, value: int, problem: str
) -> None:
    data = bytearray(encode_itex(image))
    data[place : place + 2] = value.to_bytes(2, "little")
    with pytest.raises(FileFormatError, match=problem):
        decode_itex(bytes(data))


@pytest.mark.parametrize(
    ("pixels", "arguments", "problem"),
    [
        (np.ones(4, "u1"), {}, "must have shape"),
        (np.ones((0, 4), "u1"), {}, "must have shape"),
        (np.ones((4, 4), "f4"), {}, "not of float32"),
        (np.ones((4, 4), ">u2"), {}, "not of >u2"),
        (np.ones((4, 4), "u1"), {"offset_px": (0, 70000)}, "offset"),
    ],
)
def test_pictures_that_the_format_cannot_hold(
    pixels: NDArray[Any], arguments: dict[str, Any], problem: str
) -> None:
    with pytest.raises((ShapeError, InputError), match=problem):
        ItexImage(pixels, "", **arguments)


def test_texts_that_the_format_cannot_hold() -> None:
    pixels = np.ones((2, 2), "u1")
    with pytest.raises(InputError, match="at most 65535 bytes"):
        encode_itex(ItexImage(pixels, "x" * 70000))
    with pytest.raises(InputError, match="must hold ScalingYScalingFile"):
        encode_itex(ItexImage(pixels, "[Scaling]", tables={"Y": np.zeros(2, np.float32)}))


def test_a_file_larger_than_any_picture_is_not_read(tmp_path: Path) -> None:
    with open(tmp_path / "huge.img", "wb") as file:
        file.write(b"IM")
        file.truncate(1 << 31)  # a hole: takes no room on the disk
    with pytest.raises(FileFormatError, match="larger than any streak image"):
        read_itex(tmp_path / "huge.img")
