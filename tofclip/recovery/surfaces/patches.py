"""Smooth surfaces in the returns of frames: connected patches, and a robust smooth fit to each.

A surface's inverse depth 1/z is a quadratic of the picture's coordinates, which a plane's is exactly,
or where a quadratic does not follow its returns one of the others in `shapes`. Range is ``length /
(1/z)``, with the length of the ray ``(X/f, Y/f, 1)``. A patch is the surface's first estimate: where it
is seen, and its inverse depth over a `SmoothBasis`. Pixels are raster numbers, ranges metres,
`ray_length` is (rows, columns).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.recovery.surfaces.shapes import (
    SPLINE_DEGREE,
    TINY,
    Pixels,
    SmoothBasis,
    fit_quadric,
)
from tofclip.shots import Returns, number_returns

MARGIN_PX = 10  # how far a surface may reach beyond the returns that showed it
NEIGHBOUR_BINS = 1.6  # neighbouring pixels whose ranges differ by less lie on one surface
# Of that: by how much they may differ where the surface is turned as far on either side.
STEEP_STEPS = 4.0
STEEP_EXCESS = 1.5  # of that: two such differences have more noise than one
LEAST_TOUCHING_PX = 5  # of a patch beside another
MIN_PATCH_PX = 25  # fewer returns are not a surface of their own
MIN_BEHIND_FRACTION = 0.25  # of a surface's usual brightness, for it to be seen behind another
NEIGHBOURS_PX, MIN_CROWD = 5, 0.4  # side of a square, and how much of it must see the surface
MIN_DIMMER_PX, MIN_DIMMER_LIGHT = 100, 0.02  # of a surface that is nowhere the brightest
DIMMER_BINS = 0.8  # misfit of its returns
DIMMER_REACH_BINS = 4.0  # nearer to a surface, a return is a part of it
MERGE_BINS = 0.5  # misfit of either of two patches to one surface for both
MERGE_EXCESS = 1.3  # or of their misfit to a surface of their own
# Of the larger's fit at the smaller: further off it is not tried, nor than so many of its own misfits.
MERGE_REACH_BINS, MERGE_REACH_MISFITS = 7.0, 5.0
# Of returns, also in their deviations: further off a patch's surface they may be another's.
SPLIT_BINS, SPLIT_SIGMAS = 4.0, 3.0
# Off the returns, median, lies what was fitted to two surfaces, between them (others up to 2.2); places
# where a plane is tried then, and how far from one returns show it
BETWEEN_BINS, PLANE_TRIALS, PLANE_PX = 3.0, 40, 7
MERGE_SIGMAS = 1.0  # median; 0.67 are expected of returns of the surface
FIT_ITERATIONS, SETTLED_SCALE = 10, 0.003  # at most, until the errors' scale changes by less
FITTED_RETURNS = 2000  # of a patch, evenly chosen: with more a start is no better
RIDGE = 1e-9  # per return: those along a line say nothing about what is across it
CURVATURE_PENALTY = 1e-3  # keeps small patches from bending
FLAT_PENALTY = 1e3  # keeps all from it: a bent one would follow what stands on it
KNOT_SPACING_PX, MAX_PIECES = 12, 8
RETURNS_PER_UNKNOWN = 3.0  # of splines: they share their errors
BEND_BINS = 0.3  # misfit of a quadratic from which on splines are tried
BENT_FRACTION = 0.6  # of a quadratic's misfit: splines are worth their freedom below
UNBENT_BINS = 0.4  # misfit of a bent patch from which on it may be something else
MIN_ROUND_PX = 50  # of a surface of second order in space: any few returns lie on one
EVIDENCE_ROUNDS = 2
SPLINE_START_PENALTY, SPLINE_FLOOR = 1e-5, 1e-9  # per return, before the bending is known
# Of a patch's returns, for it to be a part of its surface alone; returns that are nearer to another's
# surface may be that one's.
GROWTH, APART_BINS = 2.0, 15.0
CORRELATED_PX = 30  # returns of a frame recovery that share their errors, about


@dataclass(frozen=True)
class Patch:
    """Returns that lie on one smooth surface."""

    pixels: Pixels  # (n,)
    distance: FloatArray  # (n,), ranges of the returns there
    deviation: FloatArray  # (n,), theirs
    ray_length: FloatArray  # range over depth of each pixel of the picture
    basis: SmoothBasis
    coefficients: FloatArray  # (size,), inverse depth, 1/m, over the basis

    @classmethod
    def fit(
        cls,
        pixels: Pixels,
        distance: FloatArray,
        deviation: FloatArray,
        ray_length: FloatArray,
        curvature_penalty: float = CURVATURE_PENALTY,
    ) -> Patch:
        """Return the patch of some returns, with a quadratic that is fitted robustly."""
        basis = SmoothBasis((ray_length.shape[0], ray_length.shape[1]))
        penalty = curvature_penalty * pixels.size * np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
        inverse = ray_length.ravel()[pixels] / distance
        coefficients, _ = _fit_robustly(basis.evaluate(pixels), inverse, penalty)
        return cls(pixels, distance, deviation, ray_length, basis, coefficients)

    def compute_ranges(self, pixels: Pixels) -> FloatArray:
        """Return the ranges of the surface at some pixels, (n,)."""
        inverse = self.basis.compute_inverse(self.basis.evaluate(pixels), self.coefficients)
        found: FloatArray = self.ray_length.ravel()[pixels] / inverse
        return found

    def compute_distances(self) -> FloatArray:
        """Return the distances of the returns from their surface, (n,)."""
        return np.asarray(np.abs(self.compute_ranges(self.pixels) - self.distance))

    def find_touching(self, others: Sequence[Patch], apart: float) -> list[int]:
        """Return the numbers of patches with returns beside some of this one, at ranges that differ by less, m."""
        pictures = np.zeros((2, *self.ray_length.shape))
        pictures.reshape(2, -1)[:, self.pixels] = np.ones(self.pixels.size), self.distance
        beside = scipy.ndimage.uniform_filter(pictures, (0, 3, 3), mode="constant").reshape(2, -1)
        found = []
        for number, other in enumerate(others):
            count, total = beside[:, other.pixels]
            near = count > TINY
            off = np.abs(total[near] / count[near] - other.distance[near])
            if np.count_nonzero(off < apart) >= LEAST_TOUCHING_PX:
                found.append(number)
        return found

    def compute_error(self, surface: Patch | None = None) -> float:
        """Median distance of the returns from their surface, or from that of another patch."""
        fitted = (surface or self).compute_ranges(self.pixels)
        return float(np.median(np.abs(fitted - self.distance)))

    def compute_misfit(self, surface: Patch) -> float:
        """The same in the returns' deviations."""
        fitted = surface.compute_ranges(self.pixels)
        return float(np.median(np.abs(fitted - self.distance) / self.deviation))

    def take(self, which: Any, penalty: float = CURVATURE_PENALTY) -> Patch:
        """Return the patch of some of the returns."""
        some = self.pixels[which], self.distance[which], self.deviation[which]
        return Patch.fit(*some, self.ray_length, penalty)


