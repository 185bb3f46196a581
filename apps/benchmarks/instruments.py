"""Bytes of instruments to records, and photons to histograms, against a copy of the same bytes."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from apps.benchmarks.case import Case, Prepared
from devices.codec import Records, as_bytes
from devices.histogram import BinAxis, StampHistogram, TagHistogram
from devices.linospad2.codec import STAMP, LinoSpad2Codec
from devices.linospad2.simulation import LASER_PERIOD, uneven_board
from devices.timetag.codec import RECORD, TimeTagCodec

MEGA = 10**6
CYCLES = (60, 240)
FILLED = 0.5
"""Share of LinoSPAD2's words that hold a time stamp."""

PHOTONS = (2, 8)  # millions


def copying(data: NDArray[np.generic]) -> Prepared:
    """Return a floor alone: copies of some bytes."""
    target = np.empty_like(data)
    return Prepared(lambda: None, lambda: np.copyto(target, data), 1)


def board_words(cycles: int) -> Prepared:
    """Words of LinoSPAD2 to time stamps."""
    codec, random = LinoSpad2Codec(), np.random.default_rng(0)
    stream = random.integers(0, 1 << 31, (cycles, codec.cycle_words), dtype=np.uint32)
    stream |= (random.random(stream.shape) < FILLED).astype(np.uint32) << 31
    stream[:, 64 * codec.timestamps :] = 0
    data = as_bytes(stream.astype("<u4").tobytes())
    return Prepared(partial(codec.decode, data, 0), copying(data).floor, len(data) / MEGA)


def tag_words(millions: int) -> Prepared:
    """Words of the time tagger to tags."""
    codec = TimeTagCodec()
    data = as_bytes(codec.encode(tags(millions)))
    return Prepared(partial(codec.decode, data, codec.start), copying(data).floor, len(data) / MEGA)


def tags(millions: int) -> Records:
    """Time tags of three detectors and the laser."""
    records = np.zeros(millions * MEGA, RECORD)
    records["time_ticks"] = np.arange(records.size) * 3
    records["channels"] = np.random.default_rng(2).choice([1, 2, 4, 8], records.size)
    return records


def stamp_histogram(millions: int) -> Prepared:
    """Time stamps, in the order of the stream, into histograms of 256 pixels."""
    random, photons = np.random.default_rng(1), millions * MEGA
    records = np.zeros(photons, STAMP)
    records["pixel"] = np.arange(photons) // 100 * 4 % 256 + random.integers(0, 4, photons)
    records["code"] = random.integers(0, 1 << 27, photons)
    histogram = StampHistogram(BinAxis(20e-12, 576, 0.0, LASER_PERIOD), uneven_board(0))
    return Prepared(lambda: histogram.add(records), copying(records).floor, millions)


def tag_histogram(millions: int) -> Prepared:
    """Time tags into histograms of three detectors."""
    records = tags(millions)
    histogram = TagHistogram(BinAxis(1e-9, 512), 0, (1, 2, 3), 1 / 128e6)
    return Prepared(lambda: histogram.add(records), copying(records).floor, millions)


FLOOR = "a copy of the same bytes"

CASES = (
    Case("decode-linospad2", "LinoSPAD2 words to time stamps", "cycles", CYCLES, "MB", FLOOR, board_words),
    Case("decode-timetag", "time tagger's words to tags", "million tags", PHOTONS, "MB", FLOOR, tag_words),
    Case(
        "decode-stamps",
        "time stamps into histograms",
        "million photons",
        PHOTONS,
        "million photons",
        FLOOR,
        stamp_histogram,
    ),
    Case(
        "decode-tags", "time tags into histograms", "million photons", PHOTONS, "million photons", FLOOR, tag_histogram
    ),
)
