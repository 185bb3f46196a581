"""What every reconstruction method offers, and how it says that it cannot treat an input."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from nlos.capture import Capture
from nlos.geometry import Grid
from nlos.volume import Volume
from tofclip.arrays import ComputeDevice, is_numpy
from tofclip.errors import InputError

Progress = Callable[[int], None]
"""Called with the number of look-ups or voxels just done, from several threads; may raise to
interrupt.
"""

MEMORY_LIMIT_BYTES = 8 << 30
"""Larger volumes are refused before anything is allocated."""

VOXEL_BYTES = 12
"""A complex64 sum and its float32 magnitude."""


def ignore_progress(_: int) -> None:
    """Report nothing."""


class SubProgress:
    """Progress of one step of several, reported as a portion of all work; may be called from
    several threads.

    Parameters
    ----------
    progress : callable
        Of the whole.
    work : int
        What the step counts up to.
    portion : int
        What that is of the whole.
    """

    def __init__(self, progress: Progress, work: int, portion: int) -> None:
        self._progress, self._work, self._portion = progress, work, portion
        self._done, self._lock = 0, threading.Lock()

    def __call__(self, done: int) -> None:
        with self._lock:
            before = self._done * self._portion // self._work
            self._done += done
            increment = self._done * self._portion // self._work - before
        self._progress(increment)


@dataclass(frozen=True)
class Support:
    """Whether a method can treat an input: true if there is no reason against it.

    Parameters
    ----------
    reason : str
        Why not, as one clause that says what to do; empty if it can.
    """

    reason: str = ""

    def __bool__(self) -> bool:
        return not self.reason

    def require(self) -> None:
        """Raise the reason, if there is one, as `InputError`."""
        if self.reason:
            raise InputError(self.reason)


class Reconstructor(Protocol):
    """One method of imaging a hidden scene."""

    def supports(self, capture: Capture, grid: Grid) -> Support:
        """Say whether the method can image `capture` on `grid`, and if not, why.

        Parameters
        ----------
        capture : Capture
        grid : Grid

        Returns
        -------
        Support
        """
        ...

    def reconstruct(
        self, capture: Capture, grid: Grid, progress: Progress = ignore_progress
    ) -> Volume:
        """Image the hidden scene.

        Parameters
        ----------
        capture : Capture
        grid : Grid
        progress : callable
            Called with the amount of work just done.

        Returns
        -------
        Volume
            Brightness (z, y, x).

        Raises
        ------
        InputError
            `supports` says no.
        """
        ...


class PhasorMethod(ABC):
    """A method whose image is the magnitude of a complex field."""

    @abstractmethod
    def phasor_field(
        self, capture: Capture, grid: Grid, progress: Progress = ignore_progress
    ) -> Volume:
        """Return the complex sum whose magnitude `reconstruct` gives, complex64.

        Parameters
        ----------
        capture : Capture
        grid : Grid
        progress : callable
            As for `reconstruct`.

        Returns
        -------
        Volume
            (z, y, x) complex64.

        Raises
        ------
        InputError
            `supports` says no.
        """

    def reconstruct(
        self, capture: Capture, grid: Grid, progress: Progress = ignore_progress
    ) -> Volume:
        """Image the hidden scene.

        Parameters
        ----------
        capture : Capture
        grid : Grid
        progress : callable, optional
            Called with the number of look-ups just done, or of voxels, once for every laser spot;
            see the method.

        Returns
        -------
        Volume
            Brightness I(r), float32.

        Raises
        ------
        InputError
            `supports` says no.
        """
        field = self.phasor_field(capture, grid, progress)
        return Volume(abs(field.values), grid, field.provenance)


def check_common_support(capture: Capture, grid: Grid) -> Support:
    """Check what no method can do without: several wall points, a grid that is not behind them, and
    memory.

    Parameters
    ----------
    capture : Capture
    grid : Grid

    Returns
    -------
    Support
    """
    if len(capture.points) == 1:
        return Support("one wall point cannot locate anything: a capture needs several")
    hindmost = float(capture.points[:, 2].min())
    if grid.z[0] < hindmost:
        return Support(
            f"the grid begins at z = {grid.z[0]:.4g} m, behind the hindmost wall point at {hindmost:.4g} m: the hidden "
            "scene lies at larger z than the wall (if yours faces -z, negate x and z of all coordinates)"
        )
    if grid.size * VOXEL_BYTES > MEMORY_LIMIT_BYTES:
        return Support(
            f"{grid.size} voxels need {grid.size * VOXEL_BYTES / 2**30:.1f} GiB, more than the "
            f"{MEMORY_LIMIT_BYTES >> 30} GiB allowed: use larger voxels or a smaller box"
        )
    return Support()


def check_numpy_support(what: str, capture: Capture) -> Support:
    """Check that a method of compiled loops, `what` in the message, gets a NumPy array.

    Parameters
    ----------
    what : str
    capture : Capture

    Returns
    -------
    Support
    """
    if is_numpy(capture.signal):
        return Support()
    return Support(
        f"{what} works on NumPy arrays only, and this capture's signal is on {ComputeDevice.of(capture.signal)}: "
        "bring it back by capture.on(Place()) or --device cpu, or use rsd, hybrid or backprojection"
    )