def find_plain_patches(
    pixels: Pixels,
    distance: FloatArray,
    deviation: FloatArray,
    ray_length: FloatArray,
    bin_m: float,
) -> list[Patch]:
    """Find the smooth surfaces in a picture's returns, (n,) each, the largest first, all of them quadratics:
    which returns belong together. A pixel may have several.
    """
    if pixels.size == 0:
        return []
    patches = _split(Patch.fit(pixels, distance, deviation, ray_length), bin_m)
    patches.sort(key=lambda patch: -patch.pixels.size)
    before = len(patches) + 1
    while len(patches) < before:
        before, first = len(patches), 0
        while first < len(patches):
            for second in range(len(patches) - 1, first, -1):
                joint = _merge(patches[first], patches[second], bin_m)
                if joint is not None:
                    patches[first] = joint
                    del patches[second]
            first += 1
    return sorted(patches, key=lambda patch: -patch.pixels.size)


def _split(patch: Patch, bin_m: float) -> list[Patch]:
    """Return the connected parts of returns, and apart from these what touches them but lies on
    another surface: a ball on a table, a book that leans on it.
    """
    found: list[Patch] = []
    tolerance = NEIGHBOUR_BINS * bin_m
    for own in _connect_neighbours(patch.pixels, patch.distance, patch.ray_length.shape, tolerance):
        part, apart = patch.take(own), []
        flat = part.take(slice(None), FLAT_PENALTY)
        far = _measure_distance(part, flat, bin_m) > 1
        if far.sum() >= MIN_DIMMER_PX and not far.all():
            # what splines follow is the rim of a round surface
            whole = bend_where_needed(part, bin_m)
            if whole.compute_error() > BETWEEN_BINS * bin_m:
                far = _measure_distance(part, _find_plane(part, flat, bin_m), bin_m) > 1
            large = [p for p in _split(part.take(far), bin_m) if p.pixels.size >= MIN_DIMMER_PX]
            apart = [one for one in large if _stands_apart(one, whole, bin_m)]
        if apart:
            left = ~np.isin(part.pixels, np.concatenate([one.pixels for one in apart]))
            found += [*apart, *_split(part.take(left), bin_m)]
        else:
            found.append(part)
    return found


