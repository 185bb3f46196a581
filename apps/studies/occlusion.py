"""Through occluders (Table 7): words and a figure behind black bars, which stand for what a time
gate removes.
"""

from __future__ import annotations

import numpy as np

from apps.studies.cases import BORDER_PX, CAMERA_NAMES, Case, solve_cases
from apps.studies.library import Library
from apps.studies.outcome import Advance, Outcome, Panel, Row, Study
from tofclip.metrics import nmse

SHEAR = -0.4
PAPER_NMSE_PERCENT = {  # NMSE in per cent at SR = 1 and 0.5
    "line": ((2.14, 2.68), (0.89, 2.44), (3.03, 4.83), (2.62, 4.12)),
    "single-pixel": ((4.29, 6.96), (2.19, 3.81), (4.37, 6.41), (3.25, 4.77)),
}
SCENES = ("figure-behind-bars", "figure-behind-plates", "word-behind-bars", "word-behind-plates")
CASES = [
    Case((CAMERA_NAMES[encoder], scene, f"{ratio:g}"), scene, encoder, ratio, SHEAR, percent)
    for scene_number, scene in enumerate(SCENES)
    for encoder in PAPER_NMSE_PERCENT
    for ratio, percent in zip((1.0, 0.5), PAPER_NMSE_PERCENT[encoder][scene_number], strict=True)
]


def run_occlusion(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Recover what stands behind the occluder; shift-and-add is the truth, the bare target stands
    beside it.

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
    rows, panels = [one.row() for one in solved], []
    for number, scene in enumerate(SCENES):
        own, bare = solved[4 * number : 4 * number + 4], library.render_unoccluded(scene)
        light_field = library.light_field(scene)
        dimming = 100 * nmse(own[0].truth, bare, BORDER_PX)
        rows.append(Row(("all views, against the bare target", scene, "-"), (dimming,)))
        reference = light_field.pictures[int(np.argmin((light_field.views**2).sum(axis=1)))]
        pictures = (one.panel(f"{one.case.labels[0]}, SR = {one.case.labels[2]}") for one in own)
        line = (
            Panel(f"{scene}\none view", reference),
            Panel("bare target", bare),
            Panel("all views", own[0].truth),
        )
        panels.append((*line, *pictures))
    return Outcome(("camera", "scene", "SR"), "NMSE, %", tuple(rows), tuple(panels))


STUDY = Study(
    "table7",
    ("fig15",),
    "Through occluders",
    "Rendered figures and words stand for the paper's. Its errors are against shift-and-add, so are ours; how far that "
    "itself is from the bare target is told in rows of their own.",
    15,
    len(CASES),
    run_occlusion,
)
