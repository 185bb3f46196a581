"""Plane waves in groups of a size that vector instructions like."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nlos.plane import Plane
from nlos.rsd.diffraction import PlaneWaves
from nlos.rsd.kernels import (
    FREQUENCY_STEPS,
    LANES,
    MIRROR_IMAGES,
    TAPS,
    assemble_groups,
)
from nlos.rsd.transfer import TransferFunction
from tofclip.threads import run_blocks

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

FREQUENCIES_PER_BLOCK = 4


@dataclass(frozen=True, eq=False)
class Interpolation:
    """How every group finds a transfer function between its nodes."""

    begin: IntArray  # (groups,), first node
    # (groups + 1,), where a group's weights begin, one row of `weights` for each node from `begin`
    # on
    offset: IntArray
    weights: NDArray[np.float32]  # (some, LANES)


@dataclass(frozen=True, eq=False)
class WaveGroups:
    """Plane waves of neighbouring lateral wavenumbers, with those mirrored in the axes.

    A group is `LANES` waves whose indices are not negative, and their `MIRROR_IMAGES` images. Waves
    on an axis are images of themselves; a fraction of 0 marks repeated ones, and those that fill up
    the last group.
    """

    waves: PlaneWaves

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Of the real and imaginary parts of all waves: (groups, 2, MIRRORED, LANES)."""
        return len(self.first_frequency), 2, MIRROR_IMAGES, LANES

    @cached_property
    def _quadrant(self) -> tuple[IntArray, IntArray, FloatArray, int]:
        """Indices and lateral wavenumbers (groups, LANES) of waves without a negative index, and
        how many there are.
        """
        row, column, lateral = self.waves.quadrant
        count = row.size
        filled = np.minimum(np.arange(count + -count % LANES), count - 1).reshape(-1, LANES)
        return row[filled], column[filled], lateral[filled], count

    @cached_property
    def indices(self) -> tuple[IntArray, IntArray]:
        """Indices along y and along x, (groups, MIRRORED, LANES)."""
        row, column, _, _ = self._quadrant
        return np.stack([row, -row, row, -row], axis=1), np.stack(
            [column, column, -column, -column], axis=1
        )

    @cached_property
    def is_distinct(self) -> NDArray[np.bool_]:
        """Whether a wave stands there for the first time, (groups, MIRRORED, LANES)."""
        row, column, _, count = self._quadrant
        once = np.arange(row.size).reshape(row.shape) < count
        return np.stack(
            [once, once & (row > 0), once & (column > 0), once & (row > 0) & (column > 0)], axis=1
        )

    @property
    def leading_zeros(self) -> int:
        """Zeros before the lowest frequency that make their number a multiple of `FREQUENCY_STEPS`."""
        return -self.waves.lateral_limits.size % FREQUENCY_STEPS

    @cached_property
    def first_frequency(self) -> IntArray:
        """Where every group's frequencies begin, zeros included."""
        nearest = self._quadrant[2][:, 0]
        frequency = np.searchsorted(self.waves.lateral_limits, nearest) + self.leading_zeros
        # whole steps, as the kernel takes them
        return frequency // FREQUENCY_STEPS * FREQUENCY_STEPS

    def interpolation(self, transfer: TransferFunction) -> Interpolation:
        """Find the groups between the nodes of a transfer function."""
        lateral = self._quadrant[2]
        node, weight = (
            found.reshape(*lateral.shape, -1) for found in transfer.interpolation(lateral.ravel())
        )
        begin, end = node.min(axis=(1, 2)), node.max(axis=(1, 2)) + TAPS
        count = end - begin
        offset = np.concatenate([[0], np.cumsum(count)])
        shares = np.zeros((offset[-1], LANES), np.float32)
        place = (offset[:-1] - begin)[:, np.newaxis, np.newaxis] + node + np.arange(TAPS)
        shares[place, np.arange(LANES)[:, np.newaxis]] = weight
        return Interpolation(begin, offset, shares)

    def to_plane_waves(
        self, values: NDArray[np.complex64], plane: Plane, origin: tuple[float, float]
    ) -> NDArray[np.float32]:
        """Return ``sum_p values(p) * exp(-1j * q (r_p - origin)) / area`` of every wave q, area
        that of a period.

        By matrix products: the plane's spacing need not fit the lattice, and a coarse one repeats
        itself in q as it should. Waves beyond their limit are 0.

        `values` (y, x, frequencies); `origin`: y and x of the point whose phase is 0, m. Returns
        (groups, ahead + frequencies, 2, MIRRORED, LANES): real and imaginary parts.
        """
        waves, count = self.waves, values.shape[-1]
        row, column, lateral, distinct = self._quadrant
        weight = (self.is_distinct / np.prod(waves.period)).astype(np.float32)
        lanes = np.searchsorted(lateral.ravel()[:distinct], waves.lateral_limits, side="right")
        y, x = (
            _AxisTransform.of(axis, start, 2 * np.pi / side, reach)
            for axis, start, side, reach in zip(
                (plane.y, plane.x), origin, waves.period, waves.max_indices, strict=True
            )
        )
        spectrum = np.zeros(
            (len(row), self.leading_zeros + count, 2, MIRROR_IMAGES, LANES), np.float32
        )

        def analyse(some: slice) -> None:
            high, wide = (
                reach + 1
                for reach in waves.max_indices_within(float(waves.lateral_limits[some][-1]))
            )
            lines = y.project(np.ascontiguousarray(np.swapaxes(values[..., some], 1, 2)), high)
            parts = [
                part
                for line in lines
                for part in x.project(np.ascontiguousarray(np.swapaxes(line, 0, 2)), wide)
            ]
            at = self.leading_zeros + some.start
            assemble_groups(
                np.stack(parts), row, column, y.turns, x.turns, weight, lanes[some], at, spectrum
            )

        run_blocks(analyse, count, size=FREQUENCIES_PER_BLOCK)
        return spectrum


