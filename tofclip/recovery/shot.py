"""A shot together with the camera that took it: opened once, its camera fitted if need be; at which shear
each frame is recovered (one for all, the one that its time of flight says, or the sharpest); and the
camera's parallax from an ordinary shot: time gives the range of each gate, agreement of the views its
shear.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from tofclip.arrays import AnyArray, FloatArray
from tofclip.camera import Camera, Measurement, estimate_dark_level, measure
from tofclip.camera.model import MergedSweep, split_by_shear
from tofclip.camera.registration import (
    GATE_METHOD,
    MAX_ROUND_COUNT,
    FocusCurve,
    Parallax,
    count_registration_iterations,
    estimate_skew,
    find_sharpest_shears,
    fit_parallax_to_shears,
    register_views,
)
from tofclip.errors import CalibrationError, InputError, require, require_positive
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
    """A `streak` image with a time axis, and what is known about its `camera`, which has the time zero
    that holds for this shot; its sweep may be unknown, see `fit_camera`. `calibrated_px` (views,) are
    the slit centres as they were calibrated, where the camera was fitted to the shot since.
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


MIN_GATES = 3
MIN_RANGE_M = 0.2  # in front of it the shear would change from bin to bin; such light is stray
SEGMENT_RANGE_RATIO = 1.25  # light from there is weaker by a third
GATE_BINS = 64


@dataclass(frozen=True)
class FrameSegment:
    """Successive `frames` that share an operator, and its `shear`, pixels per view step.
    `brightness`: how bright a surface appears there, relative to the other pieces: a prior
    weighs in proportion.
    """

    frames: slice
    shear: float
    brightness: float = 1.0

    @property
    def size(self) -> int:
        """Number of frames."""
        return int(self.frames.stop - self.frames.start)


class Focus:
    """Anything that says at which shear each frame is recovered."""

    def plan_segments(
        self,
        camera: Camera,
        times: FloatArray,
        *,
        measurement: Measurement | None = None,
        progress: Progress = ignore_progress,
    ) -> list[FrameSegment]:
        """Cut the frames of a `camera` at `times` (frames,), s of flight, into pieces, in order and
        without gaps. `measurement`: of the same frames, which `SharpestFocus` needs and others do
        not; `progress` is called with the number of frame iterations just done, `work` of them.
        """
        raise NotImplementedError

    def check_camera(self, camera: Camera) -> None:
        """Raise `CalibrationError` if the camera does not know enough; by default it does."""

    def work(self, frames: int) -> int:
        """Frame iterations that `plan_segments` reports; by default nothing has to be tried."""
        return 0


@dataclass(frozen=True)
class FixedFocus(Focus):
    """One shear for all frames, in pixels per view step."""

    shear: float = 0.0

    def __post_init__(self) -> None:
        require(np.isfinite(self.shear), f"a shear must be finite, got {self.shear}")

    def __str__(self) -> str:
        return f"fixed:{self.shear:g}"

    def plan_segments(self, camera: Camera, times: FloatArray, **others: Any) -> list[FrameSegment]:
        return [FrameSegment(slice(0, times.size), self.shear)]


@dataclass(frozen=True)
class DepthLockedFocus(Focus):
    """Every frame at the shear of the range that its time of flight says, s(c t / 2). Frames whose
    shears put no view further off the slit than `tolerance_px`, pixels, share an operator. The
    light of a frame is expected to fall off as 1/range^2, and the prior's weight with it.
    """

    tolerance_px: float = 0.25

    def __post_init__(self) -> None:
        require_positive("the tolerance", self.tolerance_px, "number of pixels")

    def __str__(self) -> str:
        return "depth-locked"

    def check_camera(self, camera: Camera) -> None:
        """Ask for a known parallax."""
        if camera.lenslet_pitch <= 0:
            raise CalibrationError(
                "the camera does not know its lenslet pitch, so that range says nothing about shear: calibrate it "
                "(tofclip.camera) or choose another `focus`, fixed:S or stack:S0:S1:N"
            )

    def plan_segments(self, camera: Camera, times: FloatArray, **others: Any) -> list[FrameSegment]:
        """Cut where the shear has changed by twice the tolerance, or light is a third weaker."""
        distance = np.maximum(SPEED_OF_LIGHT * times / 2, MIN_RANGE_M)
        octave = np.floor(np.log(distance / distance[0]) / np.log(SEGMENT_RANGE_RATIO))
        pieces = split_by_shear(camera, distance, self.tolerance_px, octave)
        return [
            FrameSegment(part, shear, float(np.mean(distance[part] ** -2.0)))
            for part, shear in pieces
        ]


