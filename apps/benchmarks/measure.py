"""Run one case at one size in this process, which is fresh: time, memory, floor and peers."""

from __future__ import annotations

import statistics
import time
from typing import Any

from apps.benchmarks.case import Action, Case, PeerUnavailableError
from tofclip.sequences.jobs.jobs import measure_peak_memory_bytes

MIN_REPEATS, MAX_REPEATS = 3, 31
REPEAT_TIME_S = 1.0
"""Repeats go on for so long, or until there are `MAX_REPEATS`."""

SLOW_TIME_S = 2.0
"""What takes longer is measured once."""

FLOOR_TIME_S = 0.3
BYTES_PER_MIB = 1 << 20


def measure_case(case: Case, size: int) -> dict[str, Any]:
    """Return the figures of a case at one size.

    Returns ``seconds`` (median, least and greatest of the repeats after one that warms up),
    ``per_second``, ``peak_mib`` of the process with its libraries and inputs, ``own_mib`` of that
    only while the action ran, ``floor_seconds``, ``times_floor``, ``peers``: seconds, or why there
    are none, and ``figures``, where the case has more to say.
    """
    ready = case.prepare(size)
    before = measure_peak_memory_bytes()
    ready.action()
    peak = measure_peak_memory_bytes()
    seconds = time_repeats(ready.action, REPEAT_TIME_S)
    ready.floor()
    floor = statistics.median(time_repeats(ready.floor, FLOOR_TIME_S)) / ready.floor_fraction
    median = statistics.median(seconds)
    figures = dict(ready.figures())
    return {
        "seconds": {
            "median": median,
            "least": min(seconds),
            "greatest": max(seconds),
            "repeats": len(seconds),
        },
        "per_second": ready.amount / median,
        "peak_mib": peak / BYTES_PER_MIB,
        "own_mib": (peak - before) / BYTES_PER_MIB,
        "floor_seconds": floor,
        "times_floor": median / floor,
        "peers": {name: _time_peer(peer) for name, peer in ready.peers.items()},
        **({"figures": figures} if figures else {}),
    }


def time_repeats(action: Action, seconds: float) -> list[float]:
    """Time an action again and again.

    `seconds`: stop when the repeats took this long; from `MIN_REPEATS` to `MAX_REPEATS` of them.
    Returns seconds.
    """
    found: list[float] = []
    while len(found) < MAX_REPEATS:
        began = time.perf_counter()
        action()
        found.append(time.perf_counter() - began)
        enough = len(found) >= MIN_REPEATS or found[0] > SLOW_TIME_S
        if enough and sum(found) >= seconds:
            break
    return found


def _time_peer(peer: Any) -> dict[str, Any]:
    try:
        return {"seconds": peer()}
    except PeerUnavailableError as absence:
        return {"absent": str(absence)}
