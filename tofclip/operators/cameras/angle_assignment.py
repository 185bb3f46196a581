"""Which view gets which line: dealing the lines of a line camera to its views."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError
from tofclip.operators.shear import View

CORRELATION_LENGTH_PX = 12
"""Neighbours on a line detector whose errors are alike: what is out of focus is some ten pixels
wide.

A weight chosen by leaving out this number together comes nearer to the best one than by leaving out
single pixels, which their neighbours betray, or whole lines, which nothing else measures (letters
at SR 1 and 0.5: 1.6 and 3.0 % NMSE with angles assigned evenly, against 4.0 and 4.0 % from whole
lines).
"""

AngleAssignment = tuple[tuple[int, ...], list[NDArray[np.float64]]]
"""Numbers of the views that get any directions, and each one's own."""


def count_lines(image_shape: tuple[int, int], detector_px: int, sampling_ratio: float) -> int:
    """Return how many line detectors make up the sampling ratio.

    Parameters
    ----------
    image_shape : (int, int)
        Rows and columns of a view's picture.
    detector_px : int
        Pixels of one line detector.
    sampling_ratio : float
        Measurements over pixels of one picture.

    Returns
    -------
    int
        At least 1.

    Raises
    ------
    InputError
        The ratio is too small for a single line.
    """
    count = round(sampling_ratio * image_shape[0] * image_shape[1] / detector_px)
    if count < 1:
        raise InputError(
            f"a sampling ratio of {sampling_ratio} gives no view a projection; take a larger one"
        )
    return count


def assign_randomly(
    directions: NDArray[np.float64], views: int, random: np.random.Generator
) -> AngleAssignment:
    """Permute the directions and deal them one by one to the views in random order (supplement Note
    6).

    Parameters
    ----------
    directions : (lines,) array
    views : int
        If there are fewer directions than views, some views get none.
    random : numpy Generator

    Returns
    -------
    Deal
    """
    shuffled = random.permutation(directions)
    return _group_by_view(shuffled, np.resize(random.permutation(views), directions.size))


def assign_evenly(
    directions: NDArray[np.float64], views: Sequence[View], cycle: int, random: np.random.Generator
) -> AngleAssignment:
    """Deal so that neighbouring directions look from places spread evenly over the aperture.

    A surface out of focus moves along a detector of direction a by its own fraction of ``t = u
    cos(a) + v sin(a)``. In the picture that refocusing makes it is blurred over all t; a detector
    sees it at one. Where neighbouring directions, which measure much the same, have values of t
    that together stand for all of them, the surface is blurred as it should be instead of being
    torn into streaks. So the views are ranked by t for each direction, and each direction gets the
    one nearest to its place in a cycle of places spread evenly, alternately on either side of the
    middle; no view gets two directions more than another. Which views that are is an assignment
    problem.

    Parameters
    ----------
    directions : (lines,) array
        Ascending, rad.
    views : sequence of (float, float)
        (v, u) of every view.
    cycle : int
        Neighbouring directions that together stand for the aperture, a power of two from 2 on.
    random : numpy Generator
        Of where the cycle starts and of the order of views with the same t.

    Returns
    -------
    Deal
    """
    from scipy.optimize import linear_sum_assignment

    v, u = np.asarray(views, dtype=np.float64).T[:, :, np.newaxis]
    across = u * np.cos(directions) + v * np.sin(directions)
    # views on one line across a direction are ranked by chance, not by their order
    tie_break = 1e-6 * random.random(across.shape)
    # rank of every view along every direction, from 0 to 1
    place = (np.argsort(np.argsort(across + tie_break, axis=0), axis=0) + 0.5) / len(views)
    wanted = np.resize(
        np.roll(_antithetic_positions(cycle), random.integers(cycle)), directions.size
    )
    # each view may own several lines, but none more than its share
    copies = -(-directions.size // len(views))
    # the assignment with the least sum of squared distances from the places wanted
    taken, direction = linear_sum_assignment(np.repeat((place - wanted) ** 2, copies, axis=0))
    owners = np.empty(directions.size, np.intp)
    owners[direction] = taken // copies
    return _group_by_view(directions, owners)


def _antithetic_positions(count: int) -> NDArray[np.float64]:
    """Places spread evenly from 0 to 1, each followed by its mirror image, such as 1/8, 7/8, 3/8,
    5/8.
    """
    nearer = np.zeros(1)
    while 2 * nearer.size < count:  # van der Corput's sequence from 0 to 1/2
        nearer = np.concatenate([nearer, nearer + 0.25 / nearer.size])
    nearer += 0.5 / count
    # each place is followed by its mirror image, so that every pair is balanced
    return np.stack([nearer, 1 - nearer], axis=1).ravel()


def _group_by_view(directions: NDArray[np.float64], owners: NDArray[np.intp]) -> AngleAssignment:
    used = tuple(int(view) for view in np.unique(owners))
    return used, [directions[owners == view] for view in used]
