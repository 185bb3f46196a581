"""What a LinoSPAD2 board's calibration knows: how wide each code is, how late each pixel, and which
pixels are hot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from devices.codec import Records
from devices.linospad2.codec import PIXELS
from tofclip.errors import FileFormatError, InputError, ShapeError
from tofclip.files import format_error_line, translate_read_errors
from tofclip.records import Storable, stored_array

CODES_PER_PERIOD = 140
"""Codes in one period of the board's clock."""

CLOCK_PERIOD_S = 2500e-12
"""Period of the board's clock, s."""

_MAX_FILE_BYTES = 1 << 23
_ROUNDING_S = 1e-6 * CLOCK_PERIOD_S


@dataclass(frozen=True)
class BoardCalibration(Storable):
    """Tables that turn a pixel's codes into seconds.

    Parameters
    ----------
    code_ends : (256, 140) array
        Instant at which each code ends, s since the clock's tick, for each pixel; the converters'
        steps are uneven.
    offsets : (256,) array
        Added to a pixel's times, s.
    hot_pixels : (k,) int array
        Pixels that count without light.

    Raises
    ------
    ShapeError, InputError
        A table has another shape, is not finite, goes back, or leaves the clock's period; or there
        is no such pixel.
    """

    RECORD_KIND = "linospad2_calibration"

    code_ends: NDArray[np.float64] = field(metadata=stored_array("s", "pixel", "code"))
    offsets: NDArray[np.float64] = field(metadata=stored_array("s", "pixel"))
    hot_pixels: NDArray[np.int64] = field(
        default_factory=lambda: np.empty(0, np.int64),
        metadata=stored_array("px", "hot", dtype=np.int64, optional=True, skip_empty=True),
    )

    def __post_init__(self) -> None:
        for name, shape in (("code_ends", (PIXELS, CODES_PER_PERIOD)), ("offsets", (PIXELS,))):
            table = np.ascontiguousarray(getattr(self, name), np.float64)
            object.__setattr__(self, name, table)
            if table.shape != shape:
                raise ShapeError(f"LinoSPAD2's {name}", shape, table.shape)
            if not np.all(np.isfinite(table)):
                raise InputError(f"LinoSPAD2's {name} must be finite")
        ends = self.code_ends
        if (
            np.any(np.diff(ends, axis=1) < 0)
            or ends.min() < -_ROUNDING_S
            or ends.max() > CLOCK_PERIOD_S + _ROUNDING_S
        ):
            raise InputError(
                "LinoSPAD2's code_ends must not go back, and stay within the clock's 2.5 ns"
            )
        if np.any((self.hot_pixels < 0) | (self.hot_pixels >= PIXELS)):
            raise InputError(f"LinoSPAD2's hot pixels must lie within 0..{PIXELS - 1}")

    @classmethod
    def ideal(cls) -> BoardCalibration:
        """Return a board of even codes and pixels that are all in step."""
        ends = np.arange(1, CODES_PER_PERIOD + 1) * (CLOCK_PERIOD_S / CODES_PER_PERIOD)
        return cls(np.tile(ends, (PIXELS, 1)), np.zeros(PIXELS))

    @property
    def code_begins(self) -> NDArray[np.float64]:
        """Instant at which each code begins, s since the clock's tick, (256, 140)."""
        begins: NDArray[np.float64] = np.pad(self.code_ends[:, :-1], ((0, 0), (1, 0)))
        return begins

    def times(self, records: Records) -> NDArray[np.float64]:
        """Return when each photon came, s since its cycle began: the end of its code.

        ``time = (code - code % 140) * 2500 ps / 140 + code_ends[pixel, code % 140] +
        offsets[pixel]``
        """
        periods, code = np.divmod(records["code"], CODES_PER_PERIOD)
        found: NDArray[np.float64] = periods * CLOCK_PERIOD_S
        found += self.code_ends[records["pixel"], code]
        found += self.offsets[records["pixel"]]
        return found


def load_calibration(
    code_table: str | Path, offset_table: str | Path, hot_pixels: str | Path | None = None
) -> BoardCalibration:
    """Read tables as the board's makers and daplis write them.

    `code_table`: CSV, ps: a line of code numbers, then for each pixel its number and 140 ends of
    codes; `offset_table`: NPY with 256 numbers, ps; `hot_pixels`: text with one pixel number in
    each line.
    """
    picosecond = 1e-12
    table = _read_numbers(
        code_table, lambda path: np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
    )
    # Mapped, not read: a header that claims more than the file holds is refused before memory is
    # taken.
    offsets = _read_numbers(
        offset_table, lambda path: np.array(np.load(path, mmap_mode="r", allow_pickle=False))
    )
    hot = np.empty(0)
    if hot_pixels is not None:
        hot = _read_numbers(
            hot_pixels, lambda path: [int(word) for word in path.read_text("ascii").split()]
        )
        if np.any((hot < 0) | (hot >= PIXELS)):
            raise FileFormatError(hot_pixels, f"names pixels beyond 0..{PIXELS - 1}")
    if table.ndim != 2 or table.shape[1] != CODES_PER_PERIOD + 1:
        raise FileFormatError(
            code_table, f"must have {CODES_PER_PERIOD + 1} columns, found shape {table.shape}"
        )
    return BoardCalibration(table[:, 1:] * picosecond, offsets * picosecond, hot.astype(np.int64))


def _read_numbers(path: str | Path, reader: Callable[[Path], Any]) -> NDArray[np.float64]:
    with translate_read_errors(path):
        size = Path(path).stat().st_size
        if size > _MAX_FILE_BYTES:
            raise FileFormatError(path, f"is larger than any table of LinoSPAD2: {size} bytes")
        try:
            return np.asarray(reader(Path(path)), np.float64)
        except Exception as fault:  # whatever NumPy stumbles over, it is the file that is damaged
            raise FileFormatError(
                path, f"holds no table of numbers ({format_error_line(fault)})"
            ) from fault


def make_calibration_record(
    board: BoardCalibration, laser_period: float | None, camera: Record | None
) -> Record:
    """Return what turns time stamps into a scene: the board's tables, the laser's period, the
    camera.

    `laser_period`: seconds.
    """
    record = board.to_record()
    attributes = {} if laser_period is None else {"laser_period_s": laser_period}
    children = {} if camera is None else {"camera": camera}
    return Record(record.kind, record.fields, attributes, children)
