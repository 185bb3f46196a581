"""Random faults against the emulated time tagger: what came, what was reported, what really happened."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Sequence
from dataclasses import dataclass

from devices.address import Uri
from devices.emulation.faults import PERMANENT_ENUMERATIONS, Fault
from devices.emulation.timetag import (
    CLOCK_HZ,
    EmulatedTimeTagger,
    EmulatorSettings,
    GroundTruth,
    PoissonStream,
)
from devices.emulation.usb import VirtualUsb
from devices.source import Batch, Source, Stats
from devices.timetag.driver import open_on_backend
from tofclip.errors import (
    DeviceDisconnectedError,
    DeviceError,
    DeviceStalledError,
    DeviceTimeoutError,
)

RECORDS = 8000
TRANSFERS = 36
"""Of 512 bytes each: by then the instrument is not dark, even if six faults lose 600 records each."""
ADDRESS = "timetag://?transfer_kib=0.5&reconnect_s=2"
LONGEST_RUN = 60.0


@dataclass
class Outcome:
    """How a run ended."""

    batches: list[Batch]
    stats: Stats
    truth: GroundTruth
    fault: Exception | None = None
    is_over: bool = False


def light(seed: int, resets: int = 0) -> PoissonStream:
    """Return what the instrument sees after its counter was reset so often."""
    return PoissonStream(1e6, CLOCK_HZ, seed + 100_000 * resets)


def run(
    script: Sequence[Fault], seed: int, records: int = RECORDS, address: str = ADDRESS
) -> Outcome:
    """Read an emulated instrument until it is dark or fails, under a watchdog."""
    instrument = EmulatedTimeTagger(
        lambda resets: light(seed, resets), "T1", EmulatorSettings(records=records), script
    )
    outcome = Outcome([], Stats(), instrument.truth)
    thread = threading.Thread(target=_read, args=(instrument, address, outcome), daemon=True)
    thread.start()
    thread.join(LONGEST_RUN)
    assert outcome.is_over, f"hangs with {script}"
    return outcome


def _read(instrument: EmulatedTimeTagger, address: str, outcome: Outcome) -> None:
    source = open_on_backend(Uri.parse(address), "", VirtualUsb(instrument))
    try:
        with source:
            while instrument.truth.registered < instrument.setting.records:
                _read_what_is_there(source, outcome.batches)
            source.stop()
            while (batch := source.read()) is not None:
                outcome.batches.append(batch)
    except DeviceError as fault:
        outcome.fault = fault
    outcome.stats = source.stats
    outcome.is_over = True


def _read_what_is_there(source: Source, batches: list[Batch]) -> None:
    with contextlib.suppress(DeviceTimeoutError):
        while (batch := source.read(0.02)) is not None:
            batches.append(batch)


def expected_fault(script: Sequence[Fault]) -> type[DeviceError] | None:
    """Return the exception that must end a run, which nothing but a lasting stall or absence does."""
    stalls = {fault.transfer for fault in script if fault.kind == "stall"}
    for fault in script:
        if fault.kind == "stall" and (fault.amount > 1 or fault.transfer + 1 in stalls):
            return DeviceStalledError
        if fault.kind in ("unplug", "powerloss") and fault.amount >= PERMANENT_ENUMERATIONS:
            return DeviceDisconnectedError
    return None
