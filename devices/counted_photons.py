"""From an instrument's address to photons counted in time for each pixel, (t, y, x): what
`tofclip lidar photons` takes.

Besides what a source itself takes, its address may say how to gather (`ScanOptions`). Photons with a
time stamp each, as of a LinoSPAD2's recording, are counted in bins, for which the values of
`devices.transients.Accumulation` are taken; the line of pixels is a picture of one row.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from devices.address import Options, Uri, option
from devices.linospad2 import BoardCalibration
from devices.recording.read import read_head_if_recording
from devices.registry import open as open_source
from devices.source import Source
from devices.transients import (
    Accumulation,
    accumulate_streak,
    read_batches,
    strip_options,
)
from tofclip.errors import InputError
from tofclip.lidar import Pulse
from tofclip.lidar.photons import PhotonImage
from tofclip.storage import Record

MAX_CUBE_BYTES = 1 << 32
STAMPS_SUFFIX = ".dat"
# Of addresses whose photons may have a time stamp each; other instruments have bins of their own
STAMP_SCHEMES = ("file", "linospad2", "sim+linospad2")
# Standard deviation of a gate's edges and the laser's pulse, where nothing better is known, s
EDGE_S = 1e-10


@dataclass(frozen=True)
class ScanOptions(Options):
    """Values of an address that say how to gather."""

    scans: int = option(1, above=0)  # whole scans of a gate, or whole histograms, to add up
    binning: int = option(1, above=0)  # pixels along each side of a square that count as one


@dataclass(frozen=True)
class CountedPhotons:
    """Photons of a picture, as an instrument counted them."""

    counts: NDArray[np.float32]  # (bins, rows, columns)
    times: NDArray[np.float64]  # (bins,), of each bin, s after the laser's pulse; evenly spaced
    # how a return at one instant shows in successive bins, where the instrument knows
    pulse: Pulse | None = None

    @property
    def bin_width(self) -> float:
        """Duration of a bin, s."""
        return float(self.times[-1] - self.times[0]) / (len(self.times) - 1)

    def to_image(self) -> PhotonImage:
        """Return the photons as events, sorted by pixel."""
        return PhotonImage.from_cube(np.moveaxis(self.counts, 0, -1), self.bin_width)


def find_address(file: str) -> str | None:
    """Return the address of a file that holds an instrument's records, None of any other file."""
    path = Path(file)
    is_stamps = path.suffix.lower() == STAMPS_SUFFIX
    return f"file://{file}" if is_stamps or read_head_if_recording(path) is not None else None


def read_photons(address: str, bin_width: float | None = None) -> CountedPhotons:
    """Read as many whole scans as an address asks for, or count the photons of a recording.

    Memory: the counts, and one batch of the source.

    `address`: as `devices.open` takes it, with the values of `ScanOptions` where wanted; `bin_width`:
    duration of a bin, s, in which photons with a time stamp each are counted, 20 ps by default;
    other instruments know their own.
    """
    uri = Uri.parse(address)
    scanning = ScanOptions.from_uri(uri, *uri.values)
    gathering = Accumulation.of(uri, bin_width)
    counting = Accumulation.names() if uri.scheme in STAMP_SCHEMES else ()
    with open_source(strip_options(uri, ScanOptions.names() + counting)) as source:
        known = source.calibration
        names = () if known is None else known.fields
        axis = next((name for name in ("gate_times", "bin_times") if name in names), None)
        if known is not None and known.kind == BoardCalibration.RECORD_KIND:
            batches = read_batches(source, gathering.seconds)
            streak = accumulate_streak(batches, known, gathering)
            dark = np.float32(0) if streak.saturated is None else streak.saturated
            counts = np.where(dark, np.float32(0), streak.counts)  # of hot pixels
            return CountedPhotons(counts[:, np.newaxis, :], streak.times)
        if bin_width is not None:
            raise InputError(f"'{address}': an instrument knows its own bins")
        if known is None or axis is None:
            raise InputError(
                f"'{address}': {source.info.instrument} counts no photons in time for each pixel; "
                "a SPAD array does with mode=gated"
            )
        times = known.array(axis, np.float64, 1, "s")
        pulse = None
        if axis == "bin_times":
            counts = _add_histograms(source, scanning.scans) * known.number("count_scale")
        else:
            counts = _add_scans(source, len(times), scanning.scans, scanning.binning)
            pulse = _make_gate_response(known, times)
        source.drain()
    return CountedPhotons(counts, times, pulse)


def _add_histograms(source: Source, scans: int) -> NDArray[np.float32]:
    """Add up histograms (bins, zones) that the instrument has made; zones become one row."""
    total: NDArray[np.float32] | None = None
    done = 0
    for batch in read_batches(source, inf):
        for record in batch.records[: scans - done]:
            counts = record["counts"][:, np.newaxis, :].astype(np.float32)
            total = counts if total is None else total + counts
            done += 1
        if total is not None and done == scans:
            return total
    raise InputError(f"the source ended after {done} of {scans} whole scans")


def _add_scans(source: Source, steps: int, scans: int, binning: int) -> NDArray[np.float32]:
    """Add up whole scans; pictures of one that was cut are left out."""
    total: NDArray[np.float32] | None = None
    present: NDArray[np.float32] | None = None
    done = step = begun = 0  # `begun`: number of the scan's first picture
    for batch in read_batches(source, inf):
        for record in batch.records:
            counts = record["counts"]
            rows, columns = (size // binning for size in counts.shape)
            if total is None or present is None:
                if steps * rows * columns * 4 > MAX_CUBE_BYTES:
                    raise InputError(
                        "that number of photons does not fit into 4 GiB: choose binning=2 or 4"
                    )
                total = np.zeros((steps, rows, columns), np.float32)
                present = np.zeros_like(total)
            number = int(record["number"])
            if number != begun + step:  # cut: wait for the next beginning
                step = 0
                if number % steps:
                    continue
                begun = number
            whole = counts[: rows * binning, : columns * binning]
            present[step] = whole.reshape(rows, binning, columns, binning).sum(axis=(1, 3))
            step += 1
            if step == steps:
                total += present
                step, done, begun = 0, done + 1, begun + steps
                if done == scans:
                    return total
    raise InputError(f"the source ended after {done} of {scans} whole scans")


def _make_gate_response(known: Record, times: NDArray[np.float64]) -> Pulse:
    """Return how one instant shows while a gate moves over it: it is seen from when the gate still
    closes behind it until it opens after it, which is the instant itself.
    """
    from scipy.special import ndtr

    width = known.number("gate_width_s")
    step = float(times[1] - times[0])
    spacing = min(step, EDGE_S) / 4
    margin = 5 * EDGE_S
    offset = np.arange(-width - margin, margin + spacing, spacing)
    seen = ndtr(-offset / EDGE_S) - ndtr((-offset - width) / EDGE_S)
    return Pulse(seen, spacing, (width + margin) / spacing)
