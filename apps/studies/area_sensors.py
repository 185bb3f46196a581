"""Sparse area sensors behind a diffuser (Supp. Fig. 4a-c)."""

from __future__ import annotations

from apps.studies.cases import Case, solve_cases
from apps.studies.library import Library
from apps.studies.outcome import Advance, Outcome, Panel, Study

SPARSITIES = (1, 2, 4, 8, 16)
NOISE_FRACTION = 0.025
SCENES = ("blocks", "printed-words", "printed-letters")
CASES = [
    Case(
        (scene, str(sparsity)),
        f"{scene}:flat",
        "diffuser",
        1 / sparsity**2,
        0.0,
        white_noise=NOISE_FRACTION,
    )
    for scene in SCENES
    for sparsity in SPARSITIES
]


def run_area_sensors(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Recover scenes of three complexities from every n-th sensor pixel on either axis.

    Parameters
    ----------
    library : Library
        Light fields and recordings by name.
    seeds : int
        Repeats with other random numbers.
    advance : callable
        Called with the number of steps just done.

    Returns
    -------
    Outcome
        A row of figures for each case, and the pictures to show.
    """
    solved = solve_cases(CASES, library, seeds, advance)
    panels = []
    for first in range(0, len(solved), len(SPARSITIES)):
        line = solved[first : first + len(SPARSITIES)]
        shown = (one.panel(f"every {one.case.labels[1]}. pixel") for one in line)
        panels.append((Panel(f"{line[0].case.labels[0]}\ntrue", line[0].truth), *shown))
    rows = tuple(one.row() for one in solved)
    return Outcome(("scene", "sparsity"), "NMSE, %", rows, tuple(panels))


STUDY = Study(
    "fig4",
    (),
    "Sparse area sensors behind a diffuser, 2.5 % white noise",
    "The paper shows pictures only, of flat scenes; these are posters of our own scenes.",
    20,
    len(CASES),
    run_area_sensors,
)
