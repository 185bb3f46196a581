"""From a source's address to the streak image that recovery takes: photons histogrammed, frames
added up.

Besides what a source itself takes, its address may say how to gather (`Accumulation`), e.g.
``file://run.h5?seconds=2&bins=576``:

* ``seconds``: of reading, at most; a live source that never ends needs it, 10 by default;
* ``frames``: of a camera, to add up; 1 by default;
* ``bins``, ``start_ps``, ``period_ps``: number of histogram bins, middle of the first one after the
  laser's pulse, and the laser's period, where the source does not know it;
* ``records``: photons of a shot, where a source is read shot after shot; 100 000 by default;
* ``sync``, ``pixels``: channel of the laser's pulses and channels of the line's pixels of a time
  tagger, ``0`` and ``1,2,3`` by default.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from urllib.parse import quote, urlencode

import numpy as np
from numpy.typing import NDArray

from devices.address import Options, Uri, option, parse_integers
from devices.files import compute_photon_times
from devices.histogram import BinAxis, StampHistogram, TagHistogram, TimeHistogram
from devices.linospad2 import BoardCalibration
from devices.registry import open as open_source
from devices.source import READ_TIMEOUT_S, Batch, Source
from tofclip.camera import Camera
from tofclip.errors import DeviceTimeoutError, InputError
from tofclip.shots import Streak
from tofclip.storage import Record, collect_provenance

BIN_WIDTH_S = 20e-12  # Width of a histogram's bins where no other is given, s
PICOSECOND_S = 1e-12


@dataclass(frozen=True)
class Accumulation(Options):
    """How records become a streak image; see the module's text."""

    seconds: float = option(10.0, above=0)
    frames: int = option(1, above=0)
    bins: int | None = option(None, int)  # None: as many as fit into the laser's period
    start_ps: float = option(0.0)
    period_ps: float | None = option(None, float)  # None: as the source says
    records: int = option(100_000, above=0)
    sync: int = option(0)
    pixels: tuple[int, ...] = option((1, 2, 3), parse_integers)
    # s. None: `BIN_WIDTH_S` for photons, and the camera's own time axis for frames
    bin_width: float | None = None

    @classmethod
    def of(cls, uri: Uri, bin_width: float | None) -> Accumulation:
        """Read the values of an address that say how to gather; the others are the source's."""
        return replace(cls.from_uri(uri, *uri.values), bin_width=bin_width)

    def axis(self, known_period: float | None) -> BinAxis:
        """Return the bins of a histogram of photons."""
        width = BIN_WIDTH_S if self.bin_width is None else self.bin_width
        start = self.start_ps * PICOSECOND_S
        period = self.period_ps * PICOSECOND_S if self.period_ps else known_period
        if self.bins is not None:
            return BinAxis(width, self.bins, start, period)
        if period is None:
            raise InputError(
                "the laser's period is not known: add period_ps=... or bins=... to the address"
            )
        if not 0 < width <= period:
            raise InputError(
                f"bins must be longer than 0 and shorter than the laser's period, got {width} s"
            )
        return BinAxis(width, int(period / width * (1 + 1e-9)), start, period)


def read_transient(address: str, bin_width: float | None = None) -> Streak:
    """Read a source until it ends, or as long as its address says, and return a streak image.

    Memory: one batch of the source, and the streak image.

    Parameters
    ----------
    address : str
        As `devices.open` takes it, with the values of `Accumulation` where needed.
    bin_width : float, optional
        Width of a photon histogram's bins, s, 20 ps by default; of a camera's rows instead of its
        own time axis.

    Returns
    -------
    Streak
        With the camera that the source knows, if it knows one; hot pixels, and pixels that reached
        a camera's limit, are marked in ``Streak.saturated``.

    Raises
    ------
    InputError
        The address is none, its values cannot be, or there were no photons.
    DeviceError
        The instrument failed before there was anything to gather.
    """
    uri = Uri.parse(address)
    gathering = Accumulation.of(uri, bin_width)
    with open_source(strip_options(uri)) as source:
        known = source.calibration
        streak = accumulate_streak(read_batches(source, gathering.seconds), known, gathering)
        past = {
            **collect_provenance({"address": address, "bin_width_s": bin_width}),
            "source": source.info.as_dict(),
        }
        source.drain()
    past["stats"] = source.stats.as_dict()
    return replace(streak, camera=read_camera(known), source=address, provenance=past)


