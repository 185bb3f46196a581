"""Addresses of emulated instruments on the virtual USB."""

from __future__ import annotations

from collections.abc import Callable

from devices.emulation.faults import Fault
from devices.emulation.usb import VirtualUsb
from devices.scenes import simulate_line_light
from devices.stream import StreamSource
from devices.timetag.emulator import CLOCK_HZ, EmulatedTimeTagger, EmulatorSettings
from devices.timetag.light import PoissonStream, PulsedSceneStream, TagStream
from devices.timetag.source import OPTIONS, open_on_backend
from devices.uri import Uri
from tofclip.errors import InputError

POISSON_RATE_HZ = 12_800_000.0
SCENE_RATE_HZ = 1_000_000.0
EMULATOR_OPTIONS = (
    "seed",
    "light",
    "rate",
    "pace",
    "records",
    "packet_bytes",
    "memory_mib",
    "faults",
)


def open_timetag(uri: Uri) -> StreamSource:
    """Open ``sim+timetag://?seed=1``: an emulated time tagger behind the real driver.

    Besides the driver's own (`devices.timetag.source.OPTIONS`) it takes ``light=poisson|scene``
    (`PoissonStream` on all channels, or a `PulsedSceneStream`), ``rate`` (photons per second of its
    clock), ``pace=fast|realtime``, ``records`` (then it is dark), ``packet_bytes=510|512``,
    ``memory_mib`` and ``faults`` (as `Fault.parse` reads them). The board's own memory, with which
    it loses what a loaded computer does not fetch within 3 ms, is ``memory_mib=0.01172``.
    """
    uri.reject_unknown(*OPTIONS, *EMULATOR_OPTIONS)
    seed = uri.value("seed", int, 0)
    if not 0 <= seed < 1 << 63:
        raise InputError(f"'{uri.text}': a seed must be within 0 and 2**63")
    standard = EmulatorSettings()
    setting = EmulatorSettings(
        uri.choice("pace", "fast", "realtime") == "realtime",
        uri.value("records", int, standard.records),
        uri.value("packet_bytes", int, standard.packet_bytes),
        int(uri.value("memory_mib", float, standard.memory_bytes / (1 << 20)) * (1 << 20)),
    )
    serial = uri.location  # the real ones have none
    instrument = EmulatedTimeTagger(
        _make_stream(uri, seed), serial, setting, Fault.parse(uri.value("faults", str, ""))
    )
    return open_on_backend(uri, serial, VirtualUsb(instrument))


def _make_stream(uri: Uri, seed: int) -> Callable[[int], TagStream]:
    if uri.choice("light", "poisson", "scene") == "poisson":
        rate = uri.value("rate", float, POISSON_RATE_HZ)
        return lambda resets: PoissonStream(rate, CLOCK_HZ, seed + resets)
    scene, scene_rate = simulate_line_light(), uri.value("rate", float, SCENE_RATE_HZ)
    return lambda resets: PulsedSceneStream(scene, scene_rate, CLOCK_HZ, seed + resets)