@dataclass(frozen=True, eq=False)
class _AxisTransform:
    """Waves along an axis of evenly spaced points, about its middle: real, and half as many points."""

    cosines: NDArray[np.float32]  # (waves, half the points)
    sines: NDArray[np.float32]  # (waves, half the points)
    turns: NDArray[np.complex64]  # (waves,), waves at the middle

    @classmethod
    def of(cls, axis: FloatArray, origin: float, step: float, reach: int) -> _AxisTransform:
        """Return the transform of an axis for the plane waves of index 0 to `reach`.

        `axis` (points,): evenly spaced, m; `origin`: where all waves have phase 0, m; `step`:
        lateral wavenumber of index 1, rad/m; `reach`: largest index.
        """
        numbers = step * np.arange(reach + 1)
        half = (axis.size + 1) // 2
        # about the middle a real point's wave and its mirror point's are conjugate: cosines and
        # sines of half the points suffice
        phases = np.outer(numbers, (axis[::-1] - axis)[:half] / 2)
        turns = np.exp(-1j * numbers * ((axis[0] + axis[-1]) / 2 - origin))
        return cls(
            np.cos(phases).astype(np.float32),
            np.sin(phases).astype(np.float32),
            turns.astype(np.complex64),
        )

    def project(self, values: NDArray[np.complex64], count: int) -> list[NDArray[np.complex64]]:
        """Sums of complex values (points, ...) with the first cosines and with the first sines,
        (count, ...).

        `values` (points, ...); `count`: number of waves, from index 0 on. Returns cosine and sine
        sums.
        """
        half = self.cosines.shape[1]
        before, after = values[:half], values[::-1][:half]
        even, odd = after + before, after - before
        if len(values) % 2:
            # the middle point of an odd number is its own mirror image and counts once
            even[-1] = before[-1]
        return [
            (waves[:count] @ part.reshape(half, -1).view(np.float32))
            .view(np.complex64)
            .reshape(count, *values.shape[1:])
            for waves, part in ((self.cosines, even), (self.sines, odd))
        ]
