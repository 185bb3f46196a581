"""Stages side by side: order, overlap, bounded numbers, measured times, ends."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from time import perf_counter, sleep

import pytest

from tofclip.sequences.streaming import Stage, run_stages

STEP = 0.05


def slow(value: int) -> int:
    sleep(STEP)
    return value


def test_values_pass_all_stages_in_order():
    stages = [Stage("double", lambda value: 2 * value), Stage("text", str)]
    passages = list(run_stages(range(20), stages))
    assert [passage.value for passage in passages] == [str(2 * number) for number in range(20)]
    assert [passage.number for passage in passages] == list(range(20))


def test_stages_overlap_and_their_times_are_told():
    started = perf_counter()
    passages = list(run_stages(range(8), [Stage("first", slow), Stage("second", slow)]))
    # one after the other they would take 16 steps, side by side 9
    assert perf_counter() - started < 13 * STEP
    for passage in passages:
        assert set(passage.seconds) == {"read", "wait", "first", "second"}
        assert passage.seconds["first"] >= STEP
        assert passage.latency == pytest.approx(
            sum(passage.seconds.values()) - passage.seconds["read"]
        )
    assert passages[0].latency < 3.5 * STEP


def test_a_slow_consumer_holds_the_source_back():
    brought: list[int] = []

    def source() -> Iterator[int]:
        for number in range(50):
            brought.append(number)
            yield number

    stream = run_stages(source(), [Stage("same", lambda value: value)], queue_size=2)
    next(stream)
    sleep(4 * STEP)
    # two before and two behind the stage, one in it, the one handed out, and the one that the
    # reader holds
    assert len(brought) <= 7
    assert [passage.number for passage in stream] == list(range(1, 50))


def test_a_slow_stage_drops_the_oldest_where_that_is_wanted():
    def source() -> Iterator[int]:
        for number in range(20):
            sleep(STEP / 5)
            yield number

    passages = list(run_stages(source(), [Stage("slow", slow)], policy="drop_oldest"))
    numbers = [passage.number for passage in passages]
    assert numbers[-1] == 19  # the newest is never dropped
    assert numbers == sorted(numbers)
    assert 4 <= len(numbers) < 12
    assert all(passage.latency < 3.5 * STEP for passage in passages)


@pytest.mark.parametrize("place", ["source", "stage"])
def test_a_fault_is_raised_behind_what_was_done(place):
    def source() -> Iterator[int]:
        yield from range(3)
        if place == "source":
            raise OSError("unplugged")
        yield from range(3, 99)

    def work(value: int) -> int:
        if place == "stage" and value == 3:
            raise OSError("unplugged")
        return value

    stream = run_stages(source(), [Stage("work", work), Stage("same", lambda value: value)])
    assert [next(stream).number for _ in range(3)] == [0, 1, 2]
    with pytest.raises(OSError, match="unplugged"):
        next(stream)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("stream ")]


def test_leaving_early_ends_the_threads_and_closes_the_source():
    closed = threading.Event()

    def source() -> Iterator[int]:
        try:
            while True:
                yield 0
        finally:
            closed.set()

    stream = run_stages(source(), [Stage("same", lambda value: value)])
    next(stream)
    stream.close()
    assert closed.wait(5)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("stream ")]
