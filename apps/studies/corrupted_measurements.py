"""Bad measurements and few photons: Tables 5 and 6."""

from __future__ import annotations

from itertools import groupby

from apps.studies.cases import CAMERA_NAMES, Case, SolvedCase, solve_cases
from apps.studies.library import Library
from apps.studies.outcome import Advance, Outcome, Panel, Row, Study

SHEARS = {"blocks": -0.6, "letters": -0.4, "printed-words": -0.3, "printed-letters": -0.3}
TABLE5_PERCENT = {  # share of bad measurements to the pictures' NMSE, per cent
    ("single-pixel", "printed-words"): {0.001: 1.54, 0.002: 2.08, 0.01: 11.24},
    ("single-pixel", "printed-letters"): {0.001: 4.50, 0.002: 4.7, 0.01: 6.5},
    ("line", "letters"): {0.01: 5.07, 0.05: 12.1, 0.1: 15.2},
    ("line", "blocks"): {0.01: 1.68, 0.05: 6.05, 0.1: 9.38},
}
TABLE6_PERCENT = {  # photons of the largest reading to NMSE, per cent
    ("line", "blocks"): {400: 7.30, 1000: 6.54, 4000: 5.92, 10000: 6.01},
    ("line", "letters"): {400: 2.85, 1000: 2.66, 4000: 2.55, 10000: 2.53},
    ("single-pixel", "blocks"): {400: 57.88, 1000: 40.62, 4000: 20.58, 10000: 14.95},
    ("single-pixel", "letters"): {400: 43.45, 1000: 25.45, 4000: 16.16, 10000: 7.05},
}


def run_invalid_measurements(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Set a share of the measurements to 0 or to the largest; recover with squares, and with
    Huber's term.

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
    cases = [
        Case(
            (CAMERA_NAMES[encoder], scene, f"{100 * share:g} %", term),
            scene,
            encoder,
            1.0,
            SHEARS[scene],
            percent if term == "squares" else None,
            bad_fraction=share,
            data_term=term,
        )
        for (encoder, scene), figures in TABLE5_PERCENT.items()
        for term in ("squares", "huber")
        for share, percent in figures.items()
    ]
    return _make_outcome(
        ("camera", "scene", "bad readings", "data term"),
        solve_cases(cases, library, seeds, advance),
    )


def run_few_photons(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Count photons, the largest reading so many.

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
    cases = [
        Case(
            (CAMERA_NAMES[encoder], scene, str(photons)),
            scene,
            encoder,
            1.0,
            SHEARS[scene],
            percent,
            photons=photons,
        )
        for (encoder, scene), figures in TABLE6_PERCENT.items()
        for photons, percent in figures.items()
    ]
    return _make_outcome(
        ("camera", "scene", "photons"), solve_cases(cases, library, seeds, advance)
    )


def _make_outcome(columns: tuple[str, ...], solved: list[SolvedCase]) -> Outcome:
    panels = []
    for _, some in groupby(
        solved, key=lambda one: (one.case.encoder, one.case.scene, one.case.data_term)
    ):
        line = list(some)
        camera, scene, *_ = line[0].case.labels
        shown = (one.panel(", ".join(one.case.labels[2:])) for one in line)
        panels.append((Panel(f"{camera}, {scene}\ntrue", line[0].truth), *shown))
    rows: tuple[Row, ...] = tuple(one.row() for one in solved)
    return Outcome(columns, "NMSE, %", rows, tuple(panels))


STUDIES = (
    Study(
        "table5",
        ("fig12",),
        "Bad readings at SR = 1",
        "The paper does not say its data term; its figures stand beside squares, Huber's is ours. Scenes are our own.",
        50,
        2 * sum(map(len, TABLE5_PERCENT.values())),
        run_invalid_measurements,
    ),
    Study(
        "table6",
        ("fig13",),
        "Few photons at SR = 1",
        "Scenes are our own.",
        15,
        sum(map(len, TABLE6_PERCENT.values())),
        run_few_photons,
    ),
)
