"""At which shear each frame is recovered: one for all, the one that its time of flight says, or the
sharpest; and the camera's parallax from an ordinary shot: time gives the range of each gate, agreement
of the views its shear.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import inf
from typing import Any

import numpy as np

from tofclip.arrays import FloatArray
from tofclip.camera import Camera, Measurement, measure
from tofclip.camera.model import split_by_shear
from tofclip.camera.registration import (
    GATE_METHOD,
    FocusCurve,
    Parallax,
    count_registration_iterations,
    find_sharpest_shears,
    fit_parallax_to_shears,
)
from tofclip.errors import CalibrationError, InputError, require, require_positive
from tofclip.recovery.shot import Shot
from tofclip.solvers import Progress, ignore_progress
from tofclip.units import SPEED_OF_LIGHT

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

    Parameters
    ----------
    shot : Shot
        Of a scene at several ranges, with a true time zero. A sweep that is not known is estimated
        from the shot.
    gates : int
        Number of gates, of equal brightness.
    shears : (float, float, int)
        First and last shear tried and their number, pixels per view step.
    progress : callable
        Called with the number of frame iterations just done.

    Raises
    ------
    CalibrationError
        Fewer than two gates have their best shear within those tried.
    InputError
        Fewer than three gates.
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
