"""Whole light fields (Eq. 20) beside refocused pictures recovered directly (Eq. 21): Tables 3 and
4.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apps.studies.best import choose_settings
from apps.studies.cases import (
    BORDER_PX,
    CAMERA_NAMES,
    Case,
    Library,
    SolvedCase,
    measure_case,
    solve_cases,
)
from apps.studies.outcome import CROSS_VALIDATED, Advance, Outcome, Panel, Row, Study
from tofclip.light_field import LightField
from tofclip.metrics import nmse
from tofclip.solvers.fista import LightFieldVariation
from tofclip.threads import map_parallel

TV_WEIGHT, ITERATIONS, ANGULAR_WEIGHT = (
    3e-3,
    200,
    0.5,
)  # half the iterations leave single-pixel views a grey veil
LIGHT_FIELD_LABEL = "light field"
REFOCUSED_LABEL = "refocused from it"
DIRECT_LABEL = "direct"

SHEARS = (-1.0, -0.3, 0.3, 1.0)
TABLE3_PERCENT = {  # light field, then direct at each shear; NMSE in per cent
    ("printed-words:4x4", 1.0): (7.08, 1.94, 1.53, 1.39, 1.76),
    ("printed-words:4x4", 0.5): (7.31, 2.32, 2.15, 1.83, 2.29),
    ("printed-words:4x4", 0.25): (8.84, 5.41, 3.06, 2.57, 3.22),
    ("printed-letters:4x4", 1.0): (1.34, 0.94, 0.66, 0.61, 0.67),
    ("printed-letters:4x4", 0.5): (2.13, 1.34, 1.39, 1.35, 1.46),
    ("printed-letters:4x4", 0.25): (5.06, 3.99, 4.16, 3.75, 3.07),
}
TABLE4_SHEARS = (-1.0, 1.0)
TABLE4_PERCENT = {  # refocused from the light field, direct; at each shear
    ("line", "blocks"): ((11.98, 6.08), (3.66, 4.16)),
    ("line", "letters"): ((18.68, 8.48), (6.33, 6.75)),
    ("single-pixel", "blocks"): ((10.47, 10.67), (6.23, 7.35)),
    ("single-pixel", "letters"): ((13.02, 7.53), (4.41, 4.05)),
}
LIGHT_FIELD_CASES = [
    Case((scene, f"{ratio:g}", LIGHT_FIELD_LABEL), scene, "single-pixel", ratio, 0.0, figures[0])
    for (scene, ratio), figures in TABLE3_PERCENT.items()
]
PICTURE_CASES = [
    Case((scene, f"{ratio:g}", f"s = {shear:g}"), scene, "single-pixel", ratio, shear, percent)
    for (scene, ratio), figures in TABLE3_PERCENT.items()
    for shear, percent in zip(SHEARS, figures[1:], strict=True)
]
REFOCUSING_CASES = [
    Case((CAMERA_NAMES[encoder], scene, f"{shear:g}", label), scene, encoder, 1.0, shear, percent)
    for (encoder, scene), figures in TABLE4_PERCENT.items()
    for label, own in zip((REFOCUSED_LABEL, DIRECT_LABEL), figures, strict=True)
    for shear, percent in zip(TABLE4_SHEARS, own, strict=True)
]


def recover_light_field(case: Case, library: Library, seed: int) -> LightField:
    """Recover all views that got measurements, with total variation over pixels and views.

    `seed`: of camera and noise. Returns pictures (views, rows, columns).
    """
    measurement = measure_case(case, library, seed)
    camera, views = measurement.camera(), measurement.views
    weighting = camera.weighting()
    used = views[list(camera.used_views)]
    side = round(np.sqrt(len(used)))
    # views without measurements break the grid: then each view stands on its own
    grid, angular = (
        ((side, side), ANGULAR_WEIGHT) if len(used) == len(views) else ((1, len(used)), 0.0)
    )
    method = LightFieldVariation(TV_WEIGHT, ITERATIONS, grid=grid, angular=angular)
    measurements = weighting(measurement.values)[:, np.newaxis]
    return LightField(
        method.recover(weighting @ camera.light_field_model(), measurements).frames[0], used
    )


def run_table3(library: Library, seeds: int, advance: Advance) -> Outcome:
    """CLIP-0D of printed letters with 4 x 4 views: the whole light field, and pictures at four
    depths.

    `library`: light fields and recordings by name; `seeds`: repeats with other random numbers;
    `advance`: called with the number of steps just done. Returns A row of figures for each case,
    and the pictures to show.
    """
    solved = solve_cases(PICTURE_CASES, library, seeds, advance)
    found = _recover_light_fields(LIGHT_FIELD_CASES, library, seeds, advance)
    rows, panels = [], []
    for number, (whole, fields) in enumerate(zip(LIGHT_FIELD_CASES, found, strict=True)):
        own = solved[4 * number : 4 * number + 4]
        truth = library.light_field(whole.scene).pictures
        percent = tuple(100 * nmse(field.pictures, truth, BORDER_PX) for field in fields)
        rows += [Row(whole.labels, percent, whole.paper), *(one.row() for one in own)]
        title = f"{whole.scene.partition(':')[0]} SR = {whole.sampling_ratio:g}"
        mosaic = Panel(
            f"{title}, light field\n{np.mean(percent):.1f} %", _tile_views(fields[0].pictures)
        )
        panels.append(
            (Panel(f"{title}\ntrue views", _tile_views(truth)), mosaic, *_make_direct_panels(own))
        )
    return Outcome(("scene", "SR", "what"), "NMSE, %", tuple(rows), tuple(panels))


def run_table4(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Pictures refocused from a recovered light field beside those recovered directly, at SR = 1.

    `library`: light fields and recordings by name; `seeds`: repeats with other random numbers;
    `advance`: called with the number of steps just done. Returns A row of figures for each case,
    and the pictures to show.
    """
    direct = [case for case in REFOCUSING_CASES if case.labels[-1] == DIRECT_LABEL]
    wholes = [
        Case((CAMERA_NAMES[encoder], scene), scene, encoder, 1.0, 0.0)
        for encoder, scene in TABLE4_PERCENT
    ]
    solved = solve_cases(direct, library, seeds, advance)
    found = _recover_light_fields(wholes, library, seeds, advance)
    rows, panels = [], []
    for number, (whole, fields) in enumerate(zip(wholes, found, strict=True)):
        own = solved[2 * number : 2 * number + 2]
        line = [
            Panel(
                f"{whole.labels[0]}, {whole.scene}\nrecovered light field",
                _tile_views(fields[0].pictures),
            )
        ]
        for one, paper in zip(own, TABLE4_PERCENT[whole.encoder, whole.scene][0], strict=True):
            refocused = [field.refocus(one.case.shear) for field in fields]
            percent = tuple(100 * nmse(picture, one.truth, BORDER_PX) for picture in refocused)
            rows += [Row((*one.case.labels[:3], REFOCUSED_LABEL), percent, paper), one.row()]
            line += [
                Panel(f"true, s = {one.case.shear:g}", one.truth),
                Panel(f"{REFOCUSED_LABEL}\n{np.mean(percent):.1f} %", refocused[0]),
                one.panel(DIRECT_LABEL),
            ]
        panels.append(tuple(line))
    return Outcome(("camera", "scene", "s", "recovered"), "NMSE, %", tuple(rows), tuple(panels))


