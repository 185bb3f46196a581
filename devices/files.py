"""Files as sources: of time-correlated single-photon counting, photons one by one (PicoQuant's PTU,
Swabian Instruments' TTBIN) and whole histograms (PicoQuant's PHU, Becker & Hickl's SDT); and streak
images (ITEX, HPD-TA's TIFF), which are one frame.

::

    file -> reader: pieces of records -> RecordFile, a source

The libraries `ptufile` and `sdtfile` (extra ``tcspc``) and Swabian Instruments' own read the first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from devices.address import Options, Uri, option
from devices.frames import make_streak_calibration
from devices.source import READ_TIMEOUT_S, Batch, Info, Ledger, Records, Source, Stats
from tofclip.arrays import IntArray
from tofclip.errors import FileFormatError, InputError
from tofclip.files import (
    BoundedFile,
    format_error_line,
    guard,
    import_file_reader,
    require_bounded_size,
)
from tofclip.io import read_streak
from tofclip.io.tcspc import (
    TCSPC,
    Checkpoint,
    PtuEvents,
    PulseCount,
    read_sdt_blocks,
    require_pulses,
)
from tofclip.storage import Record, Scalar
from tofclip.units import PICOSECOND

HISTOGRAM_BYTES = 4  # Of one bin in a PHU file

# `sync`: number of the laser's pulse. `bin`: time after it, in the file's resolution. `channel`:
# from 0.
PHOTON_DTYPE = np.dtype([("sync", "<u8"), ("bin", "<u4"), ("channel", "<u4")])
BATCH_RECORDS = 1 << 16
# Larger files of histograms are not read: they would not fit into memory four times over
MAX_HISTOGRAM_FILE_BYTES = 1 << 31
MAX_BINS = 1 << 20
SWABIAN_CHUNK_TAGS = 1 << 20
# Types of Swabian Instruments' events: a time tag, and a number of tags that were lost
SWABIAN_TAG, SWABIAN_MISSED = 0, 4


class RecordFile(Source):
    """A file's records. Memory: one piece of it, decoded. The calibration of photons and histograms
    has ``resolution_s``, the width of a bin, and ``channels``; of photons also ``laser_period_s``,
    of images ``rows`` and ``columns``.

    A reader knows ``info`` and ``calibration``, the ``sizes`` of its pieces in records, how many
    records the electronics ``lost``, and can ``decode`` a piece.
    """

    is_seekable = True

    def __init__(
        self,
        path: str | Path,
        open_file: Callable[[Path], WholeRecords | PtuPhotons | SwabianPhotons],
    ) -> None:
        with guard(path, "is a damaged or unsupported file"):
            Path(path).stat()  # some libraries say of an absent file that it is damaged
            self._reader = open_file(Path(path))
        self.info, self.calibration = self._reader.info, self._reader.calibration
        self._begins = [0, *accumulate(self._reader.sizes)]
        self._closed = False
        self._decoded: tuple[int, Records] | None = None
        self.seek(0)

    @property
    def stats(self) -> Stats:
        return self._ledger.stats

    def read(self, timeout: float = READ_TIMEOUT_S) -> Batch | None:
        first = self._next
        if self._closed or first == self._begins[-1]:
            return None
        piece = int(np.searchsorted(self._begins, first, "right")) - 1
        if self._decoded is None or self._decoded[0] != piece:
            self._decoded = None  # one at a time
            self._decoded = piece, self._reader.decode(piece)
        start = first - self._begins[piece]
        records = self._decoded[1][start : start + BATCH_RECORDS]
        self._next += len(records)
        self._ledger.deliver(len(records), 0)
        return Batch(records, first)

    def seek(self, record: int) -> None:
        if not 0 <= record <= self._begins[-1]:
            raise InputError(
                f"the file has {self._begins[-1]} records, there is no number {record}"
            )
        self._next, self._ledger = record, Ledger()
        self._ledger.receive(self._begins[-1])
        self._ledger.deliver(record, 0)
        self._ledger.lose(self._reader.lost)

    def close(self) -> None:
        self._closed = True


@dataclass
class WholeRecords:
    """All records of a file as one piece."""

    records: Records
    info: Info
    calibration: Record | None
    lost: int = 0

    @property
    def sizes(self) -> list[int]:
        return [len(self.records)]

    def decode(self, piece: int) -> Records:
        return self.records


class PtuPhotons:
    """Photons of a PTU file. Opening reads the file once, to know its channels and
    where each piece begins. Markers are passed over; pictures are read by `tofclip.lidar.photons`.
    `sync`: channel of the laser's pulses in T2 mode; by default the electronics' own input for
    them.
    """

    lost = 0

    def __init__(self, path: Path, sync: int | None = None) -> None:
        self._events = events = PtuEvents(path, sync)
        self._checkpoints, self.sizes, channels = [Checkpoint()], [], 1
        for found, behind in events:
            self._checkpoints.append(behind)
            self.sizes.append(int(found.is_photon.sum()))
            channels = max(channels, int(found.channel.max(initial=0, where=found.is_photon)) + 1)
        period = events.period
        if not events.is_t3:
            count = self._checkpoints[-1].count
            require_pulses(path, count)
            period = count.period_ticks * events.tick
        self.calibration = _describe_bins(events.resolution, channels, period, path)
        self.info = Info(f"TCSPC file ({events.kind})", "", self.calibration.attributes)

    def decode(self, piece: int) -> Records:
        found = self._events.decode(piece, self._checkpoints[piece])[0]
        columns = (found.pulse, found.delay, found.channel)
        return _make_photons(*(column[found.is_photon] for column in columns))


class SwabianPhotons:
    """Photons of Swabian Instruments' files. Their library reads forwards only, so
    that stepping back begins anew. `sync`: channel of the laser's pulses, as the instrument numbers
    it: negative for falling edges. All others become channels from 0, in the order of their
    numbers.
    """

    def __init__(self, path: Path, sync: int) -> None:
        self._library = import_file_reader("Swabian.TimeTagger", "swabian-timetagger")
        self._path, self._sync = path, sync
        self._inputs: list[int] = []
        self._rewind()
        self.sizes, self.lost = [], 0
        inputs: set[int] = set()
        count = PulseCount()
        while self._file.hasData():
            (_, _, channel), lost = self._read_next()
            inputs |= set(np.unique(channel).tolist())
            self.sizes.append(len(channel))
            self.lost += lost
            count = self._count
        if count.pulses < 2:
            raise InputError(
                f"{path}: has no laser's pulses on channel {sync}; name theirs: sync=..., other "
                f"channels are {', '.join(map(str, sorted(inputs))) or 'none'}"
            )
        self._inputs = sorted(inputs)
        self._rewind()
        period = count.period_ticks * PICOSECOND
        self.calibration = _describe_bins(PICOSECOND, max(1, len(inputs)), period, path)
        named = {"inputs": ",".join(map(str, self._inputs))}
        details = {**self.calibration.attributes, **named}
        self.info = Info("time tags (Swabian Instruments)", "", details)

    def decode(self, piece: int) -> Records:
        if piece < self._next:
            self._rewind()
        while True:
            (pulse, delay, channel), _ = self._read_next()
            if self._next == piece + 1:
                return _make_photons(pulse, delay, np.searchsorted(self._inputs, channel))

    def _rewind(self) -> None:
        said: list[str] = []  # in lines of its own otherwise
        self._library.setLogger(lambda level, message: said.append(message))
        try:
            self._file = self._library.FileReader(str(self._path))
            self._file.getConfiguration()  # which fails for a damaged file; opening it does not
        except Exception as fault:  # its own, which are not known before it is imported
            why = said[0] if said else format_error_line(fault)
            raise FileFormatError(
                self._path, f"is a damaged or unsupported file ({why})"
            ) from fault
        finally:
            self._library.setLogger(None)
        self._count, self._next = PulseCount(), 0

    def _read_next(
        self,
    ) -> tuple[tuple[IntArray, IntArray, IntArray], int]:
        """Return pulse, delay and channel of the next photons, and how many tags were lost."""
        tags = self._file.getData(SWABIAN_CHUNK_TAGS)
        kind, channel = np.asarray(tags.getEventTypes()), np.asarray(tags.getChannels(), np.int64)
        time = np.asarray(tags.getTimestamps(), np.int64)
        is_tag = kind == SWABIAN_TAG
        is_pulse = is_tag & (channel == self._sync)
        pulse, delay, self._count = self._count.find_pulses(time, is_pulse)
        is_photon = is_tag & ~is_pulse & (pulse >= 0)
        lost = int(np.asarray(tags.getMissedEvents())[kind == SWABIAN_MISSED].sum())
        self._next += 1
        return (pulse[is_photon], delay[is_photon], channel[is_photon]), lost


@dataclass(frozen=True)
class PulseOptions(Options):
    """Values of addresses of time tags."""

    sync: int | None = option(None, int)  # channel of the laser's pulses


def open_ptu(uri: Uri) -> RecordFile:
    """Open ``file://run.ptu``; ``sync=N``: input of the laser's pulses in T2 mode."""
    sync = PulseOptions.from_uri(uri).sync
    return RecordFile(uri.location, lambda path: PtuPhotons(path, sync))


