"""From a source's address to shots that ranges are found in: photons histogrammed, frames added up.

Besides what a source itself takes, its address may say how to gather (`Accumulation`), e.g.
``file://run.h5?seconds=2&bins=576``:

* ``seconds``: of reading, at most; a live source that never ends needs it, 10 by default;
* ``frames``: of a camera, or histograms that the instrument made, to add up; 1 by default;
* ``scans``: the same of a gate that moves from picture to picture, whose scans are added up whole, and
  ``binning``, pixels along each side of a square that count as one; 1 by default;
* ``shape``: rows and columns of the picture that the pixels make, such as ``8x8``, where the source does
  not know it;
* ``bins``, ``start_ps``, ``period_ps``: number of histogram bins, middle of the first one after the
  laser's pulse, and the laser's period, where the source does not know it;
* ``records``: photons of a shot, where a source is read shot after shot; 100 000 by default;
* ``sync``, ``pixels``: channel of the laser's pulses and channels of the line's pixels of a time
  tagger, ``0`` and ``1,2,3`` by default.

Where a source itself takes one of these names, the value is the source's and says nothing here.

A source of which the calibration says, besides ``bin_times`` (s, of each bin) and ``count_scale``, the
``image_shape`` of a picture whose pixels look at the scene themselves gives `PhotonCube`s, as do a
gate's scans; ``axes`` there is the order of what comes, ``tyx`` by default. A ``camera`` beside it says
where the pixels look. Any other source gives streak images.

Read shot after shot, a source gives shots as they come (`TransientStream`); behind stages
that make clouds of them, `TrackedShots` knows the age of each and what became of all others.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections import deque
from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from operator import itemgetter
from pathlib import Path
from sys import maxsize
from time import monotonic, time_ns
from typing import Any

import numpy as np

from devices import registry
from devices.address import Options, Uri, option, parse_integers, parse_shape
from devices.histogram import BinAxis, BinHistogram, Histogram, StampHistogram, TagHistogram
from devices.linospad2 import BoardCalibration
from devices.recording.read import read_head_if_recording
from devices.source import READ_TIMEOUT_S, Batch, Source, Stats
from devices.stream import InstrumentClock, StreamSource
from tofclip.arrays import AnyArray, Float32Array, FloatArray
from tofclip.camera import Camera
from tofclip.errors import DeviceTimeoutError, InputError, TofclipError
from tofclip.lidar import Pulse
from tofclip.lidar.photons import PhotonCube
from tofclip.shots import Streak
from tofclip.storage import Record, collect_provenance
from tofclip.units import PICOSECOND

BIN_WIDTH_S = 20e-12  # Width of a histogram's bins where no other is given, s
READING_S = 10.0  # Of a single shot where the address does not say how long, s
MAX_CUBE_BYTES = 1 << 32
# Standard deviation of a gate's edges and the laser's pulse, where nothing better is known, s
EDGE_S = 1e-10
STAMPS_SUFFIX = ".dat"
NOTHING_KNOWN = Record("none")
LiveShot = Streak | PhotonCube


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

    @cached_property
    def epoch_ns(self) -> int:
        """When it was taken, or came, in nanoseconds since 1970 by this computer's clock; of a file, a
        tenth of a second for each shot.
        """
        age = self.compute_age()
        return self.number * 10**8 if age is None else time_ns() - round(age * 1e9)

    def compute_age(self) -> float | None:
        """Return the seconds since it was taken, or came; None for a file."""
        began = self.taken_at or self.received_at
        return monotonic() - began if began else None


@dataclass(frozen=True)
class Accumulation(Options):
    """How records become a streak image."""

    seconds: float | None = option(None, float, above=0)
    frames: int = option(1, above=0)
    scans: int = option(1, above=0)
    binning: int = option(1, above=0)
    shape: tuple[int, ...] = option((), parse_shape)
    bins: int | None = option(None, int)  # None: as many as fit into the laser's period
    start_ps: float = option(0.0)
    period_ps: float | None = option(None, float)  # None: as the source says
    records: int = option(100_000, above=0)
    sync: int = option(0)
    pixels: tuple[int, ...] = option((1, 2, 3), parse_integers)
    # s. None: `BIN_WIDTH_S` for photons, and the camera's own time axis for frames
    bin_width: float | None = None
    # whether the pixels of a line that counts photons are a picture of one row
    line: bool = False

    @property
    def pictures(self) -> int:
        """Pictures, scans or histograms of a shot."""
        return self.frames * self.scans

    def axis(self, known_period: float | None) -> BinAxis:
        width = BIN_WIDTH_S if self.bin_width is None else self.bin_width
        start = self.start_ps * PICOSECOND
        period = self.period_ps * PICOSECOND if self.period_ps else known_period
        if self.bins is not None:
            return BinAxis(width, self.bins, start, period)
        if period is None:
            raise InputError(
                "the laser's period is not known: add period_ps=... or bins=... to the address, "
                "which for a recording is 'file://run.h5?period_ps=...'"
            )
        if not 0 < width <= period:
            raise InputError(
                f"bins must be longer than 0 and shorter than the laser's period, got {width} s"
            )
        return BinAxis(width, int(period / width * (1 + 1e-9)), start, period)


def read_transient(address: str, bin_width: float | None = None) -> LiveShot:
    """Read a source until it ends, or as long as its address says, and return a shot.

    Memory: one batch of the source, and the shot.

    Parameters
    ----------
    address : str
        As `devices.open` takes it, with the values of `Accumulation` where needed.
    bin_width : float, optional
        Width of a photon histogram's bins, s, 20 ps by default; of a camera's rows instead of its
        own time axis.

    Returns
    -------
    Streak or PhotonCube
        With the camera that the source knows, if it knows one; hot pixels, and pixels that reached
        a camera's limit, are marked in ``Streak.saturated``.

    Raises
    ------
    InputError
        The address is none, its values cannot be, or there were no photons.
    DeviceError
        The instrument failed before there was anything to gather.
    """
    return _read_shot(Uri.parse(address), bin_width)


def read_photons(address: str, bin_width: float | None = None) -> PhotonCube:
    """Read photons counted in time for each pixel of a picture, as `read_transient` does; a line of
    pixels that count photons is a picture of one row.
    """
    found = _read_shot(Uri.parse(address), bin_width, line=True)
    assert isinstance(found, PhotonCube)
    return found


def find_address(file: str) -> str | None:
    """Return the address of a file that holds an instrument's records, None of any other file."""
    path = Path(file)
    if path.is_dir():  # a cube with a file for each row
        return None
    is_stamps = path.suffix.lower() == STAMPS_SUFFIX
    return f"file://{file}" if is_stamps or read_head_if_recording(path) is not None else None


