"""NumPy archives, streak images of the LIFT camera, and MATLAB files of lone data sets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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

HALF_TURN = np.diag([-1.0, -1.0, 1.0])
"""About z: from x to the left and y up to x to the right and y down."""

EVEN_BINS_TOLERANCE = 1e-3
"""Of a bin's width, what even bins may differ by: times are often rounded."""

MAX_EVEN_BINS_RATIO = 8
"""Uneven bins become at most this number of times as many even ones."""


def read_numpy_archive(fields: NamedArrays) -> Capture:
    """Read ``H`` (t, ...), ``wall_xyz`` (..., 3), ``laser_xyz`` ((3,) or (..., 3)), and of the
    time axis either ``delta_t_s`` or ``delta_t_m`` and ``t_start_m``, 0 where it is absent, or the
    middle of every bin in ``t_s`` or ``t_m``.

    Lengths in m, durations in s; bin 0 holds the path ``t_start_m`` from the laser spot to the wall
    point. Bins of different widths are put into even ones. Lasers (lasers..., 3) of which each was
    combined with all wall points come with ``H`` (t, lasers..., points...).
    """
    signal = fields.read_numbers("H")
    wall, laser = (fields.read_coordinates(f"{name}_xyz") for name in ("wall", "laser"))
    points = wall.shape[:-1]
    if signal.shape[:-1] == points and signal.shape[1:] != points:
        raise FileFormatError(
            fields.path,
            f"H of shape {signal.shape} ends with time; put time first: np.moveaxis(H, -1, 0)",
        )
    times = next((name for name in ("t_m", "t_s") if name in fields), None)
    if times is not None:
        paths = fields.finite_array(times, len(signal)) * (1 if times == "t_m" else SPEED_OF_LIGHT)
        signal, start, spacing = resample_evenly(fields, signal, paths)
        return match_lasers_to_sensors(fields, signal, wall, laser, spacing / SPEED_OF_LIGHT, start)
    start = fields.number("t_start_m") if "t_start_m" in fields else 0.0
    bin_width = (
        fields.number("delta_t_s")
        if "delta_t_s" in fields
        else fields.number("delta_t_m") / SPEED_OF_LIGHT
    )
    return match_lasers_to_sensors(fields, signal, wall, laser, bin_width, start)


def resample_evenly(
    fields: NamedArrays, signal: NDArray[Any], paths: NDArray[np.float64]
) -> tuple[NDArray[Any], float, float]:
    """Put counts of time bins that need not be even into even ones; no photon is lost or doubled.

    The light of a bin is taken to be spread evenly over it; an even bin is as wide as the median.

    `fields`: for the error message; `signal` (t, ...); `paths` (t,): path at the middle of every
    bin, m. Returns `signal` (t, ...): the same one where bins are even; `start, spacing`: path of
    the first bin and from one to the next, m.
    """
    widths = np.diff(paths)
    if len(paths) < 2 or not widths.min() > 0:
        raise FileFormatError(fields.path, "has times that do not grow from bin to bin")
    spacing = float(widths.mean())
    if np.abs(widths - spacing).max() <= EVEN_BINS_TOLERANCE * spacing:
        return signal, float(paths[0]), spacing
    spacing = float(np.median(widths))
    middles = (paths[1:] + paths[:-1]) / 2
    edges = np.concatenate([[paths[0] - widths[0] / 2], middles, [paths[-1] + widths[-1] / 2]])
    bins = max(2, int(np.ceil((edges[-1] - edges[0]) / spacing)))
    if bins > MAX_EVEN_BINS_RATIO * len(paths):
        raise FileFormatError(
            fields.path, f"has time bins so uneven that {bins} even ones would be needed"
        )
    even = edges[0] + spacing * np.arange(bins + 1)
    flat = signal.reshape(len(signal), -1)
    # The running sum is interpolated, not the counts: differences of it keep every photon.
    arrived = np.concatenate([np.zeros((1, flat.shape[1])), np.cumsum(flat, axis=0, dtype=float)])
    before = np.clip(np.searchsorted(edges, even, side="right") - 1, 0, len(signal) - 1)
    part = np.clip((even - edges[before]) / (edges[before + 1] - edges[before]), 0, 1)
    light = arrived[before] + part[:, np.newaxis] * (arrived[before + 1] - arrived[before])
    resampled = np.diff(light, axis=0).astype(np.float32).reshape(bins, *signal.shape[1:])
    return resampled, float(even[0]) + spacing / 2, spacing


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


def read_general_data(fields: NamedArrays) -> Capture:
    """Read ``data`` (rows, columns, t) of irregular pairs, with ``laserpoints`` and
    ``detectpoints`` (rows, columns, 3), m, in ``setup.mat`` beside the file.

    Bins are 32 ps, or ``timeRes`` s where that number stands in either file: the authors keep it in
    a file of settings instead, and it is another one for the data sets of others. Seen from the
    wall x runs to the left and y up: their script reverses both before it shows a volume, and only
    so the letter and the number of "tuan" read as in the photograph of them.

    Field names, units and bins are those of https://github.com/hy520484/general-NLOS; of
    ``data_NAME.mat``, ``setup_NAME.mat`` is taken where there is one.
    """
    counts = fields.read_time_last("data")
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
    stated = next((one for one in (fields, beside) if "timeRes" in one), None)
    bin_width = PAIR_BIN_WIDTH_S if stated is None else stated.number("timeRes")
    return Capture(np.moveaxis(counts, 2, 0), wall @ HALF_TURN, laser @ HALF_TURN, bin_width)


def read_lift_archive(path: str | Path) -> Capture:
    """Recover a LIFT streak image of a relay wall by the linear inverse, and take its wall out."""
    from tofclip.io import read_streak
    from tofclip.recovery import recover

    return Capture.from_frames(recover(read_streak(path), method="linear"))
