"""The text that Hamamatsu's HPD-TA and HiPic leave in their pictures, and the time axis that it
points to.

The text is a row of sections, ``[Name],key=value,key="value, with commas"``; a section may start
without a line break. The time axis is a table of float32 somewhere behind the pixels: it is not
uniform, because no sweep voltage is a straight line.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import FileFormatError, InputError
from tofclip.files import translate_read_errors

TIME_UNITS: Final = {
    "s": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    # The micro sign (U+00B5) and the Greek letter mu (U+03BC) look alike; both occur.
    "µs": 1e-6,
    "μs": 1e-6,
    "ns": 1e-9,
    "ps": 1e-12,
    "fs": 1e-15,
}

_TOKEN = re.compile(
    r'\[(?P<section>[^\]\r\n]*)\]|(?P<key>[^\s,=\[\]"][^,=\[\]"\r\n]*)=(?:"(?P<quoted>[^"]*)"|(?P<bare>[^,\[\r\n]*))'
)
_TABLE = re.compile(r"#(\d{1,15}),(\d{1,9})")
# Values of ScalingYType and of ScalingYScalingFile. In focus mode nothing is swept.
_LINEAR, _FOCUS_MODE = "1", "Focus mode"
_BYTES_PER_ENTRY = 4


def is_hpdta(text: str) -> bool:
    """Whether an image description is HPD-TA's or HiPic's."""
    return text.lstrip().startswith("[Application]")


def parse_text(text: str) -> dict[str, str]:
    """Split the text into ``{"Section/key": value}``, e.g. ``"Streak camera/Time Range": "20 ns"``."""
    found: dict[str, str] = {}
    section = ""
    for token in _TOKEN.finditer(text):
        if token["section"] is not None:
            section = token["section"].strip()
        else:
            value = token["bare"].strip() if token["quoted"] is None else token["quoted"]
            found[f"{section}/{token['key'].strip()}"] = value
    return found


def read_row_times(
    metadata: Mapping[str, str], path: str | Path, rows: int
) -> NDArray[np.float64] | None:
    """Return the instant of each row, s, counted from the start of the sweep.

    The table ``#offset,count`` covers the whole sweep; a picture of a part of the sensor
    (``areSource`` = left, top, width, height) begins at its row ``top``. In focus mode, or without
    a unit of time, there is no axis.

    `metadata`: what `parse_text` returned; `path`: the file that holds the table; `rows`: rows of
    the picture. Returns (rows,).
    """
    unit = TIME_UNITS.get(metadata.get("Scaling/ScalingYUnit", ""))
    if unit is None or metadata.get("Scaling/ScalingYScalingFile") == _FOCUS_MODE:
        return None
    table = find_table(metadata, "Y")
    if table:
        start, count = table
        # A table as long as the picture belongs to its own rows; a longer one covers the sensor.
        first = 0 if count == rows else _parse_first_row(metadata)
        if first + rows > count:
            raise FileFormatError(
                path,
                f"time axis (ScalingYScalingFile) has {count} entries, rows {first}..{first + rows - 1} need more",
            )
        return _read_table(path, start + first * _BYTES_PER_ENTRY, rows) * unit
    if metadata.get("Scaling/ScalingYType") == _LINEAR:
        return np.arange(rows, dtype=np.float64) * (
            _parse_positive(metadata, "Scaling/ScalingYScale", path) * unit
        )
    return None


def find_table(metadata: Mapping[str, str], axis: str) -> tuple[int, int] | None:
    """Return where in its file the scaling table of `axis` (``"X"`` or ``"Y"``) lies: first byte,
    float32 entries.

    None where the axis has no table: it is linear, or has no unit at all.

    `metadata`: ``Section/Key`` to value; `axis`: ``"X"`` or ``"Y"``.
    """
    found = _TABLE.fullmatch(metadata.get(f"Scaling/Scaling{axis}ScalingFile", ""))
    return (int(found[1]), int(found[2])) if found else None


def find_saturated_pixels(
    pixels: NDArray[Any], metadata: Mapping[str, str], path: str | Path
) -> NDArray[np.bool_] | None:
    """Mark the pixels that reached the sensor's limit; None for floating-point pictures, which have
    none.

    `pixels` (rows, columns): counts; `metadata`: gives the sensor's full scale; `path`: for the
    message. Returns (rows, columns).
    """
    if pixels.dtype.kind == "f":
        return None
    # A 12-bit converter in 16-bit pixels saturates long before the pixel type does.
    limit = min(np.iinfo(pixels.dtype).max, parse_full_scale(metadata))
    saturated: NDArray[np.bool_] = pixels >= limit
    if saturated.all():
        raise InputError(
            f"{path}: every pixel is saturated at {limit} counts; lower the gain or the exposure"
        )
    return saturated


def parse_full_scale(metadata: Mapping[str, str]) -> float:
    """Return the largest measurement that the camera can give, in counts; infinity where the text
    does not say.

    A sum over several exposures exceeds the converter's range, so that it says nothing there.
    """
    bits = metadata.get("Camera/Prop_BitPerChannel", "")
    single = metadata.get("Acquisition/NrExposure", "1") == "1"
    return (
        float(2 ** int(bits) - 1)
        if single and re.fullmatch(r"[1-9]|[12]\d|3[0-2]", bits)
        else math.inf
    )


def _parse_first_row(metadata: Mapping[str, str]) -> int:
    area = re.fullmatch(r"\d+,(\d{1,9}),\d+,\d+", metadata.get("Acquisition/areSource", ""))
    return int(area[1]) if area else 0


def _read_table(path: str | Path, start: int, count: int) -> NDArray[np.float64]:
    data = b""
    with translate_read_errors(path), open(path, "rb") as file:
        # Asking for more than there is would take the memory for it first.
        if start + count * _BYTES_PER_ENTRY <= os.fstat(file.fileno()).st_size:
            file.seek(start)
            data = file.read(count * _BYTES_PER_ENTRY)
    if len(data) < count * _BYTES_PER_ENTRY:
        raise FileFormatError(
            path,
            f"is truncated: its time axis of {count} entries at byte {start} (ScalingYScalingFile) is missing",
        )
    times = np.frombuffer(data, dtype="<f4").astype(np.float64)
    if not np.all(np.isfinite(times)) or np.any(np.diff(times) <= 0):
        raise FileFormatError(
            path, "its time axis (ScalingYScalingFile) does not increase row by row"
        )
    return times


def _parse_positive(metadata: Mapping[str, str], key: str, path: str | Path) -> float:
    text = metadata.get(key, "")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise FileFormatError(path, f"{key} must be a positive number, found '{text}'")
    return value
