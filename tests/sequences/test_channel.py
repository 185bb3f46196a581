"""Channels between threads: order, policies, ends and faults."""

from __future__ import annotations

from threading import Thread
from time import sleep

import pytest

from tofclip.errors import InputError
from tofclip.sequences.streaming import Channel, ChannelClosedError


def test_entries_come_in_order_and_then_the_end():
    channel = Channel[int](3)
    for number in range(3):
        channel.put(number)
    channel.finish()
    assert [channel.get() for _ in range(4)] == [0, 1, 2, None]


def test_a_full_channel_blocks_until_something_is_taken():
    channel = Channel[int](1)
    channel.put(0)
    done = []
    thread = Thread(target=lambda: (channel.put(1), done.append(True)))
    thread.start()
    sleep(0.05)
    assert not done
    assert channel.get() == 0
    thread.join(5)
    assert done
    assert channel.get() == 1


def test_what_has_waited_longest_is_dropped():
    channel = Channel[int](2, "drop_oldest")
    for number in range(5):
        channel.put(number)
    channel.finish()
    assert channel.dropped == 3
    assert [channel.get() for _ in range(3)] == [3, 4, None]


def test_a_fault_comes_behind_the_last_entry():
    channel = Channel[int](2)
    channel.put(7)
    channel.finish(ValueError("broken"))
    assert channel.get() == 7
    with pytest.raises(ValueError, match="broken"):
        channel.get()


def test_closing_frees_whoever_waits():
    full, empty = Channel[int](1), Channel[int](1)
    full.put(0)
    ended = []

    def put() -> None:
        with pytest.raises(ChannelClosedError):
            full.put(1)
        ended.append("put")

    threads = [Thread(target=put), Thread(target=lambda: ended.append(empty.get()))]
    for thread in threads:
        thread.start()
    sleep(0.05)
    full.close()
    empty.close()
    for thread in threads:
        thread.join(5)
    assert sorted(map(str, ended)) == ["None", "put"]


def test_unusable_channels_are_refused():
    with pytest.raises(InputError, match="one entry or more"):
        Channel(0)
    with pytest.raises(InputError, match="policy"):
        Channel(1, "drop_newest")  # type: ignore[arg-type]
