"""From a source's address to the streak image that recovery takes: photons histogrammed, frames
added up.

Besides what a source itself takes, its address may say how to gather (`ACCUMULATION_OPTIONS`), e.g.
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

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from time import monotonic
from urllib.parse import quote, urlencode

import numpy as np
from numpy.typing import NDArray

from devices.address import Uri
from devices.files import compute_photon_times
from devices.histogram import BinAxis, StampHistogram, TagHistogram, TimeHistogram
from devices.linospad2 import BoardCalibration
from devices.registry import open as open_source
from devices.source import READ_TIMEOUT_S, Batch, Source
from tofclip.camera import Camera
from tofclip.errors import DeviceTimeoutError, InputError
from tofclip.shots import Streak
from tofclip.storage import Record, collect_provenance

ACCUMULATION_OPTIONS = (
    "seconds",
    "frames",
    "bins",
    "start_ps",
    "period_ps",
    "records",
    "sync",
    "pixels",
)
BIN_WIDTH_S = 20e-12
"""Width of a histogram's bins where no other is given, s."""

PICOSECOND_S = 1e-12


@dataclass(frozen=True)
class AccumulationSettings:
    """How records become a streak image; see the module's text."""

    seconds: float = 10.0
    frames: int = 1
    bins: int | None = None  # none: as many as fit into the laser's period
    start: float = 0.0  # s
    period: float | None = None  # s. None: as the source says
    sync: int = 0
    pixels: tuple[int, ...] = (1, 2, 3)
    # s. None: `BIN_WIDTH_S` for photons, and the camera's own time axis for frames
    bin_width: float | None = None
    records: int = 100_000

    @classmethod
    def from_uri(cls, uri: Uri, bin_width: float | None) -> AccumulationSettings:
        """Read the values of an address that say how to gather.

        `bin_width`: seconds.
        """
        standard = cls()
        pixels = uri.value("pixels", _parse_integers, standard.pixels)
        found = cls(
            uri.value("seconds", float, standard.seconds),
            uri.value("frames", int, standard.frames),
            uri.value("bins", int, 0) if "bins" in uri.values else None,
            uri.value("start_ps", float, 0.0) * PICOSECOND_S,
            uri.value("period_ps", float, 0.0) * PICOSECOND_S
            if "period_ps" in uri.values
            else None,
            uri.value("sync", int, standard.sync),
            pixels,
            bin_width,
            uri.value("records", int, standard.records),
        )
        if not (0 < found.seconds < inf and found.frames >= 1 and found.records >= 1):
            raise InputError(f"'{uri.text}': seconds, frames and records must be positive")
        return found

    def axis(self, known_period: float | None) -> BinAxis:
        """Return the bins of a histogram of photons."""
        width = BIN_WIDTH_S if self.bin_width is None else self.bin_width
        period = self.period or known_period
        if self.bins is not None:
            return BinAxis(width, self.bins, self.start, period)
        if period is None:
            raise InputError(
                "the laser's period is not known: add period_ps=... or bins=... to the address"
            )
        if not 0 < width <= period:
            raise InputError(
                f"bins must be longer than 0 and shorter than the laser's period, got {width} s"
            )
        return BinAxis(width, int(period / width * (1 + 1e-9)), self.start, period)


def read_transient(address: str, bin_width: float | None = None) -> Streak:
    """Read a source until it ends, or as long as its address says, and return a streak image.

    Memory: one batch of the source, and the streak image.

    Parameters
    ----------
    address : str
        As `devices.open` takes it, with `ACCUMULATION_OPTIONS`'s values where needed.
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
    gathering = AccumulationSettings.from_uri(uri, bin_width)
    with open_source(strip_options(uri)) as source:
        streak = accumulate_streak(
            read_batches(source, gathering.seconds), source.calibration, gathering
        )
        known = source.calibration
        past = {
            **collect_provenance({"address": address, "bin_width_s": bin_width}),
            "source": source.info.as_dict(),
        }
        source.stop()
        while source.read() is not None:
            pass
    past["stats"] = source.stats.as_dict()
    return replace(streak, camera=read_camera(known), source=address, provenance=past)


def accumulate_streak(
    batches: Iterator[Batch], calibration: Record | None, gathering: AccumulationSettings
) -> Streak:
    """Make one streak image of everything that comes.

    `calibration`: the source's.
    """
    first = next(batches, None)
    if first is None:
        raise InputError("the source ended before it gave anything")
    names = first.records.dtype.names or ()
    if "counts" in names:
        return _sum_frames(first, batches, calibration, gathering)
    if "histogram" in names:
        return _stack_histograms([first, *batches], calibration or Record("none"), gathering)
    histogram = _make_histogram(names, calibration, gathering)
    while first is not None:
        if isinstance(histogram, TagHistogram):
            histogram.add(first.records, first.after_gap)
        elif isinstance(histogram, TimeHistogram):
            histogram.add(
                first.records["channel"],
                compute_photon_times(first.records, calibration or Record("none")),
            )
        else:
            histogram.add(first.records)
        first = next(batches, None)
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
    names: tuple[str, ...], calibration: Record | None, gathering: AccumulationSettings
) -> StampHistogram | TagHistogram | TimeHistogram:
    """Return an empty histogram for records of this kind."""
    known = calibration or Record("none")
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


def _stack_histograms(
    batches: list[Batch], calibration: Record, gathering: AccumulationSettings
) -> Streak:
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
    gathering: AccumulationSettings,
) -> Streak:
    """Add up a camera's frames; a pixel that reached its limit in one of them is not to be trusted."""
    kind = first.records.dtype["counts"].base
    limit = np.iinfo(kind).max if kind.kind in "ui" else np.inf
    total: NDArray[np.float64] = np.zeros(first.records.dtype["counts"].shape)
    saturated, left, batch = np.zeros(total.shape, bool), gathering.frames, first
    while True:
        pictures = batch.records["counts"][:left]
        total += pictures.sum(axis=0, dtype=np.float64)
        saturated |= (pictures == limit).any(axis=0)
        left -= len(pictures)
        following = next(batches, None) if left else None
        if following is None:
            break
        batch = following
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


def strip_options(uri: Uri, names: Collection[str] = ACCUMULATION_OPTIONS) -> str:
    """Return the address without what says how to gather.

    `names`: options to leave out.
    """
    # Files of photon counters need the channel of the laser's pulses themselves.
    own = {"sync"} if Path(uri.location).suffix.lower() in (".ptu", ".ttbin") else set()
    values = {k: v for k, v in uri.values.items() if k not in names or k in own}
    place = quote(uri.location, safe="/:@[]~ ")
    return f"{uri.scheme}://{place}" + (f"?{urlencode(values)}" if values else "")


def _parse_integers(text: str) -> tuple[int, ...]:
    return tuple(int(word) for word in text.split(","))
