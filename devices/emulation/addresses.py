"""Addresses of emulated instruments on the virtual USB."""

from __future__ import annotations

from collections.abc import Callable

from devices.emulation.faults import Fault
from devices.emulation.photons import Poisson, TagStream
from devices.emulation.scene_light import PulsedScene
from devices.emulation.timetag import CLOCK_HZ, EmulatedTimeTagger, Setting
from devices.emulation.usb import VirtualUsb
from devices.scenes import line_light
from devices.stream import StreamSource
from devices.timetag.source import OPTIONS, opened
from devices.uri import Uri
from tofclip.errors import InputError

RATE = 12_800_000.0
SCENE_RATE = 1_000_000.0
EMULATOR_OPTIONS = ("seed", "light", "rate", "pace", "records", "packet_bytes", "memory_mib", "faults")


def open_timetag(uri: Uri) -> StreamSource:
    """Open ``sim+timetag://?seed=1``: an emulated time tagger behind the real driver.

    Besides the driver's own (`devices.timetag.source.OPTIONS`) it takes ``light=poisson|scene`` (`Poisson` on all
    channels, or a `PulsedScene`), ``rate`` (photons per second of its clock), ``pace=fast|realtime``, ``records`` (then
    it is dark), ``packet_bytes=510|512``, ``memory_mib`` and ``faults`` (as `Fault.parse` reads them).
    """
    uri.only(*OPTIONS, *EMULATOR_OPTIONS)
    seed = uri.value("seed", int, 0)
    if not 0 <= seed < 1 << 63:
        raise InputError(f"'{uri.text}': a seed must be within 0 and 2**63")
    standard = Setting()
    setting = Setting(
        uri.choice("pace", "fast", "realtime") == "realtime",
        uri.value("records", int, standard.records),
        uri.value("packet_bytes", int, standard.packet_bytes),
        int(uri.value("memory_mib", float, standard.memory_bytes / (1 << 20)) * (1 << 20)),
    )
    serial = uri.place or f"SIM{seed}"
    instrument = EmulatedTimeTagger(_light(uri, seed), serial, setting, Fault.parse(uri.value("faults", str, "")))
    return opened(uri, serial, VirtualUsb(instrument))


def _light(uri: Uri, seed: int) -> Callable[[int], TagStream]:
    if uri.choice("light", "poisson", "scene") == "poisson":
        rate = uri.value("rate", float, RATE)
        return lambda resets: Poisson(rate, CLOCK_HZ, seed + resets)
    scene, scene_rate = line_light(), uri.value("rate", float, SCENE_RATE)
    return lambda resets: PulsedScene(scene, scene_rate, CLOCK_HZ, seed + resets)
