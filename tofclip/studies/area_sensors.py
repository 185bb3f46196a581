"""Sparse area sensors behind a diffuser (Supp. Fig. 4a-c)."""

from __future__ import annotations

from tofclip.studies.cases import Case, solve
from tofclip.studies.library import Library
from tofclip.studies.outcome import Advance, Outcome, Panel, Study

SPARSITIES = (1, 2, 4, 8, 16)
NOISE = 0.025
SCENES = {"blocks": 0.0, "printed-words": -0.3, "printed-letters": -0.3}
CASES = [
    Case((scene, str(sparsity)), scene, "diffuser", 1 / sparsity**2, shear, white_noise=NOISE)
    for scene, shear in SCENES.items()
    for sparsity in SPARSITIES
]


def area_sensors(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Recover scenes of three complexities from every n-th sensor pixel on either axis."""
    solved = solve(CASES, library, seeds, advance)
    panels = []
    for first in range(0, len(solved), len(SPARSITIES)):
        line = solved[first : first + len(SPARSITIES)]
        shown = (one.panel(f"every {one.case.labels[1]}. pixel") for one in line)
        panels.append((Panel(f"{line[0].case.scene}\ntrue", line[0].truth), *shown))
    rows = tuple(one.row() for one in solved)
    return Outcome(("scene", "sparsity"), "NMSE, %", rows, tuple(panels))


STUDY = Study(
    "fig4",
    (),
    "Sparse area sensors behind a diffuser, 2.5 % white noise",
    "The paper shows pictures only. Readings are made from 64 true views of scenes with depth, not from one flat "
    "picture; that costs quality.",
    20,
    len(CASES),
    area_sensors,
)
