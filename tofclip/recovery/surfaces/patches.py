"""Smooth functions over the picture, of which the inverse depths of surfaces are sums.

A surface's inverse depth 1/z is a quadratic of the picture's coordinates, which a plane's is exactly,
or a spline where a quadratic does not follow its returns. Range is ``length / (1/z)``, with the length
of the ray ``(X/f, Y/f, 1)``.

Smooth surfaces in the returns of frames: connected patches, and a robust smooth fit to each.

A patch is the surface's first estimate: where it is seen, and its inverse depth over a `SmoothBasis`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.shots import Returns

FloatArray = NDArray[np.float64]
Pixels = NDArray[np.intp]

COEFFICIENTS = 6  # of a quadratic
SPLINE_DEGREE = 3


@dataclass(frozen=True)
class SmoothBasis:
    """Smooth functions over the picture, of which a surface's inverse depth is a sum."""

    image_shape: tuple[int, int]
    # first row and column, and those after the last, over which splines run
    box: tuple[int, int, int, int] = (0, 0, 0, 0)
    # of the splines along rows and columns; without any it is the six monomials of a quadratic
    pieces: tuple[int, int] = (0, 0)
    # (n, n), half of ``c' bending c`` is added to the objective: what is known of coefficients c
    # without the shot. By default nothing is
    bending: FloatArray = field(default_factory=lambda: np.zeros((COEFFICIENTS, COEFFICIENTS)))

    @property
    def is_quadratic(self) -> bool:
        """Whether the functions are the monomials of a quadratic, and not splines."""
        return self.pieces == (0, 0)

    def evaluate(self, pixels: Pixels) -> FloatArray:
        """Return the functions' values at raster numbers, (pixels, n)."""
        if self.is_quadratic:
            return evaluate_monomials(pixels, self.image_shape)
        y, x = np.divmod(pixels, self.image_shape[1])
        top, left, bottom, right = self.box
        down = _evaluate_splines((y - top + 0.5) / (bottom - top), self.pieces[0])
        across = _evaluate_splines((x - left + 0.5) / (right - left), self.pieces[1])
        return (down[:, :, np.newaxis] * across[:, np.newaxis]).reshape(pixels.size, -1)

    def split_quadratic(self) -> tuple[FloatArray, FloatArray]:
        """Return the coefficients of the six monomials over this basis, (n, 6), and what of each
        function is such a quadratic, (6, n), both as least squares over the splines' box.
        """
        if self.is_quadratic:
            return np.eye(COEFFICIENTS), np.eye(COEFFICIENTS)
        top, left, bottom, right = self.box
        y, x = np.mgrid[top:bottom, left:right].reshape(2, -1)
        pixels = y * self.image_shape[1] + x
        inside = (x >= 0) & (x < self.image_shape[1]) & (y >= 0) & (y < self.image_shape[0])
        functions, monomials = (
            evaluate(pixels[inside])
            for evaluate in (self.evaluate, lambda one: evaluate_monomials(one, self.image_shape))
        )
        coefficients, *_ = np.linalg.lstsq(functions, monomials)
        quadratic, *_ = np.linalg.lstsq(monomials, functions)
        return coefficients.astype(np.float64), quadratic.astype(np.float64)


def _evaluate_splines(place: FloatArray, pieces: int) -> FloatArray:
    """Uniform cubic B-splines over 0..1, (points, pieces + 3); beyond the ends as at the ends."""
    from scipy.interpolate import BSpline

    knots = np.arange(-SPLINE_DEGREE, pieces + SPLINE_DEGREE + 1) / pieces
    inside = np.clip(place, 0.0, 1 - 1e-9)
    found: FloatArray = BSpline.design_matrix(inside, knots, SPLINE_DEGREE).toarray()
    return found


def make_second_differences(pieces: tuple[int, int]) -> FloatArray:
    """Return the matrix of second differences of neighbouring coefficients, along rows and columns."""
    rows, columns = (number + SPLINE_DEGREE for number in pieces)
    down, across = (np.diff(np.eye(number), 2, axis=0) for number in (rows, columns))
    return np.concatenate([np.kron(down, np.eye(columns)), np.kron(np.eye(rows), across)])


def evaluate_monomials(pixels: Pixels, image_shape: tuple[int, int]) -> FloatArray:
    """Return 1, x, y, x^2, xy and y^2 of pixels, (n, 6), in halves of the picture from its middle.

    `pixels` (n,): raster numbers.
    """
    rows, columns = image_shape
    y, x = np.divmod(pixels, columns)
    down, right = 2 * y / rows - 1, 2 * x / columns - 1
    return np.stack([np.ones_like(x), right, down, right**2, right * down, down**2], axis=-1)


