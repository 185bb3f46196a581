"""Files of photon counters.

PicoQuant's PTU files of any size: events as the electronics tagged them, a piece at a time, and the
pictures of a scanner. In T3 mode the electronics count the laser's pulses and time each photon
after its pulse. In T2 mode they tag every event, pulses included, by an absolute time; there a
photon's pulse is the last one before it. Markers of lines and frames come in between.

Becker & Hickl's ``.sdt`` files: what their blocks claim is checked before `sdtfile` reads them.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import AnyArray, BoolArray, FloatArray, IntArray
from tofclip.errors import FileFormatError
from tofclip.files import BoundedFile, import_file_reader, require_bounded_size
from tofclip.io.archive import MEMBER_COMPRESSIONS

TCSPC = "tofclip[tcspc]"  # what brings the libraries for these files

CHUNK_EVENTS = 1 << 20
RECORD_BYTES = 4
PICOHARP_T2 = "PicoHarpT2"
NO_PULSE = int(np.iinfo(np.int64).min)
MAX_SCAN_BYTES = 1 << 32
PHOTON_BYTES = 12  # of a photon of a picture: its pixel and its time

MILLISECOND_S = 1e-3
MARKER_TAGS = ("LineStart", "LineStop", "Frame")


@dataclass(frozen=True)
class PulseCount:
    """The laser's pulses up to some event."""

    pulses: int = 0  # how many there were
    first: int = NO_PULSE  # time of the first one in ticks, `NO_PULSE` before it
    last: int = NO_PULSE  # and of the last one

    @property
    def period_ticks(self) -> float:
        """Mean time between two pulses; 0 where there are none to tell."""
        return (self.last - self.first) / (self.pulses - 1) if self.pulses > 1 else 0.0

    def find_pulses(
        self, times: IntArray, is_pulse: BoolArray
    ) -> tuple[IntArray, IntArray, PulseCount]:
        """Find the last pulse before each of the events that follow, at `times` (n,) in ticks that
        do not go back: its number from 0, -1 where there was none, and the ticks since it; and the
        count behind these events.
        """
        at = np.concatenate([[self.last], times[is_pulse]])
        own = np.cumsum(is_pulse)
        number = self.pulses - 1 + own
        delay = np.where(number < 0, 0, times - at[own])
        first = int(at[1]) if self.first == NO_PULSE and len(at) > 1 else self.first
        return number, delay, PulseCount(self.pulses + len(at) - 1, first, int(at[-1]))


@dataclass(frozen=True)
class Checkpoint:
    """What has to be known where a piece of a file begins: how far the counter has overflowed, in
    ticks, and in T2 mode the pulses so far.
    """

    overflow: int = 0
    count: PulseCount = PulseCount()


@dataclass(frozen=True)
class Events:
    """Events of a piece, in their order; each array has one value for each."""

    time: IntArray  # number of the pulse in T3 mode, ticks in T2 mode
    pulse: IntArray  # number of the last pulse from 0
    delay: IntArray  # time after it, in bins
    channel: NDArray[np.int16]  # of photons from 0
    # others are pulses, markers, overflows, and photons before the first pulse
    is_photon: BoolArray
    marker: NDArray[np.uint8]  # one bit for each marker, where the event is one


