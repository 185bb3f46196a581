"""What one iteration costs (Table 1): CLIP and compressive light-field photography on the same scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apps.studies.cases import Advance, Library, Outcome, Panel, Row, study
from tofclip.light_field import LightField
from tofclip.operators import LinearOperator, Reshape, estimate_squared_norm
from tofclip.operators.cameras import CAMERAS, COMPRESSIVE_CAMERAS, LightFieldCamera
from tofclip.solvers import Fista, LeastSquares, NonnegativeTotalVariation
from tofclip.threads import limit_blas_threads

TV_WEIGHT = 1e-2  # relative to the largest A'f; what an iteration costs does not depend on it
NORM_ITERATIONS = 10
WHOLE, PICTURE = "light field", "refocused picture"


@dataclass(frozen=True)
class IterationCost:
    """One row of Table 1, with what was measured."""

    method: str
    recovers: str  # `WHOLE` or `PICTURE`
    measurements: int
    unknowns: int
    # of one iteration as the paper has it: N pixels on a side, n_a views on a side, m measurements,
    # r exposures, k operations of the prior for each unknown
    complexity: str
    # of one whole iteration: model, prior and bookkeeping; the median of the repeats
    seconds: float
    model_seconds: float  # of the model and its adjoint alone, the median of the repeats


def measure_iteration_costs(
    light_field: LightField,
    shear: float,
    exposures: int = 8,
    sampling_ratio: float = 0.5,
    repeats: int = 5,
) -> list[IterationCost]:
    """Time one iteration of every method of Table 1: FISTA with total variation for all of them
    alike, in memory of about ten light fields in float32. `shear`, `sampling_ratio`: of CLIP;
    `exposures`: r, of Ashok's and Babacan's methods; `repeats`: iterations timed, after a first one
    that is not.
    """
    views = [(v, u) for v, u in light_field.views.tolist()]
    shape = (light_field.pictures.shape[1], light_field.pictures.shape[2])
    line, pixel = (
        CAMERAS[name](shape, views, sampling_ratio, 0) for name in ("line", "single-pixel")
    )
    masks = {
        name: kind(shape, views, 1 if name == "marwah" else exposures, 0)
        for name, kind in COMPRESSIVE_CAMERAS.items()
    }
    diffuser = CAMERAS["diffuser"](shape, views, 1.0, 0)
    methods: list[tuple[str, LightFieldCamera, str, str]] = [
        ("Ashok", masks["ashok"], WHOLE, "(2r + k) n_a^2 N^2"),
        ("Babacan", masks["babacan"], WHOLE, "(2r + k) n_a^2 N^2"),
        ("Marwah", masks["marwah"], WHOLE, "(2 + k) n_a^2 N^2"),
        ("Cai, Antipa", diffuser, WHOLE, "(4 log N + k n_a^2) N^2"),
        ("CLIP-1D", line, WHOLE, "(2m + k n_a^2) N^2"),
        ("CLIP-0D", pixel, WHOLE, "(2m + k n_a^2) N^2"),
        ("CLIP-1D", line, PICTURE, "(2m + 2n_a^2 + k) N^2"),
        ("CLIP-0D", pixel, PICTURE, "(2m + 2n_a^2 + k) N^2"),
    ]
    costs = []
    with limit_blas_threads():  # all methods on one core
        for name, camera, recovers, complexity in methods:
            seen = light_field.pictures[list(camera.used_views)]
            measurements = camera.light_field_model()(seen)
            model = camera.model(shear) if recovers == PICTURE else _build_tall_model(camera)
            solver = _build_solver(model, measurements)
            times = (
                _measure_median_seconds(action, repeats)
                for action in (solver.step, partial(_multiply, model, solver))
            )
            unknowns = int(np.prod(model.shape_in))
            numbers = (measurements.size, unknowns)
            costs.append(IterationCost(name, recovers, *numbers, complexity, *times))
    return costs


def _multiply(model: LinearOperator, solver: Fista) -> None:
    model.adjoint(model(solver.current))


def _build_tall_model(camera: LightFieldCamera) -> LinearOperator:
    """The light field's model for its views one below the other: priors take one picture."""
    model = camera.light_field_model()
    views, rows, columns = model.shape_in
    return model @ Reshape((views * rows, columns), model.shape_in)


def _build_solver(model: LinearOperator, measurements: NDArray[Any]) -> Fista:
    block = measurements[:, np.newaxis]
    weight = TV_WEIGHT * float(model.adjoint(block).max())
    # The power iteration approaches the norm from below, hence the margin.
    step = 1 / (1.02 * estimate_squared_norm(model, NORM_ITERATIONS))
    return Fista(model, LeastSquares(block), NonnegativeTotalVariation(weight), step, 1)


def _measure_median_seconds(action: Callable[[], object], repeats: int) -> float:
    seconds = []
    for number in range(repeats + 1):
        started = perf_counter()
        action()
        # The first run fills caches and compiles; it does not count.
        if number:
            seconds.append(perf_counter() - started)
    return float(np.median(seconds))


SCENE, SHEAR = "letters", -0.4


@study(
    "table1",
    title="What an iteration costs",
    note="The paper gives the operations; seconds are measured here, on one core, and depend on the machine.",
    weight=f"fixed at {TV_WEIGHT:g}; the cost of an iteration does not depend on it",
    seconds=5,
    steps=1,
    seeded=False,
)
def run_iteration_table(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Time every method; the repeats stand in for seeds."""
    costs = measure_iteration_costs(library.light_field(SCENE), SHEAR, repeats=2 * seeds)
    advance(1)
    columns = ("method", "recovers", "measurements", "unknowns", "operations")
    rows = [
        Row((*map(str, astuple(cost)[:4]), cost.complexity), (1e3 * cost.seconds,))
        for cost in costs
    ]
    panel = Panel(f"{SCENE}, s = {SHEAR:g}", library.light_field(SCENE).refocus(SHEAR))
    return Outcome(columns, "ms per iteration", rows, [[panel]])
