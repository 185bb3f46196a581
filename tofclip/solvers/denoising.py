"""Denoisers that serve as priors, and recovery with one: plug-and-play and regularisation by
denoising.

A denoiser takes a picture, a pilot and the noise to remove, and knows nothing of any camera.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from tofclip.arrays import AnyArray, Array, require_numpy
from tofclip.errors import explain_import, require, require_shape
from tofclip.operators import LinearOperator
from tofclip.solvers.data_terms import DataTerm, DataTermMaker, Mask
from tofclip.solvers.fista import ProximalMethod, TotalVariation
from tofclip.solvers.methods import Method, Progress, Result, ignore_progress
from tofclip.threads import limit_blas_threads

Picture = AnyArray


Denoiser = Callable[[Picture, Picture, float], Picture]
"""Removes even noise of a known standard deviation from a (rows, columns) picture; looks for what is
alike in a pilot, a cleaner estimate of the same picture.
"""


@dataclass(frozen=True)
class NonlocalMeans:
    """Means over patches that look alike (A. Buades, B. Coll, J.-M. Morel, CVPR 2005, 60)."""

    patch_px: int = 5  # side of a patch
    reach_px: int = 10  # how far away patches are looked for, each way
    filtering: float = 0.6  # decay of a patch's say with its distance, over the noise's deviation

    def __call__(self, noisy: Picture, pilot: Picture, deviation: float) -> Picture:
        """Return the picture without its noise, see `Denoiser`; the pilot is not needed."""
        from skimage.restoration import denoise_nl_means

        clean = denoise_nl_means(
            noisy,
            patch_size=self.patch_px,
            patch_distance=self.reach_px,
            h=self.filtering * deviation,
            sigma=deviation,
            fast_mode=True,
        )
        return np.asarray(clean, noisy.dtype)


@dataclass(frozen=True)
class BlockMatching:
    """Block matching and 3D filtering by its authors' package `bm3d`. K. Dabov, A. Foi, V.
    Katkovnik, K. Egiazarian, IEEE Trans. Image Process. 16, 2080 (2007).
    """

    def __call__(self, noisy: Picture, pilot: Picture, deviation: float) -> Picture:
        """Return the picture without its noise, see `Denoiser`; the pilot is not needed."""
        with explain_import(
            "BM3D needs the package bm3d (free for non-commercial use only): pip install 'tofclip[bm3d]'; "
            "without it take the denoiser 'collaborative'"
        ):
            from bm3d import bm3d
        return np.asarray(bm3d(noisy, deviation), noisy.dtype)


@dataclass(frozen=True)
class CollaborativeWiener:
    """Every patch is filtered together with its likes: the second step of non-local Bayes, the
    pilot as its first.

    M. Lebrun, A. Buades, J.-M. Morel, SIAM J. Imaging Sci. 6, 1665 (2013), Eq. 3.6: mean and
    covariance of a group come from the pilot, and ``x = mean + C (C + deviation^2 I)^-1 (y -
    mean)`` is the best linear estimate of each of its patches. In a loop that calls a denoiser
    again and again, the pilot is what the last call returned. About as good as BM3D here and five
    times faster, under our own licence.
    """

    patch_px: int = 6  # side of a patch
    stride_px: int = 3  # distance between the patches that groups are made for
    reach_px: int = 10  # how far away similar patches are looked for, each way
    group: int = 40  # patches in a group

    def __call__(self, noisy: Picture, pilot: Picture, deviation: float) -> Picture:
        """Return the picture without its noise."""
        from tofclip.solvers.denoiser_kernels import filter_patch_groups

        require_shape("the pilot picture", noisy.shape, pilot.shape)
        require(
            min(noisy.shape) >= self.patch_px,
            f"a picture of {noisy.shape} is smaller than a patch of {self.patch_px} px",
        )
        settings = (self.patch_px, self.stride_px, self.reach_px, self.group)
        pictures = (np.ascontiguousarray(one, np.float32) for one in (noisy, pilot))
        clean = filter_patch_groups(*pictures, np.float32(deviation), settings)
        return np.asarray(clean, noisy.dtype)


# Stands for the brightest pixel: a single hot one must not set the scale.
PEAK_QUANTILE = 0.999


@dataclass(frozen=True)
class PlugAndPlay(Method):
    """Half-quadratic splitting with a denoiser in the place of the prior's proximal map.

    ``x = argmin data(A h) + coupling / 2 |h - z|^2``, then ``z = denoise(x)``, a number of `calls` of the
    `denoiser`, from the result of `start` onwards, which gives the data term and is total variation by
    default; z is returned. S. Venkatakrishnan, C. Bouman, B. Wohlberg, GlobalSIP 2013, 945. No objective
    falls: the number of calls is what stops it. `strength` is the deviation that is removed, relative to
    the start's brightest pixel, `coupling` relative to the largest eigenvalue of A'A: the defaults were
    found on light fields whose model error (what is out of focus) is far larger than their noise; on
    those, strengths from 0.08 to 0.12 and couplings from 0.1 to 0.3 differ by a tenth of the error.
    """

    start: ProximalMethod = field(default_factory=TotalVariation)
    denoiser: Denoiser = field(default_factory=CollaborativeWiener)
    calls: int = 8
    strength: float = 0.12
    coupling: float = 0.1
    name = "plug-and-play"
    _returns_fitted = False

    def __post_init__(self) -> None:
        require(self.calls >= 1, f"at least one call of the denoiser is needed, got {self.calls}")
        require(
            self.strength > 0 and self.coupling > 0,
            "strength and coupling of a denoiser must be positive",
        )

    def recover(
        self,
        operator: LinearOperator,
        measurements: Array,
        valid: Mask = None,
        progress: Progress = ignore_progress,
    ) -> Result:
        require_numpy("recovery with a denoiser", measurements)
        started = self.start.recover(operator, measurements, valid, progress)
        coupling = self.coupling * operator.squared_norm
        frames = np.empty_like(started.frames)
        with limit_blas_threads():  # the products of small groups of patches are too small to share
            for number, picture in enumerate(started.frames):
                column = slice(number, number + 1)
                kept = None if valid is None else valid[:, column]
                seen = measurements[:, column].astype(operator.dtype, copy=False)
                misfit = self.start.data_term(seen, kept)
                frames[number] = self._alternate(operator, misfit, picture, coupling)
                progress(self.calls)
        return replace(
            started,
            frames=frames,
            stop_reason=f"{self.calls} calls of the denoiser done",
        )

    def _alternate(
        self, operator: LinearOperator, misfit: DataTerm, picture: Array, coupling: float
    ) -> Array:
        deviation = self.strength * float(np.quantile(picture, PEAK_QUANTILE))
        if deviation <= 0:
            return picture
        fitted = clean = picture
        for _ in range(self.calls):
            fitted = np.maximum(solve_data_step(operator, misfit, clean, coupling), 0)
            clean = np.maximum(self.denoiser(fitted, clean, deviation), 0)
        return fitted if self._returns_fitted else clean

    def work(self, frames: int) -> int:
        return self.start.work(frames) + frames * self.calls

    @property
    def has_prior(self) -> bool:
        return True

    def with_data_term(self, data_term: DataTermMaker) -> Self:
        return replace(self, start=self.start.with_data_term(data_term))

    def scale_weight(self, factor: float) -> Self:
        return replace(self, start=self.start.scale_weight(factor))


@dataclass(frozen=True)
class RegularisationByDenoising(PlugAndPlay):
    """The fixed point of ``A'(A h - f) + coupling (h - denoise(h)) = 0``.

    Y. Romano, M. Elad, P. Milanfar, SIAM J. Imaging Sci. 10, 1804 (2017), its fixed-point
    iteration: what plug-and-play does, but the picture that meets the data is the answer, not the
    denoised one.
    """

    strength: float = 0.08
    coupling: float = 0.3
    name = "regularisation by denoising"
    _returns_fitted = True


def solve_data_step(
    operator: LinearOperator,
    misfit: DataTerm,
    anchor: AnyArray,
    coupling: float,
    iterations: int = 10,
) -> AnyArray:
    """Minimise ``misfit(A h) + coupling / 2 |h - anchor|^2`` near `anchor`, for a misfit of a single
    frame, by conjugate gradients; ten leave 1 % of the first gradient at the couplings in use.

    The misfit's weights are those at `anchor` (one pass of iteratively reweighted least squares).
    """
    predicted = operator(anchor)[:, np.newaxis]
    weights = misfit.weights(predicted)[:, 0]

    solution = anchor.copy()
    residual = -operator.adjoint(misfit.gradient(predicted)[:, 0])
    direction = residual.copy()
    energy = float(np.vdot(residual, residual))
    for _ in range(iterations):
        if energy == 0:
            break
        step = operator.adjoint(weights * operator(direction)) + coupling * direction
        # a Python number keeps float32 arrays float32
        length = energy / float(np.vdot(direction, step))
        solution += length * direction
        residual -= length * step
        before, energy = energy, float(np.vdot(residual, residual))
        direction = residual + energy / before * direction
    return solution
