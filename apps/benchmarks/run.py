"""Run cases, each size and number of threads in a fresh process, and put the figures together."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

from apps.benchmarks.case import Case
from apps.benchmarks.machine import describe_machine
from apps.benchmarks.peers import PEER_TIMEOUT_S, PEERS_VARIABLE
from tofclip.threads import THREADS_VARIABLE, thread_count

CASE_TIMEOUT_S = 120
TOTAL_TIMEOUT_S = 1200
"""What has not begun by then is left out, so that a run has an end on any machine: twice what two
slow cores take. The time of processes that ask other programs as well does not count.
"""


class TimeBudget:
    """Counts down `TOTAL_TIMEOUT_S`."""

    def __init__(self) -> None:
        self.remaining_s = float(TOTAL_TIMEOUT_S)
        """Seconds that are left, not negative."""

    def spend(self, seconds: float) -> None:
        """Take off what a process took."""
        self.remaining_s = max(0.0, self.remaining_s - seconds)


def run_cases(
    cases: Sequence[Case], peers: str | None, advance: Callable[[int], None]
) -> dict[str, Any]:
    """Measure cases one after the other.

    `peers`: python in which other programs are installed; `advance`: called with 1 after each
    process; there are `count_processes` of them. Returns ``describe_machine`` and ``entries``, one
    for each case.
    """
    machine = describe_machine()  # before anything is measured: its load is that of others
    clock = TimeBudget()
    return {
        "machine": machine,
        "entries": [_run_case(case, peers, clock, advance) for case in cases],
    }


def count_processes(cases: Sequence[Case]) -> int:
    """Return how many processes `run_cases` starts."""
    return sum(len(case.sizes) + len(list_thread_counts()) - 1 for case in cases)


def list_thread_counts() -> list[int]:
    """Return the numbers of threads that are compared: 1 and all, which is 2 on the smallest
    machines.
    """
    return sorted({1, thread_count()})


def _run_case(
    case: Case, peers: str | None, clock: TimeBudget, advance: Callable[[int], None]
) -> dict[str, Any]:
    *fewer, most = list_thread_counts()
    runs = []
    for size in case.sizes:
        for count in [*fewer, most] if size == case.sizes[-1] else [most]:
            wanted = peers if count == most else None  # a peer is asked once for each size
            figures = _run_process(case, (size, count), wanted, clock)
            if wanted != peers and "peers" in figures:
                figures["peers"] = {}  # not asked: that says nothing of the Python that was named
            runs.append({"size": size, "threads": count, **figures})
            advance(1)
    return {
        "name": case.name,
        "title": case.title,
        "size": case.size,
        "unit": case.unit,
        "floor": case.floor,
        "runs": runs,
        "growth": _fit_growth(runs, most),
    }


def _run_process(
    case: Case, extent: tuple[int, int], peers: str | None, clock: TimeBudget
) -> dict[str, Any]:
    """Figures of a fresh process for a size and a number of threads, or ``problem``: why there are
    none.
    """
    size, count = extent
    if clock.remaining_s == 0:
        return {"problem": f"left out: the others took {TOTAL_TIMEOUT_S} s"}
    longest = CASE_TIMEOUT_S + (PEER_TIMEOUT_S if peers else 0)  # what has begun may finish
    # with this program's own path: another one may lie in the folder that the user is in
    code = f"import sys; sys.path[:] = {sys.path!r}; import apps.benchmarks.__main__ as one; one.main()"
    command = [sys.executable, "-c", code, case.name, str(size)]
    environment = {**os.environ, THREADS_VARIABLE: str(count), PEERS_VARIABLE: peers or ""}
    began = time.monotonic()
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, env=environment, timeout=longest
        )
    except subprocess.TimeoutExpired:
        return {"problem": f"took more than {longest:.0f} s"}
    finally:
        if not peers:
            clock.spend(time.monotonic() - began)
    if done.returncode:
        return {
            "problem": (
                done.stderr.strip().splitlines() or [f"ended with status {done.returncode}"]
            )[-1]
        }
    figures: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return figures


def _fit_growth(runs: Sequence[dict[str, Any]], count: int) -> float | None:
    """Power of the size with which the time grows, between the least and the greatest size."""
    known = [run for run in runs if run["threads"] == count and "seconds" in run]
    if len(known) < 2:
        return None
    first, last = known[0], known[-1]
    times = last["seconds"]["median"] / first["seconds"]["median"]
    return math.log(times) / math.log(last["size"] / first["size"])
