"""HDF5 files of y-tal, the toolkit of the University of Zaragoza.

Field names, meanings and units are those of the class ``NLOSCaptureData`` in
``tal/io/capture_data.py`` of https://github.com/diegoroyo/tal, version 0.20: lengths and times in m
(optical path), the relay wall at z = 0 and the hidden scene at z > 0, as here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from nlos.io.fields import NamedArrays
from nlos.unwarp import remove_device_legs
from tofclip.errors import FileFormatError
from tofclip.units import SPEED_OF_LIGHT


def read_tal(fields: NamedArrays) -> Capture:
    """Read ``H`` of the formats T_Sx_Sy, T_Lx_Ly_Sx_Sy, T_Si and T_Li_Si.

    A lone laser point is a spot that stands still; as many as sensor points are paired with them,
    or confocal; other numbers are combined with all. Where ``t_accounts_first_and_last_bounces`` is
    true the ways to and from the devices are taken off.
    """
    sensor, laser = (fields.read_coordinates(f"{name}_grid_xyz") for name in ("sensor", "laser"))
    start = fields.number("t_start") if "t_start" in fields else 0.0
    bin_width = fields.number("delta_t") / SPEED_OF_LIGHT
    capture = match_lasers_to_sensors(
        fields, fields.read_numbers("H"), sensor, laser, bin_width, start
    )
    if not fields.flag("t_accounts_first_and_last_bounces"):
        return capture
    source, camera = (fields.finite_array(f"{name}_xyz", 3) for name in ("laser", "sensor"))
    return remove_device_legs(capture, source, camera)


def match_lasers_to_sensors(
    fields: NamedArrays,
    signal: NDArray[Any],
    sensor: NDArray[np.float64],
    laser: NDArray[np.float64],
    bin_width: float,
    start: float,
) -> Capture:
    """Find out by the shapes which laser points belong to which sensor points.

    `fields`: for the error message; `signal` (t, sensors...); `sensor, laser` (..., 3): m;
    `bin_width, start`: s and m.
    """
    sensors, lasers = sensor.shape[:-1], laser.shape[:-1]
    if not signal.ndim:
        raise FileFormatError(fields.path, "holds a signal without a time axis")
    if signal.shape[1:] == sensors and laser.size == 3:
        return Capture(signal, sensor, laser.reshape(3), bin_width, start)
    if signal.shape[1:] == sensors == lasers:
        spots = sensor if np.allclose(sensor, laser) else laser
        return Capture(signal, sensor, spots, bin_width, start)
    if signal.shape[1:] == (*lasers, *sensors):
        return Capture.exhaustive(signal, sensor, laser, bin_width, start)
    raise FileFormatError(
        fields.path,
        f"a signal of shape {signal.shape} belongs neither to {sensors} wall points nor to {lasers} lasers",
    )
