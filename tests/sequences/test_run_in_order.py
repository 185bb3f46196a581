"""Work on a stream: order, overlap, bounded numbers, measured times, ends."""

import gc
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor
from time import sleep

import pytest

from tofclip.errors import InputError
from tofclip.sequences.streaming import run_in_order

STEP = 0.05


@pytest.fixture
def worker():
    with ThreadPoolExecutor(1) as pool:
        yield pool


def slow(value):
    sleep(STEP)
    return value


def keep(value):
    return value


def count(number, seconds=0.0, begun=keep):
    for value in range(number):
        sleep(seconds)
        begun(value)
        yield value


def stream_threads():
    return [thread for thread in threading.enumerate() if thread.name.startswith("stream ")]


def test_a_slow_consumer_holds_the_source_back(worker):
    brought = []
    stream = run_in_order(count(50, begun=brought.append), keep, worker, at_once=2, queue_size=2)
    next(stream)
    sleep(4 * STEP)
    # two before the work and two in it, the one handed out, and the one that the reader holds
    assert len(brought) <= 6
    assert [item.number for item in stream] == list(range(1, 50))


def test_the_oldest_of_those_that_wait_are_dropped(worker):
    brought = threading.Event()

    def source():
        yield from range(6)
        brought.set()

    def work(value):
        brought.wait(30)
        return slow(value)

    items = run_in_order(source(), work, worker, 1, queue_size=3, policy="drop_oldest")
    assert [item.number for item in items] == [0, 3, 4, 5]


def test_a_slow_consumer_gets_the_newest_where_that_is_wanted():
    source = count(40, STEP / 5)
    with ThreadPoolExecutor(3) as workers:
        items = []
        for item in run_in_order(source, keep, workers, at_once=3, policy="drop_oldest"):
            items.append(item)
            sleep(2 * STEP)
    assert items[-1].number == 39
    # what comes next was read while the consumer was busy with the one before
    assert sorted(item.latency for item in items)[len(items) // 2] < 2.5 * STEP


def test_few_things_are_alive(worker):
    class Thing:
        pass

    alive = weakref.WeakSet()
    highest = 0

    def source():
        nonlocal highest
        for _ in range(30):
            thing = Thing()
            alive.add(thing)
            if len(alive) > 4:  # nothing but a cycle of references could keep them then
                gc.collect()
            highest = max(highest, len(alive))
            yield thing

    def work(_):
        sleep(STEP / 10)  # slower than the source, so that things pile up if they can
        return 1

    assert sum(item.value for item in run_in_order(source(), work, worker, at_once=1)) == 30
    # one being worked on, one that waits, the one that the reader holds, and the one that it makes
    assert highest <= 4


@pytest.mark.parametrize("place", ["source", "work"])
def test_a_fault_is_raised_behind_what_was_done(place, worker):
    def source():
        yield from range(3)
        if place == "source":
            raise OSError("unplugged")
        yield from range(3, 99)

    def work(value):
        if place == "work" and value == 3:
            raise OSError("unplugged")
        return value

    stream = run_in_order(source(), work, worker, at_once=2)
    assert [next(stream).number for _ in range(3)] == [0, 1, 2]
    with pytest.raises(OSError, match="unplugged"):
        next(stream)
    assert not stream_threads()


def test_leaving_early_ends_the_threads_and_closes_the_source(worker):
    closed = threading.Event()

    def source():
        try:
            while True:
                yield 0
        finally:
            closed.set()

    held = source()  # else letting go of it would close it as well
    stream = run_in_order(held, keep, worker, at_once=2)
    next(stream)
    stream.close()
    assert closed.wait(5)
    assert not stream_threads()


def test_what_fails_is_told_and_the_stream_goes_on(worker):
    def work(value):
        if value == 2:
            raise InputError("dark")
        return value

    failed = []
    source = [0, InputError("half written"), 2, 3]

    def note(number, fault):
        failed.append((number, str(fault)))

    items = run_in_order(source, work, worker, 1, on_failure=note)
    assert [(item.number, item.value) for item in items] == [(0, 0), (3, 3)]
    assert failed == [(1, "half written"), (2, "dark")]
    with pytest.raises(InputError, match="half written"):
        list(run_in_order(source, work, worker, 1))


def test_unusable_streams_are_refused(worker):
    for wrong in ({"at_once": 0}, {"queue_size": 0}, {"policy": "all"}):
        with pytest.raises(InputError, match=r"one entry|policy"):
            next(run_in_order([], keep, worker, **{"at_once": 1, **wrong}))
