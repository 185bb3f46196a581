"""An emulated streak camera as a source: the real driver, its own connection, a simulated scene."""

from __future__ import annotations

from dataclasses import replace

from devices.emulation.faults import Fault
from devices.ledger import Ledger
from devices.loopback import HOST
from devices.remoteex.client import RemoteExClient
from devices.remoteex.emulator import UNLIMITED_FRAMES, EmulatedStreakCamera
from devices.remoteex.source import OPTIONS, LiveSettings, RemoteExFeed, parse_live_settings
from devices.scenes import EmulatedLight, simulate_demonstration_light, simulate_line_light
from devices.source import Info
from devices.stream import StreamSource, parse_buffer_settings
from devices.uri import Uri
from tofclip.camera import Camera
from tofclip.errors import InputError
from tofclip.storage import Record


class EmulatedFeed(RemoteExFeed):
    """A camera's pictures, with what the calibration of the lenslets before it would tell.

    Closing switches the emulated camera off.
    """

    def __init__(
        self, server: EmulatedStreakCamera, camera: Camera, ledger: Ledger, settings: LiveSettings
    ) -> None:
        self._server, self._camera = server, camera
        port, data_port = server.ports
        super().__init__(
            lambda: RemoteExClient(HOST, port, data_port, settings.timeout), ledger, settings
        )

    @property
    def info(self) -> Info:
        known = super().info
        return replace(known, instrument=f"emulated {known.instrument}")

    @property
    def calibration(self) -> Record | None:
        known = super().calibration
        return (
            None if known is None else replace(known, children={"camera": self._camera.to_record()})
        )

    def close(self) -> None:
        try:
            super().close()
        finally:
            self._server.close()


def open_emulated(uri: Uri) -> StreamSource:
    """Open ``sim+remoteex://?seed=1&scene=demo&frame_rate=10&frames=N&faults=...``, an emulated
    camera behind TCP.

    Besides the driver's own (`devices.remoteex.source.OPTIONS`) it takes ``scene`` (``demo``, or
    ``small`` for a slit of 256 pixels), ``frames`` (then it is dark) and ``faults`` (as
    `devices.emulation.faults.Fault.parse` reads them).
    """
    uri.reject_unknown(
        *(name for name in OPTIONS if name != "data_port"),
        "seed",
        "scene",
        "frame_rate",
        "frames",
        "faults",
    )
    seed = uri.value("seed", int, 0)
    if seed < 0:
        raise InputError(f"'{uri.text}': a seed must not be negative")
    settings, held = parse_live_settings(uri), parse_buffer_settings(uri)
    rate, frames = uri.value("frame_rate", float, 10.0), uri.value("frames", int, UNLIMITED_FRAMES)
    faults = Fault.parse(uri.value("faults", str, ""))
    scene = (
        simulate_demonstration_light()
        if uri.choice("scene", "demo", "small") == "demo"
        else simulate_line_light()
    )
    server = EmulatedStreakCamera(EmulatedLight.of(scene, seed), rate, frames, faults)
    ledger = Ledger()
    try:
        feed = EmulatedFeed(server, scene.camera, ledger, settings)
    except BaseException:
        server.close()
        raise
    return StreamSource(feed, feed.codec, ledger, held)