MARGIN_PX = 10  # how far a surface may reach beyond the returns that showed it
NEIGHBOUR_BINS = 1.6  # neighbouring pixels whose ranges differ by less lie on one surface
# Of that: by how much they may differ where the surface is turned as far on either side.
STEEP_STEPS = 4.0
STEEP_EXCESS = 1.5  # of that: two such differences have more noise than one
MIN_PATCH_PX = 25  # fewer returns are not a surface of their own
MIN_BEHIND_FRACTION = 0.25  # of a surface's usual brightness, for it to be seen behind another
NEIGHBOURS_PX, MIN_CROWD = 5, 0.4  # side of a square, and how much of it must see the surface
MIN_DIMMER_PX, MIN_DIMMER_LIGHT = 100, 0.02  # of a surface that is nowhere the brightest
DIMMER_BINS = 0.8  # misfit of its returns
DIMMER_REACH_BINS = 4.0  # nearer to a surface, a return is a part of it
MERGE_BINS = 0.5  # misfit of either of two patches to one surface for both
MERGE_EXCESS = 1.3  # or of their misfit to a surface of their own
MERGE_REACH_BINS = 7.0  # of the larger's fit at the smaller: further off it is not tried
FIT_ITERATIONS = 10
RIDGE = 1e-9  # per return
CURVATURE_PENALTY = 1e-3  # keeps small patches from bending
KNOT_SPACING_PX = 12
MAX_PIECES = 8
BEND_BINS = 0.3  # misfit of a quadratic from which on splines are tried
BENT_FRACTION = 0.6  # of a quadratic's misfit: splines are worth their freedom below
EVIDENCE_ROUNDS = 2
SPLINE_START_PENALTY, SPLINE_FLOOR = 1e-5, 1e-9  # per return, before the bending is known
CORRELATED_PX = 30  # returns of a frame recovery that share their errors, about


@dataclass(frozen=True)
class Patch:
    """Returns that lie on one smooth surface."""

    pixels: Pixels  # (n,), raster numbers
    distance: FloatArray  # (n,), ranges of the returns there, m
    basis: SmoothBasis
    coefficients: FloatArray  # (size,), inverse depth, 1/m, over the basis

    def compute_ranges(
        self, pixels: Pixels, ray_length: FloatArray, coefficients: FloatArray | None = None
    ) -> FloatArray:
        """Return the ranges of the surface at some pixels, (n,), m.

        `pixels` (n,): raster numbers; `ray_length` (rows, columns): range over depth of each pixel;
        `coefficients` (size,): of another surface over the same basis.
        """
        chosen = self.coefficients if coefficients is None else coefficients
        found: FloatArray = ray_length.ravel()[pixels] / (self.basis.evaluate(pixels) @ chosen)
        return found


def find_patches(
    pixels: Pixels, distance: FloatArray, ray_length: FloatArray, bin_m: float
) -> list[Patch]:
    """Find the smooth surfaces in a picture's returns, the largest first.

    `pixels` (n,): raster number of each return; a pixel may have several; `distance` (n,): their
    ranges, m; `ray_length` (rows, columns): range over depth of each pixel; `bin_m`: range of a
    bin, m.
    """
    patches = [
        _fit_quadratic(pixels[own], distance[own], ray_length)
        for own in _connect_neighbours(pixels, distance, ray_length.shape, NEIGHBOUR_BINS * bin_m)
    ]
    while _merge_some(patches, ray_length, bin_m):
        pass
    patches.sort(key=lambda patch: -patch.pixels.size)
    return [_bend_where_needed(patch, ray_length, bin_m) for patch in patches]


def _merge_some(patches: list[Patch], ray_length: FloatArray, bin_m: float) -> bool:
    """Join patches, in place, that one surface fits; say whether there were any."""
    before, first = len(patches), 0
    while first < len(patches):
        for second in range(len(patches) - 1, first, -1):
            joint = _merge(patches[first], patches[second], ray_length, bin_m)
            if joint is not None:
                patches[first] = joint
                del patches[second]
        first += 1
    return len(patches) < before


def find_dimmer_patches(
    patches: list[Patch], returns: Returns, ray_length: FloatArray, bin_m: float
) -> list[Patch]:
    """Find surfaces that are nowhere the brightest of their pixels, as gauze before a bright wall.

    Recoveries make weak returns of their own, here and there; those of a surface lie side by side and
    hold a part of the light.

    `patches`: of the strongest returns; `returns`: all of the shot; `ray_length` (rows, columns);
    `bin_m`: range of a bin, m.
    """
    pixel = returns.y.astype(np.intp) * ray_length.shape[1] + returns.x
    free = np.ones(pixel.size, bool)
    for patch in patches:
        fitted = patch.compute_ranges(pixel, ray_length)
        free &= np.abs(returns.range - fitted) > DIMMER_REACH_BINS * bin_m
    chosen = np.flatnonzero(free)
    light = float(returns.intensity.sum())
    found = []
    for patch in find_patches(pixel[chosen], returns.range[chosen], ray_length, bin_m):
        on_patch = np.isin(pixel[chosen], patch.pixels)
        fitted = patch.compute_ranges(pixel[chosen], ray_length)
        on_patch &= np.abs(returns.range[chosen] - fitted) < NEIGHBOUR_BINS * bin_m
        own = float(returns.intensity[chosen[on_patch]].sum())
        dim = patch.pixels.size >= MIN_DIMMER_PX and own > MIN_DIMMER_LIGHT * light
        error = _compute_median_error(patch, ray_length)
        # noise far out of a surface's pulse makes no surface of its own
        dim = dim and error < DIMMER_BINS * bin_m
        if dim and all(_are_apart(patch, one, ray_length, bin_m) for one in patches):
            found.append(patch)
    return found


