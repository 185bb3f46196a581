"""Which view gets which angle: dealt at random as in the paper, or evenly over the aperture (beyond
the paper).
"""

from __future__ import annotations

from apps.studies.cases import CAMERA_NAMES, Case, solve_cases
from apps.studies.library import Library
from apps.studies.outcome import Advance, Outcome, Panel, Study

RATIOS = (2.0, 1.0, 0.5, 0.25)
SCENES = {"letters": -0.4, "blocks": -0.6}
RECORDED_SCENES = {"render_letters": -0.3, "render_planes": 0.0, "hci_antinous": 0.0}
ENCODERS = ("line", "line-even")


def run_angle_assignment(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Recover with both ways of dealing; others' light fields too where they are at hand, as
    figures only.

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
    scenes = SCENES | {
        f"data:{name}": shear
        for name, shear in RECORDED_SCENES.items()
        if library.has_recording(f"lightfields/{name}.npz")
    }
    cases = [
        Case(
            (scene.removeprefix("data:"), CAMERA_NAMES[encoder], f"{ratio:g}"),
            scene,
            encoder,
            ratio,
            shear,
        )
        for scene, shear in scenes.items()
        for encoder in ENCODERS
        for ratio in RATIOS
    ]
    solved = solve_cases(cases, library, seeds, advance)
    panels = []
    for first in range(0, len(SCENES) * len(ENCODERS) * len(RATIOS), len(RATIOS)):
        line = solved[first : first + len(RATIOS)]
        scene, camera, _ = line[0].case.labels
        shown = (one.panel(f"SR = {one.case.labels[2]}") for one in line)
        panels.append((Panel(f"{scene}, {camera}\ntrue", line[0].truth), *shown))
    rows = tuple(one.row() for one in solved)
    return Outcome(("scene", "camera", "SR"), "NMSE, %", rows, tuple(panels))


STUDY = Study(
    "dealing",
    (),
    "Angles dealt to views at random, and evenly over the aperture",
    "Beyond the paper, which deals at random.",
    25,
    2 * len(SCENES) * len(RATIOS),
    run_angle_assignment,
)