def _find_plane(patch: Patch, flat: Patch, bin_m: float) -> Patch:
    """The plane to which a patch's returns are nearest, of that of all, `flat`, and of those that returns
    about single places show: what is fitted to a table and a melon follows neither (MSAC, P. Torr and A.
    Zisserman, Comput. Vis. Image Underst. 78, 138, 2000).
    """
    y, x = np.divmod(patch.pixels, patch.ray_length.shape[1])
    planes = [flat]
    for middle in np.linspace(0, y.size - 1, PLANE_TRIALS).astype(np.intp):
        about = np.maximum(np.abs(y - y[middle]), np.abs(x - x[middle])) <= PLANE_PX
        if about.sum() >= MIN_PATCH_PX:
            on = _measure_distance(patch, patch.take(about, FLAT_PENALTY), bin_m) <= 1
            planes.append(patch.take(on, FLAT_PENALTY))
    off = [np.minimum(_measure_distance(patch, plane, bin_m), 1).sum() for plane in planes]
    return planes[int(np.argmin(off))]


def _measure_distance(patch: Patch, plane: Patch, bin_m: float) -> FloatArray:
    """How far returns are from a plane, (n,), of what a return on it may be."""
    most = np.maximum(SPLIT_BINS * bin_m, SPLIT_SIGMAS * patch.deviation)
    return np.asarray(np.abs(plane.compute_ranges(patch.pixels) - patch.distance) / most)


def _stands_apart(part: Patch, whole: Patch, bin_m: float) -> bool:
    """Whether a part of a patch is better followed by a surface of its own than by that of the whole."""
    followed = part.compute_error(whole)
    if followed <= MERGE_BINS * bin_m:
        return False
    # six numbers that say as much as all of the whole's; what is round takes splines of its own, as any
    # rim of a ball is one of second order
    return (
        part.compute_error() < followed
        or _give_splines(part).compute_error() < BENT_FRACTION * followed
    )


