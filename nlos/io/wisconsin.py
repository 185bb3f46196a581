"""MATLAB files of the two phasor-field data sets of the University of Wisconsin.

Field names, units and the order of axes are those that y-tal 0.20 converts (``tal/io/format.py`` of
https://github.com/diegoroyo/tal):

* Liu et al., "Non-line-of-sight imaging using phasor-field virtual wave optics", Nature 572, 620
  (2019): a struct ``dataset`` with ``data`` (laser spot, camera spot, t), ``deltat`` and ``t0`` in
  m of path, positions of the spots and of the devices in m. One camera spot and many laser spots:
  their roles are exchanged here, which changes no path.
* Liu, Bauer, Velten, "Phasor field diffraction based reconstruction for fast non-line-of-sight
  imaging systems", Nat. Commun. 11, 1645 (2020): ``rect_data`` (y, x, t) with the ways to and from
  the devices taken off, ``ts`` in s, ``sampling_spacing`` in m, and ``SPAD_index``, column and row
  of the one spot.
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


def read_phasor_field_data(fields: NamedArrays) -> Capture:
    """Read a scene of the data set of 2019; coordinates are turned so that the wall's normal
    becomes +z.
    """
    wall, spots = (_read_points(fields, f"dataset.{name}Pos") for name in ("laser", "camera"))
    signal = np.ascontiguousarray(_read_signal(fields))
    bin_width = fields.number("dataset.deltat") / SPEED_OF_LIGHT
    start = fields.number("dataset.t0") if "dataset.t0" in fields else 0.0
    capture = match_lasers_to_sensors(fields, signal, wall, spots, bin_width, start)
    # The wall points' device is the laser here, and the lone spot's the camera.
    source, eye = (fields.finite_array(f"dataset.{name}Origin", 3) for name in ("camera", "laser"))
    capture = remove_device_legs(capture, source, eye)
    if "dataset.laserNorm" not in fields:
        return capture
    return rotate_to_scene(capture, _read_points(fields, "dataset.laserNorm").mean(axis=0))


def read_rectified_data(fields: NamedArrays) -> Capture:
    """Read a scene of the data set of 2020."""
    counts = fields.read_time_last("rect_data")
    rows, columns, _ = counts.shape
    spacing = fields.number("sampling_spacing")
    x, y = ((np.arange(n) - n / 2) * spacing for n in (columns, rows))
    wall = np.stack([*np.meshgrid(x, y), np.zeros((rows, columns))], axis=-1)
    column, row = fields.finite_array("SPAD_index", 2).astype(int)
    if not (0 <= column < columns and 0 <= row < rows):
        raise FileFormatError(
            fields.path,
            f"'SPAD_index' names column {column}, row {row} of {columns} x {rows} points",
        )
    return Capture(np.moveaxis(counts, 2, 0), wall, wall[row, column], fields.number("ts"))


def _read_signal(fields: NamedArrays) -> NDArray[np.float32]:
    data = fields.read_numbers("dataset.data").T
    if "dataset.t" in fields and data.shape[0] != fields.number("dataset.t"):
        raise FileFormatError(
            fields.path,
            f"'dataset.data' must end with {fields.number('dataset.t'):g} bins, found {data.T.shape}",
        )
    return data.astype(np.float32)


def _read_points(fields: NamedArrays, name: str) -> NDArray[np.float64]:
    """Points (n, 3), whichever way round they are stored."""
    points = np.atleast_2d(fields.read_numbers(name)).astype(np.float64)
    points = points.T if points.shape[0] == 3 and points.shape[1] != 3 else points
    if points.ndim != 2 or points.shape[1] != 3:
        raise FileFormatError(
            fields.path,
            f"field '{name}' must hold points in three dimensions, found {points.shape}",
        )
    return points