def _recover_light_fields(
    cases: Sequence[Case], library: Library, seeds: int, advance: Advance
) -> list[list[LightField]]:
    """One light field for each case and seed."""
    for case in cases:
        library.light_field(case.scene)
    jobs = [(case, seed) for case in cases for seed in range(seeds)]
    found = list(map_parallel(partial(_recover_job, library, advance), jobs))
    return [found[number * seeds : (number + 1) * seeds] for number in range(len(cases))]


def _recover_job(library: Library, advance: Advance, job: tuple[Case, int]) -> LightField:
    found = recover_light_field(job[0], library, job[1])
    advance(1)
    return found


def _make_direct_panels(solved: Sequence[SolvedCase]) -> tuple[Panel, ...]:
    return tuple(one.panel(f"direct, s = {one.case.shear:g}") for one in solved)


def _tile_views(pictures: NDArray[Any]) -> NDArray[Any]:
    """As many views as fill a square, in one picture, as they stand on the grid."""
    side, (_, rows, columns) = math.isqrt(len(pictures)), pictures.shape
    grid = pictures[: side * side].reshape(side, side, rows, columns)
    return grid.swapaxes(1, 2).reshape(side * rows, side * columns)


WEIGHT_NOTE = f"for pictures {CROSS_VALIDATED}; for light fields fixed at {TV_WEIGHT:g}, the same for all of them"

STUDIES = (
    Study(
        "table3",
        ("fig8", "fig9", "fig10"),
        "CLIP-0D with 4 x 4 views: light field and refocused pictures",
        "The paper's scenes were recorded; rendered words and letters at four depths stand for them.",
        WEIGHT_NOTE,
        40,
        5 * len(TABLE3_PERCENT),
        run_table3,
        best=(
            *(choose_settings(case, is_light_field=True) for case in LIGHT_FIELD_CASES),
            *map(choose_settings, PICTURE_CASES),
        ),
    ),
    Study(
        "table4",
        ("fig11",),
        "Refocusing a recovered light field beside direct recovery, SR = 1",
        "'blocks' and 'letters' are our own scenes. The prior of the light field is total variation over pixels and "
        "views; the paper tuned its weight for each.",
        WEIGHT_NOTE,
        40,
        3 * len(TABLE4_PERCENT),
        run_table4,
        best=tuple(map(choose_settings, REFOCUSING_CASES)),
    ),
)
