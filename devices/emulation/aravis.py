"""Aravis' own emulated GigE Vision camera as a source: the real driver, GVCP and GVSP over this
computer's loopback, and pictures of a simulated scene instead of Aravis' stripes.
"""

from __future__ import annotations

import ctypes
from dataclasses import replace
from typing import Any

from devices.address import Uri
from devices.aravis import OPTIONS, AravisFeed, CameraSettings, load_aravis
from devices.emulation.scenes import (
    EmulatedLight,
    simulate_demonstration_light,
    simulate_line_light,
)
from devices.source import Info, Ledger
from devices.stream import StreamSource, parse_buffer_settings
from tofclip.camera import Camera
from tofclip.errors import DeviceNotFoundError, InputError, MissingDependencyError
from tofclip.storage import Field, Record

LOOPBACK = "127.0.0.1"
LIBRARY_FILE = "libaravis-0.8.so.0"
FillPattern = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32
)
"""``(buffer, nothing, exposure_us, gain, pixel_format)``, called in the camera's own thread."""


class EmulatedFeed(AravisFeed):
    """Frames of Aravis' own emulated camera.

    `library, ledger, settings`: as for `AravisFeed`; `lost_per_thousand`: packets of a thousand
    that are lost on the wire; `light`: what it sees; None for Aravis' moving stripes; `seen_by`:
    what a calibration would know of the lenslets before it.
    """

    def __init__(
        self,
        library: Any,
        ledger: Ledger,
        settings: CameraSettings,
        serial: str,
        lost_per_thousand: int,
        light: EmulatedLight | None = None,
        seen_by: Camera | None = None,
    ) -> None:
        self._camera_process = library.GvFakeCamera.new(LOOPBACK, serial)
        if not self._camera_process.is_running():
            raise DeviceNotFoundError(
                f"an emulated camera cannot listen on {LOOPBACK}; another one does already"
            )
        self._camera_process.set_property("gvsp-lost-ratio", lost_per_thousand / 1000)
        self._light, self._seen_by = light, seen_by
        self._shown = None if light is None else ShownLight(self._camera_process, light)
        super().__init__(library, LOOPBACK, ledger, settings)

    @property
    def info(self) -> Info:
        known = super().info
        return replace(known, instrument=f"emulated {known.instrument}")

    @property
    def calibration(self) -> Record | None:
        """The scene's own time axis, where there is a scene."""
        if self._light is None or self._seen_by is None:
            return super().calibration
        times = Field(self._light.row_times, "s", ("row",))
        return Record(
            "streak_calibration",
            {"row_times": times},
            children={"camera": self._seen_by.to_record()},
        )

    def close(self) -> None:
        try:
            super().close()
        finally:
            if self._shown is not None:
                self._shown.close()
            del self._camera_process

    def _prepare_camera(self, camera: Any) -> None:
        if self._light is not None:
            rows, columns = self._light.photons.shape
            camera.set_region(0, 0, columns, rows)


class ShownLight:
    """Lets an emulated camera send pictures of some light.

    The binding drops Python's function after the call that sets it, so that the library itself is
    asked.
    """

    def __init__(self, camera_process: Any, light: EmulatedLight) -> None:
        self._library = library = _load_library()
        # PyGObject's hash of an object is the address of what it stands for.
        self._camera = camera = library.arv_gv_fake_camera_get_fake_camera(hash(camera_process))

        def fill(buffer: int, nothing: int, exposure_us: int, gain: int, pixel_format: int) -> None:
            picture = light.draw_frame(library.arv_buffer_get_frame_id(buffer)).tobytes()
            if library.arv_fake_camera_get_payload(camera) == len(picture):
                ctypes.memmove(library.arv_buffer_get_data(buffer, None), picture, len(picture))

        self._pattern = FillPattern(fill)
        library.arv_fake_camera_set_fill_pattern(camera, self._pattern, None)

    def close(self) -> None:
        """Have the library draw its own stripes again: a camera that ends waits for its thread,
        which must not wait for Python then.
        """
        self._library.arv_fake_camera_set_fill_pattern(self._camera, FillPattern(), None)


def _load_library() -> ctypes.CDLL:
    try:
        library = ctypes.CDLL(LIBRARY_FILE)
    except OSError as fault:
        raise MissingDependencyError(
            f"{LIBRARY_FILE} does not load ({fault}); scene=stripes works without it"
        ) from fault
    for name, result, arguments in (
        ("arv_gv_fake_camera_get_fake_camera", ctypes.c_void_p, [ctypes.c_void_p]),
        ("arv_fake_camera_get_payload", ctypes.c_size_t, [ctypes.c_void_p]),
        ("arv_buffer_get_data", ctypes.c_void_p, [ctypes.c_void_p, ctypes.c_void_p]),
        ("arv_buffer_get_frame_id", ctypes.c_uint64, [ctypes.c_void_p]),
        ("arv_fake_camera_set_fill_pattern", None, [ctypes.c_void_p, FillPattern, ctypes.c_void_p]),
    ):
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


def open_emulated(uri: Uri) -> StreamSource:
    """Open ``sim+aravis://?frame_rate=100&scene=stripes&lost_per_thousand=0``: Aravis' own emulated
    camera.

    Besides the driver's own (`devices.aravis.OPTIONS`) it takes ``scene``: ``stripes`` that move, or
    ``demo`` and ``small`` (a slit of 256 pixels), of which it sends streak pictures in Mono16; ``seed`` of
    their photons; and ``lost_per_thousand``, the packets lost on the wire.
    """
    uri.reject_unknown(*OPTIONS, "scene", "seed", "lost_per_thousand")
    settings, held = CameraSettings.from_uri(uri), parse_buffer_settings(uri)
    lost, seed = uri.value("lost_per_thousand", int, 0), uri.value("seed", int, 0)
    if not 0 <= lost <= 1000:
        raise InputError(f"'{uri.text}': lost_per_thousand must be within 0..1000")
    if seed < 0:
        raise InputError(f"'{uri.text}': a seed must not be negative")
    scene = uri.choice("scene", "stripes", "small", "demo")
    light = camera = None
    if scene != "stripes":
        settings = replace(settings, pixel_format="Mono16")
        seen = simulate_line_light() if scene == "small" else simulate_demonstration_light()
        light, camera = EmulatedLight.of(seen, seed), seen.camera
    ledger = Ledger()
    serial = uri.location or "EMULATED"
    feed = EmulatedFeed(load_aravis(), ledger, settings, serial, lost, light, camera)
    return StreamSource(feed, feed.codec, ledger, held)
