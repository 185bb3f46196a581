"""Filtered back-projection: the signals themselves are back-projected, and a Laplacian sharpens
what comes out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlos.backprojection import TABLE_BYTES, TABLE_COPIES, Weighting, backproject_signals
from nlos.band import Waveforms
from nlos.capture import Capture
from nlos.geometry import Grid
from nlos.method import (
    VOXEL_BYTES,
    Method,
    Plan,
    Progress,
    require_imageable,
    require_numpy_signal,
)
from nlos.plane import axis_step, is_evenly_spaced
from nlos.volume import Volume
from tofclip.errors import InputError

PADDING_SAMPLES = (1, 2)
"""Zeros before and after every signal, where look-ups outside the record end."""


FILTER_TRUNCATION_SIGMAS = 6.0
"""Standard deviations at which the Laplacian is cut off: at 4, a thousandth of the haze would pass
it.
"""


LAPLACIAN_COPIES = 4
"""Volumes in float32 that are held beside the sum while it is sharpened."""

UNIFORM_WEIGHTING = Weighting(falloff=0.0)
"""All voxels alike: the signals' own scale."""


@dataclass(frozen=True)
class FilteredBackprojection(Method):
    """Point-wise back-projection of the measured signals, then a Laplacian, for every wall and
    laser.

    The filter is ``-sigma^2 * (d2/dx2 + d2/dy2 + d2/dz2)`` of a Gaussian of standard deviation
    sigma. What it makes negative, the shadows of bright things, is set to 0. Needs no wavelength;
    noisier than a virtual pulse.

    Costs one look-up per voxel and wall point; memory for the volume three times over and for 32
    MiB of signals.

    Velten et al., "Recovering three-dimensional shape around a corner using ultrafast
    time-of-flight imaging", Nat. Commun. 3, 745 (2012).

    Parameters
    ----------
    sigma : float
        Standard deviation of the Gaussian, m: about the size of the finest detail, and at least one
        voxel.
    weighting : Weighting
        How much a voxel gets by its distance and direction from the wall point.
    """

    sigma: float = 0.02
    weighting: Weighting = UNIFORM_WEIGHTING

    def __post_init__(self) -> None:
        if not (np.isfinite(self.sigma) and self.sigma > 0):
            raise InputError(
                f"sigma of the Laplacian must be a positive number of metres, got {self.sigma}"
            )

    def plan(self, capture: Capture, grid: Grid) -> FilteredBackprojectionPlan:
        """Make the method ready for captures like `capture` on `grid`.

        Parameters
        ----------
        capture : Capture
            A NumPy array; any wall and lasers.
        grid : Grid
            Evenly spaced, not behind the wall.

        Returns
        -------
        FilteredBackprojectionPlan

        Raises
        ------
        InputError
            The method cannot image such a capture on the grid.
        """
        require_numpy_signal("filtered back-projection", capture)
        if not all(is_evenly_spaced(axis) for axis in (grid.x, grid.y, grid.z)):
            raise InputError("the Laplacian needs evenly spaced voxels along x, y and z")
        require_imageable(capture, grid)
        return FilteredBackprojectionPlan(capture, grid, self)


class FilteredBackprojectionPlan(Plan):
    """Filtered back-projection, ready for captures of one geometry.

    Parameters
    ----------
    capture : Capture
    grid : Grid
    method : FilteredBackprojection
    """

    def __init__(self, capture: Capture, grid: Grid, method: FilteredBackprojection) -> None:
        super().__init__(capture, grid)
        self.method = method
        self._points, self._bins = len(capture.points), capture.axis.bins

    @property
    def cost(self) -> int:
        """Look-ups: one per voxel and wall point."""
        return self._points * self.grid.size

    @property
    def memory_bytes(self) -> int:
        signals = min(TABLE_BYTES, 8 * self._points * self._bins)
        return self.grid.size * (VOXEL_BYTES + 4 * LAPLACIAN_COPIES) + TABLE_COPIES * signals

    def _image(self, capture: Capture, progress: Progress) -> Volume:
        spacing = capture.axis.spacing

        def pad_signals(traces: NDArray[np.float32]) -> Waveforms:
            values = np.pad(traces, ((0, 0), PADDING_SAMPLES)).astype(np.complex64)
            return Waveforms(values, capture.start - spacing, spacing)

        count = max(1, TABLE_BYTES // (8 * (self._bins + sum(PADDING_SAMPLES))))
        total = np.ascontiguousarray(
            backproject_signals(
                capture, self.grid, pad_signals, count, self.method.weighting, progress
            ).real
        )
        sharpened = _apply_laplacian(total, self.grid, self.method.sigma)
        settings = {"method": "filtered backprojection", "sigma_m": self.method.sigma}
        return Volume(
            np.maximum(sharpened, 0), self.grid, {**capture.provenance, "imaging": settings}
        )


def _apply_laplacian(values: NDArray[np.float32], grid: Grid, sigma: float) -> NDArray[np.float32]:
    from scipy.ndimage import gaussian_filter

    sigmas = [
        sigma / axis_step(axis) if axis.size > 1 else 0.0 for axis in (grid.z, grid.y, grid.x)
    ]
    total = np.zeros_like(values)
    for axis in (axis for axis in range(3) if sigmas[axis] > 0):
        order = [2 if i == axis else 0 for i in range(3)]
        total -= np.float32(sigmas[axis] ** 2) * gaussian_filter(
            values, sigmas, order, mode="nearest", truncate=FILTER_TRUNCATION_SIGMAS
        )
    return total
