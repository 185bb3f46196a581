"""Aravis' own emulated GigE Vision camera as a source: the real driver, GVCP and GVSP over this
computer's loopback, and pictures of a simulated scene instead of Aravis' stripes.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, replace
from typing import Any

from devices.address import Uri, option
from devices.aravis import AravisFeed, CameraOptions, load_aravis
from devices.emulation.harness import HOST, EmulatedFeed
from devices.emulation.scenes import (
    EmulatedLight,
    simulate_demonstration_light,
    simulate_line_light,
)
from devices.frames import make_streak_calibration
from devices.stream import StreamSource
from tofclip.errors import DeviceNotFoundError, MissingDependencyError
from tofclip.storage import Record

LIBRARY_FILE = "libaravis-0.8.so.0"
# ``(buffer, nothing, exposure_us, gain, pixel_format)``, called in the camera's own thread
FillPattern = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32
)


class EmulatedCamera:
    """Aravis' own emulated camera: of `light`, or of moving stripes where there is none.
    `lost_per_thousand`: packets of a thousand that are lost on the wire.
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
        self._shown = None if light is None else ShownLight(self._camera, light)

    def prepare(self, camera: Any) -> None:
        """Let the driver's camera have pictures of the light's size."""
        if self._light is not None:
            rows, columns = self._light.photons.shape
            camera.set_region(0, 0, columns, rows)

    def close(self) -> None:
        """Switch it off."""
        if self._shown is not None:
            self._shown.close()
        self._shown = self._camera = None


class ShownLight:
    """Lets an emulated camera send pictures of some light. The binding drops Python's function
    after the call that sets it, so that the library itself is asked.
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
        """Draw stripes again: the camera's thread must not wait for Python at the end."""
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


@dataclass(frozen=True)
class EmulationOptions(CameraOptions):
    """Values of the emulation besides the driver's own."""

    scene: str = option("", choices=("stripes", "small", "demo"))
    seed: int = option(0, least=0)
    lost_per_thousand: int = option(0, least=0, most=1000)


def open_emulated(uri: Uri) -> StreamSource:
    """Open ``sim+aravis://?frame_rate=100&scene=stripes&lost_per_thousand=0``: Aravis' own emulated
    camera. ``scene``: ``stripes`` that move, or ``demo`` and ``small`` (a slit of 256 pixels), of
    which it sends streak pictures in Mono16; ``seed``: of their photons; ``lost_per_thousand``:
    packets lost on the wire.
    """
    options = EmulationOptions.from_uri(uri)
    library, serial, lost = load_aravis(), uri.location or "EMULATED", options.lost_per_thousand
    if options.scene == "stripes":
        camera = EmulatedCamera(library, serial, lost)
        return _open_camera(library, camera, options, None)
    options = replace(options, pixel_format="Mono16")
    seen = simulate_line_light() if options.scene == "small" else simulate_demonstration_light()
    known = make_streak_calibration(seen.row_times, seen.camera)
    camera = EmulatedCamera(library, serial, lost, EmulatedLight.of(seen, options.seed))
    return _open_camera(library, camera, options, known)


def _open_camera(
    library: Any, camera: EmulatedCamera, options: CameraOptions, known: Record | None
) -> StreamSource:
    """Open the driver's camera; `known` is the scene's own time axis, where there is a scene."""
    feed = EmulatedFeed(
        camera,
        lambda: AravisFeed(library, HOST, options, camera.prepare),
        lambda said: known or said,
    )
    return StreamSource(feed, options)
