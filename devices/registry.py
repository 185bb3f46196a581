"""Which address opens what. The tables are all there is to registering an instrument.

Every entry is ``"module:name"`` and is imported when it is needed, so that one instrument's
libraries never keep another from working.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from devices.address import Uri
from devices.source import Codec, Source
from tofclip.errors import InputError
from tofclip.storage import Scalar

# Scheme of an address -> function ``(Uri) -> Source``
OPENERS: dict[str, str] = {
    "aravis": "devices.aravis:open_aravis",
    "linospad2": "devices.linospad2:open_recording",
    "remoteex": "devices.remoteex:open_remoteex",
    "spad512": "devices.spad512:open_spad512",
    "sim+aravis": "devices.emulation.aravis:open_emulated",
    "sim+linospad2": "devices.emulation.linospad2:open_simulated",
    "sim+remoteex": "devices.emulation.remoteex:open_emulated",
    "sim+spad512": "devices.emulation.spad512:open_emulated",
    "timetag": "devices.timetag:open_timetag",
    "sim+tmf8828": "devices.emulation.histogram_kits:open_tmf8828",
    "sim+vl53l8": "devices.emulation.histogram_kits:open_vl53l8",
    "tmf8828": "devices.histogram_kits:open_tmf8828",
    "vl53l8": "devices.histogram_kits:open_vl53l8",
    "sim+timetag": "devices.emulation.timetag:open_timetag",
}
# Ending of a file's name, lower case -> function ``(Uri) -> Source``, for addresses ``file://PATH``
FILE_OPENERS: dict[str, str] = {
    ".dat": "devices.linospad2:open_recording",
    ".img": "devices.files:open_streak_file",
    ".tif": "devices.files:open_streak_file",
    ".tiff": "devices.files:open_streak_file",
    ".phu": "devices.files:open_phu",
    ".ptu": "devices.files:open_ptu",
    ".sdt": "devices.files:open_sdt",
    ".ttbin": "devices.files:open_ttbin",
    ".h5": "devices.recording.read:open_recording",
    ".hdf5": "devices.recording.read:open_recording",
}
# Functions ``() -> list[Found]`` that look for instruments. They return nothing, and never fail,
# without hardware.
FINDERS: tuple[str, ...] = (
    "devices.timetag:find_timetaggers",
    "devices.aravis:find_cameras",
)
# Name of a codec -> its class; a recording names the codec that its bytes need
CODECS: dict[str, str] = {
    "frames": "devices.frames:FrameCodec",
    "linospad2": "devices.linospad2:LinoSpad2Codec",
    "timetag": "devices.timetag_codec:TimeTagCodec",
}


@dataclass(frozen=True)
class DiscoveredInstrument:
    """An instrument that can be opened now.

    Parameters
    ----------
    uri : str
        What `open` takes.
    instrument : str
        What it is, in words.
    note : str
        What keeps it from being used, if anything does: no permission, no firmware.
    """

    uri: str
    instrument: str
    note: str = ""


def open(uri: str) -> Source:  # noqa: A001 - the name users type: devices.open
    """Open a source.

    Parameters
    ----------
    uri : str
        Its address: ``timetag://SERIAL``, ``sim+timetag://?seed=1``, ``file://PATH``; see `OPENERS`
        for all.

    Returns
    -------
    Source

    Raises
    ------
    InputError
        It is not an address, or of no known kind.
    DeviceError
        The instrument cannot be reached.

    Examples
    --------
    >>> import devices
    >>> with devices.open("sim+timetag://?seed=1") as source:
    ...     batch = source.read(timeout=5.0)
    >>> len(batch.records) > 0
    True
    """
    parsed = Uri.parse(uri)
    table, name = OPENERS, parsed.scheme
    if parsed.scheme == "file":
        table, name = FILE_OPENERS, Path(parsed.location).suffix.lower()
        if name not in table:
            raise InputError(f"'{uri}': the name must end in {', '.join(sorted(table))}")
    if name not in table:
        known = ", ".join(sorted([*table, "file"]))
        raise InputError(f"'{uri}': no source is called '{name}'; known are {known}")
    source: Source = import_entry(table[name])(parsed)
    return source


def discover() -> list[DiscoveredInstrument]:
    """Look for instruments; without any hardware, or libraries for it, the list is empty."""
    return [found for finder in FINDERS for found in import_entry(finder)()]


def build_codec(name: str, settings: Mapping[str, Scalar]) -> Codec:
    """Build the codec called `name` from the settings that it once gave."""
    if name not in CODECS:
        raise InputError(f"no codec is called '{name}'; known are {', '.join(sorted(CODECS))}")
    try:
        codec: Codec = import_entry(CODECS[name])(**settings)
    except TypeError as fault:
        raise InputError(f"codec '{name}' does not take {', '.join(settings)}") from fault
    return codec


def import_entry(entry: str) -> Any:
    """Import what a table's entry names."""
    module, _, name = entry.partition(":")
    return getattr(importlib.import_module(module), name)
