"""The time tagger's words, against words written by hand and by a plain-integer encoder."""

from __future__ import annotations

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from devices.source import Records, as_bytes
from devices.timetag.codec import (
    COUNTER_RANGE,
    DELTA,
    LOST,
    RECORD_DTYPE,
    WRAP,
    TimeTagCodec,
    mark_wraps,
)
from tofclip.errors import InputError

CODEC = TimeTagCodec()
unhurried = settings(deadline=None)  # the first call compiles


def record(ticks: int, channels: int, flags: int = 0) -> Records:
    return np.array([(ticks, channels, flags)], RECORD_DTYPE)


def records_of(rows: list[tuple[int, int, int]]) -> Records:
    return np.array(rows, RECORD_DTYPE)


@st.composite
def streams(draw: st.DrawFn) -> Records:
    """Valid streams: steps from zero to several wraps, strobes and deltas, losses."""
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
    return mark_wraps(records_of(rows))


def test_a_word_written_by_hand() -> None:
    word = bytes.fromhex("a5 23 45 67 89 ab")  # 101 00101...: unused bits 00101 are set
    assert CODEC.decode(as_bytes(word), CODEC.start).malformed == 1
    word = bytes.fromhex("a0 93 45 67 89 ab")  # lost, delta, channels 1001, counter 0x3456789ab
    found = CODEC.decode(as_bytes(word), CODEC.start)
    assert found.records.tolist() == [(0x3456789AB, 0b1001, LOST | DELTA)]
    assert CODEC.encode(found.records) == word


@unhurried
@given(streams())
def test_decoding_undoes_encoding(records: Records) -> None:
    found = CODEC.decode(as_bytes(CODEC.encode(records)), CODEC.start)
    assert found.malformed == 0
    np.testing.assert_array_equal(found.records, records)


@unhurried
@given(streams(), st.data())
def test_a_stream_may_be_cut_anywhere(records: Records, data: st.DataObject) -> None:
    stream = as_bytes(CODEC.encode(records))
    cut = data.draw(st.integers(0, len(stream)))
    front = CODEC.count_complete_bytes(stream[:cut])
    first = CODEC.decode(stream[:front], CODEC.start)
    second = CODEC.decode(stream[front:], first.state)
    np.testing.assert_array_equal(np.concatenate([first.records, second.records]), records)


@unhurried
@given(st.binary(max_size=600), st.booleans())
def test_any_bytes_decode_to_valid_records(raw: bytes, after_loss: bool) -> None:
    words = as_bytes(raw)[: CODEC.count_complete_bytes(as_bytes(raw))]
    found = CODEC.decode(words, CODEC.start, after_loss)
    assert len(found.records) + found.malformed == CODEC.count_records(words)
    epochs = found.records["time_ticks"] // COUNTER_RANGE
    marks = np.flatnonzero(found.records["flags"] & WRAP)
    assert np.all(np.diff(epochs) >= 0)
    assert np.all(np.diff(epochs, prepend=0)[marks] == 1)
    assert np.all(found.records["channels"] <= 15)


def test_the_counter_is_unwrapped_at_every_mark() -> None:
    records = mark_wraps(
        records_of(
            [(COUNTER_RANGE - 1, 1, 0), (COUNTER_RANGE + 5, 2, 0), (4 * COUNTER_RANGE, 4, 0)]
        )
    )
    assert records.tolist() == [
        (COUNTER_RANGE - 1, 1, 0),
        (COUNTER_RANGE, 0, WRAP),
        (COUNTER_RANGE + 5, 2, 0),
        (2 * COUNTER_RANGE, 0, WRAP),
        (3 * COUNTER_RANGE, 0, WRAP),
        (4 * COUNTER_RANGE, 4, WRAP),
    ]
    assert (
        CODEC.decode(as_bytes(CODEC.encode(records)), CODEC.start).records.tolist()
        == records.tolist()
    )
    assert len(mark_wraps(records_of([]))) == 0


