"""Codecs: a contract that all of them keep, then each one's words against words written by hand."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_array_equal

from devices.frames import FrameCodec
from devices.linospad2 import FIRMWARES, MAX_TIMESTAMPS, LinoSpad2Codec
from devices.registry import CODECS, build_codec
from devices.source import as_bytes
from devices.timetag_codec import (
    COUNTER_RANGE,
    DELTA,
    LOST,
    RECORD_DTYPE,
    WRAP,
    TimeTagCodec,
    mark_wraps,
)
from tofclip.errors import InputError
from tofclip.threads import THREADS_VARIABLE

TAGS = TimeTagCodec()


def tags_of(*rows):
    return np.array([*rows], RECORD_DTYPE)


@st.composite
def draw_tags(draw):
    """Steps from zero to several wraps, strobes and deltas, losses."""
    steps = st.one_of(
        st.integers(0, 1000),
        st.integers(0, 3 * COUNTER_RANGE),
        st.sampled_from([COUNTER_RANGE, COUNTER_RANGE - 1, 1]),
    )
    kinds = st.one_of(
        st.tuples(st.integers(1, 15), st.sampled_from([0, LOST])),
        st.tuples(st.integers(0, 15), st.sampled_from([DELTA, DELTA | LOST])),
    )
    rows, now = [], 1
    for step, kind in draw(st.lists(st.tuples(steps, kinds), max_size=40)):
        now += step
        rows.append((now, *kind))
    return TAGS, mark_wraps(tags_of(*rows))


@st.composite
def draw_stamps(draw):
    """Time stamps that a stream of LinoSPAD2 can hold."""
    codec = LinoSpad2Codec(
        draw(st.sampled_from(FIRMWARES)), draw(st.integers(1, 6)), draw(st.booleans())
    )
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    records = np.zeros(draw(st.integers(0, 300)), codec.dtype)
    records["cycle"] = random.integers(0, 5, len(records))
    records["pixel"] = random.integers(0, 256, len(records))
    records["code"] = random.integers(0, 1 << 28, len(records))
    if codec.counter:
        records["counter"] = random.integers(0, 1 << 63, 5, dtype=np.uint64)[records["cycle"]]
    records = codec.sort_stamps(records)
    queue = records["cycle"].astype(int) * 64 + codec.address_of[records["pixel"]] // 4
    first = np.searchsorted(queue, queue)
    return codec, records[np.arange(len(records)) - first < codec.timestamps]


@st.composite
def draw_frames(draw):
    """Up to five frames with rising numbers, some of them large."""
    bits = draw(st.sampled_from([1, 8, 16, 32]))
    codec = FrameCodec(draw(st.integers(1, 5)), draw(st.integers(1, 4)) * 8, bits)
    numbers = sorted(draw(st.sets(st.integers(0, 2**62), max_size=5)))
    records = np.zeros(len(numbers), codec.dtype)
    records["number"] = numbers
    random = np.random.default_rng(draw(st.integers(0, 1000)))
    records["counts"] = random.integers(0, 1 << bits, records["counts"].shape, dtype=np.uint64)
    return codec, records


DRAWN = {"timetag": draw_tags(), "linospad2": draw_stamps(), "frames": draw_frames()}


@pytest.mark.parametrize("name", CODECS)
@given(data=st.data())
def test_a_stream_comes_back_wherever_it_is_cut(name, data):
    codec, records = data.draw(DRAWN[name])
    stream = as_bytes(codec.encode(records))
    assert codec.count_complete_bytes(stream) == len(stream)
    assert codec.count_records(stream) == len(records)
    cut = codec.count_complete_bytes(stream[: data.draw(st.integers(0, len(stream)))])
    first = codec.decode(stream[:cut], codec.start)
    second = codec.decode(stream[cut:], first.state)
    assert_array_equal(np.concatenate([first.records, second.records]), records)
    assert (first.malformed, second.malformed) == (0, 0)
    assert first.records.dtype == codec.dtype
    again = build_codec(name, codec.settings)
    assert (again.settings, again.dtype) == (codec.settings, codec.dtype)


COUNTED, PLAIN = LinoSpad2Codec(timestamps=2, counter=True), LinoSpad2Codec(timestamps=2)


@pytest.mark.parametrize(
    ("codec", "rows", "said"),
    [
        (TAGS, [(5, 16, 0)], "4 channels"),
        (TAGS, [(5, 1, 8)], "3 flags"),
        (TAGS, [(5, 0, 0)], "needs a channel"),
        (TAGS, [(5, 1, 0), (4, 1, 0)], "not go back"),
        (TAGS, [(-5, 1, 0)], "not go back"),
        (TAGS, [(COUNTER_RANGE + 5, 1, 0)], "mark_wraps"),
        (TAGS, [(2 * COUNTER_RANGE + 5, 1, LOST)], "mark_wraps"),
        (TAGS, [(5, 1, WRAP)], "mark_wraps"),
        (PLAIN, [(0, 1, 256)], "pixel below 256"),
        (PLAIN, [(0, 1 << 28, 0)], "code below"),
        (PLAIN, [(1, 1, 0), (0, 1, 0)], "in order"),
        (PLAIN, [(0, 1, 9), (0, 1, 0)], "in order"),
        (PLAIN, [(0, 1, 0), (0, 2, 1), (0, 3, 2)], "more time stamps"),
        (PLAIN, [(1 << 31, 1, 0)], "in pieces"),
        (COUNTED, [(5, 0, 1, 0), (6, 0, 1, 0)], "same counter"),
        (FrameCodec(1, 1, 8), [(0, [[1]]), (0, [[1]])], "rising numbers from 0"),
        (FrameCodec(1, 1, 8), [(-1, [[1]])], "rising numbers from 0"),
        (FrameCodec(1, 8, 1), [(0, [[0, 0, 0, 0, 0, 0, 0, 2]])], "0 or 1"),
    ],
)
def test_records_that_no_instrument_sends(codec, rows, said):
    with pytest.raises(InputError, match=said):
        codec.encode(np.array(rows, codec.dtype))
    with pytest.raises(InputError, match="one-dimensional"):
        codec.encode(np.zeros(3))
    with pytest.raises(InputError, match="whole number"):
        codec.decode(as_bytes(b"12345"), codec.start)


@pytest.mark.parametrize(
    ("name", "settings", "said"),
    [
        ("linospad2", ("2208",), "2212b or 2212s"),
        ("linospad2", ("2212b", 0), "1..16384"),
        ("linospad2", ("2212b", MAX_TIMESTAMPS + 1), "1..16384"),
        ("frames", (0, 8, 8), "cannot be"),
        ("frames", (1, -8, 8), "cannot be"),
        ("frames", (3, 7, 1), "cannot be"),
        ("frames", (1 << 14, 1 << 14, 16), "cannot be"),
        ("frames", (8, 8, 12), "bits, not 12"),
    ],
)
def test_impossible_settings_are_refused(name, settings, said):
    with pytest.raises(InputError, match=said):
        CODECS[name](*settings)


# The time tagger's


def test_a_tag_written_by_hand():
    word = bytes.fromhex("a5 23 45 67 89 ab")  # 101 00101...: unused bits 00101 are set
    assert TAGS.decode(as_bytes(word), TAGS.start).malformed == 1
    word = bytes.fromhex("a0 93 45 67 89 ab")  # lost, delta, channels 1001, counter 0x3456789ab
    found = TAGS.decode(as_bytes(word), TAGS.start)
    assert found.records.tolist() == [(0x3456789AB, 0b1001, LOST | DELTA)]
    assert TAGS.encode(found.records) == word


@pytest.mark.parametrize("word", ["00 00 00 00 00 05", "1f 10 00 00 00 05", "01 10 00 00 00 05"])
def test_impossible_words_are_malformed(word):
    found = TAGS.decode(as_bytes(bytes.fromhex(word)), TAGS.start)
    assert (len(found.records), found.malformed) == (0, 1)


def test_the_counter_is_unwrapped_at_every_mark():
    full = COUNTER_RANGE
    records = mark_wraps(tags_of((full - 1, 1, 0), (full + 5, 2, 0), (4 * full, 4, 0)))
    assert records.tolist() == [
        (full - 1, 1, 0),
        (full, 0, WRAP),
        (full + 5, 2, 0),
        (2 * full, 0, WRAP),
        (3 * full, 0, WRAP),
        (4 * full, 4, WRAP),
    ]
    found = TAGS.decode(as_bytes(TAGS.encode(records)), TAGS.start)
    assert found.records.tolist() == records.tolist()
    assert len(mark_wraps(tags_of())) == 0


def tag_words(*rows):
    """Words of channel 1 at the given counters, with the given flags."""
    return b"".join((flags << 45 | 1 << 36 | counter).to_bytes(6, "big") for counter, flags in rows)


@pytest.mark.parametrize(
    ("rows", "after_loss", "expected"),
    [
        # A loss explains a wrap, but a small step back is not one.
        ([(1000, 0), (900, LOST), (1100, 0)], False, [1000, 1100]),
        ([(COUNTER_RANGE - 10, 0), (7, LOST)], False, [COUNTER_RANGE - 10, COUNTER_RANGE + 7]),
        # A wrap without a step back has not happened.
        ([(1000, 0), (1000, WRAP), (1100, 0)], False, [1000, 1100]),
        # Only the first good word after a gap may have wrapped unseen.
        ([(10, 0), (COUNTER_RANGE - 1, 0), (5, 0)], True, [10, COUNTER_RANGE - 1]),
        # One wrong word costs at most itself and the next.
        (
            [(1000, 0), (2000, 0), (COUNTER_RANGE - 3, 0), (4000, 0), (5000, 0)],
            False,
            [1000, 2000, COUNTER_RANGE - 3, 5000],
        ),
    ],
)
def test_only_what_may_have_wrapped_is_taken_for_a_wrap(rows, after_loss, expected):
    found = TAGS.decode(as_bytes(tag_words(*rows)), TAGS.start, after_loss)
    assert found.records["time_ticks"].tolist() == expected
    assert found.malformed == len(rows) - len(expected)


def test_a_loss_between_two_pieces_may_hide_a_wrap():
    before = TAGS.decode(as_bytes(tag_words((COUNTER_RANGE - 10, 0))), TAGS.start)
    after = as_bytes(tag_words((7, 0)))
    found = TAGS.decode(after, before.state, after_loss=True).records
    assert found["time_ticks"].tolist() == [COUNTER_RANGE + 7]
    assert TAGS.decode(after, before.state).malformed == 1


# LinoSPAD2's


def stamp_words(codec, cycles):
    return np.zeros((cycles, codec.cycle_words), "<u4")


@pytest.mark.parametrize(
    ("firmware", "converter", "address", "pixel"),
    [
        ("2212b", 0, 3, 3),
        ("2212b", 63, 1, 253),
        ("2212b", 5, 0, 20),
        ("2212s", 0, 3, 192),
        ("2212s", 63, 1, 127),
    ],
)
def test_stamps_written_by_hand(firmware, converter, address, pixel):
    codec = LinoSpad2Codec(firmware, timestamps=3)
    stream = stamp_words(codec, 2)
    stream[1, converter * 3 + 2] = 1 << 31 | address << 28 | 1234567
    stream[1, converter * 3 + 1] = 0x7FFFFFFF  # bit 31 says that there is none
    found = codec.decode(as_bytes(stream.tobytes()), 10)
    assert found.records.tolist() == [(11, 1234567, pixel)]
    assert (found.malformed, found.state) == (0, 12)


def test_the_absolute_counter_is_two_words_low_first():
    codec = LinoSpad2Codec(timestamps=2, counter=True)
    stream = stamp_words(codec, 1)
    stream[0, :3] = [0x89ABCDEF, 0x01234567, 1 << 31 | 7]
    found = codec.decode(as_bytes(stream.tobytes()), 0).records
    assert found["counter"].tolist() == [0x0123456789ABCDEF]
    assert (found["code"].tolist(), found["pixel"].tolist()) == ([7], [0])


def test_stamps_of_the_converter_without_pixels_are_malformed():
    codec = LinoSpad2Codec(timestamps=4)
    stream = stamp_words(codec, 3)
    stream[1, 0] = stream[2, 64 * 4 : 64 * 4 + 2] = 1 << 31 | 5
    data = as_bytes(stream.tobytes())
    found = codec.decode(data, 0)
    assert (len(found.records), found.malformed, codec.count_records(data)) == (1, 2, 3)


def test_threads_change_nothing(monkeypatch):
    codec, random = LinoSpad2Codec(timestamps=20), np.random.default_rng(1)
    stream = random.integers(0, 1 << 32, (1500, codec.cycle_words), dtype=np.uint64).astype("<u4")
    found = []
    for threads in ("1", "3"):
        monkeypatch.setenv(THREADS_VARIABLE, threads)
        found.append(codec.decode(as_bytes(stream.tobytes()), 0))
    alone, together = found
    assert_array_equal(together.records, alone.records)
    assert together.malformed == alone.malformed == np.count_nonzero(stream[:, 64 * 20 :] >> 31)
    assert len(alone.records) == np.count_nonzero(stream[:, : 64 * 20] >> 31)


# Cameras'


def test_pixels_lie_where_they_should():
    codec = FrameCodec(2, 8, 1)
    found = codec.decode(as_bytes(codec.pack_frame(5, bytes([0b10000001, 0b00001111]))), 4).records
    assert found["counts"].tolist() == [[[1, 0, 0, 0, 0, 0, 0, 1], [0, 0, 0, 0, 1, 1, 1, 1]]]
    codec = FrameCodec(1, 2, 16)
    found = codec.decode(as_bytes(codec.pack_frame(0, b"\x01\x02\x03\x04")), -1).records
    assert found["counts"].tolist() == [[[0x201, 0x403]]]


def test_a_frame_that_comes_again_is_malformed():
    codec = FrameCodec(1, 1, 8)
    data = b"".join(codec.pack_frame(number, b"x") for number in (3, 3, 2, 4, 1, 9))
    found = codec.decode(as_bytes(data), 2)
    assert (found.records["number"].tolist(), found.malformed, found.state) == ([3, 4, 9], 3, 9)
    assert codec.decode(as_bytes(data), 9).malformed == 6
