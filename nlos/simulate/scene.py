"""Hidden scenes of surfaces that hide one another, lit and seen by way of a wall."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture, TimeAxis
from nlos.simulate.kernels import add_facet_light
from nlos.simulate.surfaces import FloatArray, Surface
from nlos.simulate.walls import compute_wall_normals
from tofclip.errors import InputError
from tofclip.threads import run_blocks
from tofclip.units import SPEED_OF_LIGHT

BIN_OVERSAMPLING = 4
"""Fine bins per time bin: light shared between two of them spreads by less than a tenth of a bin."""

POINTS_PER_BLOCK = 64
RESPONSE_SIGMAS = 5.0
"""Standard deviations at which the instrument's response is cut off."""


@dataclass(frozen=True, eq=False)
class HiddenScene:
    """Surfaces before a relay wall that scatters evenly (Lambert's law).

    A facet of area A and reflectance f returns, by way of laser spot r_L and to wall point r_p, ``A
    * f * cos_L * cos_in * cos_out * cos_p / (d_L * d_p)^2`` after a path of ``d_L + d_p``; the
    cosines are those of the two legs with the wall's and the facet's normals. It returns nothing
    where a triangle stands in either leg. Light that meets several surfaces is left out.

    Costs one evaluation per facet and wall point, and a test of every triangle in each; memory for
    the signals and 64 wall points on fine bins.

    Parameters
    ----------
    surfaces : sequence of Surface
    """

    surfaces: Sequence[Surface]

    def __post_init__(self) -> None:
        if not self.surfaces:
            raise InputError("a hidden scene needs a surface")

    def simulate_capture(self, wall: Any, laser: Any, axis: TimeAxis, jitter: float) -> Capture:
        """Simulate a capture without noise.

        Parameters
        ----------
        wall : (..., 3) array
            Wall points, m; NaN ones stay dark. Normals follow from a wall given in rows and
            columns; else they are +z.
        laser : (3,) or (..., 3) array
            Laser spot, m, or one per wall point. A lone spot gets the normal of the nearest wall
            point.
        axis : TimeAxis
        jitter : float
            Standard deviation of the instrument's Gaussian response, s.

        Returns
        -------
        Capture

        Raises
        ------
        InputError
            The jitter is not positive.
        """
        if not (np.isfinite(jitter) and jitter > 0):
            raise InputError(f"jitter must be a positive number of seconds, got {jitter}")
        wall, laser = np.asarray(wall, dtype=np.float64), np.asarray(laser, dtype=np.float64)
        dark = Capture(
            np.zeros((axis.bins, *wall.shape[:-1])), wall, laser, axis.bin_width, axis.start
        )
        normals = compute_wall_normals(wall)[dark.valid]
        if len(dark.lasers) == 1:
            # the laser spot lies on the wall: it has the normal of the wall point next to it
            nearest = int(np.argmin(np.linalg.norm(dark.points - dark.laser, axis=1)))
            laser_normals = normals[nearest : nearest + 1]
        else:
            laser_normals = normals
        signal = dark.signal.copy()
        signal[:, dark.valid] = self._simulate_traces(
            dark, normals, laser_normals, SPEED_OF_LIGHT * jitter
        ).T
        return Capture(signal, wall, laser, axis.bin_width, axis.start)

    def _simulate_traces(
        self, capture: Capture, normals: FloatArray, laser_normals: FloatArray, sigma: float
    ) -> NDArray[np.float32]:
        """Signals (points, t) of the valid wall points."""
        from scipy.ndimage import gaussian_filter1d

        axis = capture.axis
        fine = axis.spacing / BIN_OVERSAMPLING
        # Room at both ends for light whose response reaches into the record, in whole time bins.
        margin = int(np.ceil(RESPONSE_SIGMAS * sigma / axis.spacing)) + 1
        start = axis.start - margin * axis.spacing - (BIN_OVERSAMPLING - 1) / 2 * fine
        traces = np.empty((len(capture.points), axis.bins), np.float32)

        def process_block(some: slice) -> None:
            bins = np.zeros((some.stop - some.start, (axis.bins + 2 * margin) * BIN_OVERSAMPLING))
            self._add_facet_light(capture, normals, laser_normals, some, (start, fine), bins)
            seen = gaussian_filter1d(
                bins, sigma / fine, axis=1, mode="constant", truncate=RESPONSE_SIGMAS
            )
            # fine bins, blurred by the response, are added up to the record's
            whole = seen.reshape(len(bins), -1, BIN_OVERSAMPLING).sum(axis=2)
            traces[some] = whole[:, margin : margin + axis.bins]

        run_blocks(process_block, len(traces), POINTS_PER_BLOCK)
        return traces

    def _add_facet_light(
        self,
        capture: Capture,
        normals: FloatArray,
        laser_normals: FloatArray,
        some: slice,
        time: tuple[float, float],
        bins: FloatArray,
    ) -> None:
        triangles = np.ascontiguousarray(
            np.concatenate([surface.triangles for surface in self.surfaces])
        )
        own = slice(None) if len(capture.lasers) == 1 else some
        lasers, spots = capture.lasers[own], np.ascontiguousarray(laser_normals[own])
        for surface in self.surfaces:
            material = np.array(
                [surface.material.diffuse, surface.material.retro, surface.material.spread]
            )
            facets = (surface.positions, surface.normals, surface.areas)
            add_facet_light(
                capture.points[some],
                normals[some],
                lasers,
                spots,
                *facets,
                material,
                triangles,
                *time,
                bins,
            )
