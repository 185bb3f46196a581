"""Light fields as CLIP keeps them: refocus, depth, all in focus over the sampling ratio (Tables 8
to 10).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from apps.studies.best import choose_settings
from apps.studies.cases import (
    CAMERA_NAMES,
    Case,
    Library,
    SolvedCase,
    measure_case,
    solve_cases,
)
from apps.studies.outcome import CROSS_VALIDATED, Advance, Outcome, Panel, Study
from tofclip.light_field import FocalStack, estimate_depth_from_focus, make_focal_stack
from tofclip.recovery.light_field import ClipRecovery
from tofclip.threads import map_parallel

STACK_SHEARS = np.arange(-1.3, 0.61, 0.3)


@dataclass(frozen=True)
class RepresentationTable:
    """A scene and the paper's figures: NMSE in per cent by camera and shear over the sampling
    ratios.
    """

    scene: str
    # (encoder, shear) to the figures at SR = 2, 1, 0.5 and 0.25; None where the paper has none
    figures: dict[tuple[str, float], tuple[float | None, ...]]

    @property
    def cases(self) -> list[Case]:
        """All of its cases."""
        return [
            Case(
                (CAMERA_NAMES[encoder], f"{shear:g}", f"{ratio:g}"),
                self.scene,
                encoder,
                ratio,
                shear,
                percent,
            )
            for (encoder, shear), figures in self.figures.items()
            for ratio, percent in zip((2, 1, 0.5, 0.25), figures, strict=True)
        ]

    def evaluate(self, library: Library, seeds: int, advance: Advance) -> Outcome:
        """Recover at every depth and sampling ratio with both cameras; depth maps for the first
        seed.

        `library`: light fields and recordings by name; `seeds`: repeats with other random numbers;
        `advance`: called with the number of steps just done. Returns A row of figures for each
        case, and the pictures to show.
        """
        solved = solve_cases(self.cases, library, seeds, advance)
        panels = [self._make_truth_panels(library, solved)]
        for encoder in dict.fromkeys(encoder for encoder, _ in self.figures):
            for ratio in (2, 1, 0.5, 0.25):
                line = [
                    one
                    for one in solved
                    if (one.case.encoder, one.case.sampling_ratio) == (encoder, ratio)
                ]
                panels.append(_make_panels(library, line))
        rows = tuple(one.row() for one in solved)
        return Outcome(("camera", "s", "SR"), "NMSE, %", rows, tuple(panels))

    def _make_truth_panels(self, library: Library, solved: list[SolvedCase]) -> tuple[Panel, ...]:
        truths = {one.case.shear: one.truth for one in solved}
        stack = make_focal_stack(library.light_field(self.scene), STACK_SHEARS)
        refocused = tuple(
            Panel(f"true views\ns = {shear:g}", truth) for shear, truth in truths.items()
        )
        return (*refocused, *_make_depth_panels(stack))


def _make_panels(library: Library, line: list[SolvedCase]) -> tuple[Panel, ...]:
    """The pictures of one camera and sampling ratio, with depth and all in focus from a stack of
    recoveries.
    """
    case, recovery = line[0].case, ClipRecovery(weight=line[0].weight)
    measurement = measure_case(case, library, 0)
    shears = [float(shear) for shear in STACK_SHEARS]
    pictures = list(
        map_parallel(lambda shear: recovery.recover(measurement, shear).picture, shears)
    )
    refocused = tuple(
        one.panel(f"{CAMERA_NAMES[case.encoder]} SR = {case.sampling_ratio:g}") for one in line
    )
    return (*refocused, *_make_depth_panels(FocalStack(np.stack(pictures), STACK_SHEARS)))


def _make_depth_panels(stack: FocalStack) -> tuple[Panel, Panel]:
    depths = estimate_depth_from_focus(stack)
    return Panel("s from focus", stack.shears[depths], is_map=True), Panel(
        "all in focus", stack.all_in_focus(depths)
    )


def _make_study(name: str, figure: str, title: str, table: RepresentationTable, note: str) -> Study:
    return Study(
        name,
        (figure,),
        title,
        note,
        f"{CROSS_VALIDATED}; the depth maps take that of the first depth of their row",
        35,
        len(table.cases),
        partial(RepresentationTable.evaluate, table),
        best=tuple(choose_settings(case) for case in table.cases if case.paper is not None),
    )


LETTERS_TABLE = RepresentationTable(
    "letters",
    {
        ("line", -1.0): (1.75, 2.79, 5.32, None),
        ("line", -0.4): (1.47, 2.63, 4.54, None),
        ("line", -0.1): (1.59, 3.04, 5.91, None),
        ("single-pixel", -1.0): (1.75, 2.60, 3.99, 6.61),
        ("single-pixel", -0.4): (1.48, 2.49, 4.06, 5.58),
        ("single-pixel", -0.1): (1.64, 2.84, 4.48, 7.50),
    },
)
SLANTED_TEXT_TABLE = RepresentationTable(
    "slanted-text",
    {
        ("line", -1.0): (0.97, 4.5, 9.97, None),
        ("line", -0.4): (0.80, 1.78, 6.41, None),
        ("line", 0.3): (0.72, 3.39, 5.54, None),
        ("single-pixel", -1.0): (3.01, 4.91, 8.03, 11.94),
        ("single-pixel", -0.4): (4.10, 3.85, 6.13, 9.31),
        ("single-pixel", 0.3): (3.29, 5.88, 7.62, 15.77),
    },
)
BOLT_TABLE = RepresentationTable(
    "bolt-and-letters",
    {
        ("line", -1.0): (0.97, 2.46, 4.77, None),
        ("line", -0.5): (0.80, 2.04, 3.84, None),
        ("line", 0.2): (0.72, 1.70, 3.23, None),
        ("single-pixel", -1.0): (0.82, 1.27, 1.96, 3.28),
        ("single-pixel", -0.5): (1.31, 1.72, 2.35, 3.25),
        ("single-pixel", 0.2): (0.85, 1.22, 2.11, 2.94),
    },
)
OWN_SCENE_NOTE = (
    "The paper's recordings are not public; a rendered scene of the same kind stands for them."
)

STUDIES = (
    _make_study(
        "table8",
        "fig16",
        "CLIP of the letters: refocus, depth, all in focus",
        LETTERS_TABLE,
        OWN_SCENE_NOTE,
    ),
    _make_study("table9", "fig17", "CLIP of a slanted text", SLANTED_TEXT_TABLE, OWN_SCENE_NOTE),
    _make_study(
        "table10",
        "fig18",
        "CLIP of shiny metal and letters",
        BOLT_TABLE,
        f"{OWN_SCENE_NOTE} Ball and block are glossy: uniform angular intensity does not hold there.",
    ),
)