def test_a_wrap_lost_with_others_is_noticed_by_the_counter_going_back() -> None:
    before, after = record(COUNTER_RANGE - 10, 1), record(7, 1, LOST)
    stream = as_bytes(CODEC.encode(before) + CODEC.encode(after))
    assert CODEC.decode(stream, CODEC.start).records["time_ticks"].tolist() == [
        COUNTER_RANGE - 10,
        COUNTER_RANGE + 7,
    ]


def test_a_loss_on_the_way_is_noticed_alike() -> None:
    before = CODEC.decode(as_bytes(CODEC.encode(record(COUNTER_RANGE - 10, 1))), CODEC.start)
    after = as_bytes(CODEC.encode(record(7, 1)))
    assert CODEC.decode(after, before.state, after_loss=True).records["time_ticks"].tolist() == [
        COUNTER_RANGE + 7
    ]
    assert CODEC.decode(after, before.state).malformed == 1


def test_one_wrong_word_costs_at_most_itself_and_the_next() -> None:
    rows = [(1000 * n, 1, 0) for n in range(1, 9)]
    stream = bytearray(CODEC.encode(records_of(rows)))
    stream[3 * 6 : 4 * 6] = CODEC.encode(record(COUNTER_RANGE - 3, 1))
    found = CODEC.decode(as_bytes(stream), CODEC.start)
    assert found.malformed == 1
    assert found.records["time_ticks"].tolist() == [
        1000,
        2000,
        3000,
        COUNTER_RANGE - 3,
        6000,
        7000,
        8000,
    ]


@pytest.mark.parametrize("word", ["00 00 00 00 00 05", "1f 10 00 00 00 05", "01 10 00 00 00 05"])
def test_impossible_words_are_malformed(word: str) -> None:
    found = CODEC.decode(as_bytes(bytes.fromhex(word)), CODEC.start)
    assert (len(found.records), found.malformed) == (0, 1)


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([(5, 16, 0)], "4 channels"),
        ([(5, 1, 8)], "3 flags"),
        ([(5, 0, 0)], "needs a channel"),
        ([(5, 1, 0), (4, 1, 0)], "not go back"),
        ([(-5, 1, 0)], "not go back"),
        ([(COUNTER_RANGE + 5, 1, 0)], "mark_wraps"),
        ([(2 * COUNTER_RANGE + 5, 1, LOST)], "mark_wraps"),
        ([(5, 1, WRAP)], "mark_wraps"),
    ],
)
def test_records_that_no_instrument_sends_are_refused(
    rows: list[tuple[int, int, int]], said: str
) -> None:
    with pytest.raises(InputError, match=said):
        CODEC.encode(records_of(rows))


def test_other_arrays_and_broken_words_are_refused() -> None:
    with pytest.raises(InputError, match="one-dimensional"):
        CODEC.encode(np.zeros(3))
    with pytest.raises(InputError, match="whole number"):
        CODEC.decode(as_bytes(b"12345"), CODEC.start)


def words(*rows: tuple[int, int]) -> bytes:
    """Words of channel 1 at the given counters, with the given flags."""
    return b"".join((flags << 45 | 1 << 36 | counter).to_bytes(6, "big") for counter, flags in rows)


@pytest.mark.parametrize(
    ("rows", "after_loss", "expected"),
    [
        # A loss explains a wrap, but a small step back is not one.
        ([(1000, 0), (900, LOST), (1100, 0)], False, [1000, 1100]),
        ([(COUNTER_RANGE - 10, 0), (5, LOST)], False, [COUNTER_RANGE - 10, COUNTER_RANGE + 5]),
        # A wrap without a step back has not happened.
        ([(1000, 0), (1000, WRAP), (1100, 0)], False, [1000, 1100]),
        # Only the first good word after a gap may have wrapped unseen.
        ([(10, 0), (COUNTER_RANGE - 1, 0), (5, 0)], True, [10, COUNTER_RANGE - 1]),
    ],
)
def test_only_what_may_have_wrapped_is_taken_for_a_wrap(
    rows: list[tuple[int, int]], after_loss: bool, expected: list[int]
) -> None:
    found = CODEC.decode(words(*rows), CODEC.start, after_loss)
    assert found.records["time_ticks"].tolist() == expected
    assert found.malformed == len(rows) - len(expected)