@dataclass(frozen=True)
class SharpestFocus(Focus):
    """Every gate of 64 frames at that shear, of a `number` of them from `first` to `last`, pixels
    per view step, at which its pictures are sharpest.
    """

    first: float
    last: float
    number: int

    def __post_init__(self) -> None:
        require(
            -inf < self.first < self.last < inf and self.number >= 2,
            f"a focus stack needs two or more rising shears, got {self}",
        )

    def __str__(self) -> str:
        return f"stack:{self.first:g}:{self.last:g}:{self.number}"

    def plan_segments(
        self,
        camera: Camera,
        times: FloatArray,
        *,
        measurement: Measurement | None = None,
        progress: Progress = ignore_progress,
    ) -> list[FrameSegment]:
        """Try all shears on each gate."""
        if measurement is None:
            raise InputError("the sharpest shears are found in the measurements of a shot")
        starts = range(0, times.size, GATE_BINS)
        gates = [slice(start, min(start + GATE_BINS, times.size)) for start in starts]
        shears = np.linspace(self.first, self.last, self.number)
        found = find_sharpest_shears(measurement, camera, gates, shears, progress).shears
        return [FrameSegment(gate, float(shear)) for gate, shear in zip(gates, found, strict=True)]

    def work(self, frames: int) -> int:
        """Each frame is recovered once for each shear."""
        return self.number * GATE_METHOD.work(frames)


DEFAULT_FOCUS = FixedFocus()


def parse_focus(text: str) -> Focus:
    """Read a `text` ``depth-locked``, ``fixed:S`` or ``stack:S0:S1:N``; else `InputError`."""
    name, *numbers = text.split(":")
    try:
        if name == "depth-locked" and not numbers:
            return DepthLockedFocus()
        if name == "fixed" and len(numbers) == 1:
            return FixedFocus(float(numbers[0]))
        if name == "stack" and len(numbers) == 3:
            return SharpestFocus(float(numbers[0]), float(numbers[1]), int(numbers[2]))
    except ValueError as fault:
        raise InputError(f"focus '{text}': {fault}") from fault
    raise InputError(f"focus '{text}' is none of depth-locked, fixed:S and stack:S0:S1:N")


@dataclass(frozen=True)
class ShotParallax:
    """What a shot says about the `parallax`: the `camera` with sweep, gains, centres, lenslet
    pitch and focus distance; the mean range of each gate's light, `distances` (gates,), m; and
    the focus `curve`.
    """

    camera: Camera
    parallax: Parallax
    distances: FloatArray
    curve: FocusCurve


def fit_parallax_to_shot(
    shot: Shot,
    gates: int,
    shears: tuple[float, float, int],
    progress: Progress = ignore_progress,
) -> ShotParallax:
    """Fit lenslet pitch and focus distance to the shears at which a shot's gates are in focus.

    The `shot` is of a scene at several ranges, with a true time zero; a sweep that is not known is
    estimated from it. There are so many `gates`, of equal brightness; `shears` are the first and the last
    tried and their number, pixels per view step; `progress` is called with the number of frame
    iterations just done. `InputError` for fewer than three gates, `CalibrationError` where fewer than
    two have their best shear within those tried.
    """
    require(gates >= MIN_GATES, f"a parallax needs {MIN_GATES} gates or more, got {gates}")
    shot = shot.fit_camera(progress)
    camera, times = shot.camera, shot.times
    measurement = measure(shot.streak.counts, shot.streak.saturated, camera)
    if times[0] <= 0:
        raise CalibrationError(
            "light cannot come before time zero: give the camera's (`time_zero`)"
        )
    cut, distances = split_gates_by_brightness(measurement, times, gates)
    curve = find_sharpest_shears(measurement, camera, cut, np.linspace(*shears), progress)
    found = fit_parallax_to_shears(curve.shears, distances, curve.weight)
    return ShotParallax(found.apply_to(camera), found, distances, curve)


def count_parallax_work(shot: Shot, shears: tuple[float, float, int]) -> int:
    """Return the frame iterations of `fit_parallax_to_shot`, at most, for `shot` and `shears`."""
    rows = shot.streak.counts.shape[0]
    fitting = count_registration_iterations() if shot.camera.sweep is None else 0
    return fitting + shears[2] * GATE_METHOD.work(rows)


def split_gates_by_brightness(
    measurement: Measurement, times: FloatArray, number: int
) -> tuple[list[slice], FloatArray]:
    """Cut the frames into gates of equal brightness (root of the light), fewer where it is concentrated;
    also their light's mean range, m.
    """
    light = np.maximum((measurement.values * measurement.valid).sum(axis=0, dtype=np.float64), 0)
    # the root, so that a bright near surface does not take all gates
    share = np.cumsum(np.sqrt(light)) / np.sqrt(light).sum()
    edges = np.searchsorted(share, np.arange(1, number) / number) + 1
    cuts = np.unique(np.concatenate([[0], edges, [light.size]])).tolist()
    gates = [slice(first, last) for first, last in pairwise(cuts)]
    instants = [
        # a gate without light has a mean time too
        np.average(times[gate], weights=light[gate] + np.finfo(np.float64).tiny)
        for gate in gates
    ]
    return gates, SPEED_OF_LIGHT * np.array(instants) / 2