def _are_apart(patch: Patch, other: Patch, ray_length: FloatArray, bin_m: float) -> bool:
    """Whether two surfaces are apart where the first one is seen."""
    here, there = (one.compute_ranges(patch.pixels, ray_length) for one in (patch, other))
    return float(np.median(np.abs(here - there))) > DIMMER_REACH_BINS * bin_m


def reach_further(
    patch: Patch, returns: Returns, ray_length: FloatArray, bin_m: float
) -> NDArray[np.bool_]:
    """Return where a patch's surface is seen, also behind another that is brighter there.

    A weaker return of a pixel is often the recovery's own. It counts where it lies on a surface that
    other pixels see alone, nearly as bright as there, and with neighbours that do so as well.

    `returns`: all of the shot; `ray_length` (rows, columns); `bin_m`: range of a bin, m. Returns
    (rows, columns).
    """
    own = np.zeros(ray_length.shape, bool)
    own.ravel()[patch.pixels] = True
    pixel = returns.y.astype(np.intp) * ray_length.shape[1] + returns.x
    fitted = patch.compute_ranges(pixel, ray_length)
    near = np.abs(returns.range - fitted) < NEIGHBOUR_BINS * bin_m
    if not (near & own.ravel()[pixel]).any():
        return own
    usual = float(np.median(returns.intensity[near & own.ravel()[pixel]]))
    near &= returns.intensity > MIN_BEHIND_FRACTION * usual
    seen = own.copy()
    seen.ravel()[pixel[near]] = True
    crowded = scipy.ndimage.uniform_filter(seen.astype(np.float32), NEIGHBOURS_PX, mode="nearest")
    found: NDArray[np.bool_] = own | (seen & (crowded > MIN_CROWD))
    return found


