"""NumPy archives, streak images of the LIFT camera, and MATLAB files of lone data sets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from nlos.io.fields import NamedArrays, read_matlab
from nlos.io.tal import match_lasers_to_sensors
from tofclip.errors import FileFormatError
from tofclip.units import SPEED_OF_LIGHT

SURFACE_OPTIMISATION_BIN_M = 1.2e-3
"""Path per bin, m."""

PAIR_BIN_WIDTH_S = 32e-12


def read_numpy_archive(fields: NamedArrays) -> Capture:
    """Read ``H`` (t, ...), ``wall_xyz`` (..., 3), ``laser_xyz`` ((3,) or (..., 3)), ``delta_t_s``
    or ``delta_t_m``, and ``t_start_m``, 0 where it is absent.

    Lengths in m, durations in s; bin 0 holds the path ``t_start_m`` from the laser spot to the wall
    point. Lasers (lasers..., 3) of which each was combined with all wall points come with ``H`` (t,
    lasers..., points...).

    Raises
    ------
    FileFormatError
        The signal belongs to neither wall nor lasers, or its time axis is the last.
    """
    signal = fields.read_numbers("H")
    wall, laser = (fields.read_coordinates(f"{name}_xyz") for name in ("wall", "laser"))
    start = fields.number("t_start_m") if "t_start_m" in fields else 0.0
    bin_width = (
        fields.number("delta_t_s")
        if "delta_t_s" in fields
        else fields.number("delta_t_m") / SPEED_OF_LIGHT
    )
    points = wall.shape[:-1]
    if signal.shape[:-1] == points and signal.shape[1:] != points:
        raise FileFormatError(
            fields.path,
            f"H of shape {signal.shape} ends with time; put time first: np.moveaxis(H, -1, 0)",
        )
    return match_lasers_to_sensors(fields, signal, wall, laser, bin_width, start)


def read_surface_optimisation_data(fields: NamedArrays) -> Capture:
    """Read ``transient`` (points, t) and ``lighting`` (points, 3), m, of a confocal scan.

    A bin is 1.2 mm of path, and bin 0 is path 0. x runs to the right and y down as in the authors'
    order of points: their mannequin stands upright.

    Tsai, Sankaranarayanan, Gkioulekas, "Beyond volumetric albedo: a surface optimization framework
    for non-line-of-sight imaging", CVPR 2019.
    """
    wall = fields.read_coordinates("lighting")
    counts = fields.array("transient", len(wall), None)
    return Capture(counts.T, wall, wall, SURFACE_OPTIMISATION_BIN_M / SPEED_OF_LIGHT)


def read_curvelet_data(fields: NamedArrays) -> Capture:
    """Read ``sub_Sig`` (pairs, t) in bins of 32 ps, with the laser spots and wall points of the
    pairs in ``C_i.mat`` and ``C_d.mat`` beside the file: (pairs, 3), m.

    Liu et al., "Non-line-of-sight imaging with arbitrary illumination and detection pattern", Nat.
    Commun. 14, 3230 (2023).
    """
    counts = fields.array("sub_Sig", None, None)
    laser, wall = (_read_pair_points(fields, name, len(counts)) for name in ("C_i.mat", "C_d.mat"))
    return Capture(counts.T, wall, laser, PAIR_BIN_WIDTH_S)


def read_general_data(fields: NamedArrays) -> Capture:
    """Read ``data`` (rows, columns, t) of irregular pairs in bins of 32 ps, with ``laserpoints``
    and ``detectpoints`` (rows, columns, 3), m, in ``setup.mat`` beside the file.

    Field names, units and bins are those of https://github.com/hy520484/general-NLOS; of
    ``data_NAME.mat``, ``setup_NAME.mat`` is taken where there is one.
    """
    counts = fields.array("data", None, None, None)
    own = fields.path.with_name(fields.path.name.replace("data", "setup", 1))
    setup = own if own != fields.path and own.is_file() else fields.path.with_name("setup.mat")
    if not setup.is_file():
        raise FileFormatError(
            fields.path,
            "holds data; it needs setup.mat beside it, with laserpoints and detectpoints; see docs/own_wall.md",
        )
    beside = read_matlab(setup)
    laser, wall = (
        beside.finite_array(name, *counts.shape[:2], 3) for name in ("laserpoints", "detectpoints")
    )
    return Capture(np.moveaxis(counts, 2, 0), wall, laser, PAIR_BIN_WIDTH_S)


def _read_pair_points(fields: NamedArrays, name: str, pairs: int) -> NDArray[np.float64]:
    """Points (pairs, 3), m, of the file of that name beside the signals."""
    path = fields.path.with_name(name)
    if not path.is_file():
        raise FileFormatError(
            fields.path,
            f"holds sub_Sig of {pairs} pairs; it needs C_i.mat (laser spots) and C_d.mat (wall points) beside it, "
            "see docs/own_wall.md",
        )
    beside = read_matlab(path)
    for one in sorted(beside.names):
        points = beside.read_numbers(one).astype(np.float64)
        if points.shape == (pairs, 3):
            # The authors' order is (depth, x, y) where the first column does not vary.
            return np.roll(points, -1, axis=1) if np.ptp(points[:, 0]) == 0 else points
    raise FileFormatError(path, f"holds no points of shape ({pairs}, 3)")


def read_lift_archive(path: str | Path) -> Capture:
    """Recover a LIFT streak image of a relay wall by the linear inverse, and take its wall out."""
    from tofclip.io import read_streak
    from tofclip.recovery import recover

    return Capture.from_frames(recover(read_streak(path), method="linear"))
