"""What every imaging method offers: a plan for captures of one geometry, and images from it.

`Method.plan` validates once, and raises `InputError` with the reason where a method cannot image a
capture. The plan knows its cost and memory, and images any number of captures that differ in their
signals only, such as those of a moving scene.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cached_property

import numpy as np

from nlos.band import VirtualPulse
from nlos.capture import Capture
from nlos.volume import Grid, Volume
from tofclip.arrays import is_numpy
from tofclip.errors import InputError, require_type

Progress = Callable[[int], None]
"""Called with the number of look-ups or voxels just done, from several threads; may raise to
interrupt.
"""

# Larger volumes are refused before anything is allocated.
MEMORY_LIMIT_BYTES = 8 << 30
FEWER_VOXELS = "use larger voxels or a smaller box"
# A complex64 sum and its float32 magnitude.
VOXEL_BYTES = 12


def ignore_progress(_: int) -> None:
    """Report nothing."""


class SubProgress:
    """Progress of one step of several, which counts up to `work`, as a `portion` of the whole."""

    def __init__(self, progress: Progress, work: int, portion: int) -> None:
        self._progress, self._work, self._portion = progress, work, portion
        self._done, self._lock = 0, threading.Lock()

    def __call__(self, done: int) -> None:
        with self._lock:
            before = self._done * self._portion // self._work
            self._done += done
            increment = self._done * self._portion // self._work - before
        self._progress(increment)


class PlannedGeometry:
    """Wall, laser, time axis and device that something is made ready for."""

    def __init__(self, capture: Capture) -> None:
        self.wall, self.laser = capture.wall, capture.laser
        self.axis, self.device = capture.axis, capture.device

    def require_same(self, capture: Capture) -> None:
        """Refuse a capture that was not planned for."""
        for name, planned in (("wall", self.wall), ("laser", self.laser)):
            found = getattr(capture, name)
            if found is not planned and not np.array_equal(found, planned, equal_nan=True):
                raise InputError(
                    f"the {name} is not that of the capture that this imaging was planned for"
                )
        if capture.axis != self.axis:
            raise InputError(f"planned for {self.axis}, got a capture of {capture.axis}")
        if capture.device != self.device:
            raise InputError(f"planned for signals on {self.device}, got one on {capture.device}")


class Plan(ABC):
    """A method made ready for captures of one geometry on one ``grid``: wall, laser, time axis and device
    of a capture are what counts.
    """

    images = 1  # how many are made and added up

    def __init__(self, capture: Capture, grid: Grid) -> None:
        self.grid = grid
        self.geometry = PlannedGeometry(capture)

    @cached_property
    def cost(self) -> int:
        """What `image` reports as progress in all: look-ups, or voxels once per laser spot."""
        return self.grid.size

    @cached_property
    def memory_bytes(self) -> int:
        """Most bytes that arrays of an image hold, the volume included, the capture not; within a
        factor of two.
        """
        return self.grid.size * VOXEL_BYTES

    def image(self, capture: Capture, progress: Progress = ignore_progress) -> Volume:
        """Image the hidden scene.

        Parameters
        ----------
        capture : Capture
            Of the geometry that was planned for, or `InputError`.
        progress : callable, optional
            Called with a part of `cost` whenever so much is done.

        Returns
        -------
        Volume
            Brightness, real and not negative, float32.
        """
        self.geometry.require_same(capture)
        return self._image(capture, progress)

    @abstractmethod
    def _image(self, capture: Capture, progress: Progress) -> Volume:
        """Image a capture whose geometry is that of the plan."""


class PhasorPlan(Plan):
    """A plan whose image is the magnitude of a complex field."""

    def field(self, capture: Capture, progress: Progress = ignore_progress) -> Volume:
        """Return the complex sum whose magnitude `image` gives, complex64; linear in the signal."""
        self.geometry.require_same(capture)
        return self._field(capture, progress)

    @abstractmethod
    def _field(self, capture: Capture, progress: Progress) -> Volume:
        """Return the complex field of a capture whose geometry is that of the plan."""

    def _image(self, capture: Capture, progress: Progress) -> Volume:
        field = self._field(capture, progress)
        return Volume(abs(field.values), field.grid, field.provenance)


class Method(ABC):
    """One way of imaging a hidden scene."""

    @abstractmethod
    def plan(self, capture: Capture, grid: Grid) -> Plan:
        """Make the method ready for captures like `capture` on `grid`: wall, laser, time axis and device
        are what counts. `InputError` says why it cannot image them.
        """

    def reconstruct(
        self, capture: Capture, grid: Grid, progress: Progress = ignore_progress
    ) -> Volume:
        """Image the hidden scene: ``plan(capture, grid).image(capture, progress)``.

        Parameters
        ----------
        progress : callable, optional
            Called with a part of the plan's `cost` whenever so much is done.

        Returns
        -------
        Volume
            Brightness I(r), real and not negative, float32.

        Raises
        ------
        InputError
            The method cannot image such a capture on the grid.
        """
        require_type(capture, Capture, "a hidden scene is imaged from a Capture")
        require_type(grid, Grid, "voxels are those of a Grid, see nlos.Grid.in_front_of")
        return self.plan(capture, grid).image(capture, progress)


class PhasorMethod(Method):
    """A method whose image is the magnitude of a complex field."""

    @abstractmethod
    def plan(self, capture: Capture, grid: Grid) -> PhasorPlan: ...

    def phasor_field(
        self, capture: Capture, grid: Grid, progress: Progress = ignore_progress
    ) -> Volume:
        """Return the complex sum whose magnitude `reconstruct` gives; see `PhasorPlan.field`."""
        return self.plan(capture, grid).field(capture, progress)


class PulsedMethod(PhasorMethod):
    """A method that sees a capture by a virtual pulse of so many `cycles` of a `wavelength`, m."""

    wavelength: float
    cycles: float

    def __post_init__(self) -> None:
        _ = self.pulse

    @cached_property
    def pulse(self) -> VirtualPulse:
        """The virtual pulse."""
        return VirtualPulse(self.wavelength, self.cycles)


def require_imageable(capture: Capture, grid: Grid) -> None:
    """Refuse a single wall point, a grid behind the wall, and more than `MEMORY_LIMIT_BYTES`."""
    if len(capture.points) == 1:
        raise InputError("one wall point cannot locate anything: a capture needs several")
    hindmost = float(capture.points[:, 2].min())
    if grid.z[0] < hindmost:
        raise InputError(
            f"the grid begins at z = {grid.z[0]:.4g} m, behind the hindmost wall point at {hindmost:.4g} m: the hidden "
            "scene lies at larger z than the wall (if yours faces -z, negate x and z of all coordinates)"
        )
    require_memory(grid.size * VOXEL_BYTES, f"{grid.size} voxels", FEWER_VOXELS)


def require_memory(needed: float, what: str, remedy: str, limit: int | None = None) -> None:
    """Refuse what needs more bytes than a limit, by default `MEMORY_LIMIT_BYTES`."""
    limit = limit or MEMORY_LIMIT_BYTES
    if needed > limit:
        size = f"{needed / 2**30:.1f} GiB, more than the {limit >> 30} GiB allowed"
        raise InputError(f"{what} need {size}: {remedy}")


def require_numpy_signal(what: str, capture: Capture) -> None:
    """Refuse a signal on another device for a method of compiled loops, `what` in the message."""
    if not is_numpy(capture.signal):
        raise InputError(
            f"{what} works on NumPy arrays only, and this capture's signal is on {capture.device}: "
            "take --device cpu or capture.on(ComputeDevice()), or use rsd, hybrid or backprojection"
        )
