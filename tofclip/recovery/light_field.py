"""From the measurements of a light-field camera to the picture at one depth, by names that a user
can type, and to a picture that is sharp at all depths, and the depths.

Refocusing explains the measurements by one picture at one depth, and everything else blurs it. Here
each pixel lies at a shear of its own (`tofclip.light_field.views`), so that one picture h explains all
measurements:

    minimise over h >= 0:  ``1/2 |A W h - f|^2 + weight TV(h)``,

with W from the reference view's picture to all views, what hides what included, and the views'
encoders A. Where the depths are not known they come from the sharpest of pictures refocused at
several. Shift-and-add of the views W h is the picture refocused at any depth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter

import numpy as np
import scipy.ndimage
from numpy.typing import ArrayLike

from tofclip.arrays import AnyArray, FloatArray, IntArray
from tofclip.errors import require, require_known, require_positive, require_shape
from tofclip.light_field import FocalStack, LightField, estimate_depth_from_focus
from tofclip.light_field.views import ClipMeasurement, make_view_warp
from tofclip.operators import Diagonal, Identity, LinearOperator, Selection
from tofclip.operators.cameras import LightFieldCamera
from tofclip.plugins import DENOISERS, METHODS
from tofclip.solvers import (
    DataTermMaker,
    Huber,
    LeastSquares,
    PlugAndPlay,
    Poisson,
    Progress,
    ProximalMethod,
    ignore_progress,
)
from tofclip.solvers.data_terms import estimate_robust_deviation
from tofclip.solvers.fista import (
    FOLD_COUNT,
    INITIAL_WEIGHT,
    MAX_WEIGHT_WORK,
    LightFieldVariation,
    choose_weight,
)

PRESETS = {"fast": 2, "quality": 10}  # calls of the denoiser
DATA_TERMS = ("squares", "huber", "poisson")
MAX_ITERATIONS = 400
LIGHT_FIELD_WEIGHT = 1e-3  # the best of those tried on rendered planes at sampling ratios 0.5 to 2
OBJECTIVE_TOLERANCE = 1e-4  # of the objective in an iteration: then the recovery has converged
THRESHOLD_PASSES = 3  # at the errors, after which Huber's threshold stays within a few percent
# Robust deviations: 95 % of the efficiency of squares, and safe from what is still unknown; and once
# they are known: most of what is out of focus counts in full.
INITIAL_THRESHOLD_DEVIATIONS, FINAL_THRESHOLD_DEVIATIONS = 1.345, 3.0
# How much the weight is raised with Huber's term. Its prediction error is a sum of many small errors on
# the dark ground, which any weight predicts, and of edges cut off; on letters with 0 to 10 % bad
# measurements the best weight is 1.5 to 2 times the one with the lowest error.
HUBER_WEIGHT_FACTOR = 2.0


@dataclass(frozen=True)
class WeightSearch:
    """How a weight is looked for by cross-validation."""

    first: float = INITIAL_WEIGHT  # weight that is tried first
    max_folds: int = FOLD_COUNT  # folds that are tried
    # of the objective in an iteration, at which a trial stops
    tolerance: float = OBJECTIVE_TOLERANCE


THOROUGH_SEARCH = WeightSearch()


@dataclass(frozen=True)
class ClipResult:
    """A picture and how it came about."""

    picture: AnyArray  # (rows, columns)
    weight: float  # of the variational prior, relative to the largest value of A'f
    iterations: int
    stop_reason: str
    seconds: float  # of the recovery at its final weight
    seconds_setup: float  # of building the camera's model and whatever depends on it alone
    seconds_weight: float  # of choosing the weight and the data term's threshold


@dataclass(frozen=True)
class ClipRecovery:
    """How to recover; every choice has a name."""

    # ``tv``, ``wavelet``, ``l1`` or another method with a prior: minimised with the data term.
    # ``collaborative``, ``bm3d``, ``nlm`` or another denoiser: plugged in after total variation
    prior: str = "tv"
    # ``fast`` stops where the prior's own problem has converged (denoisers: 2 calls). ``quality``
    # goes on with ten calls of the denoiser, the collaborative one if the prior is none
    preset: str = "fast"
    # of the variational prior, relative to the largest value of A'f; chosen by cross-validation if
    # not given
    weight: float | None = None
    # ``squares``; ``huber`` where some measurements are wildly wrong; ``poisson`` the likelihood of
    # photon counts
    data_term: str = "squares"

    def __post_init__(self) -> None:
        if not (_is_variational(self.prior) or self.prior in DENOISERS):
            variational = filter(_is_variational, METHODS.own)
            require_known("prior", self.prior, [*variational, *DENOISERS])
        require_known("preset", self.preset, PRESETS)
        require_known("data term", self.data_term, DATA_TERMS)
        if self.weight is not None:
            require_positive("the prior's weight", self.weight)

    @property
    def work(self) -> int:
        """Recoveries that `recover` reports: those of the choice of the weight, and the last one."""
        return 1 + (MAX_WEIGHT_WORK if self.weight is None else 0)

    def recover(
        self, measurement: ClipMeasurement, shear: float, progress: Progress = ignore_progress
    ) -> ClipResult:
        """Recover the picture refocused at `shear`, pixels per view step; `progress` is called with the
        number of recoveries just done, of `work`.
        """
        camera = measurement.camera()
        return self.recover_picture(measurement, camera, camera.model(shear), progress)

    def recover_picture(
        self,
        measurement: ClipMeasurement,
        camera: LightFieldCamera,
        model: LinearOperator,
        progress: Progress = ignore_progress,
        search: WeightSearch = THOROUGH_SEARCH,
    ) -> ClipResult:
        """Recover the picture, (rows, columns), that a model of one's own explains the camera's
        measurements by, such as ``camera.model(shear)``.
        """
        begin = perf_counter()
        problem = self._make_problem(measurement, camera, model)
        ready = perf_counter()
        method = self._choose_method(problem, progress, search)
        chosen = perf_counter()
        result = self._add_denoiser(method).recover(problem.model, problem.measurements)
        progress(1)
        return ClipResult(
            result.frames[0],
            method.weight,
            result.iterations,
            result.stop_reason,
            perf_counter() - chosen - result.setup_seconds,
            ready - begin + result.setup_seconds,
            chosen - ready,
        )

    def _make_problem(
        self, measurement: ClipMeasurement, camera: LightFieldCamera, model: LinearOperator
    ) -> _InverseProblem:
        weighting, near = camera.weighting(), camera.correlation_length
        if self.data_term != "poisson":
            seen = weighting(measurement.values)[:, np.newaxis]
            return _InverseProblem(weighting @ model, seen, near, LeastSquares)
        require(
            isinstance(weighting, Identity),
            f"measurements of a {camera.name} camera all have about the same photon noise; take squares",
        )
        counts = measurement.counts()
        # dark measurements count no more than a quarter of the mean: they would hold up the convergence
        # of all others
        deviation = np.sqrt(np.maximum(counts, counts.mean() / 4) + 1)
        weighted = Diagonal(measurement.photons_per_unit / deviation) @ model
        seen = (counts / deviation)[:, np.newaxis]
        return _InverseProblem(weighted, seen, near, partial(Poisson, deviation=deviation))

    def _choose_method(
        self, problem: _InverseProblem, progress: Progress, search: WeightSearch
    ) -> ProximalMethod:
        """Return the prior's method with its data term and weight."""
        first = search.first if self.weight is None else self.weight
        method: ProximalMethod = METHODS[self.prior if _is_variational(self.prior) else "tv"](
            first, MAX_ITERATIONS, OBJECTIVE_TOLERANCE, problem.data_term
        )
        if self.data_term == "huber":
            method = _make_robust(method, problem)
        if self.weight is not None:
            return method
        # neighbours on a detector are left out together, or they would predict each other
        weight = choose_weight(
            replace(method, tolerance=search.tolerance),
            problem.model,
            problem.measurements[:, 0],
            problem.correlation_length,
            progress=progress,
            first=search.first,
            max_folds=search.max_folds,
        ).weight
        return replace(
            method, weight=weight * HUBER_WEIGHT_FACTOR if self.data_term == "huber" else weight
        )

    def _add_denoiser(self, method: ProximalMethod) -> ProximalMethod | PlugAndPlay:
        variational = _is_variational(self.prior)
        if self.preset == "fast" and variational:
            return method
        denoiser = DENOISERS.make("collaborative" if variational else self.prior, {})
        return PlugAndPlay(method, denoiser, PRESETS[self.preset])


