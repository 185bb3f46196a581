"""How fast the time tagger's path is, whether it drops anything at half of that, and a thousand
random faults.

Run with ``python tests/benchmarks/instruments.py [--seconds S] [--steady S] [--scripts N]
[--json]``. Everything goes through the real driver and pyusb's own code, on the emulated
instrument, which makes its photons on the same machine. ``--steady 60`` is the long run of the
acceptance; its memory is looked at once a second.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import devices
from devices.codec import as_bytes
from devices.emulation.faults import draw_fault_script
from devices.emulation.photons import MAX_TICK, PoissonStream
from devices.emulation.timetag import CLOCK_HZ
from devices.recorder import record_source
from devices.throughput import measure_throughput
from devices.timetag.codec import RECORD_BYTES, TimeTagCodec
from tofclip.errors import DeviceDisconnectedError

MEGA = 1e6
SIM = "sim+timetag://?seed=1"
AT_ONCE = 16
PAGE_KIB = resource.getpagesize() // 1024


def decoding(repeats: int) -> dict[str, float]:
    """The bare codec, both ways, on a piece of half a megabyte."""
    codec = TimeTagCodec()
    words = as_bytes(PoissonStream(1.28e7, CLOCK_HZ, 1).words((1 << 19) // RECORD_BYTES, MAX_TICK))
    records = codec.decode(words, codec.start).records

    def rate(action: Any) -> float:
        action()
        seconds = []
        for _ in range(repeats):
            begin = time.perf_counter()
            action()
            seconds.append(time.perf_counter() - begin)
        return float(len(words) / statistics.median(seconds) / MEGA)

    return {
        "decode_mb_per_s": rate(lambda: codec.decode(words, codec.start)),
        "encode_mb_per_s": rate(lambda: codec.encode(records)),
    }


def flat_out(seconds: float, repeats: int) -> dict[str, float]:
    """As fast as it goes: emulator, pyusb, driver, ring, decoding to NumPy."""
    measure_throughput(devices.open(SIM), 0.5)
    rates = [
        measure_throughput(devices.open(SIM), seconds).figures["bytes_per_second"] / MEGA
        for _ in range(repeats)
    ]
    return {
        "pyusb_path_mb_per_s": statistics.median(rates),
        "least": min(rates),
        "greatest": max(rates),
    }


def to_disk_and_back(seconds: float) -> dict[str, float]:
    """Recording with decoding, and the replay of that."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "run.h5")
        done = record_source(devices.open(SIM), path, seconds)
        replay = measure_throughput(devices.open(f"file://{path}"), 600.0)
    return {
        "record_mb_per_s": done.bytes / done.seconds / MEGA,
        "replay_mb_per_s": replay.figures["bytes_per_second"] / MEGA,
    }


def steady(seconds: float, rate_mb: float) -> dict[str, float]:
    """A constant rate for some time: nothing may be lost, and memory must not grow."""
    address = f"{SIM}&pace=realtime&rate={rate_mb * MEGA / RECORD_BYTES}"
    memory: list[tuple[float, float]] = []

    def look(passed: float) -> None:
        if not memory or passed > memory[-1][0] + min(1.0, seconds / 10):
            memory.append((passed, resident_mib()))

    trial = measure_throughput(devices.open(address), seconds, look)
    settled = [size for passed, size in memory if passed >= seconds / 4]
    return {
        "steady_seconds": seconds,
        "steady_mb_per_s": trial.bytes / trial.seconds / MEGA,
        "dropped_host": trial.stats.dropped_host,
        "lost_device": trial.stats.lost_device,
        "malformed": trial.stats.malformed,
        "memory_mib": settled[-1],
        "memory_growth_mib": max(settled) - settled[0],
    }


def resident_mib() -> float:
    """Memory of this process now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE_KIB / 1024


def faults(number: int) -> dict[str, float]:
    """Random faults: scripts in which the accounts or the exception were not what they should be."""
    sys.path.append(str(Path(__file__).parents[1] / "devices"))
    import fault_scripts  # shared with the tests

    scripts = [draw_fault_script(seed, fault_scripts.TRANSFERS) for seed in range(number)]
    with ThreadPoolExecutor(AT_ONCE) as pool:
        outcomes = list(pool.map(fault_scripts.run, scripts, range(number)))
    unbalanced = sum(not outcome.stats.is_balanced for outcome in outcomes)
    untrue = sum(
        outcome.stats.acquired != outcome.truth.registered - outcome.truth.lost_power_off
        for outcome in outcomes
        if not isinstance(outcome.fault, DeviceDisconnectedError)
    )
    wrong = sum(
        type(outcome.fault) is not (fault_scripts.expected_fault(script) or type(None))
        for script, outcome in zip(scripts, outcomes, strict=True)
    )
    return {"scripts": number, "unbalanced": unbalanced, "untrue": untrue, "wrong_exception": wrong}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=3.0, help="of each repeat at full speed")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--steady", type=float, default=10.0, help="seconds at constant rate")
    parser.add_argument("--rate", type=float, default=75.0, help="that rate, in MB/s")
    parser.add_argument("--scripts", type=int, default=1000)
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    figures = {
        **decoding(100),
        **flat_out(chosen.seconds, chosen.repeats),
        **to_disk_and_back(chosen.seconds),
        **steady(chosen.steady, chosen.rate),
        **faults(chosen.scripts),
    }
    if chosen.json:
        print(json.dumps(figures))
        return
    for name, value in figures.items():
        print(f"{name:<22}{value:>12.4g}")


if __name__ == "__main__":
    main()
