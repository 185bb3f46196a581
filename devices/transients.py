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

Read shot after shot, a source gives streak images as they come (`TransientStream`); behind stages
that make clouds of them, `TrackedShots` knows the age of each and what became of all others.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Collection, Generator, Iterator
from dataclasses import dataclass, replace
from math import inf
from operator import itemgetter
from pathlib import Path
from sys import maxsize
from time import monotonic
from urllib.parse import quote, urlencode

import numpy as np
from numpy.typing import NDArray

from devices.address import Options, Uri, option, parse_integers
from devices.files import compute_photon_times
from devices.histogram import BinAxis, StampHistogram, TagHistogram, TimeHistogram
from devices.linospad2 import BoardCalibration
from devices.registry import open as open_source
from devices.source import READ_TIMEOUT_S, Batch, Source, Stats
from devices.stream import InstrumentClock, StreamSource
from tofclip.camera import Camera
from tofclip.errors import DeviceTimeoutError, InputError, TofclipError
from tofclip.shots import Streak
from tofclip.storage import Record, collect_provenance

BIN_WIDTH_S = 20e-12  # Width of a histogram's bins where no other is given, s
PICOSECOND_S = 1e-12


@dataclass(frozen=True)
class Accumulation(Options):
    """How records become a streak image."""

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
        past = collect_provenance({"address": address, "bin_width_s": bin_width})
        source.drain()
    past |= {"source": source.info.as_dict(), "stats": source.stats.as_dict()}
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
    times = calibration.number("resolution_s") * (np.arange(len(counts), dtype=np.float64) + 0.5)
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


MAX_STAMPS = 10_000  # Shots on their way whose stamps are kept


@dataclass(frozen=True)
class ShotStamp:
    """As which shot, and when, a streak image was taken."""

    # its number at the instrument, from 0: those that were lost on the way have been counted
    number: int
    # when the instrument took the last of it by its own clock, s of `time.monotonic`; 0 where it
    # does not say
    taken_at: float = 0.0
    # when the last of it came, s of `time.monotonic`; 0 where it comes from a file
    received_at: float = 0.0

    def compute_age(self) -> float | None:
        """Return the seconds since it was taken, or came; None for a file."""
        began = self.taken_at or self.received_at
        return monotonic() - began if began else None


@dataclass(frozen=True)
class ShotAccounts:
    """What became of every shot."""

    acquired: int  # shots that the instrument took, or that were read from a file
    delivered: int
    dropped_device: int  # lost by the instrument or on the wire, or damaged when they came
    # came and were dropped for newer ones, by the driver's buffer or between the stages, or waited
    # still when the stream was ended
    dropped_host: int
    failed: int = 0  # could not be read, or no cloud could be made of them

    @property
    def dropped(self) -> int:
        """All that were taken and lost or left out, without those that failed."""
        return self.dropped_device + self.dropped_host


def read_transients(address: str, bin_width: float | None = None) -> TransientStream:
    """Read a source until it ends, and yield one streak image after the other.

    One is made of each ``frames`` pictures of a camera or ``records`` photons, as the address says;
    the last one may have fewer. The source is opened with the first image, and closed with the
    stream. Memory: a batch of the source, and a streak image.
    """
    return TransientStream(address, bin_width)


