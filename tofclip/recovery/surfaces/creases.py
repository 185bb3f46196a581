"""Where a patch of frames' returns is several bodies that touch at one range, as a head and a torso, or two leaves:
at valleys and at creases.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.recovery.surfaces.patches import (
    BEND_BINS,
    BENT_FRACTION,
    MIN_PATCH_PX,
    NEIGHBOURS_PX,
    SPLIT_BINS,
    UNBENT_BINS,
    Patch,
    bend_where_needed,
)
from tofclip.recovery.surfaces.shapes import TINY, Pixels

# Misfit in its returns' deviations from which on a patch may be two at a crease (0.67 are expected of a surface's),
# and what is left of it where it is: with as much freedom again a ball alone has 0.5.
CREASE_SIGMAS, CREASE_FRACTION, CREASE_ROUNDS = 0.67, 0.5, 8
# By which a valley between two bodies is farther than either, and of what neighbours scatter.
VALLEY_BINS, VALLEY_SCALES = 2.0, 4.0


def bend_patches(patches: list[Patch], bin_m: float) -> list[Patch]:
    """Bend plain patches where their returns are, and part them at creases; the largest first."""
    bent = (bend_where_needed(patch, bin_m) for patch in patches)
    parts = [part for patch in bent for part in _part_at_creases(patch, bin_m)]
    return sorted(parts, key=lambda part: -part.pixels.size)


def _part_at_creases(patch: Patch, bin_m: float) -> list[Patch]:
    """Return the parts of a patch, bent where needed as they are, where surfaces of their own follow the
    returns of each far better: things that touch at one range, as a ball and the cable on which it hangs,
    or two limbs; else the patch.
    """
    error = patch.compute_error()
    if error < BEND_BINS * bin_m:
        return [patch]
    parts, left = _try_label(patch, _find_valleys(patch, bin_m), bin_m)
    if left >= BENT_FRACTION * error:
        if error < UNBENT_BINS * bin_m or patch.compute_misfit(patch) < CREASE_SIGMAS:
            return [patch]
        tried = [_try_label(patch, label, bin_m) for label in _find_creases(patch, bin_m)]
        parts, left = min(tried, key=lambda one: one[1])
        if left >= CREASE_FRACTION * error:
            return [patch]
    return [part for piece in parts for part in _part_at_creases(piece, bin_m)]


def _try_label(patch: Patch, label: Pixels, bin_m: float) -> tuple[list[Patch], float]:
    """Parts of a patch, bent where needed, by the number that each return has, (n,), and the median distance of
    their returns from them.
    """
    parts = [bend_where_needed(part, bin_m) for part in _take_parts(patch, label)]
    if len(parts) < 2:
        return [patch], np.inf
    distances = [part.compute_distances() for part in parts]
    return parts, float(np.median(np.concatenate(distances)))


def _take_parts(patch: Patch, label: Pixels) -> list[Patch]:
    """The large enough parts of a patch by the number that each return has, (n,)."""
    numbers, sizes = np.unique(label, return_counts=True)
    return [patch.take(label == one) for one in numbers[sizes >= MIN_PATCH_PX]]


def _find_valleys(patch: Patch, bin_m: float) -> Pixels:
    """Number the bodies, (n,), between which valleys are: each bulges towards the camera, and its range rises on
    all sides to where it ends or meets another (watersheds, L. Vincent and P. Soille, IEEE Trans. Pattern
    Anal. Mach. Intell. 13, 583, 1991).
    """
    rough = np.median(np.abs(patch.distance - _average_beside(patch, patch.distance)))
    least = max(VALLEY_BINS * bin_m, VALLEY_SCALES * 1.4826 * float(rough))
    columns = patch.ray_length.shape[1] + 2  # none is beside the next row's
    y, x = np.divmod(patch.pixels, columns - 2)
    places: list[int] = (y * columns + x).tolist()
    beside = [down * columns + right for down in (-1, 0, 1) for right in (-1, 0, 1)]
    owner: dict[int, int] = {}
    joined: list[int] = []  # of each body, itself or the one of which it is a part
    nearest: list[float] = []

    def find(body: int) -> int:
        while joined[body] != body:
            body = joined[body]
        return body

    for index in np.argsort(patch.distance, kind="stable"):
        here, distance = places[index], float(patch.distance[index])
        bodies = {find(owner[here + way]) for way in beside if here + way in owner}
        if not bodies:
            bodies = {len(joined)}
            joined.append(len(joined))
            nearest.append(distance)
        first, *others = sorted(bodies, key=nearest.__getitem__)
        owner[here] = first
        for other in others:
            if distance - nearest[other] < least:
                joined[other] = first
    return np.array([find(owner[here]) for here in places], np.intp)


def _find_creases(patch: Patch, bin_m: float) -> Pixels:
    """Number, 0 and 1, which of two quadratics returns follow, from some first guesses on, (guesses, n)."""
    y, x = np.divmod(patch.pixels, patch.ray_length.shape[1])
    most = SPLIT_BINS * bin_m
    found = (_part_in_two(patch, one > np.median(one), most) for one in (x, y, x + y, x - y))
    return np.array([*found], np.intp)


def _part_in_two(patch: Patch, second: NDArray[np.bool_], most: float) -> NDArray[np.bool_]:
    """Say which returns follow the second of two quadratics better, (n,), with those about them, from a
    first guess on. No return counts for more than `most`, m.
    """
    for _ in range(CREASE_ROUNDS):
        if min(second.sum(), (~second).sum()) < MIN_PATCH_PX:
            break
        fits = (patch.take(own).compute_ranges(patch.pixels) for own in (~second, second))
        off = [
            _average_beside(patch, np.minimum(np.abs(fit - patch.distance), most)) for fit in fits
        ]
        before, second = second, off[1] < off[0]
        if (before == second).all():
            break
    return second


def _average_beside(patch: Patch, values: FloatArray) -> FloatArray:
    """Mean of values of returns, (n,), over those in the pixels about each."""
    pictures = np.zeros((2, *patch.ray_length.shape))
    flat = pictures.reshape(2, -1)
    flat[0, patch.pixels], flat[1, patch.pixels] = values, 1
    beside = (0, NEIGHBOURS_PX, NEIGHBOURS_PX)
    total, count = scipy.ndimage.uniform_filter(pictures, beside, mode="constant")
    return np.asarray((total / np.maximum(count, TINY)).ravel()[patch.pixels])
