"""What LinoSPAD2's recordings do not say themselves, in a small TOML file beside each of them."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from devices.linospad2.calibration import BoardCalibration, load_calibration
from devices.linospad2.codec import LinoSpad2Codec
from tofclip.errors import FileFormatError, InputError, StorageError
from tofclip.files import translate_read_errors

_MAX_FILE_BYTES = 1 << 16
_KEY_TYPES: dict[str, type] = {
    "firmware": str,
    "timestamps_per_cycle": int,
    "absolute_counter": bool,
    "board": str,
    "code_table": str,
    "offset_table": str,
    "hot_pixels": str,
    "laser_period_ps": float,
    "camera": str,
}
_REQUIRED_KEYS = ("firmware", "timestamps_per_cycle", "absolute_counter")


@dataclass(frozen=True)
class Sidecar:
    """How to read a recording."""

    codec: LinoSpad2Codec
    # the board's tables; `BoardCalibration.ideal` where none are named
    calibration: BoardCalibration
    board: str = ""  # which board it was; may be empty
    # time between two laser pulses, s, where pulses were locked to the board's clock
    laser_period: float | None = None
    camera: Path | None = None  # file of the camera in front of the line


def read_sidecar(recording: str | Path) -> Sidecar:
    """Read the TOML file that lies beside `recording` and has its name.

    Its keys are ``firmware`` ("2212b" or "2212s"), ``timestamps_per_cycle`` and
    ``absolute_counter`` (true or false), and optionally ``board``, ``code_table`` with
    ``offset_table``, ``hot_pixels``, ``laser_period_ps`` and ``camera``. Names of files are
    relative to the TOML file.
    """
    path = Path(recording).with_suffix(".toml")
    values = _check_keys(_parse_toml(path, recording), path)
    if ("code_table" in values) != ("offset_table" in values):
        raise FileFormatError(
            path, "code_table and offset_table belong together: give both or neither"
        )
    try:
        codec = LinoSpad2Codec(
            values["firmware"], values["timestamps_per_cycle"], values["absolute_counter"]
        )
        calibration = _read_calibration(values, path.parent)
    except InputError as fault:
        raise FileFormatError(path, str(fault)) from fault
    period = values.get("laser_period_ps")
    if period is not None and not 0 < period < float("inf"):
        raise FileFormatError(path, f"laser_period_ps must be a positive number, found {period}")
    return Sidecar(
        codec,
        calibration,
        values.get("board", ""),
        None if period is None else period * 1e-12,
        path.parent / values["camera"] if "camera" in values else None,
    )


def _parse_toml(path: Path, recording: str | Path) -> dict[str, Any]:
    if not path.exists():
        keys = ", ".join(_REQUIRED_KEYS)
        raise StorageError(
            f"{recording}: its format is not in the file itself; write {keys} into {path.name} beside it"
        )
    with translate_read_errors(path), open(path, "rb") as file:
        # One byte more than allowed shows that there is more, without reading all of it.
        data = file.read(_MAX_FILE_BYTES + 1)
    if len(data) > _MAX_FILE_BYTES:
        raise FileFormatError(
            path,
            f"is larger than any description of a recording: more than {_MAX_FILE_BYTES} bytes",
        )
    try:
        return tomllib.loads(data.decode())
    except ValueError as fault:
        raise FileFormatError(path, f"is not TOML ({fault})") from fault


def _check_keys(found: dict[str, Any], path: Path) -> dict[str, Any]:
    for key in _REQUIRED_KEYS:
        if key not in found:
            raise FileFormatError(path, f"lacks the key '{key}'")
    for key, value in found.items():
        if key not in _KEY_TYPES:
            raise FileFormatError(
                path, f"has the unknown key '{key}'; known are {', '.join(_KEY_TYPES)}"
            )
        kind = _KEY_TYPES[key]
        # TOML distinguishes 50000 from 50000.0, which people do not. By exact type, because bool is an int in
        # Python.
        is_number = kind is float and type(value) is int
        if type(value) is not kind and not is_number:
            raise FileFormatError(path, f"{key} must be a {kind.__name__}, found {value!r}")
    return found


def _read_calibration(values: dict[str, Any], folder: Path) -> BoardCalibration:
    hot = folder / values["hot_pixels"] if "hot_pixels" in values else None
    if "code_table" in values:
        return load_calibration(folder / values["code_table"], folder / values["offset_table"], hot)
    if hot is not None:
        raise InputError("hot_pixels needs code_table and offset_table as well")
    return BoardCalibration.ideal()
