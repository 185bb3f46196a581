"""Total variation of a whole light field: over the pictures' pixels and from view to view.

A wavelet prior that no position of the wavelets' grid distinguishes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofclip.arrays import Array
from tofclip.errors import InputError, ShapeError
from tofclip.solvers.fista import ProximalMethod, ProximalStep, Regulariser, validate_weight


class NonnegativeLightFieldVariation:
    """``weight * TV(h)`` for h >= 0 over (v, u, y, x), the angular differences counted `angular`
    times.

    Isotropic: the length of the four differences at each sample. The dual is kept from call to
    call, as in `NonnegativeTotalVariation`; one sweep a call. Memory: four duals and two
    temporaries of the light field's size.

    `weight`: in the unit of ``A'f``; `grid`: views down and across; the views come row by row;
    `angular`: 0: every view on its own.
    """

    zero_bound = 0.0

    def __init__(self, weight: float, grid: tuple[int, int], angular: float) -> None:
        if not (np.isfinite(angular) and angular >= 0):
            raise InputError(f"the angular weight must be finite and not negative, got {angular}")
        self.weight, self.grid, self.angular = validate_weight(weight), grid, angular
        self._dual: Array | None = None

    def proximal_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: Array
    ) -> ProximalStep:
        """Take a proximal gradient step on a block of light fields; see `Regulariser`.

        `current, previous` (views, rows, columns, lanes): the last two solutions; `previous` is
        overwritten with the result; `momentum` (lanes,); `gradient` (views, rows, columns, lanes):
        overwritten; `step` (lanes,): the same for all: they keep their size, as no distance is
        returned. Returns its penalty is weight times total variation.
        """
        from tofclip.solvers import kernels

        views, rows, columns, lanes = current.shape
        if views != self.grid[0] * self.grid[1]:
            raise ShapeError("the light field's views", self.grid[0] * self.grid[1], views)
        flat = (views * rows, columns, lanes)
        pair = (a.reshape(flat) for a in (current, previous))
        size = current.dtype.type(step[0])
        kernels.take_gradient_step(*pair, momentum, gradient.reshape(flat), size)
        shape = (*self.grid, rows, columns, lanes)
        if self._dual is None:
            self._dual = np.zeros((4, *shape), current.dtype)
        noisy, result = gradient.reshape(shape), previous.reshape(shape)
        weight, angular = current.dtype.type(size * self.weight), current.dtype.type(self.angular)
        if weight > 0:
            kernels.compute_light_field_primal(noisy, self._dual, weight, angular, result)
            kernels.update_light_field_dual(
                # 8 bounds the squared norm of the four-fold gradient for angular = 0 (Chambolle
                # 2004); angular differences add at most 8 angular^2
                result,
                self._dual,
                1 / (8 * weight * (1 + angular * angular)),
                angular,
            )
        total = np.zeros(lanes)
        kernels.compute_light_field_primal(noisy, self._dual, weight, angular, result)
        kernels.sum_light_field_variation(result, angular, total)
        return ProximalStep(previous, self.weight * total)

    def scale_dual(self, pull: Array) -> None:
        """Not known."""


@dataclass(frozen=True)
class LightFieldVariation(ProximalMethod):
    """Nonnegative light fields with sharp borders, their views alike (4D total variation;
    supplement Eq. 20).
    """

    weight: float = 1e-2
    iterations: int = 200
    grid: tuple[int, int] = (1, 1)  # views down and across
    # how much a difference between neighbouring views counts beside one between neighbouring
    # pixels. Views differ by their parallax: 0.5 suits disparities of about a pixel, more suits
    # less
    angular: float = 0.5
    name = "light-field tv"

    def _make_regulariser(self, weight: float) -> Regulariser:
        return NonnegativeLightFieldVariation(weight, self.grid, self.angular)


SHIFT_COUNT = 4
"""Grid positions that are averaged over."""


class NonnegativeWavelets:
    """``weight * |W h|_1`` over the details of a wavelet transform, averaged over shifts, for h >=
    0.

    Cycle spinning (R. Coifman, D. Donoho, 1995): the picture is shifted, its details are shrunk, it
    is shifted back, and the results are averaged. The average of proximal maps is the proximal map
    of the penalties' proximal average (Y. Yu, NIPS 2013), so with shifts that stay the same the
    solver's objective still falls. The approximation is not shrunk. One instance belongs to one
    block.

    `weight`: in the unit of ``A'f``; `wavelet`: name in PyWavelets; `seed`: of the shifts.
    """

    zero_bound = 0.0

    def __init__(self, weight: float, wavelet: str = "db4", seed: int = 0) -> None:
        self.weight = validate_weight(weight)
        self.wavelet = wavelet
        # The same shifts in every iteration: new ones would be another penalty each time, and the
        # objective could rise.
        self._shifts = np.random.default_rng(seed).integers(0, 64, (SHIFT_COUNT, 2))

    def proximal_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: Array
    ) -> ProximalStep:
        """Shrink the wavelet details at `SHIFT_COUNT` shifts and average; see `Regulariser`.

        `current` (rows, columns, lanes); `previous` (rows, columns, lanes): overwritten with the
        result; `momentum` (lanes,); `gradient` (rows, columns, lanes): overwritten; `step`
        (lanes,): the same for all: they keep their size, as no distance is returned. Returns
        `previous`, and the weight times its details' l1 norm, averaged over the shifts.
        """
        from tofclip.solvers.kernels import take_gradient_step

        size = current.dtype.type(step[0])
        take_gradient_step(current, previous, momentum, gradient, size)
        # Not needed any more after the gradient step; it gathers the average over the shifts.
        previous[:] = 0
        penalty = np.zeros(current.shape[-1])
        for shift in self._shifts:
            shifted = np.roll(gradient, shift, (0, 1))
            shrunk, total = self._shrink_details(shifted, float(size) * self.weight)
            previous += np.roll(shrunk, -shift, (0, 1))
            penalty += total
        previous /= SHIFT_COUNT
        np.maximum(previous, 0, out=previous)
        return ProximalStep(previous, self.weight * penalty / SHIFT_COUNT)

    def scale_dual(self, pull: Array) -> None:
        """Not known."""

    def _shrink_details(self, picture: Array, threshold: float) -> tuple[Array, Array]:
        """Shrink the details; return the picture and the sum of its details' sizes for each frame."""
        import pywt

        # Periodic borders keep the transform orthogonal, so that shrinking is the exact proximal
        # map.
        grid = {"wavelet": self.wavelet, "mode": "periodization", "axes": (0, 1)}
        coefficients = pywt.wavedec2(picture, level=_count_levels(picture), **grid)
        total = np.zeros(picture.shape[-1])
        kept = [coefficients[0]]
        for details in coefficients[1:]:
            soft = tuple(
                pywt.threshold(band, threshold, "soft").astype(picture.dtype) for band in details
            )
            total += sum(np.abs(band).sum(axis=(0, 1), dtype=np.float64) for band in soft)
            kept.append(soft)
        rows, columns = picture.shape[:2]
        # An odd side comes back one pixel longer.
        return pywt.waverec2(kept, **grid)[:rows, :columns], total


def _count_levels(picture: Array) -> int:
    """As deep as the approximation still has a dozen pixels a side."""
    return max(1, int(np.log2(min(picture.shape[:2]) / 12)))
