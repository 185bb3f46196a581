"""Files of time-correlated single-photon counting: PicoQuant's PTU and PHU, Becker & Hickl's SDT.

The libraries `ptufile` and `sdtfile` read them (extra ``tcspc``). Photons one by one come from
`devices.ptu`; here are whole histograms (PHU, SDT).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from devices.codec import Records
from devices.ledger import Ledger
from devices.source import READ_TIMEOUT_S, Batch, Info, Source
from devices.statistics import Stats
from devices.uri import Uri
from tofclip.errors import FileFormatError, InputError, MissingDependencyError, TofclipError
from tofclip.file_limits import BoundedFile, require_bounded_size
from tofclip.io.becker_hickl import require_bounded_sdt
from tofclip.storage import Record, Scalar, format_error_line, translate_read_errors

HISTOGRAM_BYTES = 4
"""Of one bin in a PHU file."""

PHOTON_DTYPE = np.dtype([("sync", "<u8"), ("bin", "<u4"), ("channel", "<u4")])
"""`sync`: number of the laser's pulse. `bin`: time after it, in the file's resolution. `channel`:
from 0.
"""

BATCH_RECORDS = 1 << 16
MAX_FILE_BYTES = 1 << 31
"""Larger files are not read: their photons would not fit into memory four times over."""

MAX_BINS = 1 << 20

FileContents = tuple[Records, dict[str, Scalar], Info]


class TcspcFile(Source):
    """A file's records. Memory: four times the file, which the libraries read as a whole.

    The calibration has ``resolution_s``, the width of a bin, and ``channels``.

    Parameters
    ----------
    path : path-like
    reader : callable
        Makes records, calibration and info of the file.

    Raises
    ------
    StorageError
        The file is absent or may not be read.
    FileFormatError
        It is damaged.
    """

    def __init__(self, path: str | Path, reader: Callable[[Path], FileContents]) -> None:
        with translate_read_errors(path):
            size = Path(path).stat().st_size
        if size > MAX_FILE_BYTES:
            raise FileFormatError(
                path, f"is larger than {MAX_FILE_BYTES} bytes; export a part of it"
            )
        try:
            with translate_read_errors(path):
                self._records, self._attributes, self._info = reader(Path(path))
        except TofclipError:
            raise
        except (
            Exception
        ) as fault:  # whatever the library stumbles over, it is the file that is damaged
            raise FileFormatError(
                path, f"is a damaged or unsupported file ({format_error_line(fault)})"
            ) from fault
        self._closed = False
        self.seek(0)

    @property
    def info(self) -> Info:
        return self._info

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
        first = self._next
        records = self._records[first : first + BATCH_RECORDS]
        if self._closed or len(records) == 0:
            return None
        self._next += len(records)
        self._ledger.deliver(len(records), 0)
        return Batch(records, first)

    def seek(self, record: int) -> None:
        if not 0 <= record <= len(self._records):
            raise InputError(
                f"the file has {len(self._records)} records, there is no number {record}"
            )
        self._next, self._ledger = record, Ledger()
        self._ledger.receive(len(self._records))
        self._ledger.deliver(record, 0)

    def close(self) -> None:
        self._closed = True


def open_phu(uri: Uri) -> TcspcFile:
    """Open ``file://run.phu``."""
    return _open_file(uri, _read_picoquant_histograms)


def open_sdt(uri: Uri) -> TcspcFile:
    """Open ``file://run.sdt``."""
    return _open_file(uri, _read_becker_hickl_histograms)


def _open_file(uri: Uri, reader: Callable[[Path], FileContents]) -> TcspcFile:
    uri.reject_unknown()
    return TcspcFile(uri.location, reader)


def _read_picoquant_histograms(path: Path) -> FileContents:
    ptufile = import_library("ptufile")
    with BoundedFile(path) as opened, ptufile.PhuFile(opened) as file:
        bins = np.ravel(file.tags["HistResDscr_HistogramBins"]).tolist()
        require_bounded_size(
            path, "histograms", sum(map(abs, bins)) * HISTOGRAM_BYTES, path.stat().st_size
        )
        return _make_histogram_records(
            file.histograms(), float(file.tcspc_resolution), "PicoQuant histograms", path
        )


def _read_becker_hickl_histograms(path: Path) -> FileContents:
    sdtfile = import_library("sdtfile")
    require_bounded_sdt(path)
    with sdtfile.SdtFile(path) as file:
        curves = [
            curve for block in file.data for curve in np.asarray(block).reshape(-1, block.shape[-1])
        ]
        steps = {float(times[1] - times[0]) for times in file.times if len(times) > 1}
    if len(steps) != 1:
        raise FileFormatError(
            path, f"has blocks of {len(steps)} different resolutions, expected one"
        )
    return _make_histogram_records(curves, steps.pop(), "Becker & Hickl histograms", path)


def _make_histogram_records(
    curves: Any, resolution: float, instrument: str, path: Path
) -> FileContents:
    lengths = {len(curve) for curve in curves}
    if len(lengths) != 1 or not 0 < max(lengths) <= MAX_BINS:
        raise FileFormatError(
            path, f"has histograms of {sorted(lengths) or 'no'} bins, expected one length"
        )
    counts = np.stack(list(curves))
    records = np.zeros(len(counts), [("channel", "<u4"), ("histogram", "<u4", counts.shape[1:])])
    records["channel"], records["histogram"] = np.arange(len(counts)), counts
    attributes: dict[str, Scalar] = {
        "resolution_s": require_positive(resolution, path),
        "channels": len(counts),
    }
    return records, attributes, Info(instrument, "", dict(attributes))


def require_positive(resolution: float, path: Path) -> float:
    """Return a bin's duration, s, if it can be one."""
    if not (np.isfinite(resolution) and resolution > 0):
        raise FileFormatError(path, f"says that its bins last {resolution} s")
    return resolution


def import_library(name: str) -> Any:
    """Import what reads these files, or raise the line that says how to install it."""
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError as fault:
        raise MissingDependencyError(
            f"{name} is missing; install tofclip[tcspc] to read this file"
        ) from fault


def compute_photon_times(photons: Records, calibration: Record) -> NDArray[np.float64]:
    """Return when each photon came, s after the laser's pulse: the beginning of its bin.

    Parameters
    ----------
    photons : (n,) record array
        With a field ``bin``.
    calibration : Record
        Gives the resolution, s.

    Returns
    -------
    (n,) float64 array
    """
    times: NDArray[np.float64] = photons["bin"] * float(calibration.attribute("resolution_s"))
    return times
