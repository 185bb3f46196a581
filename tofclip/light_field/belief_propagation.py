"""Labels for pixels, each with its own costs, such that neighbours agree: belief propagation on the
pixel grid.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError, ShapeError

Array = NDArray[Any]

MAX_ITERATIONS = 40
MAX_LABEL_STEP = 3
"""Labels this number of steps apart cost no more: depth may jump at an object's border."""


def find_smooth_labels(
    costs: Array, smoothness: float, iterations: int = MAX_ITERATIONS
) -> NDArray[np.int64]:
    """Choose labels of low total cost: each pixel's own, and `smoothness` times the steps between
    neighbours.

    Damped min-sum belief propagation with a truncated linear price, all pixels at once (P. F.
    Felzenszwalb, D. P. Huttenlocher, Int. J. Comput. Vis. 70, 41, 2006).

    Parameters
    ----------
    costs : (labels, rows, columns) array
    smoothness : float
        Zero or more; zero takes each pixel's cheapest label.
    iterations : int
        Messages travel one pixel in each.

    Returns
    -------
    (rows, columns) array of whole numbers

    Raises
    ------
    ShapeError
        The costs have not three dimensions.
    InputError
        A cost is not finite, or the smoothness is negative.

    Notes
    -----
    Memory is ten times that of `costs` in float32.
    """
    if costs.ndim != 3:
        raise ShapeError("costs", "(labels, rows, columns)", costs.shape)
    if not (np.all(np.isfinite(costs)) and smoothness >= 0):
        raise InputError("costs must be finite and the smoothness zero or more")
    own = costs.astype(np.float32)
    messages = np.zeros((4, *own.shape), np.float32)  # from above, below, left, right
    for _ in range(iterations if smoothness > 0 else 0):
        belief = own + messages.sum(axis=0)
        for towards, back, (pixels, neighbours) in zip(
            range(4), (1, 0, 3, 2), _NEIGHBOUR_SLICES, strict=True
        ):
            # what a pixel passes to a neighbour leaves out what came from that neighbour
            said = _pass_message(belief - messages[back], np.float32(smoothness))
            # half of the step: undamped messages may oscillate
            messages[towards][neighbours] += (said[pixels] - messages[towards][neighbours]) / 2
    chosen: NDArray[np.int64] = (own + messages.sum(axis=0)).argmin(axis=0)
    return chosen


_ALL, _FIRST, _LAST = slice(None), slice(None, -1), slice(1, None)
_NEIGHBOUR_SLICES = (
    ((_ALL, _FIRST, _ALL), (_ALL, _LAST, _ALL)),
    ((_ALL, _LAST, _ALL), (_ALL, _FIRST, _ALL)),
    ((_ALL, _ALL, _FIRST), (_ALL, _ALL, _LAST)),
    ((_ALL, _ALL, _LAST), (_ALL, _ALL, _FIRST)),
)


def _pass_message(costs: Array, price: np.float32) -> Array:
    """Cheapest cost of each label at the neighbour, given the costs here: min over k of costs(k) +
    price(|l - k|).
    """
    cheapest = costs.min(axis=0)
    # truncated: from here on a jump costs the same, however far
    found = np.minimum(costs, cheapest + MAX_LABEL_STEP * price)
    for step in range(1, MAX_LABEL_STEP):
        np.minimum(found[step:], costs[:-step] + step * price, out=found[step:])
        np.minimum(found[:-step], costs[step:] + step * price, out=found[:-step])
    relative: Array = found - cheapest
    return relative
