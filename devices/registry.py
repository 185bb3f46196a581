"""Which address opens what: a line of a table, or an entry point of a package, adds an instrument.

Every entry is ``"module:name"`` and is imported when it is needed, so that one instrument's
libraries never keep another from working.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from devices.address import Uri
from devices.source import Codec, Source
from tofclip.errors import InputError
from tofclip.files import format_error_line
from tofclip.plugins import Parts
from tofclip.storage import Scalar

SOURCES = Parts(
    "tofclip.sources",
    "source",
    {
        # by the scheme of their address
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
        # by the ending of the file that ``file://PATH`` names, lower case
        ".dat": "devices.linospad2:open_recording",
        ".tif": "devices.files:open_streak_file",  # and every other one, if a reader knows the content
        ".phu": "devices.files:open_phu",
        ".ptu": "devices.files:open_ptu",
        ".sdt": "devices.files:open_sdt",
        ".ttbin": "devices.files:open_ttbin",
        ".h5": "devices.recording.read:open_recording",
        ".hdf5": "devices.recording.read:open_recording",
    },
)
register_source = SOURCES.register
# A recording names the codec that its bytes need.
CODECS = Parts(
    "tofclip.codecs",
    "codec",
    {
        "frames": "devices.frames:FrameCodec",
        "linospad2": "devices.linospad2:LinoSpad2Codec",
        "timetag": "devices.timetag_codec:TimeTagCodec",
    },
)
# Functions ``() -> list[DiscoveredInstrument]`` that look for connected instruments, by the scheme of
# their addresses. They return nothing, and never fail, without hardware.
FINDERS = Parts(
    "tofclip.finders",
    "finder",
    {
        "timetag": "devices.timetag:find_timetaggers",
        "aravis": "devices.aravis:find_cameras",
    },
)


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
        Its address: ``timetag://SERIAL``, ``sim+timetag://?seed=1``, ``file://PATH``; see `SOURCES`
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
    return open_parsed(Uri.parse(uri))


def open_parsed(uri: Uri) -> Source:
    """As `open`, of an address that was taken apart already."""
    is_file = uri.scheme == "file"
    name = Path(uri.location).suffix.lower() if is_file else uri.scheme
    if is_file and name not in SOURCES:
        name = ".tif"
    if name not in SOURCES or name.startswith(".") != is_file:
        said = f"no source is called '{name}'; known are {', '.join(list_schemes())}"
        raise InputError(f"'{uri.text}': {said}")
    source: Source = SOURCES[name](uri)
    return source


def list_schemes() -> list[str]:
    """Return what addresses may begin with."""
    return sorted(["file", *(name for name in SOURCES if not name.startswith("."))])


def list_endings() -> list[str]:
    """Return what the names of files may end in."""
    return sorted(name for name in SOURCES if name.startswith("."))


def discover() -> list[DiscoveredInstrument]:
    """Look for instruments, also those of other packages; without any hardware, or libraries for it,
    the list is empty.
    """
    found: list[DiscoveredInstrument] = []
    for name in FINDERS:
        try:
            found += FINDERS[name]()
        except Exception as fault:  # whatever another package does: the others are found
            said = f"cannot be looked for: {format_error_line(fault)}"
            found.append(DiscoveredInstrument(f"{name}://", FINDERS.get_origin(name), said))
    return found


def build_codec(name: str, settings: Mapping[str, Scalar]) -> Codec:
    """Build the codec called `name` from the settings that it once gave."""
    codec: Codec = CODECS.make(name, settings)
    return codec
