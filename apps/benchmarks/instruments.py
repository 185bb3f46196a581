"""Instruments: their bytes to records and photons to histograms, against a copy of the bytes."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from apps.benchmarks.harness import Action, Prepare, PreparedCase
from devices.emulation.linospad2 import LASER_PERIOD_S, draw_uneven_calibration
from devices.histogram import BinAxis, StampHistogram, TagHistogram
from devices.linospad2 import STAMP_DTYPE, LinoSpad2Codec
from devices.source import Records, as_bytes
from devices.timetag_codec import RECORD_DTYPE, TimeTagCodec

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


PREPARE: dict[str, Prepare] = {
    "decode-linospad2": prepare_board_decoding,
    "decode-timetag": prepare_tag_decoding,
    "decode-stamps": prepare_stamp_histogram,
    "decode-tags": prepare_tag_histogram,
}