class TransientStream(Iterator[Streak]):
    """Streak images as they come, and where every other one went; see `read_transients`.

    A live camera whose pictures are taken one by one is read newest first, unless the address
    chooses a ``policy``: what is shown or ranged late would be of no use. What is dropped for that
    is in `stats`.
    """

    def __init__(self, address: str, bin_width: float | None = None) -> None:
        self._uri = Uri.parse(address)
        self._gathering = Accumulation.of(self._uri, bin_width)
        self._source: Source | None = None
        self._shots = self._read()
        self._records_per_shot = 1
        self._clock = InstrumentClock()
        self._taken_at = self._received_at = 0.0
        self.stamp: ShotStamp | None = None
        """Of the last image; None before the first."""
        self.is_numbered = False
        """Whether the instrument itself numbers its shots, as cameras do."""

    @property
    def is_live(self) -> bool:
        """Whether an instrument, real or emulated, is being read."""
        return self._source is not None and self._source.is_live

    @property
    def stats(self) -> Stats:
        """Where every record went; see `Source.stats`."""
        return Stats() if self._source is None else self._source.stats

    @property
    def shots_acquired(self) -> int:
        """Images for which the instrument has registered enough."""
        return -(-self.stats.acquired // self._records_per_shot)

    @property
    def shots_lost(self) -> int:
        """Of these, images for which the instrument or the wire lost or damaged the data."""
        return (self.stats.lost_device + self.stats.malformed) // self._records_per_shot

    def __next__(self) -> Streak:
        return next(self._shots)

    def close(self) -> None:
        """Close the source."""
        self._shots.close()

    def _read(self) -> Generator[Streak]:
        gathering = self._gathering
        with open_source(strip_options(self._uri)) as source:
            self._source = source
            known = source.calibration
            camera = read_camera(known)
            tick = None if known is None else known.attributes.get("tick_s")
            self._records_per_shot = gathering.records
            if isinstance(source, StreamSource) and source.codec.name == "frames":
                self._records_per_shot = gathering.frames
                self.is_numbered = True
                if gathering.frames == 1 and "policy" not in self._uri.values:
                    source.keep_newest()
            seconds = gathering.seconds if "seconds" in self._uri.values else inf
            batches = self._note_times(read_batches(source, seconds), tick)
            for number, parts in itertools.groupby(_split_shots(batches, gathering), itemgetter(0)):
                streak = accumulate_streak((part for _, part in parts), known, gathering)
                self.stamp = ShotStamp(number, self._taken_at, self._received_at)
                yield replace(streak, camera=camera, source=f"{self._uri.text} shot {number}")

    def _note_times(self, batches: Iterator[Batch], tick: object) -> Iterator[Batch]:
        """Note when each batch was taken and came; time tags carry a clock of `tick` s."""
        for batch in batches:
            self._taken_at, self._received_at = batch.taken_at, batch.received_at
            names = batch.records.dtype.names or ()
            if isinstance(tick, float) and "time_ticks" in names and len(batch):
                stamp = float(batch.records["time_ticks"][-1]) * tick
                self._clock.observe(stamp, batch.received_at)
                self._taken_at = self._clock.to_host(stamp) if batch.received_at else 0.0
            yield batch


class TrackedShots(Iterator[Streak | TofclipError]):
    """Shots on their way into stages, each with its stamp, so that the consumer behind the stages
    can say how old a shot is and where the others went. `shots`: A `TransientStream`, or shots from
    files: in the place of one that cannot be read its error.
    """

    def __init__(self, shots: Iterator[Streak] | Iterator[Streak | TofclipError]) -> None:
        self._shots = shots
        self._stream = shots if isinstance(shots, TransientStream) else None
        self._stamps: dict[int, ShotStamp] = {}
        self._count = self._first_number = 0
        self._peeked: deque[Streak | TofclipError] = deque()

    @property
    def is_live(self) -> bool:
        """Whether an instrument is read, so that what comes too late is dropped."""
        return self._stream is not None and self._stream.is_live

    def peek(self) -> Streak | None:
        """Return the next shot that can be read, which is still to come; None at the end."""
        while not self._peeked or isinstance(self._peeked[-1], TofclipError):
            try:
                self._peeked.append(self._take())
            except StopIteration:
                return None
        return self._peeked[-1]

    def __next__(self) -> Streak | TofclipError:
        return self._peeked.popleft() if self._peeked else self._take()

    def _take(self) -> Streak | TofclipError:
        shot = next(self._shots)
        stamp = (self._stream and self._stream.stamp) or ShotStamp(self._count)
        self._stamps[self._count] = stamp
        if self._count == 0:
            self._first_number = stamp.number
        self._stamps.pop(self._count - MAX_STAMPS, None)
        self._count += 1
        return shot

    def get_stamp(self, place: int) -> ShotStamp:
        """Return the stamp of shot number `place` from 0; asked once for each, in order."""
        for earlier in [known for known in list(self._stamps) if known < place]:
            del self._stamps[earlier]  # they were dropped
        return self._stamps.pop(place, ShotStamp(place))

    def count_dropped(self, stamp: ShotStamp, delivered: int) -> int:
        """Return how many shots up to a delivered one were lost, wherever that was. Those behind it
        are not known yet. `stamp`: the newest delivered one's; `delivered`: shots delivered so far,
        this one included.
        """
        missing = stamp.number - self._first_number + 1 - delivered
        if self._stream is not None and not self._stream.is_numbered:
            missing += self._stream.shots_lost
        return missing

    def count_shots(self, delivered: int, failed: int = 0) -> ShotAccounts:
        """Return what became of every shot; final once the stream has been closed."""
        acquired, lost = self._count, 0
        if self._stream is not None and self._stream.is_live:
            # The instrument knows of shots that never reached this program.
            acquired = max(self._stream.shots_acquired, self._count)
            lost = self._stream.shots_lost
        dropped = acquired - lost - delivered - failed
        return ShotAccounts(acquired, delivered, lost, dropped, failed)

    def close(self) -> None:
        """Close the source; not while another thread waits for a shot."""
        getattr(self._shots, "close", lambda: None)()


def _split_shots(batches: Iterator[Batch], gathering: Accumulation) -> Iterator[tuple[int, Batch]]:
    """Cut batches where shots end, and say to which shot each part belongs. Pictures carry the
    instrument's number, in which those that were lost have been counted; where it begins anew, it
    is counted on from the last one. Photons are counted here.
    """
    done = number = base = 0
    last = -1
    for batch in batches:
        names = batch.records.dtype.names or ()
        size = {"counts": gathering.frames, "histogram": maxsize}.get(names[-1], gathering.records)
        own = batch.records["number"] if "number" in names else None
        if own is not None and len(own):
            base += last + 1 if own[0] <= last else 0
            last = int(own[-1])
        start = 0
        while start < len(batch):
            end = min(len(batch), start + size - done % size)
            if done % size == 0:
                number = (done if own is None else base + int(own[start])) // size
            after_gap, first = batch.after_gap and start == 0, batch.first + start
            part = batch.records[start:end]
            yield number, replace(batch, records=part, first=first, after_gap=after_gap)
            done += end - start
            start = end
