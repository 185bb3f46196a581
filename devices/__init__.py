"""Instruments: one interface to those that are connected, recorded or simulated.

::

    with devices.open("sim+timetag://?seed=1") as source:
        for batch in source:
            batch.records      # NumPy structured array, one row per record
    source.stats               # acquired = delivered + unread + dropped_host + lost_device +
    malformed streak = devices.read_transient("sim+linospad2://?seed=1")     # photons or frames to
    what tofclip.recover takes

Which address opens which instrument is written down in `devices.registry`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from devices.codec import Codec, DecodeResult
    from devices.registry import DiscoveredInstrument, discover, open  # noqa: A004 - the name users type
    from devices.source import Batch, Info, Source
    from devices.statistics import Stats
    from devices.transients import read_transient

__all__ = [
    "Batch",
    "Codec",
    "DecodeResult",
    "DiscoveredInstrument",
    "Info",
    "Source",
    "Stats",
    "discover",
    "open",
    "read_transient",
]

_HOMES = {
    "Batch": "devices.source",
    "Codec": "devices.codec",
    "DecodeResult": "devices.codec",
    "DiscoveredInstrument": "devices.registry",
    "Info": "devices.source",
    "Source": "devices.source",
    "Stats": "devices.statistics",
    "discover": "devices.registry",
    "open": "devices.registry",
    "read_transient": "devices.transients",
}


def __getattr__(name: str) -> Any:
    """Import a public name on first use, so that ``import devices`` stays quick."""
    if name not in _HOMES:
        raise AttributeError(f"module 'devices' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names, imported or not."""
    return sorted({*globals(), *__all__})