def recover_light_field(
    measurement: ClipMeasurement, weight: float = LIGHT_FIELD_WEIGHT
) -> LightField:
    """Recover every view instead of one picture (Eq. 20), by total variation over pixels and views of a
    complete grid.

    Far more unknowns than measurements: expect less than of the refocused picture, whose views
    agree. Views without measurements are filled in from their neighbours. Memory: about ten times
    the light field.
    """
    camera, views = measurement.camera(), measurement.views
    down, across = (np.unique(views[:, axis]) for axis in (0, 1))
    complete = np.stack(np.meshgrid(down, across, indexing="ij"), axis=-1).reshape(-1, 2)
    require(
        complete.shape == views.shape and np.array_equal(complete, views),
        "a light field is recovered from a complete grid of views, row by row; some are missing",
    )
    weighting = camera.weighting()
    kept, shape = camera.used_views, measurement.image_shape
    used = Selection((len(views), *shape), (len(kept), *shape), kept)
    model = weighting @ camera.light_field_model() @ used
    grid = (down.size, across.size)
    method = LightFieldVariation(weight, MAX_ITERATIONS, OBJECTIVE_TOLERANCE, grid=grid)
    found = method.recover(model, weighting(measurement.values)[:, np.newaxis])
    return LightField(found.frames[0], views)


