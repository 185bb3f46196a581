"""Of which bodies a patch may consist, as a head and a torso, or two leaves that touch at one range. All are of second
order, and each grows from a few points on as far as returns are near it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.recovery.surfaces.patches import (
    BEND_BINS,
    CORRELATED_PX,
    MIN_PATCH_PX,
    NEIGHBOURS_PX,
    SPLIT_BINS,
    Patch,
    bend_where_needed,
)
from tofclip.recovery.surfaces.shapes import ROUND_COEFFICIENTS, TINY, guess_quadric

# What is left of the distances of returns, for them to be of other bodies if the shot says so; and for frames' returns
# to be without more ado: persons, leaves and letters have 0.1 to 0.33, balls and melons, whose returns are displaced,
# 0.335 to 0.7.
NEARER, SURELY_NEARER = 0.75, 1 / 3
ALL_NOISE = 0.67  # median distance of returns from their surface, in their deviations: a wall's in little light
# How many bodies are begun at most, or one in each square of `NEIGHBOURS_PX`; how near returns have to be, with those
# beside them, that a body grows over; how far a body may reach over others; and how often.
SEEDS, GROWN_BINS, BESIDE_PX, REACH_PX, ROUNDS = 50, 2.0, 3, 3, 8
HALVED_PX = 1000  # patches of no more are halved

Box = tuple[slice, slice]  # rows and columns


def bend_patches(patches: Sequence[Patch], bin_m: float) -> list[Patch]:
    """Bend plain patches where their returns are, or as the bodies of which they consist where no one surface follows
    these; the largest first.
    """
    bent = [one for patch in patches for one in _bend(patch, bin_m)]
    return sorted(bent, key=lambda one: -one.pixels.size)


def _bend(patch: Patch, bin_m: float) -> list[Patch]:
    bent = bend_where_needed(patch, bin_m)
    if bent.compute_error() < BEND_BINS * bin_m or _is_noise(bent):
        return [bent]
    # what is algebraically nearest is off where frames' returns at a limb are too near
    parts = [part.take(slice(None)) for part in find_bodies([patch], bin_m)]
    parts = [bend_where_needed(part, bin_m) for part in parts]
    left = [distance for part in parts for distance in part.compute_distances()]
    sure = len(parts) > 1 and np.median(left) < SURELY_NEARER * bent.compute_error()
    return parts if sure else [bent]


def _is_noise(patch: Patch) -> bool:
    """Whether returns are no farther from their surface than their deviations say, as surely as so many tell."""
    unsure = np.sqrt(CORRELATED_PX / patch.pixels.size)
    return bool((1 + unsure) * patch.compute_misfit(patch) < ALL_NOISE)


def find_bodies(patches: Sequence[Patch], bin_m: float) -> list[Patch]:
    """Return the bodies of which patches may consist together, of which one may be one surface of second order, or
    none if these are not nearer to the returns: the largest that grows, then the largest of what it leaves, and so
    on; at last each return goes to the body that is nearest. What grew may be several bodies itself.
    """
    whole = _join_returns(patches)
    error = _measure_error(patches if len(patches) > 1 else [_make_round(whole, bin_m)], bin_m)
    if error < BEND_BINS * bin_m or whole.pixels.size < 2 * MIN_PATCH_PX:
        return []
    parts = _take(whole, _Area(whole, bin_m).grow_bodies(), bin_m)
    if len(parts) < 2 or _measure_error(parts, bin_m) >= NEARER * error:
        return []
    return [one for part in parts for one in find_bodies([part], bin_m) or [part]]


def find_halves(patch: Patch, bin_m: float) -> list[Patch]:
    """Return the two bodies of which a small patch may consist, or none: each begins with a half of it. There is no
    room for any to grow from its middle in the top of a cup.
    """
    if not 2 * MIN_PATCH_PX <= patch.pixels.size <= HALVED_PX:
        return []
    whole = _make_round(patch.take(slice(None)), bin_m)
    error = _measure_error([whole], bin_m)
    if error < BEND_BINS * bin_m:
        return []
    tried = [_take(whole, own, bin_m) for own in _Area(whole, bin_m).halve()]
    parts = max(tried, key=lambda one: _measure_size(one, bin_m))
    return parts if len(parts) > 1 and _measure_error(parts, bin_m) < NEARER * error else []


def _join_returns(patches: Sequence[Patch]) -> Patch:
    """Return the patch that some are together, the nearest return of each pixel."""
    pixels, distance, deviation = (
        np.concatenate([getattr(one, name) for one in patches])
        for name in ("pixels", "distance", "deviation")
    )
    order = np.argsort(distance, kind="stable")
    _, first = np.unique(pixels[order], return_index=True)
    own = order[first]
    return Patch.fit(pixels[own], distance[own], deviation[own], patches[0].ray_length)


def _take(whole: Patch, bodies: Sequence[NDArray[np.bool_]], bin_m: float) -> list[Patch]:
    return [_make_round(whole.take(own), bin_m) for own in bodies]


def _make_round(patch: Patch, bin_m: float) -> Patch:
    """A patch with a surface of second order if its returns need it and are nearer to that."""
    if _measure_error([patch], bin_m) < BEND_BINS * bin_m:
        return patch
    inverse = patch.ray_length.ravel()[patch.pixels] / patch.distance
    basis, coefficients = guess_quadric(patch.pixels, inverse, patch.basis.image_shape)
    curved = replace(patch, basis=basis, coefficients=coefficients)
    return min(patch, curved, key=lambda one: _measure_error([one], bin_m))


def _measure_error(patches: Sequence[Patch], bin_m: float) -> float:
    """Mean distance of returns from the surfaces of their patches; none counts for more than a few bins."""
    distances = np.concatenate([patch.compute_distances() for patch in patches])
    return float(np.mean(np.minimum(distances, SPLIT_BINS * bin_m)))


def _measure_size(patches: Sequence[Patch], bin_m: float) -> float:
    """How many returns patches have, the less the farther they are off."""
    number = sum(patch.pixels.size for patch in patches)
    return number * (1 - _measure_error(patches, bin_m) / (SPLIT_BINS * bin_m)) if number else 0


class _Area:
    """The returns of a patch as they lie beside each other. Bodies are pictures of which returns are theirs."""

    def __init__(self, patch: Patch, bin_m: float) -> None:
        self.patch, self.bin_m = patch, bin_m
        row, column = np.divmod(patch.pixels, patch.ray_length.shape[1])
        self.place = row - row.min(), column - column.min()
        self.free = np.zeros([int(one.max()) + 1 for one in self.place], bool)
        self.free[self.place] = True
        self.pixel = np.zeros(self.free.shape, np.intp)
        self.pixel[self.place] = patch.pixels
        self.distance, self.ray_length = np.ones((2, *self.free.shape))
        self.distance[self.place] = patch.distance
        self.ray_length[self.place] = patch.ray_length[row, column]
        self.side = max(NEIGHBOURS_PX, round(float(np.sqrt(row.size / SEEDS))))

    def grow_bodies(self) -> list[NDArray[np.bool_]]:
        """Say which returns are of which body that grows, (n,) each."""
        return self._settle(self._grow_bodies())

    def halve(self) -> Iterator[list[NDArray[np.bool_]]]:
        """Yield what becomes of some pairs of halves, (n,) each."""
        middle = [float(one.mean()) for one in self.place]
        down, right = np.indices(self.free.shape) - np.reshape(middle, (2, 1, 1))
        for way in ((1, 0), (0, 1), (1, 1), (1, -1)):
            half = way[0] * down + way[1] * right > 0
            halves = self.free & half, self.free & ~half
            # of a level wire one may be nothing
            yield self._settle([one for one in halves if np.count_nonzero(one) >= MIN_PATCH_PX])

    def _grow_bodies(self) -> list[NDArray[np.bool_]]:
        """Bodies, the largest first, none of which has returns of another."""
        free, bodies = self.free.copy(), list[NDArray[np.bool_]]()
        seeds = np.argwhere(free[:: self.side, :: self.side]) * self.side
        grown = dict[tuple[int, ...], tuple[NDArray[np.bool_], float]]()
        while True:
            # what grows from deep within another body is mostly that one
            left = free.copy()
            for own, _ in grown.values():
                left &= _reach(self.free & ~own, self.side - 1)
            for seed in map(tuple, seeds):
                if left[seed] and seed not in grown:
                    grown[seed] = self._grow(seed, free)
                    left &= _reach(self.free & ~grown[seed][0], self.side - 1)
            best, size = max(grown.values(), key=lambda one: one[1], default=(free, 0.0))
            if not size:
                return bodies
            bodies.append(best)
            free &= ~best
            grown = {seed: one for seed, one in grown.items() if not (one[0] & best).any()}

    def _grow(
        self, seed: tuple[int, ...], free: NDArray[np.bool_]
    ) -> tuple[NDArray[np.bool_], float]:
        """What grows from the returns about one, and its size: how many it has, the less the farther off they are."""
        down, right = np.ogrid[: free.shape[0], : free.shape[1]]
        own = free & (np.hypot(down - seed[0], right - seed[1]) <= self.side)
        size, most, nothing = 0.0, GROWN_BINS * self.bin_m, np.zeros_like(free)
        for _ in range(ROUNDS):
            if not free[seed] or np.count_nonzero(own) <= ROUND_COEFFICIENTS:
                return nothing, 0.0
            about = _find_box(own, self.side)
            off, before = self._measure_off(own, about), own[about]
            piece, _ = scipy.ndimage.label(free[about] & (off < most), np.ones((3, 3)))
            counts = np.bincount(piece[before], minlength=2)[1:]
            if not counts.any():
                return nothing, 0.0
            after = _reach(before, self.side - 1) & (piece == 1 + np.argmax(counts))
            size = float(np.sum(1 - off[after] / most))
            own = np.zeros_like(free)
            own[about] = after
            if (after == before).all():
                break
        return (own, size) if np.count_nonzero(own) >= MIN_PATCH_PX else (nothing, 0.0)

    def _settle(self, bodies: list[NDArray[np.bool_]]) -> list[NDArray[np.bool_]]:
        """Give each return near bodies to the one that is nearest, until none changes."""
        for _ in range(ROUNDS if bodies else 0):
            off = np.full((len(bodies), *self.free.shape), np.inf)
            for own, far in zip(bodies, off, strict=True):
                about = _find_box(own, REACH_PX + BESIDE_PX)
                near = _reach(own[about], REACH_PX) & self.free[about]
                far[about] = np.where(near, self._measure_off(own, about), np.inf)
            nearest = np.where(np.isfinite(off).any(axis=0), off.argmin(axis=0), -1)
            before = bodies
            bodies = [_find_largest(nearest == number) for number in range(len(bodies))]
            if all((one == other).all() for one, other in zip(before, bodies, strict=True)):
                break
            bodies = [own for own in bodies if np.count_nonzero(own) >= MIN_PATCH_PX]
            if not bodies:
                break
        return [own[self.place] for own in bodies]

    def _measure_off(self, own: NDArray[np.bool_], about: Box) -> FloatArray:
        """How far the returns of a box, and those beside them, are off the surface of some, m; none counts for more
        than a few bins.
        """
        inverse = self.ray_length[own] / self.distance[own]
        basis, found = guess_quadric(self.pixel[own], inverse, self.patch.basis.image_shape)
        seen, off = self.free[about], np.zeros(self.free[about].shape)
        inverse = basis.compute_inverse(basis.evaluate(self.pixel[about][seen]), found)
        away = self.ray_length[about][seen] / np.maximum(inverse, TINY)
        away = np.abs(away - self.distance[about][seen])
        off[seen] = np.minimum(away, SPLIT_BINS * self.bin_m)
        mean = partial(scipy.ndimage.uniform_filter, size=BESIDE_PX, mode="constant")
        return np.asarray(mean(off) / np.maximum(mean(seen.astype(np.float64)), TINY))


def _find_largest(own: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The largest of the connected pieces of which some consist."""
    piece, _ = scipy.ndimage.label(own, np.ones((3, 3)))
    return np.asarray(piece == 1 + np.argmax(np.bincount(piece.ravel(), minlength=2)[1:]))


def _find_box(own: NDArray[np.bool_], far: int) -> Box:
    """The rows and columns about some, and as many more px."""
    (box,) = scipy.ndimage.find_objects(own.astype(np.int8))
    down, right = (slice(max(one.start - far, 0), one.stop + far) for one in box)
    return down, right


def _reach(own: NDArray[np.bool_], far: int) -> NDArray[np.bool_]:
    """What is that near to some, along rows and columns, px."""
    return np.asarray(scipy.ndimage.maximum_filter(own, 2 * far + 1))
