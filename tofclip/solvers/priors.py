"""Priors R(h) on a block of pictures, each with its proximal gradient step.

A step begins at the extrapolated point ``z = current + momentum * (current - previous)`` and leads to
``prox_{step R}(z - step * gradient)``, `gradient` being the data term's at z. Pictures are (rows,
columns, lanes), a light field's (views, rows, columns, lanes); what each frame has for itself is
(lanes,). NumPy's arrays take the compiled loops, which overwrite `previous` with the result; those of
other libraries a few passes with the functions of the array API standard. Nothing waits for a device.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from tofclip.arrays import Array, clip_values, is_numpy, namespace, zeros
from tofclip.errors import require, require_shape

TINY = 1e-300


class ProximalStep(NamedTuple):
    """A proximal gradient step and what is known about it, frame by frame: the `picture` (rows,
    columns, lanes); its `penalty` R (lanes,), float64; and the squared `distance` (lanes,),
    float64, from the point that the step began at, without which steps keep their size.
    """

    picture: Array
    penalty: Array
    distance: Array | None = None


class Regulariser(ABC):
    """A penalty R(h) whose proximal map is known, on a block of pictures; 0 where h is. Its `weight` is
    in the unit of ``A'f``.

    Attributes
    ----------
    zero_bound : float
        A frame is zero where A'f (the data term's negative gradient at zero) nowhere exceeds this.
    """

    zero_bound = 0.0

    def __init__(self, weight: float) -> None:
        require(
            np.isfinite(weight) and weight >= 0,
            f"a regularisation weight must be finite and not negative, got {weight}",
        )
        self.weight = float(weight)

    @abstractmethod
    def proximal_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: Array
    ) -> ProximalStep:
        """Return ``prox_{step R}(z - step * gradient)``, a proximal gradient step. The last two
        solutions, `current` and `previous`, and the data term's `gradient` at z are (rows, columns,
        lanes), `momentum` and `step`, of the pictures' dtype, (lanes,). `previous` and `gradient`
        may be overwritten, and the result lie in the former.
        """

    def scale_dual(self, pull: Array) -> Array | None:
        """Return by how much each frame's dual point must shrink to be feasible, (lanes,) float64,
        or None where that is not known; `pull` is the negative gradient of the data term, (rows,
        columns, lanes).
        """
        return None


def _repeat_lanes(pixels: int, *numbers: Array) -> tuple[Array, ...]:
    """Numbers that a lane has for itself, for every one of some pixels: a compiled loop over a row has
    one index then, and is vectorised.
    """
    # np.tile takes longer than the loop itself where there is a single picture
    return tuple(np.repeat(one[np.newaxis], pixels, axis=0).ravel() for one in numbers)


def _sum_lanes(row: Array, lanes: int) -> Array:
    """Add up what belongs to the same lane, float64."""
    return row.reshape(-1, lanes).sum(axis=0, dtype=np.float64)


class NonnegativeSparsity(Regulariser):
    """``weight * sum(h)`` for h >= 0, infinite otherwise: the l1 norm of a nonnegative picture."""

    def __init__(self, weight: float) -> None:
        super().__init__(weight)
        self.zero_bound = self.weight

    def proximal_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: Array
    ) -> ProximalStep:
        if is_numpy(current):
            from tofclip.solvers.kernels import STRETCH_NUMBERS, shrink_nonnegative

            scaled = step * step.dtype.type(self.weight)
            own = _repeat_lanes(max(STRETCH_NUMBERS // step.size, 1), momentum, step, scaled)
            total, distance = np.zeros((2, own[0].size))
            shrink_nonnegative(
                *(pictures.reshape(-1) for pictures in (current, previous, gradient)),
                *own,
                np.zeros((3, own[0].size), current.dtype),
                total,
                distance,
            )
            total, distance = (_sum_lanes(row, step.size) for row in (total, distance))
            return ProximalStep(previous, self.weight * total, distance)
        xp = namespace(current)
        # In place as far as possible: on a GPU memory is what limits the size of a block.
        point = current + momentum * (current - previous)
        gradient += self.weight
        gradient *= -step
        gradient += point
        picture = xp.clip(gradient, min=0.0)
        pixels = tuple(range(picture.ndim - 1))
        total = xp.sum(picture, axis=pixels, dtype=xp.float64)
        point -= picture
        distance = xp.sum(point * point, axis=pixels, dtype=xp.float64)
        return ProximalStep(picture, self.weight * total, distance)

    def scale_dual(self, pull: Array) -> Array:
        """Return what makes ``A' dual`` nowhere greater than the weight."""
        xp = namespace(pull)
        steepest = xp.max(pull, axis=tuple(range(pull.ndim - 1)))
        steepest = clip_values(xp.astype(steepest, xp.float64), TINY)
        return clip_values(self.weight / steepest, highest=1.0)


