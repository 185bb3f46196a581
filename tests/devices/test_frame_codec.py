"""Pictures as records."""

from __future__ import annotations

from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from numpy.typing import NDArray

from devices.frames import FrameCodec
from devices.registry import build_codec
from devices.source import as_bytes
from devices.spad512 import ExposureRequest
from tofclip.errors import InputError


@st.composite
def films(draw: st.DrawFn) -> tuple[FrameCodec, NDArray[Any]]:
    """A codec and up to five frames with rising numbers, some of them large."""
    bits = draw(st.sampled_from([1, 8, 16, 32]))
    codec = FrameCodec(draw(st.integers(1, 5)), draw(st.integers(1, 4)) * 8, bits)
    numbers = sorted(draw(st.sets(st.integers(0, 2**62), max_size=5)))
    records = np.zeros(len(numbers), codec.dtype)
    records["number"] = numbers
    random = np.random.default_rng(draw(st.integers(0, 1000)))
    records["counts"] = random.integers(0, 1 << bits, records["counts"].shape, dtype=np.uint64)
    return codec, records


@given(films())
def test_decoding_gives_back_the_frames(film: tuple[FrameCodec, NDArray[Any]]) -> None:
    codec, records = film
    data = as_bytes(codec.encode(records))
    found = codec.decode(data, codec.start)
    np.testing.assert_array_equal(found.records, records)
    assert (found.malformed, codec.count_records(data), codec.count_complete_bytes(data)) == (
        0,
        len(records),
        len(data),
    )
    assert found.state == (int(records["number"][-1]) if len(records) else codec.start)
    assert build_codec("frames", codec.settings) == codec


def test_pixels_lie_where_they_should() -> None:
    codec = FrameCodec(2, 8, 1)
    found = codec.decode(as_bytes(codec.pack_frame(5, bytes([0b10000001, 0b00001111]))), 4).records
    assert found["counts"].tolist() == [[[1, 0, 0, 0, 0, 0, 0, 1], [0, 0, 0, 0, 1, 1, 1, 1]]]
    codec = FrameCodec(1, 2, 16)
    assert codec.decode(as_bytes(codec.pack_frame(0, b"\x01\x02\x03\x04")), -1).records[
        "counts"
    ].tolist() == [[[0x201, 0x403]]]


def test_a_frame_that_comes_again_is_malformed() -> None:
    codec = FrameCodec(1, 1, 8)
    data = b"".join(codec.pack_frame(number, b"x") for number in (3, 3, 2, 4, 1, 9))
    found = codec.decode(as_bytes(data), 2)
    assert (found.records["number"].tolist(), found.malformed, found.state) == ([3, 4, 9], 3, 9)
    assert codec.decode(as_bytes(data), 9).malformed == 6


@pytest.mark.parametrize(
    "shape", [(0, 8, 8), (1, -8, 8), (3, 7, 1), (1 << 14, 1 << 14, 16), (8, 8, 12)]
)
def test_pictures_that_cannot_be_are_refused(shape: tuple[int, int, int]) -> None:
    with pytest.raises(InputError):
        FrameCodec(*shape)


def test_frames_that_cannot_be_are_refused() -> None:
    codec = FrameCodec(1, 8, 1)
    with pytest.raises(InputError, match="one-dimensional array"):
        codec.encode(np.zeros(3))
    with pytest.raises(InputError, match="rising numbers from 0"):
        codec.encode(np.zeros(3, codec.dtype))
    two = np.zeros(1, codec.dtype)
    two["counts"] = 2
    with pytest.raises(InputError, match="0 or 1"):
        codec.encode(two)
    with pytest.raises(InputError, match="whole number"):
        codec.decode(np.zeros(3, np.uint8), -1)


@pytest.mark.parametrize(
    ("bits", "pile_up", "stored"), [(4, False, 8), (8, False, 8), (8, True, 16), (12, False, 16)]
)
def test_pictures_of_more_than_eight_bits_take_two_bytes(
    bits: int, pile_up: bool, stored: int
) -> None:
    """Corrected for pile-up, counts of 8 bits go beyond 255."""
    request = ExposureRequest(bits=bits, pile_up=pile_up)
    assert request.codec.bits == stored