def _connect_neighbours(
    pixels: Pixels, distance: FloatArray, shape: tuple[int, ...], tolerance: float
) -> list[Pixels]:
    """Connected returns, of eight neighbouring pixels each, whose ranges differ by less than a
    tolerance, or by more but as much as on the other side, as on a surface turned far; the largest
    first.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    order, rank = rank_within_pixels(pixels, distance)
    # the nearest returns of all pixels, the second ones and so on; a rim stands for no neighbour
    layers = np.full((int(rank.max()) + 1, shape[0] + 2, shape[1] + 2), -1)
    y, x = np.divmod(pixels[order], shape[1])
    layers[rank, y + 1, x + 1] = order
    links = []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        beside = np.roll(layers, (-down, -right), (1, 2))
        for one, other in itertools.product(layers, beside):
            near = (one >= 0) & (other >= 0)
            near &= np.abs(distance[one] - distance[other]) < tolerance
            links.append(np.stack([one[near], other[near]]))
        before, middle, after = np.roll(layers[0], (down, right), (0, 1)), layers[0], beside[0]
        steep = (before >= 0) & (middle >= 0) & (after >= 0)
        step, next_step = distance[middle] - distance[before], distance[after] - distance[middle]
        steep &= np.abs(step) + np.abs(next_step) < 2 * STEEP_STEPS * tolerance
        steep &= np.abs(next_step - step) < STEEP_EXCESS * tolerance
        links += [np.stack([one[steep], middle[steep]]) for one in (before, after)]
    ends = np.concatenate(links, axis=1)
    graph = coo_array((np.ones(ends.shape[1], np.int8), tuple(ends)), shape=(pixels.size,) * 2)
    _, label = connected_components(graph, directed=False)
    sizes = np.bincount(label)
    largest = np.argsort(-sizes, kind="stable")
    return [np.flatnonzero(label == one) for one in largest[sizes[largest] >= MIN_PATCH_PX]]


def rank_within_pixels(pixels: Pixels, distance: FloatArray) -> tuple[Pixels, Pixels]:
    """Return the order of returns by pixel and range, and the rank of each in its pixel, from 0."""
    order = np.lexsort((distance, pixels))
    return order, number_returns(pixels[order]).astype(np.intp) - 1


def _fit_robustly(
    design: FloatArray, values: FloatArray, penalty: FloatArray
) -> tuple[FloatArray, float]:
    """Coefficients and scale of the errors; outliers are weighted down (Cauchy's weights)."""
    some = slice(None, None, 1 + values.size // FITTED_RETURNS)
    design, penalty, values = design[some], penalty * values[some].size / values.size, values[some]
    weights, coefficients, scale = np.ones(values.size), np.zeros(design.shape[1]), 0.0
    penalty = penalty + RIDGE * values.size * np.eye(design.shape[1])
    for _ in range(FIT_ITERATIONS):
        normal = design.T @ (design * weights[:, np.newaxis]) + penalty * weights.mean()
        coefficients = np.linalg.solve(normal, design.T @ (weights * values))
        error, before = values - design @ coefficients, scale
        scale = max(1.4826 * float(np.median(np.abs(error))), TINY)
        if abs(scale - before) < SETTLED_SCALE * before:
            break
        weights = 1 / (1 + (error / (2 * scale)) ** 2)
    return coefficients, scale


def _merge(large: Patch, small: Patch, bin_m: float) -> Patch | None:
    """Return both as one patch if one surface fits either as well as a surface of its own, or as well
    as returns are known.
    """
    reach = max(MERGE_REACH_BINS * bin_m, MERGE_REACH_MISFITS * large.compute_error())
    if small.compute_error(large) > reach:
        return None
    both = large, small
    pixels = np.concatenate([one.pixels for one in both])
    distance = np.concatenate([one.distance for one in both])
    deviation = np.concatenate([one.deviation for one in both])
    joint = Patch.fit(pixels, distance, deviation, large.ray_length)
    for one in both:
        # in little light returns scatter by more than that about a surface of their own
        least = max(MERGE_BINS * bin_m, MERGE_EXCESS * one.compute_error())
        if one.compute_error(joint) >= least and one.compute_misfit(joint) >= MERGE_SIGMAS:
            return None
    return joint


def bend_where_needed(patch: Patch, bin_m: float) -> Patch:
    """Make a patch a surface of second order in space, or give it splines, whichever follows its
    returns better, where a quadratic does not follow them.
    """
    plain = patch.compute_error()
    if plain < BEND_BINS * bin_m:
        return patch
    tried: list[Patch] = []
    if patch.pixels.size >= MIN_ROUND_PX:
        inverse = patch.ray_length.ravel()[patch.pixels] / patch.distance
        basis, coefficients = fit_quadric(patch.pixels, inverse, patch.basis.image_shape)
        tried = [replace(patch, basis=basis, coefficients=coefficients)]
    # free as splines are, they follow a ball's returns better than the ball, where these are displaced
    if not tried or tried[0].compute_error() >= UNBENT_BINS * bin_m:
        tried = [_give_splines(patch), *tried]
    bent = min(tried, key=Patch.compute_error)
    return bent if bent.compute_error() < BENT_FRACTION * plain else patch


def _give_splines(patch: Patch) -> Patch:
    corners = np.stack(np.divmod(patch.pixels, patch.ray_length.shape[1]))
    start, end = corners.min(axis=1) - MARGIN_PX, corners.max(axis=1) + 1 + MARGIN_PX
    free = int(patch.pixels.size / RETURNS_PER_UNKNOWN)
    spacing = float(KNOT_SPACING_PX)
    while True:
        down, across = np.clip(np.rint((end - start) / spacing), 1, MAX_PIECES).astype(int)
        if (down + SPLINE_DEGREE) * (across + SPLINE_DEGREE) <= free or down == across == 1:
            break
        spacing *= 1.1
    box = (int(start[0]), int(start[1]), int(end[0]), int(end[1]))
    basis = replace(patch.basis, box=box, pieces=(int(down), int(across)))
    design = basis.evaluate(patch.pixels)
    inverse = patch.ray_length.ravel()[patch.pixels] / patch.distance
    # second differences of neighbouring coefficients, along rows and columns
    rows, columns = (np.eye(number + SPLINE_DEGREE) for number in basis.pieces)
    differences = np.concatenate(
        [np.kron(np.diff(rows, 2, axis=0), columns), np.kron(rows, np.diff(columns, 2, axis=0))]
    )
    floor = SPLINE_FLOOR * patch.pixels.size * np.eye(design.shape[1])
    bending = differences.T @ differences
    penalty = floor + SPLINE_START_PENALTY * patch.pixels.size * bending
    for _ in range(EVIDENCE_ROUNDS):
        coefficients, scale = _fit_robustly(design, inverse, penalty)
        # the bending that the fit itself shows is what is known about it (empirical Bayes)
        usual = float(np.mean((differences @ coefficients) ** 2)) + TINY
        penalty = scale**2 * CORRELATED_PX * bending / usual + floor
    return replace(patch, basis=replace(basis, bending=bending / usual), coefficients=coefficients)


def extend_patches(patches: list[Patch], returns: Returns, bin_m: float) -> list[Patch]:
    """Give patches whose returns scatter those beside them that lie on their surfaces as well and on no
    other's, the brightest of their pixels or not, where these are many: of a dim surface that is turned far
    frames may show a corner alone without gaps, and what fits a corner is many bins off elsewhere.
    """
    if not patches:
        return patches
    pixel = returns.y.astype(np.intp) * patches[0].ray_length.shape[1] + returns.x
    near = np.array([np.isin(pixel, patch.pixels) for patch in patches])
    for patch, own in zip(patches, near, strict=True):
        off = returns.range[own] - patch.compute_ranges(pixel[own])
        own[own] = np.abs(off) < APART_BINS * bin_m
    elsewhere = near.sum(axis=0) - near > 0
    distance, deviation = (one.astype(np.float64) for one in (returns.range, returns.confidence))
    return [
        _extend(patch, pixel[free], distance[free], deviation[free], bin_m)
        if patch.compute_error() > MERGE_BINS * bin_m
        else patch
        for patch, free in zip(patches, ~elsewhere, strict=True)
    ]


def _extend(
    patch: Patch, pixels: Pixels, distance: FloatArray, deviation: FloatArray, bin_m: float
) -> Patch:
    size, grown = 0, patch
    while grown.pixels.size > size:
        size, seen = grown.pixels.size, np.zeros(patch.ray_length.shape, bool)
        seen.ravel()[grown.pixels] = True
        beside = scipy.ndimage.binary_dilation(seen, np.ones((NEIGHBOURS_PX,) * 2))
        off = np.abs(distance - grown.compute_ranges(pixels))
        most = max(NEIGHBOUR_BINS * bin_m, SPLIT_SIGMAS * grown.compute_error())
        own = np.flatnonzero(beside.ravel()[pixels] & (off < most))
        own = own[np.argsort(off[own])]
        _, nearest = np.unique(pixels[own], return_index=True)
        own = own[nearest]
        if own.size > size:
            grown = Patch.fit(pixels[own], distance[own], deviation[own], patch.ray_length)
    return patch if size < GROWTH * patch.pixels.size else bend_where_needed(grown, bin_m)


def find_dimmer_patches(
    patches: list[Patch], returns: Returns, ray_length: FloatArray, bin_m: float
) -> list[Patch]:
    """Find surfaces that are nowhere the brightest of their pixels, as gauze before a bright wall,
    beside the patches of the strongest returns. Recoveries make weak returns of their own, here and
    there; those of a surface lie side by side and hold a part of the light.
    """
    pixel = returns.y.astype(np.intp) * ray_length.shape[1] + returns.x
    free = np.ones(pixel.size, bool)
    for patch in patches:
        free &= np.abs(returns.range - patch.compute_ranges(pixel)) > DIMMER_REACH_BINS * bin_m
    pixel, distance, intensity = pixel[free], returns.range[free], returns.intensity[free]
    deviation = returns.confidence[free].astype(np.float64)
    light = MIN_DIMMER_LIGHT * float(returns.intensity.sum())
    found = []
    for plain in find_plain_patches(pixel, distance, deviation, ray_length, bin_m):
        if plain.pixels.size < MIN_DIMMER_PX:
            break
        patch = bend_where_needed(plain, bin_m)
        own = np.isin(pixel, patch.pixels)
        own &= np.abs(distance - patch.compute_ranges(pixel)) < NEIGHBOUR_BINS * bin_m
        here = patch.compute_ranges(patch.pixels)
        apart = [np.median(np.abs(here - one.compute_ranges(patch.pixels))) for one in patches]
        if (
            float(intensity[own].sum()) > light
            # noise far out of a surface's pulse makes no surface of its own
            and patch.compute_error() < DIMMER_BINS * bin_m
            and min(apart, default=np.inf) > DIMMER_REACH_BINS * bin_m
        ):
            found.append(patch)
    return found


def reach_further(patch: Patch, returns: Returns, bin_m: float) -> NDArray[np.bool_]:
    """Return where a patch's surface is seen, (rows, columns), also behind another that is brighter.

    A weaker return of a pixel is often the recovery's own. It counts where it lies on a surface that
    other pixels see alone, nearly as bright as there, and with neighbours that do so as well.
    """
    own = np.zeros(patch.ray_length.shape, bool)
    own.ravel()[patch.pixels] = True
    pixel = returns.y.astype(np.intp) * patch.ray_length.shape[1] + returns.x
    near = np.abs(returns.range - patch.compute_ranges(pixel)) < NEIGHBOUR_BINS * bin_m
    light = returns.intensity[near & own.ravel()[pixel]]
    if not light.size:
        return own
    near &= returns.intensity > MIN_BEHIND_FRACTION * float(np.median(light))
    seen = own.copy()
    seen.ravel()[pixel[near]] = True
    crowded = scipy.ndimage.uniform_filter(seen.astype(np.float32), NEIGHBOURS_PX, mode="nearest")
    found: NDArray[np.bool_] = own | (seen & (crowded > MIN_CROWD))
    return found
