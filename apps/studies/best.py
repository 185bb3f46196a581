"""The best that a user gets of the paper's cases: even angles, and each pixel at a depth of its own.

Where that is not below the paper's figure, the presets `fast` and `quality` are tried as well.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import groupby
from typing import Any

from apps.studies.cases import BORDER_PX, Case, Library, measure_case
from apps.studies.outcome import Advance
from tofclip.light_field.measurement import ClipMeasurement
from tofclip.metrics import nmse
from tofclip.operators.cameras import EvenAngleLineCamera
from tofclip.recovery.all_in_focus import make_shear_range, recover_all_in_focus
from tofclip.recovery.light_field import PRESETS, ClipRecovery
from tofclip.threads import map_parallel

SHEAR_RANGE = (-1.4, 1.4)
"""That surfaces are looked for in, for all scenes alike."""

SEED = 0


@dataclass(frozen=True)
class BestCase:
    """A row of a table, and what is measured and scored for it."""

    labels: tuple[str, ...]  # of the row
    case: Case  # with the settings of choice
    # all views are scored instead of the picture refocused at the case's shear
    is_light_field: bool = False

    @property
    def key(self) -> str:
        """Return what the row is kept by."""
        return " | ".join(self.labels)


@dataclass(frozen=True)
class BestFigure:
    """What came out for a row."""

    percent: float  # NMSE
    setting: str  # that gave it


def choose_settings(case: Case, is_light_field: bool = False) -> BestCase:
    """Return the row of a case with even angles for lines, and Huber's term for bad measurements."""
    encoder = EvenAngleLineCamera.name if case.encoder == "line" else case.encoder
    data_term = "huber" if case.bad_fraction else case.data_term
    chosen = replace(case, encoder=encoder, data_term=data_term)
    return BestCase(case.labels, chosen, is_light_field)


def solve_best(
    cases: Sequence[BestCase],
    library: Library,
    known: Mapping[str, BestFigure],
    keep: Callable[[dict[str, BestFigure]], None],
    advance: Advance,
) -> dict[str, BestFigure]:
    """Solve the rows that are not known yet, measurements on all cores.

    `library`: light fields by name; `known`: by `BestCase.key`, of an earlier run; `keep`: called
    with all figures so far after each measurement, so that a run that is stopped can go on;
    `advance`: called with the number of rows just done. Returns by `BestCase.key`, of all rows.
    """
    found = {one.key: known[one.key] for one in cases if one.key in known}
    advance(len(found))
    missing = [one for one in cases if one.key not in found]
    shared = [
        list(rows)
        for _, rows in groupby(sorted(missing, key=_identify_measurement), _identify_measurement)
    ]
    for one in missing:  # rendered once, before the threads start
        library.light_field(one.case.scene)
    for solved in map_parallel(partial(_solve_measurement, library), shared):
        found |= solved
        keep(found)
        advance(len(solved))
    return found


def _identify_measurement(one: BestCase) -> str:
    """Return what rows share that are recovered from the same measurement."""
    shared = replace(one.case, labels=(), shear=0.0, paper=None)
    return repr(sorted(asdict(shared).items()))


def _solve_measurement(library: Library, rows: list[BestCase]) -> dict[str, BestFigure]:
    case = rows[0].case
    truth = library.light_field(case.scene)
    measurement = measure_case(case, library, SEED)
    surfaces = recover_all_in_focus(
        measurement,
        make_shear_range(*SHEAR_RANGE, measurement.views),
        recovery=ClipRecovery(data_term=case.data_term),
    )
    views = surfaces.render_views(truth.views)
    found = {}
    for one in rows:
        if one.is_light_field:
            percent = 100 * nmse(views.pictures, truth.pictures, BORDER_PX)
        else:
            picture, true = (field.refocus(one.case.shear) for field in (views, truth))
            percent = 100 * nmse(picture, true, BORDER_PX)
        figure = BestFigure(percent, "surfaces")
        paper = one.case.paper
        if paper is not None and percent >= paper and not one.is_light_field:
            figure = _try_presets(one.case, measurement, library, figure)
        found[one.key] = figure
    return found


def _try_presets(
    case: Case, measurement: ClipMeasurement, library: Library, other: BestFigure
) -> BestFigure:
    """Return the best of both presets and the other figure."""
    truth = library.light_field(case.scene).refocus(case.shear)
    best, recovery = other, ClipRecovery(data_term=case.data_term)
    for preset in PRESETS:
        found = replace(recovery, preset=preset).recover(measurement, case.shear)
        # the weight chosen for the first serves the second
        recovery = replace(recovery, weight=found.weight)
        percent = 100 * nmse(found.picture, truth, BORDER_PX)
        if percent < best.percent:
            best = BestFigure(percent, preset)
    return best


def to_plain(figures: Mapping[str, BestFigure]) -> dict[str, Any]:
    """Return figures as JSON keeps them."""
    return {key: asdict(figure) for key, figure in figures.items()}


def from_plain(kept: Mapping[str, Any]) -> dict[str, BestFigure]:
    """Return the figures that `to_plain` gave."""
    return {key: BestFigure(**figure) for key, figure in kept.items()}
