"""PicoQuant's PTU files of any size, read a piece at a time: photons after the laser's pulses.

In T3 mode the electronics count pulses and time each photon after its pulse. In T2 mode they tag
every event, pulses included, by an absolute time: here each photon's pulse is the last one before
it. Markers (of lines and frames) and overflows of counters are passed over; pictures are read by
`tofclip lidar photons`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from devices.codec import Records
from devices.ledger import Ledger
from devices.source import READ_TIMEOUT_S, Batch, Info, Source
from devices.statistics import Stats
from devices.tcspc import BATCH_RECORDS, PHOTON_DTYPE, import_library, require_positive
from devices.uri import Uri
from tofclip.errors import FileFormatError, InputError, TofclipError
from tofclip.file_limits import BoundedFile
from tofclip.storage import Record, Scalar, format_error_line, translate_read_errors

CHUNK_RECORDS = 1 << 20
RECORD_BYTES = 4
PICOHARP_T2 = "PicoHarpT2"
NO_PULSE = np.iinfo(np.int64).min


@dataclass(frozen=True)
class _Checkpoint:
    """What has to be known at a chunk's beginning.

    Parameters
    ----------
    photons : int
        Before it.
    overflow : int
        Of the counter, in its ticks.
    pulse : int
        Time of the last pulse in ticks, `NO_PULSE` before the first; T2 mode only.
    pulses : int
        How many there were; T2 mode only.
    """

    photons: int = 0
    overflow: int = 0
    pulse: int = NO_PULSE
    pulses: int = 0


class PtuSource(Source):
    """A file's photons. Memory: a million of its records, decoded, some 70 MiB.

    Opening reads the file once, to know its channels and where each piece begins. The calibration
    has ``resolution_s``, the width of a bin, ``channels`` and ``laser_period_s``.

    Parameters
    ----------
    path : path-like
    sync : int, optional
        Channel of the laser's pulses in T2 mode; by default the electronics' own input for them.

    Raises
    ------
    StorageError
        The file is absent or may not be read.
    FileFormatError
        It is damaged, or has no pulses to count from.
    """

    def __init__(self, path: str | Path, sync: int | None = None) -> None:
        self._path, self._sync = Path(path), sync
        try:
            with translate_read_errors(path):
                self._open_file()
                self._find_pieces()
        except TofclipError:
            raise
        except Exception as fault:  # whatever the library stumbles over, the file is damaged
            raise FileFormatError(
                path, f"is a damaged or unsupported file ({format_error_line(fault)})"
            ) from fault
        self._closed = False
        self._held: Records = np.empty(0, PHOTON_DTYPE)
        self._chunk = self._skip = 0
        self._ledger = Ledger()
        self.seek(0)

    @property
    def info(self) -> Info:
        return Info(f"TCSPC file ({self._kind})", "", dict(self._attributes))

    @property
    def calibration(self) -> Record:
        return Record("tcspc_calibration", attributes=self._attributes)

    @property
    def stats(self) -> Stats:
        return self._ledger.stats

    @property
    def is_seekable(self) -> bool:
        return True

    def read(self, timeout: float = READ_TIMEOUT_S) -> Batch | None:
        """Return the next batch at once; `timeout` does not matter."""
        if self._closed:
            return None
        while not len(self._held) and self._chunk < len(self._pieces):
            self._held = self._decode(self._chunk)[0][self._skip :]
            self._chunk, self._skip = self._chunk + 1, 0
        records, self._held = self._held[:BATCH_RECORDS], self._held[BATCH_RECORDS:]
        if not len(records):
            return None
        first = self._ledger.stats.delivered
        self._ledger.deliver(len(records), 0)
        return Batch(records, first)

    def seek(self, record: int) -> None:
        if not 0 <= record <= self._photons:
            raise InputError(f"the file has {self._photons} records, there is no number {record}")
        begins = [piece.photons for piece in self._pieces]
        self._chunk = max(0, int(np.searchsorted(begins, record, "right")) - 1)
        self._skip = record - begins[self._chunk] if begins else 0
        self._held = self._held[:0]
        self._ledger = Ledger()
        self._ledger.receive(self._photons)
        self._ledger.deliver(record, 0)

    def close(self) -> None:
        self._closed = True

    def _open_file(self) -> None:
        ptufile = import_library("ptufile")
        with BoundedFile(self._path) as opened, ptufile.PtuFile(opened) as file:
            self._is_t3 = bool(file.is_t3)
            self._kind = str(file.record_type.name)
            self._global_resolution = float(file.global_resolution)
            resolution = float(file.tcspc_resolution) if self._is_t3 else self._global_resolution
            self._resolution = require_positive(resolution, self._path)
            rate = float(file.syncrate) if self._is_t3 else 0.0
            self._period = 1 / rate if rate > 0 else None
            self._decode_records = file.decode_records
            self._offset, announced = int(file.record_offset), int(file.number_records)
        held = max(0, self._path.stat().st_size - self._offset) // RECORD_BYTES
        self._count = min(announced, held)

    def _find_pieces(self) -> None:
        """Read through the file once and note how things are where each piece begins."""
        self._pieces: list[_Checkpoint] = []
        at, channels = _Checkpoint(), 0
        first_pulse = NO_PULSE
        for chunk in range(-(-self._count // CHUNK_RECORDS)):
            self._pieces.append(at)
            photons, behind = self._decode(chunk)
            channels = max(channels, int(photons["channel"].max(initial=0)) + 1)
            if first_pulse == NO_PULSE and len(photons) and not self._is_t3:
                first_pulse = int(self._first_pulse)
            at = behind
        self._photons = at.photons
        if not self._is_t3:
            if at.pulses < 2:
                raise FileFormatError(
                    self._path,
                    "is in T2 mode and has no laser's pulses there; name their channel: sync=...",
                )
            spent = (at.pulse - first_pulse) * self._global_resolution
            self._period = spent / max(1, at.pulses - 1)
        self._attributes: dict[str, Scalar] = {
            "resolution_s": self._resolution,
            "channels": max(channels, 1),
        }
        if self._period:
            self._attributes["laser_period_s"] = self._period

    def _decode(self, chunk: int) -> tuple[Records, _Checkpoint]:
        """Return a piece's photons, and how things are behind it."""
        before = self._pieces[chunk]
        first = chunk * CHUNK_RECORDS
        # Read, not mapped: mapped pages would count as this program's memory.
        words = np.fromfile(
            self._path,
            "<u4",
            min(CHUNK_RECORDS, self._count - first),
            offset=self._offset + first * RECORD_BYTES,
        )
        # An added event at tick 0 shows by its time how often the counter has run over.
        decoded = self._decode_records(np.append(words, np.uint32(0)))
        overflow = before.overflow + int(decoded["time"][-1])
        events = decoded[:-1]
        times = events["time"].astype(np.int64) + before.overflow
        if self._is_t3:
            photons = self._gather_t3(events, times)
            return photons, _Checkpoint(before.photons + len(photons), overflow)
        is_pulse = self._find_pulses(events, words)
        photons, pulse, pulses = self._gather_t2(events, times, is_pulse, before)
        return photons, _Checkpoint(before.photons + len(photons), overflow, pulse, pulses)

    def _gather_t3(self, events: Any, times: NDArray[np.int64]) -> Records:
        is_photon = (events["channel"] >= 0) & (events["dtime"] >= 0)
        photons = np.empty(int(is_photon.sum()), PHOTON_DTYPE)
        photons["sync"] = times[is_photon]
        photons["bin"] = events["dtime"][is_photon]
        photons["channel"] = events["channel"][is_photon]
        return photons

    def _find_pulses(self, events: Any, words: NDArray[np.uint32]) -> NDArray[np.bool_]:
        """Return which events are the laser's pulses."""
        is_special = words >> 31 != 0
        if self._sync is not None:
            return np.asarray((events["channel"] == self._sync) & ~is_special)
        if self._kind == PICOHARP_T2:
            return np.asarray(events["channel"] == 0)  # which has no other mark
        # The library gives them channel 0, as photons of the first input.
        return np.asarray((events["channel"] == 0) & is_special)

    def _gather_t2(
        self,
        events: Any,
        times: NDArray[np.int64],
        is_pulse: NDArray[np.bool_],
        before: _Checkpoint,
    ) -> tuple[Records, int, int]:
        """Count each photon's time from the last pulse; those before the first one have none."""
        channel = events["channel"]
        pulse_times = np.concatenate([[before.pulse], times[is_pulse]])
        number = np.cumsum(is_pulse)  # of the last pulse, in this piece from 1
        is_photon = (channel >= 0) & ~is_pulse & (pulse_times[number] != NO_PULSE)
        if len(pulse_times) > 1 and before.pulses == 0:
            self._first_pulse = int(pulse_times[1])
        photons = np.empty(int(is_photon.sum()), PHOTON_DTYPE)
        own = number[is_photon]
        photons["sync"] = before.pulses + own - 1
        photons["bin"] = times[is_photon] - pulse_times[own]
        photons["channel"] = channel[is_photon] - (self._kind == PICOHARP_T2)
        return photons, int(pulse_times[-1]), before.pulses + len(pulse_times) - 1


def open_ptu(uri: Uri) -> PtuSource:
    """Open ``file://run.ptu``; ``sync=N`` where a file in T2 mode has the laser's pulses on an input
    for photons.
    """
    uri.reject_unknown("sync")
    return PtuSource(uri.location, uri.value("sync", int, 0) if "sync" in uri.values else None)