def accumulate_streak(
    batches: Iterator[Batch], calibration: Record | None, gathering: Accumulation
) -> Streak:
    """Make one streak image of everything that comes."""
    first = next(batches, None)
    if first is None:
        raise InputError("the source ended before it gave anything")
    known = calibration or Record("none")
    names = first.records.dtype.names or ()
    if "counts" in names:
        return _sum_frames(first, batches, calibration, gathering)
    if "histogram" in names:
        return _stack_histograms([first, *batches], known, gathering)
    histogram = _make_histogram(names, known, gathering)
    for batch in itertools.chain([first], batches):
        records = batch.records
        if isinstance(histogram, TagHistogram):
            histogram.add(records, batch.after_gap)
        elif isinstance(histogram, TimeHistogram):
            histogram.add(records["channel"], compute_photon_times(records, known))
        else:
            histogram.add(records)
    return histogram.to_streak()


def read_batches(source: Source, seconds: float) -> Iterator[Batch]:
    """Read until the end, or for some seconds of a live source."""
    deadline = monotonic() + seconds
    while not source.is_live or monotonic() < deadline:
        try:
            batch = source.read(READ_TIMEOUT_S)
        except DeviceTimeoutError:
            if not source.stats.delivered:
                raise
            return
        if batch is None:
            return
        yield batch


def _make_histogram(
    names: tuple[str, ...], known: Record, gathering: Accumulation
) -> StampHistogram | TagHistogram | TimeHistogram:
    """Return an empty histogram for records of this kind."""
    if names[-2:] == ("code", "pixel"):
        period = known.number("laser_period_s", 0.0) or None
        return StampHistogram(gathering.axis(period), BoardCalibration.from_record(known))
    if "time_ticks" in names:
        tick = known.number("tick_s")
        return TagHistogram(gathering.axis(None), gathering.sync, gathering.pixels, tick)
    if "bin" in names:
        axis = gathering.axis(known.number("laser_period_s", 0.0) or None)
        return TimeHistogram(int(known.number("channels")), axis, known.number("resolution_s"))
    raise InputError(f"records of {', '.join(names)} are not photons of a line of pixels")


def _stack_histograms(batches: list[Batch], calibration: Record, gathering: Accumulation) -> Streak:
    """Return histograms that the instrument has made itself, a channel in each column."""
    counts = np.concatenate([batch.records["histogram"] for batch in batches]).T
    times: NDArray[np.float64] = np.float64(calibration.number("resolution_s")) * (
        np.arange(len(counts)) + 0.5
    )
    streak = Streak(counts.astype(np.float32), times)
    return streak if gathering.bin_width is None else streak.with_bin_width(gathering.bin_width)


def _sum_frames(
    first: Batch,
    batches: Iterator[Batch],
    calibration: Record | None,
    gathering: Accumulation,
) -> Streak:
    """Add up a camera's frames; a pixel that reached its limit in one of them is not to be trusted."""
    kind = first.records.dtype["counts"].base
    limit = np.iinfo(kind).max if kind.kind in "ui" else np.inf
    total: NDArray[np.float64] = np.zeros(first.records.dtype["counts"].shape)
    saturated, left = np.zeros(total.shape, bool), gathering.frames
    for batch in itertools.chain([first], batches):
        pictures = batch.records["counts"][:left]
        total += pictures.sum(axis=0, dtype=np.float64)
        saturated |= (pictures == limit).any(axis=0)
        left -= len(pictures)
        if not left:
            break
    times = None
    for name in ("row_times", "bin_times"):  # of a sweep, or of histograms of zones
        if calibration is not None and name in calibration.fields:
            times = calibration.array(name, np.float64, 1, "s")
    streak = Streak(total.astype(np.float32), times, saturated)
    return streak if gathering.bin_width is None else streak.with_bin_width(gathering.bin_width)


def read_camera(calibration: Record | None) -> Camera | None:
    """Return the camera that a source knows, None where it knows none."""
    known = None if calibration is None else calibration.children.get("camera")
    return None if known is None else Camera.from_record(known)


def strip_options(uri: Uri, names: Collection[str] = Accumulation.names()) -> str:
    """Return the address without what says how to gather."""
    # Files of photon counters need the channel of the laser's pulses themselves.
    own = {"sync"} if Path(uri.location).suffix.lower() in (".ptu", ".ttbin") else set()
    values = {k: v for k, v in uri.values.items() if k not in names or k in own}
    place = quote(uri.location, safe="/:@[]~ ")
    return f"{uri.scheme}://{place}" + (f"?{urlencode(values)}" if values else "")