def _read_shot(uri: Uri, bin_width: float | None, line: bool = False) -> LiveShot:
    with _open_source(uri, bin_width, line) as (source, gathering):
        known = source.calibration or NOTHING_KNOWN
        if find_gate_steps(known):  # a scan lasts as long as it does
            shots = _read_scans(read_batches(source, inf), known, gathering)
            shot: LiveShot = next(shots)[1]
        else:
            shot = _accumulate(
                read_batches(source, gathering.seconds or READING_S), known, gathering
            )
        past = collect_provenance({"address": uri.text, "bin_width_s": bin_width})
        source.drain()
    past |= {"source": source.info.as_dict(), "stats": source.stats.as_dict()}
    return replace(shot, camera=read_camera(known), source=uri.text, provenance=past)


def _accumulate(batches: Iterator[Batch], known: Record, gathering: Accumulation) -> LiveShot:
    """Make one shot of everything that comes. Histograms of a line are those of a picture where the
    address gives a shape; hot pixels count nothing there.
    """
    first = next(batches, None)
    if first is None:
        raise InputError("the source ended before it gave anything")
    all_batches = itertools.chain([first], batches)
    names = first.records.dtype.names or ()
    if "counts" in names:
        return _sum_frames(first.records.dtype["counts"], all_batches, known, gathering)
    if "histogram" in names:
        # which the instrument has made itself, a channel in each column
        made = np.concatenate([batch.records["histogram"] for batch in all_batches]).T
        times = known.number("resolution_s") * (np.arange(len(made), dtype=np.float64) + 0.5)
        streak = Streak(made.astype(np.float32), times)
        if gathering.bin_width is not None:
            streak = streak.with_bin_width(gathering.bin_width)
    else:
        histogram = _make_histogram(names, known, gathering)
        for batch in all_batches:
            histogram.add(batch.records, batch.after_gap)
        streak = histogram.to_streak()
    shape = gathering.shape or (gathering.line and (1, streak.counts.shape[1]))
    if not shape:
        return streak
    dark = np.float32(0) if streak.saturated is None else streak.saturated
    counts = np.where(dark, np.float32(0), streak.counts)
    return PhotonCube(_reshape(counts, (len(counts), *shape)), streak.times)


