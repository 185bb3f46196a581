"""Work on a stream of things in stages, each on a thread of its own, so that they overlap."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from threading import Thread
from time import perf_counter
from typing import Any, NamedTuple

from tofclip.sequences.streaming.channel import Channel, ChannelClosedError, Policy

READ, WAIT = "read", "wait"
STOP_TIMEOUT_S = 5.0
"""Seconds that the end of a stream waits for a source that is just being read."""


class Stage(NamedTuple):
    """One step of the work.

    Parameters
    ----------
    name : str
    work : callable
        Takes what the stage before it returned.
    """

    name: str
    work: Callable[[Any], Any]


@dataclass
class StreamItem:
    """One thing on its way through the stages.

    Parameters
    ----------
    number : int
        Its place in the source, from 0; those that were dropped have been counted.
    value : object
        What the last stage made of it.
    seconds : dict
        Time that each stage took, by name; also ``"read"``, which the source took to bring it and
        which is not latency, and ``"wait"``, spent between stages.
    """

    number: int
    value: Any
    seconds: dict[str, float] = field(default_factory=dict)
    ready: float = 0.0

    @property
    def latency(self) -> float:
        """Time from when the source brought it until it was handed out, s."""
        return sum(time for name, time in self.seconds.items() if name != READ)


def run_stages(
    source: Iterable[Any], stages: Sequence[Stage], queue_size: int = 1, policy: Policy = "block"
) -> Generator[StreamItem, None, None]:
    """Yield what becomes of everything that `source` brings, in order.

    Each stage runs on a thread of its own, and so does the source. When the consumer is slow the
    stages wait for it, and then the channel before the first stage is full: there the policy
    decides. At most ``(queue_size + 1) * (len(stages) + 1)`` things are alive at a time. Closing
    the generator stops the threads, and closes the source on its own thread if it can be closed.

    With ``"drop_oldest"`` no work is begun while a result waits for the consumer, and of several
    that were under way by then only the newest are kept. So what the consumer gets is about as old
    as its own work on the one before takes, not as all the stages' together; at most one thing in
    each stage and channel was worked on in vain for each that is handed out.

    Parameters
    ----------
    source : iterable
    stages : sequence of Stage
        At least one.
    queue_size : int
        Things that wait before each stage, at most.
    policy : "block" or "drop_oldest"
        ``"block"`` lets the source wait: nothing is lost of a file, and an instrument's own buffer
        fills up. ``"drop_oldest"`` keeps the latency low: a live view takes the newest.

    Yields
    ------
    StreamItem

    Raises
    ------
    Whatever the source or a stage raises, once everything before it has been yielded.
    """
    channels = [
        Channel[StreamItem](queue_size, policy),
        *(Channel[StreamItem](queue_size) for _ in stages[1:]),
        # Results that were finished meanwhile are dropped for newer ones as well: were they kept,
        # everything behind them would wait and grow old.
        Channel[StreamItem](queue_size, policy),
    ]
    threads = [
        Thread(target=_run_reader, args=(source, channels[0]), name="stream reader", daemon=True)
    ]
    # Nothing is begun while the consumer has not taken what is there.
    gates = [channels[-1] if policy == "drop_oldest" else None, *(None for _ in stages[1:])]
    for stage, gate, (before, after) in zip(stages, gates, pairwise(channels), strict=True):
        threads.append(
            Thread(
                target=_run_stage,
                args=(stage, before, after, gate),
                name=f"stream {stage.name}",
                daemon=True,
            )
        )
    for thread in threads:
        thread.start()
    try:
        while (item := channels[-1].get()) is not None:
            _add_waiting_time(item, perf_counter())
            yield item
    finally:
        # First all channels, then the threads: a thread that waits on a neighbour's channel must
        # wake up.
        for channel in channels:
            channel.close()
        for thread in threads:
            thread.join(STOP_TIMEOUT_S)


def _run_reader(source: Iterable[Any], target: Channel[StreamItem]) -> None:
    """Bring what the source has; the reader's whole life."""
    items = iter(source)
    try:
        started = perf_counter()
        for number, value in enumerate(items):
            now = perf_counter()
            target.put(StreamItem(number, value, {READ: now - started, WAIT: 0.0}, now))
            started = perf_counter()
        target.finish()
    except ChannelClosedError:
        # Closed on this thread, because a generator cannot be closed while another thread runs it.
        getattr(items, "close", lambda: None)()
    except BaseException as fault:  # the consumer gets to see it
        target.finish(fault)


def _run_stage(
    stage: Stage,
    source: Channel[StreamItem],
    target: Channel[StreamItem],
    gate: Channel[StreamItem] | None,
) -> None:
    """Work on one thing after the other, each when the gate has room; a stage's whole life."""
    try:
        while True:
            if gate is not None:
                gate.wait_for_room()
            item = source.get()
            if item is None:
                break
            started = perf_counter()
            _add_waiting_time(item, started)
            item.value = stage.work(item.value)
            item.ready = perf_counter()
            item.seconds[stage.name] = item.ready - started
            target.put(item)
        target.finish()
    except ChannelClosedError:
        pass
    except BaseException as fault:  # the consumer gets to see it
        target.finish(fault)


def _add_waiting_time(item: StreamItem, now: float) -> None:
    item.seconds[WAIT] += now - item.ready
