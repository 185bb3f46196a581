"""A shot together with the camera that took it: opened once, its camera fitted if need be."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tofclip.arrays import AnyArray, FloatArray
from tofclip.camera import Camera, estimate_dark_level
from tofclip.camera.model import MergedSweep
from tofclip.camera.registration import MAX_ROUND_COUNT, estimate_skew, register_views
from tofclip.errors import InputError
from tofclip.io import read_streak
from tofclip.recovery.defects import find_clipping_level, mask_defects
from tofclip.shots import Streak
from tofclip.solvers import Progress, ignore_progress
from tofclip.units import NANOSECOND, PICOSECOND, SPEED_OF_LIGHT

# Of its full width at half maximum: with fewer a pulse's place is less sure.
ROWS_PER_PULSE = 3
MAX_ROW_PER_PULSE = 100.0
"""Longest row, in widths of the pulse: beyond, the unit of one of them is wrong."""
# Of the time that all rows last: light that is on its way for longer tells of a wrong unit as well.
MAX_FLIGHT_PER_SHOT = 100.0


@dataclass(frozen=True)
class Shot:
    """A streak image together with what is known about the camera that took it.

    Parameters
    ----------
    streak : Streak
        With a time axis.
    camera : Camera
        With the time zero that holds for this shot. Its sweep may be unknown; see `fit_camera`.
    calibrated_px : (views,) array, optional
        Slit centres as they were calibrated, where the camera was fitted to the shot since.
    """

    streak: Streak
    camera: Camera
    calibrated_px: FloatArray | None = None

    @property
    def times(self) -> FloatArray:
        """Time of flight of each row, (rows,), s: the camera's time zero is taken off."""
        return self.streak.times - self.camera.time_zero

    def merge_rows(self, number: int) -> Shot:
        """Return this shot with so many successive rows added up in each; a rest is left out."""
        if number == 1:
            return self
        streak, camera = self.streak, self.camera
        whole = len(streak.counts) // number * number

        def split(rows: AnyArray) -> AnyArray:
            return rows[:whole].reshape(-1, number, *rows.shape[1:])

        bad = None if streak.saturated is None else split(streak.saturated).max(axis=1)
        counts, times = split(streak.counts).sum(axis=1), split(streak.times).mean(axis=1)
        sweep = None if camera.sweep is None else MergedSweep(camera.sweep, number)
        streak = replace(streak, counts=counts, row_times=times, saturated=bad)
        return replace(self, streak=streak, camera=camera.replace(sweep=sweep))

    def fit_camera(
        self, progress: Progress = ignore_progress, max_rounds: int = MAX_ROUND_COUNT
    ) -> Shot:
        """Return this shot with a camera whose sweep is known, found from the shot if need be, in
        `max_rounds` refinements at most; `progress` as for `tofclip.camera.register_views`.
        """
        if self.camera.sweep is not None:
            return self
        found = fit_camera_to_shot(self.streak, self.camera, progress, max_rounds)
        return replace(self, camera=found, calibrated_px=self.camera.centres_px)


def count_needless_rows(shot: Shot) -> int:
    """Return how many rows of a shot may be added up in one, as the pulse lasts much longer: of frames of
    less time each shows a thin line of what is turned, and hardly any light. One where readings are cut
    off at the sensor's limit, which a sum does not show.
    """
    counts, times = shot.streak.counts, shot.streak.times
    said = shot.camera.pulse_fwhm * (times.size - 1) / float(times[-1] - times[0])
    if said < 1.5 * ROWS_PER_PULSE or np.isfinite(find_clipping_level(counts)):
        return 1
    # How long light stays the same is what a pulse lasts at most, whatever is said of it: a Gaussian
    # is half like itself after 0.71 of its full width. Noise is not like that of the next row.
    light = counts - np.float32(estimate_dark_level(counts))
    lags = range(1, min(int(said), len(light) - 1) + 1)
    like = np.array([np.vdot(light[:-lag], light[lag:]) for lag in lags])
    seen = np.count_nonzero(np.logical_and.accumulate(like > like[0] / 2)) / np.sqrt(0.5)
    return max(1, round(min(said, seen) / ROWS_PER_PULSE))


