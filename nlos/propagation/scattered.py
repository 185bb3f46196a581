"""From scattered wall points to a plane by Fourier transforms that ask for no lattice."""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nlos.plane import WallLattice
from nlos.propagation.wall_to_plane_plan import TERM_S, WallBeforePlane, WallToPlanePlan
from nlos.rsd.transfer import SphericalWaves

if TYPE_CHECKING:
    import finufft

FloatArray = NDArray[np.float64]

ANALYSIS_ERROR_FRACTION = 0.1
"""Of the error allowed, what the transforms of scattered points may take."""

UPSAMPLING = 1.25
"""Of the transforms' own grids; half as slow as the usual 2 for as few points as walls have."""

INDEX_STEP = 8
"""Indices along an axis from one plan to the next: a plan serves several frequencies."""

POINT_S, WAVE_S = 2.5e-8, 9e-9
"""Seconds on one core per term, roughly, for a wall point and for a plane wave."""


def has_finufft() -> bool:
    """Whether the library for them, finufft, is installed."""
    return importlib.util.find_spec("finufft") is not None


class ScatteredWallToPlanePlan(WallToPlanePlan):
    """How fields get from scattered points to a plane: as from a lattice, but for the first step.

    Parameters are those of `WallToPlanePlan`; no point need stand on the lattice `wall`, which only
    says where they begin and how long a period is.
    """

    @classmethod
    def of(
        cls,
        geometry: WallBeforePlane,
        waves: SphericalWaves,
        strength: FloatArray,
        tolerance: float,
    ) -> WallToPlanePlan:
        """Return the plan for any wall points, in the steps of the plane.

        `strength` (frequencies,): relative amplitude of each frequency; `tolerance`: relative
        error.
        """
        points, plane = geometry.points, geometry.plane
        x, y = (
            low + step * np.arange(max(2, int(np.ceil((high - low) / step)) + 1))
            for low, high, step in zip(
                points[:, :2].min(axis=0), points[:, :2].max(axis=0), plane.steps[::-1], strict=True
            )
        )
        nowhere = np.zeros(0, np.intp)
        return cls(geometry, WallLattice(x, y, nowhere, nowhere), waves, strength, tolerance)

    @property
    def seconds_per_term(self) -> float:
        """Roughly, on one core."""
        y, x = self.max_indices
        return TERM_S + POINT_S * len(self.points) + WAVE_S * 4 * y * x

    def analysis(self, terms: int) -> ScatteredAnalysis:
        """Return what analyses a field on the wall; not to be shared between threads."""
        along_y, along_x = (
            spacing * (self.points[:, axis] - start)
            for spacing, axis, start in zip(
                self.steps, (1, 0), (self.wall.y[0], self.wall.x[0]), strict=True
            )
        )
        return ScatteredAnalysis(
            along_y,
            along_x,
            self.steps[1] / self.steps[0],
            ANALYSIS_ERROR_FRACTION * self.tolerance,
        )


class ScatteredAnalysis:
    """Sums ``sum_p values(p) * exp(-1j * q r_p)`` of several terms, for points anywhere: what
    `LatticeAnalysis` gives.

    `along_y, along_x` (points,): phase of the wave of index 1 along each axis at every point, rad;
    `tall`: indices along y for each one along x; `tolerance`: relative error allowed.

    A. H. Barnett, J. Magland, L. af Klinteberg, "A parallel nonuniform fast Fourier transform
    library based on an 'exponential of semicircle' kernel", SIAM J. Sci. Comput. 41, C479 (2019).
    """

    def __init__(
        self, along_y: FloatArray, along_x: FloatArray, tall: float, tolerance: float
    ) -> None:
        self._places = [
            np.asarray((phase + np.pi) % (2 * np.pi) - np.pi, np.float32)
            for phase in (along_x, along_y)
        ]
        # float32 cannot give what is finer than some of its own steps
        self._tall, self._tolerance = tall, max(tolerance, 10 * float(np.finfo(np.float32).eps))
        self._plans: dict[tuple[int, int, int], finufft.Plan] = {}

    def spectra(
        self, values: NDArray[np.complex64], weights: NDArray[np.complex64], reach: int
    ) -> NDArray[np.complex64]:
        """Analyse ``values * weights[m]`` up to an index along x.

        `values` (points,); `weights` (terms, points). Returns (terms, columns, rows): columns and
        rows in the order of Fourier transforms, first 0 and last -1.
        """
        # whole steps, so that neighbouring frequencies share a plan
        sizes = (
            2 * INDEX_STEP * (int(largest) // INDEX_STEP + 1)
            for largest in (reach + 1, (reach + 1) * self._tall + 1)
        )
        columns, rows = sizes
        spectra: NDArray[np.complex64] = self._get_plan(len(weights), columns, rows).execute(
            values * weights
        )
        return spectra.reshape(len(weights), columns, rows)

    def _get_plan(self, terms: int, columns: int, rows: int) -> finufft.Plan:
        import finufft

        if (terms, columns, rows) not in self._plans:
            options = {
                "isign": -1,
                "dtype": "complex64",
                "nthreads": 1,
                "modeord": 1,
                "upsampfac": UPSAMPLING,
            }
            plan = finufft.Plan(1, (columns, rows), n_trans=terms, eps=self._tolerance, **options)
            plan.setpts(*self._places)
            # Frequencies come in order: only the latest plan will be asked for again.
            self._plans = {(terms, columns, rows): plan}
        return self._plans[terms, columns, rows]
