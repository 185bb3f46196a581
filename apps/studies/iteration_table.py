"""Table 1 as measured: seconds of one iteration of every method on the same scene."""

from __future__ import annotations

from apps.studies.complexity import measure_iteration_costs
from apps.studies.library import Library
from apps.studies.outcome import Advance, Outcome, Panel, Row, Study

SCENE, SHEAR = "letters", -0.4


def run_iteration_table(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Time every method; the repeats stand in for seeds.

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
    costs = measure_iteration_costs(library.light_field(SCENE), SHEAR, repeats=2 * seeds)
    advance(1)
    rows = tuple(
        Row(
            (
                cost.method,
                cost.recovers,
                str(cost.measurements),
                str(cost.unknowns),
                cost.complexity,
            ),
            (1e3 * cost.seconds,),
        )
        for cost in costs
    )
    truth = library.light_field(SCENE).refocus(SHEAR)
    return Outcome(
        ("method", "recovers", "readings", "unknowns", "operations"),
        "ms per iteration",
        rows,
        ((Panel(f"{SCENE}, s = {SHEAR:g}", truth),),),
    )


STUDY = Study(
    "table1",
    (),
    "What an iteration costs",
    "The paper gives the operations; seconds are measured here, on one core, and depend on the machine.",
    5,
    1,
    run_iteration_table,
    seeded=False,
)
