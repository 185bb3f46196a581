"""Plane waves in groups of a size that vector instructions like."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nlos.plane import Plane
from nlos.rsd.kernels import LANES, MIRRORED, NODES, STEPS, TAPS, group_waves
from nlos.rsd.spectrum import PlaneWaves
from nlos.rsd.transfer import Transfer
from tofclip.threads import run_blocks

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

FREQUENCIES_AT_A_TIME = 4


@dataclass(frozen=True, eq=False)
class Interpolation:
    """How every group finds a transfer function between its nodes.

    Parameters
    ----------
    begin : (groups,) int64 array
        First node.
    offset : (groups + 1,) int64 array
        Where a group's weights begin, one row of `shares` for each node from `begin` on.
    shares : (some, LANES) float32 array
    """

    begin: IntArray
    offset: IntArray
    shares: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Groups:
    """Plane waves of neighbouring lateral wavenumbers, with those mirrored in the axes.

    A group is `LANES` waves whose indices are not negative, and their `MIRRORED` images. Waves on an axis are images of
    themselves; a share of 0 marks repeated ones, and those that fill up the last group.

    Parameters
    ----------
    waves : PlaneWaves
    """

    waves: PlaneWaves

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Of the real and imaginary parts of all waves: (groups, 2, MIRRORED, LANES)."""
        return len(self.first), 2, MIRRORED, LANES

    @cached_property
    def _quarter(self) -> tuple[IntArray, IntArray, FloatArray, int]:
        """Indices and lateral wavenumbers (groups, LANES) of waves without a negative index, and how many there are."""
        waves = self.waves
        inside = np.flatnonzero((waves.row >= 0) & (waves.column >= 0))
        filled = np.concatenate([inside, np.repeat(inside[-1:], -inside.size % LANES)]).reshape(-1, LANES)
        return waves.row[filled], waves.column[filled], waves.lateral[filled], inside.size

    @cached_property
    def indices(self) -> tuple[IntArray, IntArray]:
        """Indices along y and along x, (groups, MIRRORED, LANES)."""
        row, column, _, _ = self._quarter
        return np.stack([row, -row, row, -row], axis=1), np.stack([column, column, -column, -column], axis=1)

    @cached_property
    def distinct(self) -> NDArray[np.bool_]:
        """Whether a wave stands there for the first time, (groups, MIRRORED, LANES)."""
        row, column, _, count = self._quarter
        once = np.arange(row.size).reshape(row.shape) < count
        return np.stack([once, once & (row > 0), once & (column > 0), once & (row > 0) & (column > 0)], axis=1)

    @property
    def ahead(self) -> int:
        """Zeros before the lowest frequency that make their number a multiple of `STEPS`."""
        return -self.waves.limits.size % STEPS

    @cached_property
    def first(self) -> IntArray:
        """Where every group's frequencies begin, zeros included."""
        nearest = self._quarter[2][:, 0]
        frequency = np.searchsorted(self.waves.limits, nearest) + self.ahead
        return frequency // STEPS * STEPS

    def interpolation(self, transfer: Transfer) -> Interpolation:
        """Find the groups between the nodes of a transfer function."""
        lateral = self._quarter[2]
        node, share = (found.reshape(*lateral.shape, -1) for found in transfer.interpolation(lateral.ravel()))
        begin, end = node.min(axis=(1, 2)), node.max(axis=(1, 2)) + TAPS
        count = -(-(end - begin) // NODES) * NODES
        begin = np.minimum(begin, transfer.nodes.size - count)
        offset = np.concatenate([[0], np.cumsum(count)])
        shares = np.zeros((offset[-1], LANES), np.float32)
        place = (offset[:-1] - begin)[:, np.newaxis, np.newaxis] + node + np.arange(TAPS)
        shares[place, np.arange(LANES)[:, np.newaxis]] = share
        return Interpolation(begin, offset, shares)

    def analysed(self, values: NDArray[np.complex64], plane: Plane, origin: tuple[float, float]) -> NDArray[np.float32]:
        """Return ``sum_p values(p) * exp(-1j * q (r_p - origin)) / area`` of every wave q, area that of a period.

        By matrix products: the plane's spacing need not fit the lattice, and a coarse one repeats itself in q as it
        should. Waves beyond their limit are 0.

        Parameters
        ----------
        values : (y, x, frequencies) complex64 array
        plane : Plane
        origin : (float, float)
            y and x of the point whose phase is 0, m.

        Returns
        -------
        (groups, ahead + frequencies, 2, MIRRORED, LANES) float32 array
            Real and imaginary parts.
        """
        waves, count = self.waves, values.shape[-1]
        row, column, lateral, distinct = self._quarter
        share = (self.distinct / np.prod(waves.period)).astype(np.float32)
        lanes = np.searchsorted(lateral.ravel()[:distinct], waves.limits, side="right")
        y, x = (
            _Analysis.of(axis, start, 2 * np.pi / side, reach)
            for axis, start, side, reach in zip((plane.y, plane.x), origin, waves.period, waves.reach, strict=True)
        )
        spectrum = np.zeros((len(row), self.ahead + count, 2, MIRRORED, LANES), np.float32)

        def analyse(some: slice) -> None:
            high, wide = (reach + 1 for reach in waves.reach_within(float(waves.limits[some][-1])))
            lines = y.sums(np.ascontiguousarray(np.swapaxes(values[..., some], 1, 2)), high)
            parts = [part for line in lines for part in x.sums(np.ascontiguousarray(np.swapaxes(line, 0, 2)), wide)]
            at = self.ahead + some.start
            group_waves(np.stack(parts), row, column, y.turns, x.turns, share, lanes[some], at, spectrum)

        run_blocks(analyse, count, size=FREQUENCIES_AT_A_TIME)
        return spectrum


@dataclass(frozen=True, eq=False)
class _Analysis:
    """Waves along an axis of evenly spaced points, about its middle: real, and half as many points.

    Parameters
    ----------
    cosines, sines : (waves, half the points) float32 array
    turns : (waves,) complex64 array
        Waves at the middle.
    """

    cosines: NDArray[np.float32]
    sines: NDArray[np.float32]
    turns: NDArray[np.complex64]

    @classmethod
    def of(cls, axis: FloatArray, origin: float, step: float, reach: int) -> _Analysis:
        numbers = step * np.arange(reach + 1)
        half = (axis.size + 1) // 2
        phases = np.outer(numbers, (axis[::-1] - axis)[:half] / 2)
        turns = np.exp(-1j * numbers * ((axis[0] + axis[-1]) / 2 - origin))
        return cls(np.cos(phases).astype(np.float32), np.sin(phases).astype(np.float32), turns.astype(np.complex64))

    def sums(self, values: NDArray[np.complex64], count: int) -> list[NDArray[np.complex64]]:
        """Sums of complex values (points, ...) with the first cosines and with the first sines, (count, ...)."""
        half = self.cosines.shape[1]
        before, after = values[:half], values[::-1][:half]
        even, odd = after + before, after - before
        if len(values) % 2:
            even[-1] = before[-1]
        return [
            (waves[:count] @ part.reshape(half, -1).view(np.float32))
            .view(np.complex64)
            .reshape(count, *values.shape[1:])
            for waves, part in ((self.cosines, even), (self.sines, odd))
        ]