def _reshape(counts: AnyArray, shape: tuple[int, ...]) -> AnyArray:
    if counts.size != math.prod(shape):
        raise InputError(f"{counts.size} numbers are no picture of {' x '.join(map(str, shape))}")
    return counts.reshape(shape)


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


def _make_histogram(names: tuple[str, ...], known: Record, gathering: Accumulation) -> Histogram:
    """Return an empty histogram for records of this kind."""
    if names[-2:] == ("code", "pixel"):
        period = known.number("laser_period_s", 0.0) or None
        return StampHistogram(gathering.axis(period), BoardCalibration.from_record(known))
    if "time_ticks" in names:
        tick = known.number("tick_s")
        return TagHistogram(gathering.axis(None), gathering.sync, gathering.pixels, tick)
    if "bin" in names:
        axis = gathering.axis(known.number("laser_period_s", 0.0) or None)
        return BinHistogram(int(known.number("channels")), axis, known.number("resolution_s"))
    raise InputError(f"records of {', '.join(names)} are not photons of a line of pixels")


def _sum_frames(
    dtype: np.dtype[Any], batches: Iterator[Batch], known: Record, gathering: Accumulation
) -> LiveShot:
    """Add up a camera's frames; a pixel that reached its limit in one of them is not to be trusted."""
    if gathering.line and "bin_times" not in known.fields:
        raise InputError(
            "this instrument counts no photons in time for each pixel; a SPAD array does with mode=gated"
        )
    limit = np.iinfo(dtype.base).max if dtype.base.kind in "ui" else np.inf
    total: FloatArray = np.zeros(dtype.shape)
    saturated, left = np.zeros(total.shape, bool), gathering.pictures
    for batch in batches:
        pictures = batch.records["counts"][:left]
        total += pictures.sum(axis=0, dtype=np.float64)
        saturated |= (pictures == limit).any(axis=0)
        left -= len(pictures)
        if not left:
            break
    is_picture = gathering.shape or gathering.line or "image_shape" in known.fields
    if "bin_times" in known.fields and is_picture:
        return _arrange_histograms(total, known, gathering)
    times = None
    for name in ("row_times", "bin_times"):  # of a sweep, or of histograms of zones
        if name in known.fields:
            times = known.array(name, np.float64, 1, "s")
    streak = Streak(total.astype(np.float32), times, saturated)
    return streak if gathering.bin_width is None else streak.with_bin_width(gathering.bin_width)