def _connect_neighbours(
    pixels: Pixels, distance: FloatArray, shape: tuple[int, ...], tolerance: float
) -> list[Pixels]:
    """Connected returns, of eight neighbouring pixels each, whose ranges differ by less than a
    tolerance; the largest first.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if pixels.size == 0:
        return []
    rows, columns = shape
    order = np.lexsort((distance, pixels))
    starts = np.flatnonzero(np.diff(pixels[order], prepend=-1))
    rank = np.arange(order.size) - np.repeat(starts, np.diff(starts, append=order.size))
    layers = np.full((int(rank.max(initial=0)) + 1, rows, columns), -1)
    layers.reshape(len(layers), -1)[rank, pixels[order]] = order
    links = []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = layers[:, : rows - down, max(0, -right) : columns - max(0, right)]
        there = layers[:, down:, max(0, right) : columns + min(0, right)]
        for one in here.reshape(len(layers), -1):
            for other in there.reshape(len(layers), -1):
                near = (one >= 0) & (other >= 0)
                near &= np.abs(distance[one] - distance[other]) < tolerance
                links.append(np.stack([one[near], other[near]]))
        links += _link_steep_pixels(layers[0], distance, (down, right), tolerance)
    ends = np.concatenate(links, axis=1)
    graph = coo_array((np.ones(ends.shape[1], np.int8), tuple(ends)), shape=(pixels.size,) * 2)
    _, label = connected_components(graph, directed=False)
    sizes = np.bincount(label)
    largest = np.argsort(-sizes, kind="stable")
    return [np.flatnonzero(label == one) for one in largest[sizes[largest] >= MIN_PATCH_PX]]


def _link_steep_pixels(
    layer: Pixels, distance: FloatArray, step: tuple[int, int], tolerance: float
) -> list[Pixels]:
    """Pairs of neighbours whose ranges differ by more, but as much as on the other side: three
    pixels of a surface that is turned far.
    """
    down, right = step
    rows, columns = layer.shape
    tall, wide = rows - 2 * down, columns - 2 * abs(right)
    first = max(0, -2 * right)
    three = [
        layer[k * down : k * down + tall, first + k * right : first + k * right + wide]
        for k in range(3)
    ]
    before, middle, after = three
    there = (before >= 0) & (middle >= 0) & (after >= 0)
    one, other = distance[middle] - distance[before], distance[after] - distance[middle]
    there &= np.abs(one) + np.abs(other) < 2 * STEEP_STEPS * tolerance
    there &= np.abs(other - one) < STEEP_EXCESS * tolerance
    return [
        np.stack([before[there], middle[there]]),
        np.stack([middle[there], after[there]]),
    ]


def _fit_quadratic(pixels: Pixels, distance: FloatArray, ray_length: FloatArray) -> Patch:
    basis = SmoothBasis((ray_length.shape[0], ray_length.shape[1]))
    inverse = ray_length.ravel()[pixels] / distance
    penalty = CURVATURE_PENALTY * pixels.size * np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    coefficients, _ = _fit_robustly(basis.evaluate(pixels), inverse, penalty)
    return Patch(pixels, distance, basis, coefficients)


def _fit_robustly(
    design: FloatArray, values: FloatArray, penalty: FloatArray
) -> tuple[FloatArray, float]:
    """Coefficients and scale of the errors; outliers are weighted down (Cauchy's weights)."""
    weights, coefficients, scale = np.ones(values.size), np.zeros(design.shape[1]), 0.0
    # returns along a line say nothing about what is across it
    penalty = penalty + RIDGE * values.size * np.eye(design.shape[1])
    for _ in range(FIT_ITERATIONS):
        normal = design.T @ (design * weights[:, np.newaxis]) + penalty * weights.mean()
        coefficients = np.linalg.solve(normal, design.T @ (weights * values))
        error = values - design @ coefficients
        scale = max(1.4826 * float(np.median(np.abs(error))), float(np.finfo(np.float32).eps))
        weights = 1 / (1 + (error / (2 * scale)) ** 2)
    return coefficients, scale


def _bend_where_needed(patch: Patch, ray_length: FloatArray, bin_m: float) -> Patch:
    """Give a patch splines where a quadratic does not follow its returns and they do."""
    shape = (ray_length.shape[0], ray_length.shape[1])
    plain = _compute_median_error(patch, ray_length)
    if plain < BEND_BINS * bin_m:
        return patch
    y, x = np.divmod(patch.pixels, shape[1])
    top, left, bottom, right = int(y.min()), int(x.min()), int(y.max()) + 1, int(x.max()) + 1
    box = (top - MARGIN_PX, left - MARGIN_PX, bottom + MARGIN_PX, right + MARGIN_PX)
    down, across = (
        min(MAX_PIECES, max(1, round(side / KNOT_SPACING_PX)))
        for side in (box[2] - box[0], box[3] - box[1])
    )
    basis = SmoothBasis(shape, box, (down, across))
    design = basis.evaluate(patch.pixels)
    inverse = ray_length.ravel()[patch.pixels] / patch.distance
    differences = make_second_differences(basis.pieces)
    floor = SPLINE_FLOOR * patch.pixels.size * np.eye(design.shape[1])
    penalty = floor + SPLINE_START_PENALTY * patch.pixels.size * differences.T @ differences
    for _ in range(EVIDENCE_ROUNDS):
        coefficients, scale = _fit_robustly(design, inverse, penalty)
        # the bending that the fit itself shows is what is known about it (empirical Bayes)
        usual = float(np.mean((differences @ coefficients) ** 2)) + float(np.finfo(np.float32).eps)
        bending = differences.T @ differences / usual
        penalty = scale**2 * CORRELATED_PX * bending + floor
    bent = Patch(
        patch.pixels, patch.distance, SmoothBasis(shape, box, basis.pieces, bending), coefficients
    )
    return bent if _compute_median_error(bent, ray_length) < BENT_FRACTION * plain else patch


def _compute_median_error(
    patch: Patch, ray_length: FloatArray, coefficients: FloatArray | None = None
) -> float:
    """Median distance of a patch's returns from its surface, or another over its basis, m."""
    fitted = patch.compute_ranges(patch.pixels, ray_length, coefficients)
    return float(np.median(np.abs(fitted - patch.distance)))


def _merge(large: Patch, small: Patch, ray_length: FloatArray, bin_m: float) -> Patch | None:
    """Return both as one patch if one surface fits either as well as a surface of its own."""
    if _compute_median_error(small, ray_length, large.coefficients) > MERGE_REACH_BINS * bin_m:
        return None
    pixels = np.concatenate([large.pixels, small.pixels])
    joint = _fit_quadratic(pixels, np.concatenate([large.distance, small.distance]), ray_length)
    fits = all(
        _compute_median_error(one, ray_length, joint.coefficients)
        # in little light returns scatter by more than that about a surface of their own
        < max(MERGE_BINS * bin_m, MERGE_EXCESS * _compute_median_error(one, ray_length))
        for one in (large, small)
    )
    return joint if fits else None
