"""Filtered back-projection: the signals themselves are back-projected, and a Laplacian sharpens
what comes out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlos.backprojection import TABLE_BYTES, Weighting, backproject_signals
from nlos.band import Waveforms
from nlos.capture import Capture
from nlos.geometry import Grid
from nlos.method import (
    Progress,
    Support,
    check_common_support,
    check_numpy_support,
    ignore_progress,
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


UNIFORM_WEIGHTING = Weighting(falloff=0.0)
"""All voxels alike: the signals' own scale."""


@dataclass(frozen=True)
class FilteredBackprojection:
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

    def supports(self, capture: Capture, grid: Grid) -> Support:
        """Say whether `capture` can be imaged on `grid`, and if not, why: a condition, with
        ``.reason``.

        Parameters
        ----------
        capture : Capture
        grid : Grid

        Returns
        -------
        Support
        """
        arrays = check_numpy_support("filtered back-projection", capture)
        if not arrays:
            return arrays
        if not all(is_evenly_spaced(axis) for axis in (grid.x, grid.y, grid.z)):
            return Support("the Laplacian needs evenly spaced voxels along x, y and z")
        return check_common_support(capture, grid)

    def lookups(self, capture: Capture, grid: Grid) -> int:
        """Number of look-ups that a reconstruction costs; what `progress` counts up to.

        Parameters
        ----------
        capture : Capture
        grid : Grid

        Returns
        -------
        int
            Wall points times voxels.
        """
        return len(capture.points) * grid.size

    def reconstruct(
        self, capture: Capture, grid: Grid, progress: Progress = ignore_progress
    ) -> Volume:
        """Image the hidden scene.

        Parameters
        ----------
        capture : Capture
        grid : Grid
            Evenly spaced.
        progress : callable, optional
            Called with the number of look-ups just done.

        Returns
        -------
        Volume
            Float32, not negative.

        Raises
        ------
        InputError
            `supports` says no.
        """
        self.supports(capture, grid).require()

        def pad_signals(traces: NDArray[np.float32]) -> Waveforms:
            values = np.pad(traces, ((0, 0), PADDING_SAMPLES)).astype(np.complex64)
            return Waveforms(values, capture.start - capture.axis.spacing, capture.axis.spacing)

        count = max(1, TABLE_BYTES // (8 * (capture.axis.bins + sum(PADDING_SAMPLES))))
        total = np.ascontiguousarray(
            backproject_signals(capture, grid, pad_signals, count, self.weighting, progress).real
        )
        sharpened = self._apply_laplacian(total, grid)
        settings = {"method": "filtered backprojection", "sigma_m": self.sigma}
        return Volume(np.maximum(sharpened, 0), grid, {**capture.provenance, "imaging": settings})

    def _apply_laplacian(self, values: NDArray[np.float32], grid: Grid) -> NDArray[np.float32]:
        from scipy.ndimage import gaussian_filter

        sigmas = [
            self.sigma / axis_step(axis) if axis.size > 1 else 0.0
            for axis in (grid.z, grid.y, grid.x)
        ]
        total = np.zeros_like(values)
        for axis in (axis for axis in range(3) if sigmas[axis] > 0):
            order = [2 if i == axis else 0 for i in range(3)]
            # sigma^2 takes the unit away, so that images at different sigmas compare
            total -= np.float32(sigmas[axis] ** 2) * gaussian_filter(
                values, sigmas, order, mode="nearest", truncate=FILTER_TRUNCATION_SIGMAS
            )
        return total
