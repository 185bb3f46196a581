"""Which view gets which line: dealing the lines of a line camera to its views."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError


def count_of_lines(image_shape: tuple[int, int], detector_px: int, sampling_ratio: float) -> int:
    """Return how many line detectors make up the sampling ratio, refusing none."""
    count = round(sampling_ratio * image_shape[0] * image_shape[1] / detector_px)
    if count < 1:
        raise InputError(f"a sampling ratio of {sampling_ratio} gives no view a projection; take a larger one")
    return count


def dealt_at_random(
    directions: NDArray[np.float64], views: int, random: np.random.Generator
) -> tuple[tuple[int, ...], list[NDArray[np.float64]]]:
    """Permute the directions and deal them one by one to the views in random order (supplement Note 6).

    Parameters
    ----------
    directions : (lines,) array
    views : int
        If there are fewer directions than views, some views get none.
    random : numpy Generator

    Returns
    -------
    used : tuple of int
        Numbers of the views that get any.
    directions : list of arrays
        Each used view's own.
    """
    shuffled = random.permutation(directions)
    owners = np.resize(random.permutation(views), directions.size)
    used = tuple(int(view) for view in np.unique(owners))
    return used, [shuffled[owners == view] for view in used]
