"""The buffer between the instrument and a slow reader."""

from __future__ import annotations

import threading

import pytest

from devices.source import Gap, Ledger, OverflowPolicy, Piece, RingBuffer, Stats
from tofclip.errors import BufferOverflowError, DeviceDisconnectedError, DeviceTimeoutError

SOON = 0.02


def filled(policy: OverflowPolicy, pieces: int) -> tuple[RingBuffer, Ledger]:
    """A ring with room for three pieces of two records."""
    ledger = Ledger()
    ring = RingBuffer(30, policy, ledger)
    for number in range(pieces):
        ring.put(Piece(bytes([number]) * 10, 2))
    return ring, ledger


def numbers(ring: RingBuffer) -> list[tuple[int, Gap]]:
    ring.end()
    found = []
    while (piece := ring.get(SOON)) is not None:
        found.append((piece.data[0], piece.gap))
    return found


def test_pieces_come_out_as_they_went_in() -> None:
    ring, ledger = filled("block", 3)
    assert ledger.stats == Stats(acquired=6, unread=6)
    assert numbers(ring) == [(0, Gap.NONE), (1, Gap.NONE), (2, Gap.NONE)]
    assert ring.get(SOON) is None


def test_the_oldest_go_and_the_gap_is_marked() -> None:
    ring, ledger = filled("drop_oldest", 5)
    assert ledger.stats == Stats(acquired=10, unread=6, dropped_host=4)
    assert numbers(ring) == [(2, Gap.LOSS), (3, Gap.NONE), (4, Gap.NONE)]


def test_a_dropped_restart_stays_a_restart() -> None:
    ledger = Ledger()
    ring = RingBuffer(10, "drop_oldest", ledger)
    ring.put(Piece(b"a" * 10, 1, Gap.RESTART))
    ring.put(Piece(b"b" * 10, 1))
    assert numbers(ring) == [(ord("b"), Gap.RESTART)]


def test_a_restart_stays_one_though_only_a_loss_was_dropped_before_it() -> None:
    ring = RingBuffer(20, "drop_oldest", Ledger())
    ring.put(Piece(b"a" * 10, 1))
    ring.put(Piece(b"b" * 10, 1, Gap.RESTART))
    ring.put(Piece(b"c" * 10, 1))
    assert numbers(ring) == [(ord("b"), Gap.RESTART), (ord("c"), Gap.NONE)]


def test_one_piece_always_fits() -> None:
    ring = RingBuffer(1, "fail", Ledger())
    ring.put(Piece(b"larger than that", 1))
    assert numbers(ring) == [(ord("l"), Gap.NONE)]


def test_failing_ends_after_what_was_in_time() -> None:
    ring, ledger = filled("fail", 3)
    with pytest.raises(BufferOverflowError, match="policy=drop_oldest"):
        ring.put(Piece(b"x" * 10, 2))
    assert ledger.stats == Stats(acquired=8, unread=6, dropped_host=2)
    for number in range(3):
        piece = ring.get(SOON)
        assert piece is not None
        assert piece.data[0] == number
    for _ in range(2):
        with pytest.raises(BufferOverflowError):
            ring.get(SOON)


def test_blocking_waits_for_room() -> None:
    ring, ledger = filled("block", 3)
    writer = threading.Thread(target=ring.put, args=(Piece(b"\x03" * 10, 2),))
    writer.start()
    writer.join(SOON)
    assert writer.is_alive()
    first = ring.get(SOON)
    writer.join(5.0)
    assert not writer.is_alive()
    assert first is not None
    assert ledger.stats.dropped_host == 0
    assert [number for number, _ in numbers(ring)] == [1, 2, 3]


def test_the_end_frees_a_writer() -> None:
    ring, _ = filled("block", 3)
    writer = threading.Thread(target=ring.put, args=(Piece(b"\x03" * 10, 2),))
    writer.start()
    ring.end()
    writer.join(5.0)
    assert not writer.is_alive()
    assert len(numbers(ring)) == 4


def test_the_first_fault_counts() -> None:
    ring, _ = filled("block", 0)
    with pytest.raises(DeviceTimeoutError, match=r"for 0\.02 s"):
        ring.get(SOON)
    ring.fail(DeviceDisconnectedError("first"))
    ring.fail(DeviceDisconnectedError("second"))
    with pytest.raises(DeviceDisconnectedError, match="first"):
        ring.get(SOON)
