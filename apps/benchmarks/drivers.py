"""Study: an instrument's whole path (emulator, driver, ring, decoder, file), against decoding alone."""

from __future__ import annotations

import atexit
import itertools
import tempfile
from pathlib import Path

import devices
from apps.benchmarks.harness import Action, Case, PreparedCase
from devices.emulation.timetag import CLOCK_HZ, MAX_TICK, PoissonStream
from devices.recorder import record_source
from devices.source import Source, as_bytes
from devices.timetag.codec import RECORD_BYTES, TimeTagCodec

MEGA = 10**6
ADDRESS = "sim+timetag://?seed=1"
SIZES_MB = (16, 64)
PIECE_BYTES = (1 << 19) // RECORD_BYTES * RECORD_BYTES
RATE_HZ = 1.28e7


def read_records(source: Source, size_mb: int) -> None:
    """Read and decode a source until `size_mb` megabytes have come.

    `source`: closed at the end.
    """
    wanted, records = size_mb * MEGA // RECORD_BYTES, 0
    with source:
        while records < wanted:
            batch = source.read()
            if batch is None:
                break
            records += len(batch.records)
        source.stop()


def make_decoding(size_mb: int) -> Action:
    """The bare decoder on as many bytes, in pieces as the driver hands them over."""
    codec = TimeTagCodec()
    count = PIECE_BYTES // RECORD_BYTES
    words = as_bytes(PoissonStream(RATE_HZ, CLOCK_HZ, 1).next_words(count, MAX_TICK))
    pieces = size_mb * MEGA // PIECE_BYTES

    def decode() -> None:
        for _ in range(pieces):
            codec.decode(words, codec.start)

    return decode


def prepare_driver(size_mb: int) -> PreparedCase:
    """From the emulated instrument through pyusb's own code to records."""
    return PreparedCase(
        lambda: read_records(devices.open(ADDRESS), size_mb), make_decoding(size_mb), size_mb
    )


def make_recording(size_mb: int) -> Path:
    """A recording of so much, in a folder that goes when the process ends."""
    folder = tempfile.TemporaryDirectory()
    atexit.register(folder.cleanup)
    path, source = Path(folder.name) / "run.h5", devices.open(ADDRESS)

    def stop_when_enough(_: float) -> None:
        if path.stat().st_size > size_mb * MEGA:
            source.stop()

    record_source(source, path, watch=stop_when_enough)
    return path


def prepare_recorder(size_mb: int) -> PreparedCase:
    """A source of bytes, here a recording, into a file."""
    path, number = make_recording(size_mb), itertools.count()

    def record() -> None:
        copy = path.with_name(f"copy{next(number)}.h5")
        record_source(devices.open(f"file://{path}"), copy)
        copy.unlink()

    return PreparedCase(record, make_decoding(size_mb), size_mb)


def prepare_replay(size_mb: int) -> PreparedCase:
    """A recording to its records."""
    path = make_recording(size_mb)
    return PreparedCase(
        lambda: read_records(devices.open(f"file://{path}"), size_mb),
        make_decoding(size_mb),
        size_mb,
    )


CASES = tuple(
    Case(f"driver-{name}", title, "MB", SIZES_MB, "MB", "decoding the same bytes alone", prepare)
    for name, title, prepare in (
        ("timetag", "time tagger: emulator, pyusb, driver, ring, decoder", prepare_driver),
        ("record", "a recording, recorded anew", prepare_recorder),
        ("replay", "a recording to its records", prepare_replay),
    )
)