@dataclass(frozen=True)
class _InverseProblem:
    """Model and measurements (measurements, 1) weighted as the data term wants them."""

    model: LinearOperator
    measurements: AnyArray
    correlation_length: int
    data_term: DataTermMaker


def _make_robust(method: ProximalMethod, problem: _InverseProblem) -> ProximalMethod:
    """Return the method with Huber's term, its threshold from the errors a narrow one leaves."""
    looking = method
    for _ in range(THRESHOLD_PASSES):
        seen = looking.recover(problem.model, problem.measurements).frames[0]
        deviation = estimate_robust_deviation(problem.model(seen) - problem.measurements[:, 0])
        looking = replace(
            looking,
            data_term=partial(Huber, threshold=INITIAL_THRESHOLD_DEVIATIONS * deviation),
            weight=INITIAL_WEIGHT / 4,
        )
    return replace(
        method, data_term=partial(Huber, threshold=FINAL_THRESHOLD_DEVIATIONS * deviation)
    )


def _is_variational(prior: str) -> bool:
    """Whether a prior is minimised with the data term, and no denoiser."""
    is_method = prior not in DENOISERS and prior in METHODS
    return is_method and ProximalMethod in getattr(METHODS[prior], "__mro__", ())


# The weight is relative to the largest A'f, and far below that of refocusing, as nothing is out of
# focus: 3e-5 to 3e-3 on rendered scenes without noise. One fold of eight, stopped early, finds it;
# eight folds would take longer than all the rest.
SURFACE_WEIGHT_SEARCH = WeightSearch(first=3e-4, max_folds=1, tolerance=1e-3)
REFOCUSING_WEIGHT_SEARCH = WeightSearch(max_folds=1, tolerance=1e-3)
# Four times that of depth from focus alone: a wrong depth costs more here than a shifted border. On
# rendered scenes it lowers the error of refocused pictures by up to a fifth.
SMOOTHNESS = 0.4
MAP_ERROR_PX = 0.1  # by which rounding a known map displaces the outermost view at most
SHEAR_STEP_PX = 0.6  # by which the outermost view moves between depths that are tried


@dataclass(frozen=True)
class AllInFocus:
    """A picture with the depth of each pixel."""

    picture: AnyArray  # (rows, columns), what the reference view (0, 0) sees
    shears: FloatArray  # (rows, columns), pixels per view step
    # (rows, columns), the same from pictures refocused one by one; None where the depths were known
    refocused: AnyArray | None
    weight: float  # of the prior, relative to the largest value of A'f
    iterations: int
    stop_reason: str
    seconds: float

    def render_views(self, views: ArrayLike) -> LightField:
        """Return what views, (views, 2) of (v, u), see of it: each pixel moves by its own shear."""
        wanted = np.asarray(views, np.float64)
        depths, labels = np.unique(self.shears, return_inverse=True)
        warp = make_view_warp(
            labels.reshape(self.shears.shape), depths, [(v, u) for v, u in wanted.tolist()]
        )
        return LightField(warp(self.picture), wanted)