def open_ttbin(uri: Uri) -> RecordFile:
    """Open ``file://run.ttbin?sync=1``; ``sync`` is the channel of the laser's pulses."""
    sync = PulseOptions.from_uri(uri).sync
    if sync is None:
        raise InputError(f"'{uri.text}': name the channel of the laser's pulses: sync=1")
    return RecordFile(uri.location, lambda path: SwabianPhotons(path, sync))


def _make_photons(pulse: Any, delay: Any, channel: Any) -> Records:
    photons = np.empty(len(pulse), PHOTON_DTYPE)
    photons["sync"], photons["bin"], photons["channel"] = pulse, delay, channel
    return photons


def _describe_bins(
    resolution: float, channels: int, period: float, path: Path, **shape: int
) -> Record:
    """Return the calibration of photons in bins of `resolution`, s."""
    if not 0 < resolution < np.inf:
        raise FileFormatError(path, f"says that its bins last {resolution} s")
    found: dict[str, Scalar] = {"resolution_s": resolution, "channels": channels, **shape}
    if period:
        found["laser_period_s"] = period
    return Record("tcspc_calibration", attributes=found)


def _read_picoquant_histograms(path: Path) -> WholeRecords:
    size = _require_moderate_size(path)
    ptufile = import_file_reader("ptufile", TCSPC)
    with BoundedFile(path) as opened, ptufile.PhuFile(opened) as file:
        bins = np.ravel(file.tags["HistResDscr_HistogramBins"]).tolist()
        require_bounded_size(path, "histograms", sum(map(abs, bins)) * HISTOGRAM_BYTES, size)
        resolution = float(file.tcspc_resolution)
        return _stack_histograms(file.histograms(), resolution, "PicoQuant histograms", path)