class NonnegativeTotalVariation(Regulariser):
    """``weight * TV(h)`` for h >= 0, infinite otherwise; TV is the isotropic total variation of
    each frame.

    The proximal map has no closed form: each call does one sweep of projected gradient on the dual of
    ``1/2 |x - noisy|^2 + step * weight * TV(x), x >= 0`` (A. Chambolle, J. Math. Imaging Vis. 20, 89
    (2004)). The dual is kept from one call to the next (warm start), so that a single sweep follows
    the solver's own convergence: on the clip scene's shot one sweep ends 1.4 % above the objective of
    ten after 60 iterations and 0.4 % after 200, and the time of further sweeps is better spent on
    further iterations. One instance therefore belongs to one block. Steps keep their size: an inexact
    proximal map after a longer step is refused, or not, by the rounding of the last digits, and
    pictures of two devices would differ by a percent.
    """

    def __init__(self, weight: float) -> None:
        super().__init__(weight)
        self._dual: Array | None = None

    def proximal_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: Array
    ) -> ProximalStep:
        if self._dual is None:
            self._dual = zeros((2, *current.shape), current)
        if is_numpy(current):
            from tofclip.solvers.kernels import descend_total_variation

            rows, columns, lanes = current.shape
            flat = rows, columns * lanes
            scaled = step * step.dtype.type(self.weight)
            # the squared norm of the gradient is at most 8 (Chambolle 2004)
            sweep = np.divide(1, 8 * scaled, out=np.zeros_like(scaled), where=scaled > 0)
            momentum, step, scaled, sweep = _repeat_lanes(columns, momentum, step, scaled, sweep)
            total = np.zeros(flat[1], current.dtype)
            descend_total_variation(
                lanes,
                current.reshape(flat),
                previous.reshape(flat),
                momentum,
                gradient.reshape(flat),
                step,
                scaled,
                self._dual.reshape(2, *flat),
                sweep,
                np.zeros((4, flat[1]), current.dtype),
                total,
            )
            return ProximalStep(previous, self.weight * _sum_lanes(total, lanes))
        xp = namespace(current)
        gradient *= -step
        gradient += current + momentum * (current - previous)
        scaled = step * self.weight
        if self.weight > 0:
            slope = _forward_differences(_primal_block(gradient, self._dual, scaled))
            dual = self._dual + slope / (8 * scaled)
            # projected onto vectors of length at most 1
            length = xp.sqrt(xp.sum(dual * dual, axis=0))
            self._dual = dual / xp.clip(length, min=1.0)
        picture = _primal_block(gradient, self._dual, scaled)
        length = xp.sqrt(xp.sum(_forward_differences(picture) ** 2, axis=0))
        total = xp.sum(length, axis=(0, 1), dtype=xp.float64)
        return ProximalStep(picture, self.weight * total)


def _primal_block(noisy: Array, dual: Array, weight: Array) -> Array:
    """Return ``max(noisy + weight * div(dual), 0)``, for any library's arrays."""
    xp = namespace(noisy)
    down, across = dual[0, ...], dual[1, ...]
    # What roll brings round from the far border is zero there, as the last difference is.
    divergence = down - xp.roll(down, 1, axis=0)
    divergence += across
    divergence -= xp.roll(across, 1, axis=1)
    divergence *= weight
    divergence += noisy
    return xp.clip(divergence, min=0.0)


def _forward_differences(picture: Array) -> Array:
    """Differences to the next row and column, (2, rows, columns, frames); 0 across the border."""
    xp = namespace(picture)
    below = xp.concat([picture[1:, ...], picture[-1:, ...]], axis=0)
    right = xp.concat([picture[:, 1:, ...], picture[:, -1:, ...]], axis=1)
    return xp.stack([below, right]) - picture


