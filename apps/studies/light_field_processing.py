"""Depth from focus and a viewpoint between the views, from true light fields (supplement Note 2)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from apps.studies.library import Library
from apps.studies.outcome import Advance, Outcome, Panel, Row, Study
from tofclip.light_field import estimate_depth_from_focus, make_focal_stack
from tofclip.metrics import nmse
from tofclip.simulate.light_fields import make_scene, render_shear_map, render_view

SCENES = ("letters", "blocks", "still-life", "slanted-text")
SHEARS = np.arange(-1.4, 1.01, 0.2)
NOVEL_VIEW = (-1.5, 2.5)
BORDER_PX = 6
SEARCH_RADIUS_PX = 2
TEXTURE_THRESHOLD = 0.2  # of the steepest slopes


def compute_depth_accuracy(
    found: NDArray[Any], true: NDArray[Any], picture: NDArray[Any], step: float
) -> float:
    """Share of textured pixels whose shear is right to three quarters of the stack's step.

    At an object's border the shear of either side counts, two pixels wide: what is in focus there
    is both.

    Parameters
    ----------
    found, true : (rows, columns) arrays
        Shears.
    picture : (rows, columns) array
        Textured pixels have a slope of a fifth of its steepest or more; six pixels at the border do
        not count.
    step : float
        Between the shears of the focal stack.

    Returns
    -------
    float
        0 to 1.
    """
    slope = np.hypot(*np.gradient(picture))
    textured = slope > TEXTURE_THRESHOLD * np.quantile(slope, 0.99)
    near = range(-SEARCH_RADIUS_PX, SEARCH_RADIUS_PX + 1)
    errors = [np.abs(found - np.roll(true, (y, x), (0, 1))) for y in near for x in near]
    right = np.min(errors, axis=0) <= 0.75 * step
    inner = (slice(BORDER_PX, -BORDER_PX),) * 2
    return float(right[inner][textured[inner]].mean())


def run_light_field_processing(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Score depth from focus against the exact shears and a viewpoint against a camera rendered
    there.

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
    rows, panels = [], []
    for name in SCENES:
        scene, light_field = make_scene(name, library.array), library.light_field(name)
        reference = render_view(scene, library.array, (0.0, 0.0))
        stack, moved = (
            make_focal_stack(light_field, SHEARS),
            make_focal_stack(light_field, SHEARS, NOVEL_VIEW),
        )
        depths, true = estimate_depth_from_focus(stack), render_shear_map(scene, library.array)
        seen = moved.all_in_focus(estimate_depth_from_focus(moved))
        there = render_view(scene, library.array, NOVEL_VIEW)
        right = compute_depth_accuracy(
            SHEARS[depths], true, reference, float(SHEARS[1] - SHEARS[0])
        )
        rows += [
            Row((name, "right plane, % of textured pixels"), (100 * right,)),
            Row(
                (name, "viewpoint between the views, NMSE in %"),
                (100 * nmse(seen, there, BORDER_PX),),
            ),
            Row(
                (name, "reference view in its place, NMSE in %"),
                (100 * nmse(reference, there, BORDER_PX),),
            ),
        ]
        maps = (
            Panel("true s", true, is_map=True),
            Panel("s from focus", SHEARS[depths], is_map=True),
        )
        views = (Panel("rendered viewpoint", there), Panel("synthesised", seen))
        panels.append((Panel(f"{name}\nreference view", reference), *maps, *views))
        advance(1)
    return Outcome(("scene", "figure"), "see the rows", tuple(rows), tuple(panels))


STUDY = Study(
    "note2",
    (),
    "Depth from focus, and a viewpoint between the views",
    f"The paper has no figures. The viewpoint is (v, u) = {NOVEL_VIEW}, the truth a camera rendered there.",
    10,
    len(SCENES),
    run_light_field_processing,
    seeded=False,
)
