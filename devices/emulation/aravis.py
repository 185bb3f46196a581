"""Aravis' own emulated GigE Vision camera as a source: the real driver, GVCP and GVSP over this
computer's loopback, and pictures of a simulated scene instead of Aravis' stripes.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, replace
from typing import Any

from devices.address import Uri, option
from devices.aravis import AravisFeed, CameraOptions, load_aravis
from devices.emulation.harness import HOST, open_on
from devices.emulation.scenes import EmulatedLight, simulate_light
from devices.frames import make_streak_calibration
from devices.stream import StreamSource
from tofclip.errors import DeviceNotFoundError, MissingDependencyError

LIBRARY_FILE = "libaravis-0.8.so.0"
# ``(buffer, nothing, exposure_us, gain, pixel_format)``, called in the camera's own thread
FillPattern = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32
)


class EmulatedCamera:
    """Aravis' own emulated camera: of `light`, or of moving stripes where there is none.
    `lost_per_thousand`: packets of a thousand that are lost on the wire. Pictures are drawn by a
    function of the library's: the binding drops Python's after the call that sets it.
    """

    def __init__(
        self, library: Any, serial: str, lost_per_thousand: int, light: EmulatedLight | None = None
    ) -> None:
        self._camera = library.GvFakeCamera.new(HOST, serial)
        if not self._camera.is_running():
            raise DeviceNotFoundError(
                f"an emulated camera cannot listen on {HOST}; another one does already"
            )
        self._camera.set_property("gvsp-lost-ratio", lost_per_thousand / 1000)
        self._light = light
        if light is None:
            return
        self._library = called = _load_library()
        # PyGObject's hash of an object is the address of what it stands for.
        self._fake = fake = called.arv_gv_fake_camera_get_fake_camera(hash(self._camera))

        def fill(buffer: int, nothing: int, exposure_us: int, gain: int, pixel_format: int) -> None:
            picture = light.draw_frame(called.arv_buffer_get_frame_id(buffer)).tobytes()
            if called.arv_fake_camera_get_payload(fake) == len(picture):
                ctypes.memmove(called.arv_buffer_get_data(buffer, None), picture, len(picture))

        self._pattern = FillPattern(fill)
        called.arv_fake_camera_set_fill_pattern(fake, self._pattern, None)

    def prepare(self, camera: Any) -> None:
        """Let the driver's camera have pictures of the light's size."""
        if self._light is not None:
            rows, columns = self._light.photons.shape
            camera.set_region(0, 0, columns, rows)

    def close(self) -> None:
        """Switch it off, with stripes: the camera's thread must not wait for Python at the end."""
        if self._camera is not None and self._light is not None:
            self._library.arv_fake_camera_set_fill_pattern(self._fake, FillPattern(), None)
        self._camera = None


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


@dataclass(frozen=True)
class EmulationOptions(CameraOptions):
    """Values of the emulation besides the driver's own."""

    # stripes that move, or streak pictures in Mono16 of a scene, small with a slit of 256 pixels
    scene: str = option("", choices=("stripes", "small", "demo"))
    seed: int = option(0, least=0)  # of their photons
    lost_per_thousand: int = option(0, least=0, most=1000)  # packets, on the wire


def open_emulated(uri: Uri) -> StreamSource:
    """Open ``sim+aravis://``, Aravis' own emulated camera; `EmulationOptions` has its values."""
    options = EmulationOptions.from_uri(uri)
    library, serial = load_aravis(), uri.location or "EMULATED"
    light, known = None, None
    if options.scene != "stripes":
        options = replace(options, pixel_format="Mono16")
        seen = simulate_light(options.scene)
        light = EmulatedLight.of(seen, options.seed)
        known = make_streak_calibration(seen.row_times, seen.camera)
    camera = EmulatedCamera(library, serial, options.lost_per_thousand, light)
    connect = lambda: AravisFeed(library, HOST, options, camera.prepare)  # noqa: E731
    return open_on(camera, connect, options, lambda said: known or said)
