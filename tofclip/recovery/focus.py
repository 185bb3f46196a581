"""At which shear each frame is recovered: one for all, the one that its time of flight tells, or the sharpest."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera, Measurement
from tofclip.camera.calibration.parallax import sharpest_shears
from tofclip.errors import CalibrationError, InputError
from tofclip.solvers import Progress, silent
from tofclip.units import SPEED_OF_LIGHT

FloatArray = NDArray[np.float64]

NEAREST = 0.2  # m; in front of it the shear would change from bin to bin, and light of such ranges is stray
FARTHER = 1.25  # light from there is weaker by a third
GATE_BINS = 64


@dataclass(frozen=True)
class Piece:
    """Successive frames that share an operator.

    Parameters
    ----------
    frames : slice
    shear : float
        Pixels per view step.
    brightness : float
        How bright a surface appears there, relative to the other pieces: a prior weighs in proportion.
    """

    frames: slice
    shear: float
    brightness: float = 1.0

    @property
    def size(self) -> int:
        """Number of frames."""
        return int(self.frames.stop - self.frames.start)


class Focus(Protocol):
    """Anything that says at which shear each frame is recovered."""

    def require(self, camera: Camera) -> None:
        """Raise `CalibrationError` if the camera does not know enough."""
        ...

    def pieces(
        self, camera: Camera, times: FloatArray, measurement: Measurement, progress: Progress = silent
    ) -> list[Piece]:
        """Cut the frames at `times` (s of flight) into pieces, in order and without gaps."""
        ...

    def work(self, frames: int) -> int:
        """Frame iterations that `pieces` reports."""
        ...


@dataclass(frozen=True)
class FixedFocus:
    """One shear for all frames, in pixels per view step."""

    shear: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite(self.shear):
            raise InputError(f"a shear must be finite, got {self.shear}")

    def __str__(self) -> str:
        return f"fixed:{self.shear:g}"

    def require(self, camera: Camera) -> None:
        """Ask for nothing."""

    def pieces(
        self, camera: Camera, times: FloatArray, measurement: Measurement, progress: Progress = silent
    ) -> list[Piece]:
        """Return a single piece."""
        return [Piece(slice(0, times.size), self.shear)]

    def work(self, frames: int) -> int:
        """Nothing has to be tried."""
        return 0


@dataclass(frozen=True)
class DepthLocked:
    """Every frame at the shear of the range that its time of flight tells, s(c t / 2).

    Frames whose shears put no view further off the slit than the tolerance share an operator. The light of a frame
    is expected to fall off as 1/range^2, and the prior's weight with it.

    Parameters
    ----------
    tolerance_px : float
        Largest error of a view's place on the slit.
    """

    tolerance_px: float = 0.25

    def __post_init__(self) -> None:
        if not (np.isfinite(self.tolerance_px) and self.tolerance_px > 0):
            raise InputError(f"the tolerance must be a positive number of pixels, got {self.tolerance_px}")

    def __str__(self) -> str:
        return "depth-locked"

    def require(self, camera: Camera) -> None:
        """Ask for a known parallax."""
        if camera.lenslet_pitch <= 0:
            raise CalibrationError(
                "the camera does not know its lenslet pitch, so that range says nothing about shear: calibrate it "
                "(tofclip.camera.calibration.parallax) or choose --focus fixed:S or stack:S0:S1:N"
            )

    def pieces(
        self, camera: Camera, times: FloatArray, measurement: Measurement, progress: Progress = silent
    ) -> list[Piece]:
        """Cut where the shear has changed by twice the tolerance, or the light has become a third weaker."""
        distance = np.maximum(SPEED_OF_LIGHT * times / 2, NEAREST)
        shears = camera.shear_at(distance)
        step = 2 * self.tolerance_px / np.abs(camera.view_positions).max(initial=1.0)
        number = np.floor((shears - shears[0]) / step).astype(np.int64)
        octave = np.floor(np.log(distance / distance[0]) / np.log(FARTHER))
        changed = (np.diff(number) != 0) | (np.diff(octave) != 0)
        cuts = np.flatnonzero(np.concatenate([[True], changed, [True]]))
        parts = [slice(int(first), int(last)) for first, last in pairwise(cuts)]
        return [Piece(part, float(shears[part].mean()), float(np.mean(distance[part] ** -2.0))) for part in parts]

    def work(self, frames: int) -> int:
        """Nothing has to be tried."""
        return 0


@dataclass(frozen=True)
class SharpestFocus:
    """Every gate of 64 frames at that shear, of a stack, at which its pictures are sharpest.

    Parameters
    ----------
    first, last : float
        Ends of the stack, pixels per view step.
    number : int
        Shears tried.
    """

    first: float
    last: float
    number: int

    def __post_init__(self) -> None:
        if not (np.isfinite(self.first) and np.isfinite(self.last) and self.first < self.last and self.number >= 2):
            raise InputError(f"a focus stack needs two or more rising shears, got {self}")

    def __str__(self) -> str:
        return f"stack:{self.first:g}:{self.last:g}:{self.number}"

    def require(self, camera: Camera) -> None:
        """Ask for nothing."""

    def pieces(
        self, camera: Camera, times: FloatArray, measurement: Measurement, progress: Progress = silent
    ) -> list[Piece]:
        """Try all shears on each gate."""
        starts = range(0, times.size, GATE_BINS)
        gates = [slice(start, min(start + GATE_BINS, times.size)) for start in starts]
        shears = np.linspace(self.first, self.last, self.number)
        found = sharpest_shears(measurement, camera, gates, shears, progress).shears
        return [Piece(gate, float(shear)) for gate, shear in zip(gates, found, strict=True)]

    def work(self, frames: int) -> int:
        """Each frame is recovered once for each shear."""
        from tofclip.camera.calibration.parallax import LOOK

        return self.number * LOOK.work(frames)


AT_THE_CALIBRATED_DEPTH = FixedFocus()


def focus_named(text: str) -> Focus:
    """Read ``depth-locked``, ``fixed:S`` or ``stack:S0:S1:N``.

    Raises
    ------
    InputError
        Anything else.
    """
    name, *numbers = text.split(":")
    try:
        if name == "depth-locked" and not numbers:
            return DepthLocked()
        if name == "fixed" and len(numbers) == 1:
            return FixedFocus(float(numbers[0]))
        if name == "stack" and len(numbers) == 3:
            return SharpestFocus(float(numbers[0]), float(numbers[1]), int(numbers[2]))
    except ValueError as fault:
        raise InputError(f"focus '{text}': {fault}") from fault
    raise InputError(f"focus '{text}' is none of depth-locked, fixed:S and stack:S0:S1:N")
