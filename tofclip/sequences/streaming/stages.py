"""Work on a stream of things in stages, each on a thread of its own, so that they overlap."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from threading import Thread
from time import perf_counter
from typing import Any, NamedTuple

from tofclip.sequences.streaming.channel import Channel, ClosedError, Policy

READ, WAIT = "read", "wait"
LONGEST_STOP = 5.0
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
class Passage:
    """One thing on its way through the stages.

    Parameters
    ----------
    number : int
        Its place in the source, from 0; those that were dropped have been counted.
    value : object
        What the last stage made of it.
    seconds : dict
        Time that each stage took, by name; also ``"read"``, which the source took to bring it and which is no latency,
        and ``"wait"``, spent between stages.
    """

    number: int
    value: Any
    seconds: dict[str, float] = field(default_factory=dict)
    ready: float = 0.0

    @property
    def latency(self) -> float:
        """Time from when the source brought it until it was handed out, s."""
        return sum(time for name, time in self.seconds.items() if name != READ)


def in_stages(
    source: Iterable[Any], stages: Sequence[Stage], held: int = 1, policy: Policy = "block"
) -> Generator[Passage, None, None]:
    """Yield what becomes of everything that `source` brings, in order.

    Each stage runs on a thread of its own, and so does the source. When the consumer is slow the stages wait for it,
    and then the channel before the first stage is full: there the policy decides. So whatever is dropped has cost no
    work, and at most ``(held + 1) * (len(stages) + 1)`` things are alive at a time. Closing the generator stops the
    threads, and closes the source on its own thread if it can be closed.

    Parameters
    ----------
    source : iterable
    stages : sequence of Stage
        At least one.
    held : int
        Things that wait before each stage, at most.
    policy : "block" or "drop_oldest"
        ``"block"`` lets the source wait: nothing is lost of a file, and an instrument's own buffer fills up.
        ``"drop_oldest"`` keeps the latency low.

    Raises
    ------
    Whatever the source or a stage raises, once everything before it has been yielded.
    """
    channels = [Channel[Passage](held, policy), *(Channel[Passage](held) for _ in stages)]
    threads = [Thread(target=_read, args=(source, channels[0]), name="stream reader", daemon=True)]
    for stage, (before, after) in zip(stages, pairwise(channels), strict=True):
        threads.append(Thread(target=_run, args=(stage, before, after), name=f"stream {stage.name}", daemon=True))
    for thread in threads:
        thread.start()
    try:
        while (passage := channels[-1].get()) is not None:
            _note_waiting(passage, perf_counter())
            yield passage
    finally:
        for channel in channels:
            channel.close()
        for thread in threads:
            thread.join(LONGEST_STOP)


def _read(source: Iterable[Any], target: Channel[Passage]) -> None:
    """Bring what the source has; the reader's whole life."""
    items = iter(source)
    try:
        started = perf_counter()
        for number, value in enumerate(items):
            now = perf_counter()
            target.put(Passage(number, value, {READ: now - started, WAIT: 0.0}, now))
            started = perf_counter()
        target.finish()
    except ClosedError:
        getattr(items, "close", lambda: None)()
    except BaseException as fault:  # the consumer gets to see it
        target.finish(fault)


def _run(stage: Stage, source: Channel[Passage], target: Channel[Passage]) -> None:
    """Work on one thing after the other; a stage's whole life."""
    try:
        while (passage := source.get()) is not None:
            started = perf_counter()
            _note_waiting(passage, started)
            passage.value = stage.work(passage.value)
            passage.ready = perf_counter()
            passage.seconds[stage.name] = passage.ready - started
            target.put(passage)
        target.finish()
    except ClosedError:
        pass
    except BaseException as fault:  # the consumer gets to see it
        target.finish(fault)


def _note_waiting(passage: Passage, now: float) -> None:
    passage.seconds[WAIT] += now - passage.ready
