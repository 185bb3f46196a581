"""Ranges point by point, of what the functions of a surface do not follow: two leaves that were taken for one,
the rim of a ball.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.recovery.surfaces.amplitudes import (
    AmplitudeSolver,
    explain_by_amplitude,
    scale_amplitude,
)
from tofclip.recovery.surfaces.model import SurfaceModel
from tofclip.recovery.surfaces.pulse import TINY, Image
from tofclip.recovery.surfaces.ranges import MOVED_FREE_ITERATIONS, delay_light

# Of local shifts: the side of the square that moves together, and the least that is known of one.
LOCAL_PX, LEAST_INFORMATION = 5, 1.0
# Of a surface's error at a place, what the light that is left there shows: neighbours' amplitudes take
# the rest. Medians over ten kinds of bent surfaces of known range are 0.13 to 0.75.
SHIFT_SHOWN = 1 / 3
# By how much of it an amplitude may be off where a range is, and iterations of conjugate gradients.
LOCAL_FADE, LOCAL_ITERATIONS = 0.5, 10


def measure_local_shifts(model: SurfaceModel, amplitude: Image, rest: Image) -> FloatArray:
    """Return by how much the light of each point and of those about it arrives later, (points,), m,
    root mean square, than on its surface: what the surface's functions do not follow, as at the rim of
    a ball. A pulse's width is the most that a shift of light shows.

    Noise and what else the model does not explain is another in each view, a range is the same in all:
    products of different views' shifts are on average the shift's square, whatever the misfit's size.
    """
    apart, moved = delay_light(model), amplitude * np.float32(1 / model.row_m)
    pull = np.array(apart.gather_views(model.weights * rest)) * moved
    known = np.array(apart.gather_views(model.weights * apart.render(moved))) * moved
    most, shifts = (model.pulse.sigma * model.row_m) ** 2, np.zeros(amplitude.size)
    for part, mask in zip(model.parts, model.masks, strict=True):
        pictures = np.zeros((2, len(pull), *mask.shape))
        pictures[:, :, mask] = pull[:, part], known[:, part]
        sums = LOCAL_PX**2 * scipy.ndimage.uniform_filter(
            pictures, LOCAL_PX, mode="constant", axes=(2, 3)
        )
        products, sure = (one.sum(0) ** 2 - (one**2).sum(0) for one in sums[:, :, mask])
        sure = np.maximum(sure, LEAST_INFORMATION)
        squares = sums[0][:, mask] ** 2
        noise = 2 * (squares.sum(0) ** 2 - (squares**2).sum(0))  # of products, if there is no shift
        # what all of the surface shows, and of what a place shows beyond it as much as is no noise
        # (empirical Bayes)
        total = max(float(sure.sum()), LEAST_INFORMATION)
        usual = max(float(products.sum()) / total, 0.0)
        usual += LOCAL_PX * float(np.sqrt(noise.sum())) / total
        beyond = products - usual * sure
        spread = max(np.sum(beyond**2 - noise), 0.0)
        own = usual + spread * sure * beyond / (spread * sure**2 + noise * np.sum(sure**2) + TINY)
        shifts[part] = np.sqrt(np.clip(own, 0, most))
    return shifts


def follow_local_shifts(
    solver: AmplitudeSolver, rest: Image, variance: Image, shifts: FloatArray
) -> FloatArray:
    """Return by how much farther each point is than on its surface, (points,), m, as the light that is left of
    a shot, `rest`, shows: with ranges of LOCAL_PX pixels that move together, usually by `shifts`, (points,), m, and
    with amplitudes, the shot is explained best (the mean of a Gaussian process). `variance`: of
    `AmplitudeSolver.estimate_local_variance`.
    """
    model, light = solver.model, solver.amplitude
    apart, moved = delay_light(model), light * np.float32(1 / model.row_m)
    weights = model.weights / variance
    usual, fade = shifts.astype(np.float32), np.float32(LOCAL_FADE) * light
    mean = partial(scipy.ndimage.uniform_filter, size=LOCAL_PX, mode="constant")

    def spread(values: Image) -> Image:
        return LOCAL_PX * solver.map_pictures(mean, values)

    def pull(image: Image) -> NDArray[np.float32]:
        seen = weights * image
        return np.concatenate(
            [usual * spread(moved * apart.gather(seen)), fade * model.gather(seen)]
        )

    def multiply(unknown: NDArray[np.float32]) -> NDArray[np.float32]:
        away, brighter = np.split(unknown.astype(np.float32), 2)
        image = apart.render(moved * spread(usual * away)) + model.render(fade * brighter)
        return unknown + pull(image)

    product = scipy.sparse.linalg.LinearOperator((2 * light.size,) * 2, multiply, dtype=np.float32)
    # what the prior took from amplitudes is not late
    scale = scale_amplitude(model, light > 0)
    _, late = explain_by_amplitude(model, rest, scale, MOVED_FREE_ITERATIONS)
    found, _ = scipy.sparse.linalg.cg(product, pull(late), maxiter=LOCAL_ITERATIONS)
    return np.asarray(spread(usual * found[: light.size]))