def _read_becker_hickl_histograms(path: Path) -> WholeRecords:
    _require_moderate_size(path)
    blocks, resolution = read_sdt_blocks(path)
    curves = [curve for block in blocks for curve in block.reshape(-1, block.shape[-1])]
    shape = {}
    if len({block.shape for block in blocks}) == 1 and blocks[0].ndim == 3:
        shape = dict(zip(("rows", "columns"), blocks[0].shape, strict=False))
    return _stack_histograms(curves, resolution, "Becker & Hickl histograms", path, **shape)


def _require_moderate_size(path: Path) -> int:
    size = path.stat().st_size
    if size > MAX_HISTOGRAM_FILE_BYTES:
        raise FileFormatError(
            path, f"is larger than {MAX_HISTOGRAM_FILE_BYTES} bytes; export a part of it"
        )
    return size


def _stack_histograms(
    curves: Any, resolution: float, instrument: str, path: Path, **shape: int
) -> WholeRecords:
    """Return histograms, each a record; all must have as many bins."""
    lengths = {len(curve) for curve in curves}
    if len(lengths) != 1 or not 0 < max(lengths) <= MAX_BINS:
        raise FileFormatError(
            path, f"has histograms of {sorted(lengths) or 'no'} bins, expected one length"
        )
    counts = np.stack(list(curves))
    records = np.zeros(len(counts), [("channel", "<u4"), ("histogram", "<u4", counts.shape[1:])])
    records["channel"], records["histogram"] = np.arange(len(counts)), counts
    known = _describe_bins(resolution, len(counts), 0.0, path, **shape)
    return WholeRecords(records, Info(instrument, "", known.attributes), known)


def _read_picture(path: Path) -> WholeRecords:
    """Return one frame, and the time axis that its file brings."""
    streak = read_streak(path)
    rows, columns = streak.counts.shape
    frame = np.zeros(1, [("number", "<i8"), ("counts", "<f4", streak.counts.shape)])
    frame["counts"] = streak.counts
    said = streak.metadata
    details: dict[str, Scalar] = {
        "rows": rows,
        "columns": columns,
        "camera": said.get("Camera/CameraName", ""),
        "date": said.get("Application/Date", ""),
    }
    info = Info("streak image in a file", said.get("Camera/SerialNumber", ""), details)
    times = streak.row_times
    return WholeRecords(frame, info, None if times is None else make_streak_calibration(times))


def _make_opener(files: str, read: Callable[[Path], WholeRecords]) -> Callable[[Uri], RecordFile]:
    """Return what opens files of one piece, whose addresses have no values."""

    def open_whole(uri: Uri) -> RecordFile:
        Options.from_uri(uri)
        return RecordFile(uri.location, read)

    open_whole.__doc__ = f"Open {files}."
    return open_whole


open_phu = _make_opener("``file://run.phu``", _read_picoquant_histograms)
open_sdt = _make_opener(
    "``file://run.sdt``; an image's pixels are its channels", _read_becker_hickl_histograms
)
open_streak_file = _make_opener("``file://shot.img`` or ``file://shot.tif``", _read_picture)