def make_shear_range(nearest: float, farthest: float, views: FloatArray) -> FloatArray:
    """Return shears, (depths,), to look for surfaces at between two of them, pixels per view step, as
    close as the views, (views, 2) of (v, u) in view steps, can tell them apart.
    """
    require(
        np.isfinite([nearest, farthest]).all() and nearest < farthest,
        f"surfaces are looked for from a smaller shear to a larger one, not from {nearest} to {farthest}",
    )
    step = SHEAR_STEP_PX / max(float(np.abs(views).max()), 1.0)
    return np.linspace(nearest, farthest, 1 + int(np.ceil((farthest - nearest) / step - 1e-9)))


def recover_all_in_focus(
    measurement: ClipMeasurement,
    shears: ArrayLike,
    weight: float | None = None,
    recovery: ClipRecovery | None = None,
    progress: Progress = ignore_progress,
) -> AllInFocus:
    """Recover an all-in-focus picture and its depths from one shot. `shears` (depths,): that
    surfaces may have, pixels per view step, two or more; `weight`: of the prior, by
    cross-validation if not given; `recovery`: prior and data term of all pictures, and the weight
    of the refocused ones; `progress`: called with the number of recoveries just done, of
    `count_recoveries`.
    """
    began = perf_counter()
    depths = np.asarray(shears, np.float64)
    require(
        depths.ndim == 1 and depths.size >= 2 and np.all(np.diff(depths) > 0),
        "depths are looked for among two or more ascending shears",
    )
    refocusing = recovery or ClipRecovery()
    # the weight found in the middle serves all depths
    camera = measurement.camera()
    middle = refocusing.recover_picture(
        measurement,
        camera,
        camera.model(float(depths[depths.size // 2])),
        search=REFOCUSING_WEIGHT_SEARCH,
    )
    progress(1)
    refocusing = replace(refocusing, weight=middle.weight)
    pictures = []
    for shear in depths:
        pictures.append(refocusing.recover(measurement, float(shear)).picture)
        progress(1)
    stack = FocalStack(np.stack(pictures), depths)
    labels = estimate_depth_from_focus(stack, smoothness=SMOOTHNESS)
    found = _solve(measurement, labels, depths, replace(refocusing, weight=weight), began)
    progress(1)
    return replace(found, refocused=stack.all_in_focus(labels))


def count_recoveries(shears: ArrayLike) -> int:
    """Return how many recoveries `recover_all_in_focus` reports for so many shears."""
    return np.size(shears) + 2


def recover_on_depth_map(
    measurement: ClipMeasurement,
    shears: FloatArray,
    weight: float | None = None,
    recovery: ClipRecovery | None = None,
) -> AllInFocus:
    """Recover an all-in-focus picture where the depths are known: shears of the reference view's pixels,
    (rows, columns), pixels per view step, infinite where there is nothing. The weight is found by
    cross-validation if not given.
    """
    began = perf_counter()
    require_shape("the map of shears", measurement.image_shape, shears.shape)
    known = np.isfinite(shears)
    require(known.any(), "the map of shears is nowhere finite")
    step = 2 * MAP_ERROR_PX / max(float(np.abs(measurement.views).max()), 1.0)
    # where there is nothing it is dark, at whatever depth: the farthest hides nothing
    filled = np.where(known, shears, shears[known].max())
    levels, labels = np.unique(np.rint(filled / step), return_inverse=True)
    # pixels on the border of two surfaces hold some of the nearer one's light, and move with it
    nearer = scipy.ndimage.minimum_filter(labels.reshape(shears.shape), 3)
    settings = replace(recovery or ClipRecovery(), weight=weight)
    return _solve(measurement, nearer, levels * step, settings, began)


def _solve(
    measurement: ClipMeasurement,
    labels: IntArray,
    shears: FloatArray,
    recovery: ClipRecovery,
    began: float,
) -> AllInFocus:
    """The picture for known labels."""
    camera = measurement.camera()
    used = [camera.views[number] for number in camera.used_views]
    model = camera.light_field_model() @ make_view_warp(labels, shears, used)
    found = recovery.recover_picture(measurement, camera, model, search=SURFACE_WEIGHT_SEARCH)
    return AllInFocus(
        found.picture,
        shears[labels],
        None,
        found.weight,
        found.iterations,
        found.stop_reason,
        perf_counter() - began,
    )