class NonnegativeLightFieldVariation(Regulariser):
    """``weight * TV(h)`` for h >= 0 over (v, u, y, x), the angular differences counted `angular`
    times; 0 leaves every view on its own.

    Isotropic: the length of the four differences at each sample. The dual is kept from call to call,
    one sweep a call, as in `NonnegativeTotalVariation`. Memory: four duals and two temporaries of the
    light field's size. `grid` has the views down and across; the views come row by row.
    """

    def __init__(self, weight: float, grid: tuple[int, int], angular: float) -> None:
        super().__init__(weight)
        require(
            np.isfinite(angular) and angular >= 0,
            f"the angular weight must be finite and not negative, got {angular}",
        )
        self.grid, self.angular = grid, angular
        self._dual: Array | None = None

    def proximal_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: Array
    ) -> ProximalStep:
        """As `Regulariser.proximal_step`, of one size for all lanes."""
        from tofclip.solvers import kernels

        views, rows, columns, lanes = current.shape
        require_shape("the light field's views", (self.grid[0] * self.grid[1],), (views,))
        _descend(current, previous, momentum, gradient, step)
        number = current.dtype.type
        weight, angular = number(step[0] * self.weight), number(self.angular)
        shape = (*self.grid, rows, columns * lanes)
        if self._dual is None:
            self._dual = np.zeros((4, *shape), current.dtype)
        noisy, result = gradient.reshape(shape), previous.reshape(shape)
        room, total = np.zeros((2, shape[-1]), current.dtype), np.zeros(shape[-1])
        if weight > 0:
            kernels.compute_light_field_primal(
                lanes, noisy, self._dual, weight, angular, room, result
            )
            # 8 bounds the squared norm of the four-fold gradient for angular = 0 (Chambolle 2004);
            # angular differences add at most 8 angular^2
            sweep = number(1 / (8 * weight * (1 + angular * angular)))
            kernels.update_light_field_dual(lanes, result, self._dual, sweep, angular, room[0])
        kernels.compute_light_field_primal(lanes, noisy, self._dual, weight, angular, room, result)
        kernels.sum_light_field_variation(lanes, result, angular, room[0], total)
        return ProximalStep(previous, self.weight * _sum_lanes(total, lanes))


def _descend(
    current: Array, previous: Array, momentum: Array, gradient: Array, step: Array
) -> None:
    """``gradient = z - step * gradient``, for NumPy's arrays of any number of axes."""
    from tofclip.solvers.kernels import take_gradient_step

    columns, lanes = current.shape[-2:]
    flat = (-1, columns * lanes)
    take_gradient_step(
        *(pictures.reshape(flat) for pictures in (current, previous)),
        *_repeat_lanes(columns, momentum, step),
        gradient.reshape(flat),
    )


WAVELET = "db4"  # by PyWavelets' name
SHIFT_COUNT = 4  # grid positions that are averaged over


class NonnegativeWavelets(Regulariser):
    """``weight * |W h|_1`` over the details of a wavelet transform, averaged over shifts, for h >= 0.

    Cycle spinning (R. Coifman, D. Donoho, 1995): the picture is shifted, its details are shrunk, it
    is shifted back, and the results are averaged. The average of proximal maps is the proximal map
    of the penalties' proximal average (Y. Yu, NIPS 2013), so with shifts that stay the same the
    solver's objective still falls. The approximation is not shrunk.
    """

    def __init__(self, weight: float) -> None:
        super().__init__(weight)
        # The same shifts in every iteration: new ones would be another penalty each time, and the
        # objective could rise.
        self._shifts = np.random.default_rng(0).integers(0, 64, (SHIFT_COUNT, 2))

    def proximal_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: Array
    ) -> ProximalStep:
        """As `Regulariser.proximal_step`, of one size for all lanes."""
        _descend(current, previous, momentum, gradient, step)
        previous[:] = 0
        penalty = np.zeros(current.shape[-1])
        for shift in self._shifts:
            shifted = np.roll(gradient, shift, (0, 1))
            shrunk, total = self._shrink_details(shifted, float(step[0]) * self.weight)
            previous += np.roll(shrunk, -shift, (0, 1))
            penalty += total
        previous /= SHIFT_COUNT
        np.maximum(previous, 0, out=previous)
        return ProximalStep(previous, self.weight * penalty / SHIFT_COUNT)

    def _shrink_details(self, picture: Array, threshold: float) -> tuple[Array, Array]:
        """Shrink the details; return the picture and the sum of its details' sizes for each frame."""
        import pywt

        rows, columns = picture.shape[:2]
        # As deep as the approximation still has a dozen pixels a side. Periodic borders keep the
        # transform orthogonal, so that shrinking is the exact proximal map.
        levels = max(1, int(np.log2(min(rows, columns) / 12)))
        grid = {"wavelet": WAVELET, "mode": "periodization", "axes": (0, 1)}
        approximation, *details = pywt.wavedec2(picture, level=levels, **grid)
        soft = [
            tuple(pywt.threshold(band, threshold, "soft").astype(picture.dtype) for band in bands)
            for bands in details
        ]
        total = sum(
            np.abs(band).sum(axis=(0, 1), dtype=np.float64) for bands in soft for band in bands
        )
        # An odd side comes back one pixel longer.
        return pywt.waverec2([approximation, *soft], **grid)[:rows, :columns], total
