"""The solvers' inner loops with the functions of the array API standard: for CuPy, PyTorch and
whatever follows it.
"""

from __future__ import annotations

from tofclip.arrays import Array, namespace, zeros


class PortableLoops:
    """Loops on arrays of any library, each a few passes through memory, for many frames at once;
    see `Loops`.
    """

    def prox_l1(
        self,
        current: Array,
        previous: Array,
        momentum: Array,
        gradient: Array,
        step: float,
        threshold: float,
    ) -> tuple[Array, Array]:
        """Leave all arrays but `gradient` as they are."""
        xp = namespace(current)
        noisy = self.gradient_step(current, previous, momentum, gradient, step)
        noisy -= threshold
        result = xp.clip(noisy, min=0.0)
        pixels = tuple(range(result.ndim - 1))
        return result, xp.sum(result, axis=pixels, dtype=xp.float64)

    def gradient_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: float
    ) -> Array:
        """Leave all arrays but `gradient` as they are."""
        gradient *= -step
        gradient += current
        gradient += momentum * (current - previous)
        return gradient

    def prox_tv(
        self, noisy: Array, dual: Array | None, weight: float, sweeps: int, result: Array
    ) -> tuple[Array, Array, Array]:
        """Leave all arrays as they are."""
        xp = namespace(noisy)
        if dual is None:
            dual = zeros((2, *noisy.shape), noisy)
        if weight > 0:
            for _ in range(sweeps):
                dual = _project_to_unit_ball(
                    dual + _forward_differences(_primal_block(noisy, dual, weight)) / (8 * weight)
                )
        result = _primal_block(noisy, dual, weight)
        length = xp.sqrt(xp.sum(_forward_differences(result) ** 2, axis=0))
        return result, xp.sum(length, axis=(0, 1), dtype=xp.float64), dual

    def sum_squares(self, values: Array) -> Array:
        """Square and add."""
        xp = namespace(values)
        return xp.sum(values * values, axis=0, dtype=xp.float64)

    def restore_frames(self, values: Array, before: Array, rejected: Array) -> Array:
        """Choose frame by frame, without asking the device whether there is anything to do."""
        return namespace(values).where(rejected, before, values)


def _primal_block(noisy: Array, dual: Array, weight: float) -> Array:
    """Return ``max(noisy + weight * div(dual), 0)``.

    The last row of the vertical and the last column of the horizontal dual are always zero (the
    difference across the border is), and take the place of what comes before the first.
    """
    xp = namespace(noisy)
    down, across = dual[0, ...], dual[1, ...]
    divergence = down - xp.roll(down, 1, axis=0)
    divergence += across
    divergence -= xp.roll(across, 1, axis=1)
    divergence *= weight
    divergence += noisy
    return xp.clip(divergence, min=0.0)


def _forward_differences(picture: Array) -> Array:
    """Return the differences to the next row and column, (2, rows, columns, frames); 0 across the
    border.
    """
    xp = namespace(picture)
    below = xp.concat([picture[1:, ...], picture[-1:, ...]], axis=0)
    right = xp.concat([picture[:, 1:, ...], picture[:, -1:, ...]], axis=1)
    return xp.stack([below, right]) - picture


def _project_to_unit_ball(dual: Array) -> Array:
    """Return `dual` projected onto vectors of length at most 1."""
    xp = namespace(dual)
    length = xp.sqrt(xp.sum(dual * dual, axis=0))
    return dual / xp.clip(length, min=1.0)
