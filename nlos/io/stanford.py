"""MATLAB files of the two confocal data sets of Stanford.

* Light-cone transform (O'Toole, Lindell, Wetzstein, Nature 555, 338, 2018): ``rect_data`` (x, y, t)
  with the light's way to the wall taken off, in bins of 4 ps, and ``width``, half the side of the
  wall in m; as ``cnlos_reconstruction.m`` of that paper's code takes them. x falls along the first
  axis: that code reverses x before it shows a volume, and only so their letter S reads as an S.
* f-k migration (Lindell, Wetzstein, O'Toole, ACM Trans. Graph. 38, 116, 2019): ``meas`` (y, x, t)
  in bins of 32 ps on a wall of 2 m x 2 m, and in a file beside it ``tofgrid`` (y, x), the arrival
  of the wall's own light in ps; as ``demo.m`` and ``cnlos_reconstruction.m`` of
  https://github.com/computational-imaging/nlos-fk take them.

Whether x or y run as in a photograph f-k migration's data set does not say.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from nlos.io.fields import NamedArrays, read_matlab
from nlos.kernels import shift_signals
from tofclip.errors import FileFormatError
from tofclip.units import PICOSECOND

LIGHT_CONE_BIN_WIDTH_S = 4e-12
MIGRATION_BIN_WIDTH_S = 32e-12
MIGRATION_WALL_WIDTH_M = 2.0
"""m"""


def read_light_cone_data(fields: NamedArrays) -> Capture:
    """Read a scene of the light-cone transform's data set."""
    counts = fields.read_time_last("rect_data")
    wall = np.swapaxes(_build_wall(counts.shape[1], counts.shape[0], fields.number("width")), 0, 1)
    wall = wall[::-1]
    return Capture(np.moveaxis(counts, 2, 0), wall, wall, LIGHT_CONE_BIN_WIDTH_S)


def read_migration_data(fields: NamedArrays) -> Capture:
    """Read a scene of f-k migration's data set; ``tofgrid`` from the same file or from a
    ``tof*.mat`` beside it.
    """
    counts = fields.read_time_last("meas")
    arrival = _read_arrival_bins(fields, counts.shape[:2])
    delay_bins = arrival * PICOSECOND / MIGRATION_BIN_WIDTH_S
    by_bin = np.ascontiguousarray(
        np.moveaxis(counts, 2, 0).reshape(counts.shape[2], -1), dtype=np.float32
    )
    signal = shift_signals(by_bin, delay_bins.ravel()).reshape(counts.shape[2], *counts.shape[:2])
    wall = _build_wall(counts.shape[0], counts.shape[1], MIGRATION_WALL_WIDTH_M / 2)
    return Capture(signal, wall, wall, MIGRATION_BIN_WIDTH_S)


def _build_wall(rows: int, columns: int, half_width: float) -> NDArray[np.float64]:
    x, y = np.meshgrid(
        np.linspace(-half_width, half_width, columns), np.linspace(-half_width, half_width, rows)
    )
    return np.stack([x, y, np.zeros_like(x)], axis=-1)


def _read_arrival_bins(fields: NamedArrays, shape: tuple[int, ...]) -> NDArray[np.float64]:
    if "tofgrid" in fields:
        return fields.finite_array("tofgrid", *shape)
    name = fields.path.name
    beside = [fields.path.with_name(other) for other in (name.replace("meas", "tof"), "tof.mat")]
    found = next((path for path in beside if path != fields.path and path.is_file()), None)
    if found is None:
        raise FileFormatError(
            fields.path,
            f"has no 'tofgrid', and there is no {Path(beside[1]).name} beside it to tell when the wall lit up",
        )
    return read_matlab(found).finite_array("tofgrid", *shape)
