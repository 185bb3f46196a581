"""The best that a user gets of the paper's cases: even angles, and each pixel at a depth of its own.

Where that is not below the paper's figure, the presets `fast` and `quality` are tried as well.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import groupby
from typing import Any

from numpy.typing import NDArray

from apps.studies.cases import BORDER_PX, Advance, Case, Library, measure_case, read_cases
from tofclip.light_field.views import ClipMeasurement
from tofclip.metrics import nmse
from tofclip.operators.cameras import EvenAngleLineCamera
from tofclip.recovery.light_field import (
    PRESETS,
    ClipRecovery,
    make_shear_range,
    recover_all_in_focus,
)
from tofclip.threads import map_parallel

SHEAR_RANGE = (-1.4, 1.4)  # that surfaces are looked for in, for all scenes alike
SEED = 0
LIGHT_FIELD_LABEL = "light field"  # last label of rows where all views are scored


@dataclass(frozen=True)
class BestFigure:
    """What came out for a row."""

    percent: float  # NMSE
    setting: str  # that gave it


def list_best_cases(name: str) -> list[Case]:
    """Return a study's rows of the paper, with the settings of choice."""
    return [choose_settings(case) for case in read_cases(name) if case.paper is not None]


def choose_settings(case: Case) -> Case:
    """Return a case with even angles for lines, and Huber's term for bad measurements."""
    encoder = EvenAngleLineCamera.name if case.encoder == "line" else case.encoder
    return replace(
        case, encoder=encoder, data_term="huber" if case.bad_fraction else case.data_term
    )


def solve_best(
    cases: Sequence[Case],
    library: Library,
    known: Mapping[str, BestFigure],
    keep: Callable[[dict[str, BestFigure]], None],
    advance: Advance,
) -> dict[str, BestFigure]:
    """Solve the rows that are not known yet, measurements on all cores; figures by `Case.key`.
    `known`: of an earlier run; `keep`: called with all figures so far after each measurement, so
    that a run that is stopped can go on.
    """
    figures = {case.key: known[case.key] for case in cases if case.key in known}
    advance(len(figures))
    missing = [case for case in cases if case.key not in figures]
    shared = [
        list(rows)
        for _, rows in groupby(sorted(missing, key=_identify_measurement), _identify_measurement)
    ]
    for case in missing:  # rendered once, before the threads start
        library.light_field(case.scene)
    for solved in map_parallel(partial(_solve_measurement, library), shared):
        figures |= solved
        keep(figures)
        advance(len(solved))
    return figures


def _identify_measurement(case: Case) -> str:
    """Return what rows share that are recovered from the same measurement."""
    return repr(sorted(asdict(replace(case, labels=(), shear=0.0, paper=None)).items()))


def _solve_measurement(library: Library, cases: list[Case]) -> dict[str, BestFigure]:
    truth = library.light_field(cases[0].scene)
    measurement = measure_case(cases[0], library, SEED)
    recovery = ClipRecovery(data_term=cases[0].data_term)
    shears = make_shear_range(*SHEAR_RANGE, measurement.views)
    views = recover_all_in_focus(measurement, shears, recovery=recovery).render_views(truth.views)
    figures = {}
    for case in cases:
        is_light_field = case.labels[-1] == LIGHT_FIELD_LABEL
        pictures = (
            (views.pictures, truth.pictures)
            if is_light_field
            else (views.refocus(case.shear), truth.refocus(case.shear))
        )
        figure = BestFigure(100 * nmse(*pictures, BORDER_PX), "surfaces")
        if not is_light_field and case.paper is not None and figure.percent >= case.paper:
            figure = _try_presets(case, measurement, pictures[1], figure)
        figures[case.key] = figure
    return figures


def _try_presets(
    case: Case, measurement: ClipMeasurement, truth: NDArray[Any], best: BestFigure
) -> BestFigure:
    """Return the best of both presets and the figure so far."""
    recovery = ClipRecovery(data_term=case.data_term)
    for preset in PRESETS:
        recovered = replace(recovery, preset=preset).recover(measurement, case.shear)
        # the weight chosen for the first serves the second
        recovery = replace(recovery, weight=recovered.weight)
        percent = 100 * nmse(recovered.picture, truth, BORDER_PX)
        if percent < best.percent:
            best = BestFigure(percent, preset)
    return best
