"""Hidden points that scatter evenly, the simplest scene, whose image is known exactly; and photon
noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nlos.capture import Capture, TimeAxis
from tofclip.arrays import FloatArray, require_numpy
from tofclip.errors import InputError, ShapeError
from tofclip.units import SPEED_OF_LIGHT


def add_poisson_noise(
    capture: Capture, peak_counts: float, background: float = 0.0, seed: int = 0
) -> Capture:
    """Draw Poisson counts.

    Parameters
    ----------
    capture : Capture
        Expected signal, not negative; its largest measurement maps to `peak_counts`.
    peak_counts : float
        Expected counts in the brightest bin, without background.
    background : float
        Expected counts of background, added to every bin.
    seed : int
        Of the random numbers; recorded in the provenance.

    Returns
    -------
    Capture
        Counts.

    Raises
    ------
    InputError
        The peak is not positive, the background negative, or the signal negative or dark.
    """
    if not (
        np.isfinite(peak_counts) and peak_counts > 0 and np.isfinite(background) and background >= 0
    ):
        raise InputError(
            f"counts need a positive peak and a background of 0 or more, got {peak_counts}, {background}"
        )
    require_numpy("drawing photons", capture.signal)
    brightest = float(capture.signal.max())
    if brightest <= 0 or float(capture.signal.min()) < 0:
        raise InputError(
            "photons can only be drawn from a signal that is nowhere negative and not all dark"
        )
    expected = capture.signal * (peak_counts / brightest) + background
    signal = np.random.default_rng(seed).poisson(expected).astype(np.float32)
    noise = {"peak_counts": peak_counts, "background": background, "seed": seed}
    return replace(capture, signal=signal, provenance={**capture.provenance, "noise": noise})


@dataclass(frozen=True, eq=False)
class PointScene:
    """Hidden points that scatter evenly in all directions, see each other not, and hide nothing.

    A point of albedo a, at distance d_L from the laser spot and d_p from wall point p, returns ``a
    / (d_L * d_p)^2`` after a path of ``d_L + d_p``. No grid of voxels takes part, so the simulation
    shares nothing with a method that images it.

    Parameters
    ----------
    positions : (n, 3) array
        m.
    albedo : (n,) array, optional
        Defaults to 1.
    """

    positions: FloatArray
    albedo: FloatArray | None = None

    def __post_init__(self) -> None:
        positions = np.atleast_2d(np.asarray(self.positions, dtype=np.float64))
        albedo = (
            np.ones(len(positions))
            if self.albedo is None
            else np.asarray(self.albedo, dtype=np.float64)
        )
        if positions.ndim != 2 or positions.shape[1] != 3:
            raise ShapeError("positions of hidden points", "(n, 3)", positions.shape)
        if albedo.shape != (len(positions),):
            raise ShapeError("albedo", (len(positions),), albedo.shape)
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "albedo", albedo)

    def simulate_capture(self, wall: Any, laser: Any, axis: TimeAxis, jitter: float) -> Capture:
        """Simulate a capture without noise.

        Parameters
        ----------
        wall : (..., 3) array
            Wall points, m; where one is NaN, its signal is 0.
        laser : (3,) or (..., 3) array
            Laser spot, m, or one per wall point.
        axis : TimeAxis
        jitter : float
            Standard deviation of the instrument's Gaussian response, s; its integral over every
            time bin is exact.

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
        signal = np.zeros((axis.bins, *wall.shape[:-1]))
        for position, albedo in zip(self.positions, np.asarray(self.albedo), strict=True):
            outward = np.linalg.norm(laser - position, axis=-1)
            back = np.linalg.norm(wall - position, axis=-1)
            brightness = albedo / (outward * back) ** 2
            signal += brightness * _integrate_gaussian(
                axis, outward + back, SPEED_OF_LIGHT * jitter
            )
        return Capture(np.nan_to_num(signal), wall, laser, axis.bin_width, axis.start)


def _integrate_gaussian(axis: TimeAxis, path: FloatArray, sigma: float) -> FloatArray:
    """Share of a unit Gaussian about `path` (...) in every bin, shape (t, ...); bin i is centred on
    its path.
    """
    from scipy.special import ndtr

    edges = axis.start + axis.spacing * (np.arange(axis.bins + 1) - 0.5)
    below: FloatArray = ndtr((edges.reshape(-1, *[1] * path.ndim) - path) / sigma)
    return np.diff(below, axis=0)