class PtuEvents:
    """A PTU file as pieces of a million events. Memory: one piece, decoded. `sync`: channel of the
    laser's pulses in T2 mode; by default the electronics' own input for them.
    """

    def __init__(self, path: str | Path, sync: int | None = None) -> None:
        self.path, self._sync = Path(path), sync
        ptufile = import_file_reader("ptufile", TCSPC)
        with BoundedFile(self.path) as opened, ptufile.PtuFile(opened) as file:
            self.is_t3 = bool(file.is_t3)
            self.is_image = bool(file.is_image)
            self.kind = str(file.record_type.name)
            self.tick = float(file.global_resolution)  # s, of `Events.time`
            # s, of `Events.delay`
            self.resolution = float(file.tcspc_resolution) if self.is_t3 else self.tick
            rate = float(file.syncrate) if self.is_t3 else 0.0
            self.period = 1 / rate if rate > 0 else 0.0  # s between pulses in T3 mode, 0: not given
            self.tags: Mapping[str, Any] = dict(file.tags)
            self._decode_records = file.decode_records
            self._offset, announced = int(file.record_offset), int(file.number_records)
        held = max(0, self.path.stat().st_size - self._offset) // RECORD_BYTES
        self.events = min(announced, held)

    @property
    def pieces(self) -> int:
        """How many there are."""
        return -(-self.events // CHUNK_EVENTS)

    def decode(self, piece: int, before: Checkpoint) -> tuple[Events, Checkpoint]:
        """Decode a piece; return its events, and what has to be known behind it."""
        first = piece * CHUNK_EVENTS
        # Read, not mapped: mapped pages would count as this program's memory.
        number, start = min(CHUNK_EVENTS, self.events - first), self._offset + first * RECORD_BYTES
        words = np.fromfile(self.path, "<u4", number, offset=start)
        # An added event at tick 0 shows by its time how often the counter has run over.
        decoded = self._decode_records(np.append(words, np.uint32(0)))
        overflow = before.overflow + int(decoded["time"][-1])
        found = decoded[:-1]
        time = found["time"].astype(np.int64) + before.overflow
        channel, marker = found["channel"].astype(np.int16), found["marker"]
        if self.is_t3:
            delay = found["dtime"].astype(np.int64)
            is_photon = (channel >= 0) & (delay >= 0)
            events = Events(time, time, delay, channel, is_photon, marker)
            return events, replace(before, overflow=overflow)
        # The library gives the electronics' own pulses channel 0: special events, but of PicoHarps.
        is_own = channel == 0
        if self.kind == PICOHARP_T2:
            channel -= 1
        else:
            is_own &= words >> 31 != 0
        is_pulse = is_own if self._sync is None else (channel == self._sync) & ~is_own
        pulse, delay, count = before.count.find_pulses(time, is_pulse)
        is_photon = (channel >= 0) & ~is_own & ~is_pulse & (pulse >= 0)
        return Events(time, pulse, delay, channel, is_photon, marker), Checkpoint(overflow, count)

    def __iter__(self) -> Iterator[tuple[Events, Checkpoint]]:
        """Decode one piece after the other, each with what has to be known behind it."""
        at = Checkpoint()
        for piece in range(self.pieces):
            events, at = self.decode(piece, at)
            yield events, at


def require_pulses(path: Path, count: PulseCount) -> None:
    """Refuse a file in T2 mode that has no pulses to count from."""
    if count.pulses < 2:
        raise FileFormatError(
            path, "is in T2 mode and has no laser's pulses there; name their channel: sync=..."
        )


@dataclass(frozen=True)
class ScannedPhotons:
    """Photons of a scanner's picture; all its frames together."""

    x: NDArray[np.uint16]  # (photons,), pixel
    y: NDArray[np.uint16]  # (photons,), pixel
    time: FloatArray  # (photons,), s after the laser's pulse


class _Lines(NamedTuple):
    """When the scanner was on which row: ticks where each line begins and ends, and its row."""

    begin: IntArray
    end: IntArray
    duration: IntArray
    row: IntArray


def get_scan_shape(events: PtuEvents) -> tuple[int, int]:
    """Return the rows and columns of a scanner's picture."""
    rows, columns = (int(events.tags.get(f"ImgHdr_Pix{axis}", 0)) for axis in "YX")
    if not (0 < rows < 1 << 16 and 0 < columns < 1 << 16):
        raise FileFormatError(events.path, f"claims a picture of {rows} x {columns} pixels")
    if events.tags.get("ImgHdr_SinCorrection", 0):
        raise FileFormatError(events.path, "was scanned in a sine, which is not read in T2 mode")
    return rows, columns


def read_scan(events: PtuEvents) -> ScannedPhotons:
    """Put the photons of a file in T2 mode into the pixels of a scanner's picture, by the markers
    that it sets where lines begin and end and frames change; those between lines are left out. The
    file is read twice. Memory: a piece of it, and 12 bytes for each photon.
    """
    rows, columns = get_scan_shape(events)
    lines = _find_lines(events, rows, columns)
    is_back = bool(events.tags.get("ImgHdr_BiDirect", 0))
    found: list[ScannedPhotons] = []
    photons = 0
    for piece, _ in events:
        line = np.searchsorted(lines.begin, piece.time, "right") - 1
        inside = piece.is_photon & (line >= 0)
        inside[inside] = piece.time[inside] < lines.end[line[inside]]
        line, time = line[inside], piece.time[inside]
        x = (time - lines.begin[line]) * columns // lines.duration[line]
        y = lines.row[line]
        if is_back:
            x = np.where(y % 2, columns - 1 - x, x)
        delay = piece.delay[inside] * np.float64(events.resolution)
        found.append(ScannedPhotons(x.astype(np.uint16), y.astype(np.uint16), delay))
        photons += len(x)
        if photons * PHOTON_BYTES > MAX_SCAN_BYTES:
            raise FileFormatError(
                events.path, f"has {photons} photons or more in its lines; export a part of it"
            )
    return ScannedPhotons(
        *(np.concatenate([getattr(one, name) for one in found]) for name in ("x", "y", "time"))
    )


def _find_lines(events: PtuEvents, rows: int, columns: int) -> _Lines:
    """Read through the markers; lines beyond the picture, or without an end, are left out."""
    numbers = (int(events.tags.get(f"ImgHdr_{name}", 0)) for name in MARKER_TAGS)
    start, stop, change = (1 << number - 1 if 0 < number <= 8 else 0 for number in numbers)
    marked: dict[int, list[IntArray]] = {start: [], stop: [], change: []}
    count = PulseCount()
    for piece, at in events:
        count = at.count
        for mask, times in marked.items():
            times.append(piece.time[(piece.marker & mask != 0) & ~piece.is_photon])
    require_pulses(events.path, count)
    begin, end, frames = (np.concatenate(marked[mask]) for mask in (start, stop, change))
    if not len(begin):
        raise FileFormatError(events.path, "has no markers where lines begin")
    dwell = float(events.tags.get("ImgHdr_TimePerPixel", 0.0)) * MILLISECOND_S / events.tick
    never = np.iinfo(np.int64).max
    following = np.append(begin[1:], never)
    ended = np.append(end, never)[np.searchsorted(end, begin, "right")]
    duration = np.full(len(begin), round(dwell * columns)) if dwell > 0 else ended - begin
    until = np.minimum(np.minimum(ended, following), begin + np.minimum(duration, never - begin))
    frame = np.searchsorted(frames, begin, "right")
    row = np.arange(len(begin)) - np.searchsorted(frame, frame, "left")
    if not change:
        row %= rows
    valid = (row < rows) & (duration > 0) & ((dwell > 0) | (ended <= following) & (ended < never))
    if not valid.any():
        raise FileFormatError(events.path, "has no markers where lines end")
    # A line that is left out ends where it begins.
    return _Lines(begin, np.where(valid, until, begin), np.maximum(duration, 1), row)


LAST_OLD_REVISION = 14
EXTENDED_COUNT = 0x7FFF  # where 16 bits do not suffice: the number of blocks is in `reserved1`


def read_sdt_blocks(path: Path) -> tuple[list[AnyArray], float]:
    """Read counts (..., bins) of each block, and the duration of a bin, s."""
    sdtfile = import_file_reader("sdtfile", "tofclip[tcspc]")
    require_bounded_sdt(path)
    with BoundedFile(path) as opened, sdtfile.SdtFile(opened) as file:
        blocks = [np.asarray(block) for block in file.data]
        steps = {float(times[1] - times[0]) for times in file.times if len(times) > 1}
    if len(steps) != 1:
        raise FileFormatError(path, f"has blocks of {len(steps)} resolutions, expected one")
    return blocks, steps.pop()


def require_bounded_sdt(path: Path) -> None:
    """Refuse a file that claims more in its blocks than it can hold."""
    from sdtfile import sdtfile

    layout = np.dtype(sdtfile.FILE_HEADER).newbyteorder("<")
    size = path.stat().st_size
    if size < layout.itemsize:
        raise FileFormatError(path, "is truncated: it is shorter than an SDT header")
    header = np.fromfile(path, layout, 1)[0]
    revision = sdtfile.FileRevision(int(header["revision"])).revision
    names = sdtfile.BLOCK_HEADER if revision > LAST_OLD_REVISION else sdtfile.BLOCK_HEADER_OLD
    layout = np.dtype(names).newbyteorder("<")
    number, place = int(header["no_of_data_blocks"]), int(header["data_block_offs"])
    if number == EXTENDED_COUNT:
        number = int(header["reserved1"])
    require_bounded_size(path, "blocks", number * layout.itemsize, size)
    for block in range(number):
        if place + layout.itemsize > size:
            raise FileFormatError(path, f"is truncated: block {block} lies beyond its end")
        found = np.fromfile(path, layout, 1, offset=place)[0]
        packed = bool(sdtfile.BlockType(int(found["block_type"])).compress)
        require_bounded_size(path, f"block {block}", int(found["block_length"]), size, packed)
        begin, place = int(found["data_offs"]), int(found["next_block_offs"])
        if not packed:
            continue
        # A ZIP archive of one member, which could unpack to any size.
        if not 0 <= begin < place <= size:
            raise FileFormatError(path, f"is truncated: block {block} lies beyond its end")
        content = np.fromfile(path, np.uint8, place - begin, offset=begin).tobytes()
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            for member in archive.filelist[:1]:
                if member.compress_type not in MEMBER_COMPRESSIONS:
                    raise FileFormatError(path, f"block {block} is packed in an unknown way")
                claimed, held = member.file_size, member.compress_size
                require_bounded_size(path, f"block {block}", claimed, held, True)