def open_shot(
    source: str | Path | Streak,
    camera: str | Path | Camera | None = None,
    time_zero: float | None = None,
    bin_width: float | None = None,
) -> Shot:
    """Read a shot and settle which camera and which time zero belong to it.

    Hot pixels, traces of particles and dead columns are masked, and what columns have at all times, as of
    ambient light, is taken off (`tofclip.recovery.defects`).

    Parameters
    ----------
    source : path-like or Streak
        A file that `tofclip.read_streak` reads, or a streak image.
    camera : path-like or Camera, optional
        By default the one that the streak image carries.
    time_zero : float, optional
        Reading of the time axis at which light of range 0 would arrive, s; the camera's by default.
    bin_width : float, optional
        Duration of a row, s; overrides the streak image's own time axis.

    Raises
    ------
    MissingTimeAxisError
        Neither the streak image nor `bin_width` says how long a row lasts.
    InputError
        There is no camera.
    StorageError, FileFormatError
        A file cannot be read.

    Examples
    --------
    >>> import numpy as np
    >>> import tofclip
    >>> camera = tofclip.Camera([20.0], [0.0], (16, 16), 41)
    >>> streak = tofclip.Streak(np.eye(40, 41), np.arange(40) * 20e-12)
    >>> open_shot(streak, camera, time_zero=-10.784e-9).camera.time_zero
    -1.0784e-08
    """
    if isinstance(source, Streak):
        streak = source if bin_width is None else source.with_bin_width(bin_width)
    else:
        streak = read_streak(source, bin_width)
    known = camera if camera is None or isinstance(camera, Camera) else Camera.load(camera)
    known = known or streak.camera
    if known is None:
        raise InputError(
            f"{streak.source} carries no camera: give one (`camera`, made by tofclip calibrate)"
        )
    require_plausible_rows(streak, known)
    shot = Shot(streak, known if time_zero is None else known.replace(time_zero=time_zero))
    require_plausible_time_zero(shot)
    return replace(shot, streak=mask_defects(streak, known.pulse_fwhm))


def require_plausible_rows(streak: Streak, camera: Camera) -> None:
    """Refuse a `streak` image whose rows do not go with the pulse of `camera`, as of a wrong unit:
    `MissingTimeAxisError` without a time axis, `InputError` where a row is far longer than the
    pulse, or all rows together are shorter than it.
    """
    times, pulse = streak.times, camera.pulse_fwhm
    rows = times.size
    width = (times[-1] - times[0]) / max(rows - 1, 1)
    if width > MAX_ROW_PER_PULSE * pulse:
        fault = f"is {width / pulse:.3g} times as long as the pulse"
    elif 0 < width * rows < pulse:
        fault = f"is so short that all {rows} rows are shorter than the pulse"
    else:
        return
    raise InputError(
        f"{streak.source}: a row of {width / PICOSECOND:.4g} ps {fault} ({pulse / PICOSECOND:.3g} ps); "
        "check the unit of `bin_width`, or give the pulse to calibrate (`pulse`)"
    )


def require_plausible_time_zero(shot: Shot) -> None:
    """Refuse a shot so long after its time zero that the unit of one of them is wrong."""
    first, last = SPEED_OF_LIGHT / 2 * shot.times[[0, -1]]
    if 0 < last - first < first / MAX_FLIGHT_PER_SHOT:
        raise InputError(
            f"{shot.streak.source}: time zero {shot.camera.time_zero / NANOSECOND:.6g} ns puts its rows at ranges "
            f"of {first:.4g} to {last:.4g} m; check the unit of `time_zero`"
        )


def fit_camera_to_shot(
    streak: Streak,
    camera: Camera,
    progress: Progress = ignore_progress,
    max_rounds: int = MAX_ROUND_COUNT,
) -> Camera:
    """Return `camera`, where the search starts, with sweep, gains and centres found from a
    `streak` image itself; `progress` and `max_rounds` as for `tofclip.camera.register_views`.
    """
    skew = estimate_skew(streak.counts, camera)
    # registration refines a skew that is right to a few rows, which the energy curves give
    coarse = replace(camera, sweep=skew.sweep)
    times = streak.times - camera.time_zero
    return register_views(
        streak.counts, streak.saturated, coarse, progress, times, max_rounds
    ).camera


def compute_view_delays_bins(camera: Camera) -> list[float]:
    """Rows by which each view is late at the first row, relative to the reference view."""
    if camera.sweep is None:
        return [0.0] * camera.views
    rows, _ = camera.sweep.raw_position(np.zeros(camera.views), camera.centres_px)
    reference = int(np.argmin(np.abs(camera.view_positions)))
    return [float(row) for row in rows - rows[reference]]