def _arrange_histograms(counts: FloatArray, known: Record, gathering: Accumulation) -> PhotonCube:
    """Put histograms that an instrument has made where its calibration says they look."""
    _require_own_bins(gathering)
    times = known.array("bin_times", np.float64, 1, "s")
    shape = gathering.shape or (1, counts.size // times.size)
    if not gathering.shape and "image_shape" in known.fields:
        shape = tuple(known.array("image_shape", np.int64, 1, "px").tolist())
    sides = dict(zip("tyx", (times.size, *shape), strict=True))
    order = str(known.attributes.get("axes", "tyx"))
    if sorted(order) != sorted(sides):
        raise InputError(f"the axes of histograms are t, y and x in some order, not '{order}'")
    cube = _reshape(counts, tuple(sides[axis] for axis in order))
    scale = float(known.attributes.get("count_scale", 1.0))
    cube = np.transpose(cube, [order.index(axis) for axis in "tyx"]) * np.float32(scale)
    return PhotonCube(cube, times)


def _require_own_bins(gathering: Accumulation) -> None:
    if gathering.bin_width is not None:
        raise InputError("an instrument that counts photons in bins knows their width")


def find_gate_steps(known: Record) -> int:
    """Return the pictures of a gate's scan; 0 where no gate moves."""
    return known.fields["gate_times"].values.size if "gate_times" in known.fields else 0


def _read_scans(
    batches: Iterator[Batch], known: Record, gathering: Accumulation
) -> Iterator[tuple[int, PhotonCube]]:
    """Yield sums of whole scans of a gate, each with its number; one that was cut is left out."""
    _require_own_bins(gathering)
    times, binning = known.array("gate_times", np.float64, 1, "s"), gathering.binning
    pulse, steps = _make_gate_response(known, times), times.size
    total: Float32Array = np.zeros(0, np.float32)
    scan: list[Float32Array] = []
    done = begun = 0  # `begun`: number of the scan's first picture
    for record in itertools.chain.from_iterable(batch.records for batch in batches):
        number = int(record["number"])
        if number != begun + len(scan):  # cut: wait for the next beginning
            scan = []
            if number % steps:
                continue
            begun = number
        rows, columns = (size // binning for size in record["counts"].shape)
        if steps * rows * columns * 4 > MAX_CUBE_BYTES:
            raise InputError(
                "that number of photons does not fit into 4 GiB: choose binning=2 or 4"
            )
        whole = record["counts"][: rows * binning, : columns * binning]
        blocks = whole.reshape(rows, binning, columns, binning)
        scan.append(blocks.sum(axis=(1, 3)).astype(np.float32))
        if len(scan) < steps:
            continue
        if done % gathering.pictures == 0:
            total = np.zeros((steps, rows, columns), np.float32)
        for picture, own in zip(total, scan, strict=True):
            picture += own
        scan, done, begun = [], done + 1, begun + steps
        if done % gathering.pictures == 0:
            place = begun // steps // gathering.pictures - 1
            yield place, PhotonCube(total, times, pulse=pulse, sampled=True)
    if done < gathering.pictures:
        raise InputError(f"the source ended after {done} of {gathering.pictures} whole scans")


def _make_gate_response(known: Record, times: FloatArray) -> Pulse:
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


def read_camera(known: Record) -> Camera | None:
    """Return the camera that a source knows, None where it knows none."""
    return Camera.from_record(known.children["camera"]) if "camera" in known.children else None


@contextlib.contextmanager
def _open_source(
    uri: Uri, bin_width: float | None, line: bool = False
) -> Iterator[tuple[Source, Accumulation]]:
    """Open an address; what its source does not take of it says how to gather."""
    others = {*Accumulation.names()}
    with registry.open_parsed(replace(uri, others=others)) as source:
        left = replace(uri, values={name: uri.values[name] for name in others & uri.values.keys()})
        yield source, replace(Accumulation.from_uri(left), bin_width=bin_width, line=line)


class TransientStream(Iterator[LiveShot]):
    """Shots of an address as they come, and where every other one went.

    One is made of each ``frames`` pictures of a camera, ``scans`` of a gate or ``records`` photons, as
    the address says; the last one may have fewer. The source is opened with the first shot, and
    closed with the stream. Memory: a batch of the source, and a shot.

    A live camera whose pictures are taken one by one is read newest first, unless the address
    chooses a ``policy``: what is shown or ranged late would be of no use. What is dropped for that
    is in `stats`.
    """

    def __init__(self, address: str, bin_width: float | None = None) -> None:
        self._uri, self._bin_width = Uri.parse(address), bin_width
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
        return Stats() if self._source is None else self._source.stats

    @property
    def shots_acquired(self) -> int:
        """Images for which the instrument has registered enough."""
        return -(-self.stats.acquired // self._records_per_shot)

    @property
    def shots_lost(self) -> int:
        """Of these, images for which the instrument or the wire lost or damaged the data."""
        return (self.stats.lost_device + self.stats.malformed) // self._records_per_shot

    def __next__(self) -> LiveShot:
        return next(self._shots)

    def close(self) -> None:
        self._shots.close()

    def _read(self) -> Generator[LiveShot]:
        with _open_source(self._uri, self._bin_width) as (source, gathering):
            self._source = source
            known = source.calibration or NOTHING_KNOWN
            camera, tick = read_camera(known), known.attributes.get("tick_s")
            self._records_per_shot = gathering.records
            steps = find_gate_steps(known)
            if isinstance(source, StreamSource) and source.codec.name == "frames":
                self._records_per_shot = (steps or 1) * gathering.pictures
                self.is_numbered = True
                if self._records_per_shot == 1 and "policy" not in self._uri.values:
                    source.keep_newest()
            batches = self._note_times(read_batches(source, gathering.seconds or inf), tick)
            shots = _read_scans if steps else _accumulate_shots
            for number, shot in shots(batches, known, gathering):
                self.stamp = ShotStamp(number, self._taken_at, self._received_at)
                yield replace(shot, camera=camera, source=f"{self._uri.text} shot {number}")

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


def _accumulate_shots(
    batches: Iterator[Batch], known: Record, gathering: Accumulation
) -> Iterator[tuple[int, LiveShot]]:
    """Yield shots of as many records as they have, each with its number."""
    for number, parts in itertools.groupby(_split_shots(batches, gathering), itemgetter(0)):
        yield number, _accumulate((part for _, part in parts), known, gathering)


def _split_shots(batches: Iterator[Batch], gathering: Accumulation) -> Iterator[tuple[int, Batch]]:
    """Cut batches where shots end, and say to which shot each part belongs. Pictures carry the
    instrument's number, in which those that were lost have been counted; where it begins anew, it
    is counted on from the last one. Photons are counted here.
    """
    done = number = base = 0
    last = -1
    for batch in batches:
        names = batch.records.dtype.names or ()
        size = {"counts": gathering.pictures, "histogram": maxsize}.get(
            names[-1], gathering.records
        )
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


MAX_STAMPS = 10_000  # Shots on their way whose stamps are kept


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


class TrackedShots(Iterator[LiveShot | TofclipError]):
    """Shots on their way into stages, each with its stamp, so that the consumer behind the stages
    can say how old a shot is and where the others went. `shots`: a `TransientStream`, or shots from
    files: in the place of one that cannot be read its error.
    """

    def __init__(self, shots: Iterator[LiveShot] | Iterator[LiveShot | TofclipError]) -> None:
        self._shots = shots
        self._stream = shots if isinstance(shots, TransientStream) else None
        self._stamps: dict[int, ShotStamp] = {}
        self._count = self._first_number = 0
        self._peeked: deque[LiveShot | TofclipError] = deque()

    @property
    def is_live(self) -> bool:
        """Whether an instrument is read, so that what comes too late is dropped."""
        return self._stream is not None and self._stream.is_live

    @property
    def is_file(self) -> bool:
        """Whether a recording is read, which waits."""
        return self._stream is not None and not self._stream.is_live

    def peek(self) -> LiveShot | None:
        """Return the next shot that can be read, which is still to come; None at the end."""
        while not self._peeked or isinstance(self._peeked[-1], TofclipError):
            try:
                self._peeked.append(self._take())
            except StopIteration:
                return None
        return self._peeked[-1]

    def __next__(self) -> LiveShot | TofclipError:
        return self._peeked.popleft() if self._peeked else self._take()

    def _take(self) -> LiveShot | TofclipError:
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
