"""Instruments: their bytes to records and photons to histograms, against a copy of the bytes, and the
whole path (emulator, driver, ring, decoder, file), against decoding alone.
"""

from __future__ import annotations

import atexit
import itertools
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import devices
from apps.benchmarks.harness import Action, Prepare, PreparedCase
from devices.emulation.linospad2 import LASER_PERIOD_S, draw_uneven_calibration
from devices.emulation.timetag import CLOCK_HZ, MAX_TICK, PoissonStream
from devices.histogram import BinAxis, StampHistogram, TagHistogram
from devices.linospad2 import STAMP_DTYPE, LinoSpad2Codec
from devices.recorder import record_source
from devices.source import Records, Source, as_bytes
from devices.timetag_codec import RECORD_BYTES, RECORD_DTYPE, TimeTagCodec

MEGA = 10**6
FILL_FRACTION = 0.5  # of LinoSPAD2's words hold a time stamp


def make_copy(data: NDArray[np.generic]) -> Action:
    """The floor: a copy of the same bytes."""
    return partial(np.copyto, np.empty_like(data), data)


def prepare_board_decoding(cycles: int) -> PreparedCase:
    """Words of LinoSPAD2 to time stamps."""
    codec, random = LinoSpad2Codec(), np.random.default_rng(0)
    stream = random.integers(0, 1 << 31, (cycles, codec.cycle_words), dtype=np.uint32)
    stream |= (random.random(stream.shape) < FILL_FRACTION).astype(np.uint32) << 31
    stream[:, 64 * codec.timestamps :] = 0
    data = as_bytes(stream.astype("<u4").tobytes())
    return PreparedCase(partial(codec.decode, data, 0), make_copy(data), len(data) / MEGA)


def prepare_tag_decoding(millions: int) -> PreparedCase:
    """Words of the time tagger to tags."""
    codec = TimeTagCodec()
    data = as_bytes(codec.encode(make_tags(millions)))
    return PreparedCase(partial(codec.decode, data, codec.start), make_copy(data), len(data) / MEGA)


def make_tags(millions: int) -> Records:
    """Time tags of three detectors and the laser."""
    records = np.zeros(millions * MEGA, RECORD_DTYPE)
    records["time_ticks"] = np.arange(records.size) * 3
    records["channels"] = np.random.default_rng(2).choice([1, 2, 4, 8], records.size)
    return records


def prepare_stamp_histogram(millions: int) -> PreparedCase:
    """Time stamps, in the order of the stream, into histograms of 256 pixels."""
    random, photons = np.random.default_rng(1), millions * MEGA
    records = np.zeros(photons, STAMP_DTYPE)
    records["pixel"] = np.arange(photons) // 100 * 4 % 256 + random.integers(0, 4, photons)
    records["code"] = random.integers(0, 1 << 27, photons)
    histogram = StampHistogram(
        BinAxis(20e-12, 576, 0.0, LASER_PERIOD_S), draw_uneven_calibration(0)
    )
    return PreparedCase(lambda: histogram.add(records), make_copy(records), millions)


def prepare_tag_histogram(millions: int) -> PreparedCase:
    """Time tags into histograms of three detectors."""
    records = make_tags(millions)
    histogram = TagHistogram(BinAxis(1e-9, 512), 0, (1, 2, 3), 1 / 128e6)
    return PreparedCase(lambda: histogram.add(records), make_copy(records), millions)


ADDRESS = "sim+timetag://?seed=1"
PIECE_BYTES = (1 << 19) // RECORD_BYTES * RECORD_BYTES
RATE_HZ = 1.28e7


def read_records(source: Source, size_mb: int) -> None:
    """Read and decode a source until `size_mb` megabytes have come, and close it."""
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


def prepare_reading(recorded: bool, size_mb: int) -> PreparedCase:
    """From the emulated instrument through pyusb's own code, or from a recording, to records."""
    address = f"file://{make_recording(size_mb)}" if recorded else ADDRESS
    read = partial(read_records, size_mb=size_mb)
    return PreparedCase(lambda: read(devices.open(address)), make_decoding(size_mb), size_mb)


PREPARE: dict[str, Prepare] = {
    "decode-linospad2": prepare_board_decoding,
    "decode-timetag": prepare_tag_decoding,
    "decode-stamps": prepare_stamp_histogram,
    "decode-tags": prepare_tag_histogram,
    "driver-timetag": partial(prepare_reading, False),
    "driver-record": prepare_recorder,
    "driver-replay": partial(prepare_reading, True),
}
