"""The photons that a wall counts as a linear function of the hidden albedo, by time of flight."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from nlos.refinement.kernels import VOXELS_PER_RUN, add_backprojected_light, add_expected_light
from nlos.volume import Grid
from tofclip.arrays import FloatArray
from tofclip.threads import run_blocks, thread_count

Array = NDArray[Any]

# Wall points that a thread treats at a time.
POINTS_PER_BLOCK = 64


@dataclass(frozen=True, eq=False)
class TimeOfFlight:
    """Light of hidden voxels in the bins of a capture's wall points.

    A voxel of albedo a returns ``a / (d_L * d_p)^2`` after the path ``d_L + d_p``, spread over the
    paths of its whole volume, the bin, and the instrument's response. Nothing is held per pair of
    voxel and wall point.
    """

    capture: Capture  # wall, lasers and time axis are what counts
    grid: Grid
    # (n,), instrument's response in bins, of sum 1; its middle element stands for no delay
    response: FloatArray
    # light also falls with this power of the cosines of both legs with z: 0 for points that scatter
    # evenly, 2 for matte surfaces that face a matte wall; 1 lies between
    obliquity: int = 0

    def compute_light(self, albedo: Array, voxels: Array, points: Array) -> Array:
        """Return the light (m, bins) of some voxels (n,), flat indices into the grid, at some of
        the capture's points (m,).
        """
        light = np.empty((len(points), self._bins), np.float32)
        places, albedo = np.take(self._places, voxels, axis=1), np.asarray(albedo, np.float32)

        def process_block(some: slice) -> None:
            changes = np.zeros((some.stop - some.start, self._bins + 2))
            add_expected_light(*self._pairs(points[some]), *self._scale, places, albedo, changes)
            light[some] = np.cumsum(changes[:, : self._bins], axis=1)

        run_blocks(process_block, len(points), POINTS_PER_BLOCK)
        return self.spread(light, self.response)

    def backproject(
        self, values: Array, voxels: Array, points: Array, squared: bool = False
    ) -> Array:
        """Return what some voxels (n,) see of values (m, bins): the adjoint of `compute_light`.
        `squared`: weight by the square of the light instead: with the inverse of the expected
        counts this is what they tell of a voxel, Fisher's information.
        """
        # Running sums from the end on: a box of light is the difference of two, see the kernel. The
        # response is turned around, as the adjoint of a convolution asks for.
        sums = np.zeros((len(points), self._bins + 2), np.float32)
        spread = self.spread(values, self.response[::-1])
        np.cumsum(spread[:, ::-1], axis=1, out=sums[:, self._bins - 1 :: -1])
        places, pairs = np.take(self._places, voxels, axis=1), self._pairs(points)
        total = np.zeros(len(voxels), np.float32)

        def process_block(some: slice) -> None:
            block = np.ascontiguousarray(places[:, some])
            add_backprojected_light(*pairs, *self._scale, block, sums, squared, total[some])

        size = max(VOXELS_PER_RUN, -(-len(voxels) // (4 * thread_count())))
        run_blocks(process_block, max(len(voxels), 1), size)
        return total

    @property
    def _bins(self) -> int:
        return self.capture.axis.bins

    @cached_property
    def _places(self) -> NDArray[np.float32]:
        grid = self.grid
        z, y, x = np.meshgrid(grid.z, grid.y, grid.x, indexing="ij")
        return np.stack([x.ravel(), y.ravel(), z.ravel()]).astype(np.float32)

    @cached_property
    def _scale(self) -> tuple[Array, np.float32, np.float32, int]:
        """Extent of a voxel, path at which the record begins, bins per metre of path, and the
        obliquity.
        """
        axes = (self.grid.x, self.grid.y, self.grid.z)
        cell = [float(np.median(np.diff(axis))) if axis.size > 1 else 0.0 for axis in axes]
        axis = self.capture.axis
        start = np.float32(axis.start - axis.spacing / 2)
        return np.array(cell, np.float32), start, np.float32(1 / axis.spacing), self.obliquity

    def _pairs(self, points: Array) -> tuple[Array, Array]:
        lasers = self.capture.lasers
        return (
            self.capture.points[points].astype(np.float32),
            (lasers if len(lasers) == 1 else lasers[points]).astype(np.float32),
        )

    def spread(self, values: Array, response: FloatArray) -> Array:
        """Convolve values (m, bins) with a response (n,) in time, whose middle is no delay."""
        if response.size == 1:
            return np.asarray(values, np.float32)
        from scipy.ndimage import convolve1d

        return np.asarray(
            convolve1d(np.asarray(values, np.float32), response, axis=1, mode="constant")
        )
