"""HDF5 files of the Zaragoza NLOS data set.

Galindo, Marco, O'Toole, Wetzstein, Gutierrez, Jarabo, "A dataset for benchmarking time-resolved
non-line-of-sight imaging", SIGGRAPH 2019 posters; https://graphics.unizar.es/nlos_dataset. Field
names and the two orders of axes that occur are those that y-tal 0.20 converts (``tal/io/format.py``
of https://github.com/diegoroyo/tal).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from nlos.io.fields import NamedArrays
from nlos.io.orientation import rotate_to_scene
from nlos.io.tal import match_lasers_to_sensors
from nlos.unwarp import remove_device_legs
from tofclip.errors import FileFormatError
from tofclip.units import SPEED_OF_LIGHT

CONFOCAL_AXES, EXHAUSTIVE_AXES = 5, 7


def read_zaragoza(fields: NamedArrays) -> Capture:
    """Read a rendering; colours and bounces are added up, and the ways to and from the devices
    taken off.

    ``data`` is (colour, t, bounce, camera grid, laser grid) where positions are (3, ...), and the
    reverse where they are (..., 3); a confocal file has no laser grid. ``deltaT`` and ``t0`` are in
    m of path. The wall's normals, and the hidden volume where it is given, tell which way the scene
    lies; coordinates are turned so that it lies at larger z.
    """
    first = fields.read_numbers("cameraGridPositions").shape[0] == 3
    signal = _read_signal(fields, first)
    camera, laser = (
        _read_point_grid(fields, f"{name}GridPositions", first) for name in ("camera", "laser")
    )
    bin_width, start = (
        fields.number("deltaT") / SPEED_OF_LIGHT,
        fields.number("t0") if "t0" in fields else 0.0,
    )
    capture = match_lasers_to_sensors(fields, signal, camera, laser, bin_width, start)
    source, eye = (
        fields.read_numbers(f"{name}Position").astype(np.float64).reshape(3)
        for name in ("laser", "camera")
    )
    return rotate_to_scene(
        remove_device_legs(capture, source, eye), _find_scene_direction(fields, camera, first)
    )


def _read_signal(fields: NamedArrays, first: bool) -> NDArray[np.float32]:
    """Signal (t, lasers..., points...) summed over colours and bounces; a lone laser's axes are
    left out.
    """
    data = fields.read_numbers("data")
    if data.ndim not in (CONFOCAL_AXES, EXHAUSTIVE_AXES):
        raise FileFormatError(
            fields.path, f"field 'data' must have 5 or 7 axes, found shape {data.shape}"
        )
    if first:
        # (colour, t, bounce, camera..., laser...)
        signal = data.sum(axis=(0, 2), dtype=np.float32)
        lasers_last = signal.ndim == 1 + 4
        signal = np.moveaxis(signal, (3, 4), (1, 2)) if lasers_last else signal
    else:
        # (laser..., camera..., bounce, t, colour)
        signal = np.moveaxis(data.sum(axis=(-1, -3), dtype=np.float32), -1, 0)
    lone = signal.ndim == 1 + 4 and signal.shape[1:3] == (1, 1)
    return np.ascontiguousarray(signal[:, 0, 0] if lone else signal)


def _read_point_grid(fields: NamedArrays, name: str, first: bool) -> NDArray[np.float64]:
    grid = fields.read_numbers(name).astype(np.float64)
    grid = np.moveaxis(grid, 0, -1) if first else grid
    if grid.shape[-1] != 3:
        raise FileFormatError(
            fields.path, f"field '{name}' must hold points in three dimensions, found {grid.shape}"
        )
    return grid


def _find_scene_direction(
    fields: NamedArrays, camera: NDArray[np.float64], first: bool
) -> NDArray[np.float64]:
    """Direction of the wall's normal that points to the hidden scene; +z where the file says
    nothing.
    """
    if "cameraGridNormals" not in fields:
        return np.array([0.0, 0.0, 1.0])
    normal: NDArray[np.float64] = (
        _read_point_grid(fields, "cameraGridNormals", first).reshape(-1, 3).mean(axis=0)
    )
    if "hiddenVolumePosition" in fields:
        hidden = fields.read_numbers("hiddenVolumePosition").reshape(3) - camera.reshape(
            -1, 3
        ).mean(axis=0)
        normal = normal * (np.sign(hidden @ normal) or 1.0)
    return normal
