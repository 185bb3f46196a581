"""What a light field must and can do (supplement Notes 1 and 2): even light over the views, depth from
focus, and a viewpoint between the views.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apps.studies.cases import BORDER_PX, Library
from apps.studies.outcome import Advance, Outcome, Panel, Row, Study
from tofclip.light_field import FocalStack, LightField, estimate_depth_from_focus, make_focal_stack
from tofclip.light_field.measurement import CameraSetup, measure
from tofclip.metrics import nmse
from tofclip.operators import LinearShear
from tofclip.recovery.light_field import ClipRecovery
from tofclip.simulate.bodies import Body, Lambertian, Rectangle, Specular
from tofclip.simulate.light_fields import Scene, render_light_field, render_shear_map, render_view
from tofclip.simulate.patterns import Pattern, make_plain_pattern, make_text_pattern
from tofclip.simulate.scenes import make_scene
from tofclip.threads import map_parallel

FOCUS_SCENES = ("letters", "blocks", "still-life", "slanted-text")
FOCUS_SHEARS = np.arange(-1.4, 1.01, 0.2)
NOVEL_VIEW = (-1.5, 2.5)
FOCUS_BORDER_PX = 6
SEARCH_RADIUS_PX = 2
TEXTURE_THRESHOLD = 0.2  # of the steepest slopes


def compute_depth_accuracy(
    found: NDArray[Any], true: NDArray[Any], picture: NDArray[Any], step: float
) -> float:
    """Share of textured pixels whose shear is right to three quarters of the stack's step.

    At an object's border the shear of either side counts, two pixels wide: what is in focus there
    is both.

    `found, true` (rows, columns): shears; `picture` (rows, columns): textured pixels have a slope
    of a fifth of its steepest or more; six pixels at the border do not count; `step`: between the
    shears of the focal stack. Returns 0 to 1.
    """
    slope = np.hypot(*np.gradient(picture))
    textured = slope > TEXTURE_THRESHOLD * np.quantile(slope, 0.99)
    # At an edge the focus measure answers for a neighbour, so that the best shear within a few
    # pixels counts.
    near = range(-SEARCH_RADIUS_PX, SEARCH_RADIUS_PX + 1)
    errors = [np.abs(found - np.roll(true, (y, x), (0, 1))) for y in near for x in near]
    right = np.min(errors, axis=0) <= 0.75 * step
    inner = (slice(FOCUS_BORDER_PX, -FOCUS_BORDER_PX),) * 2
    return float(right[inner][textured[inner]].mean())


def run_light_field_processing(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Score depth from focus against the exact shears and a viewpoint against a camera rendered
    there.

    `library`: light fields and recordings by name; `seeds`: repeats with other random numbers;
    `advance`: called with the number of steps just done. Returns A row of figures for each case,
    and the pictures to show.
    """
    rows, panels = [], []
    for name in FOCUS_SCENES:
        scene, light_field = make_scene(name, library.array), library.light_field(name)
        reference = render_view(scene, library.array, (0.0, 0.0))
        stack, moved = (
            make_focal_stack(light_field, FOCUS_SHEARS),
            make_focal_stack(light_field, FOCUS_SHEARS, NOVEL_VIEW),
        )
        depths, true = estimate_depth_from_focus(stack), render_shear_map(scene, library.array)
        seen = moved.all_in_focus(estimate_depth_from_focus(moved))
        there = render_view(scene, library.array, NOVEL_VIEW)
        right = compute_depth_accuracy(
            FOCUS_SHEARS[depths], true, reference, float(FOCUS_SHEARS[1] - FOCUS_SHEARS[0])
        )
        rows += [
            Row((name, "right plane, % of textured pixels"), (100 * right,)),
            Row(
                (name, "viewpoint between the views, NMSE in %"),
                (100 * nmse(seen, there, FOCUS_BORDER_PX),),
            ),
            Row(
                (name, "reference view in its place, NMSE in %"),
                (100 * nmse(reference, there, FOCUS_BORDER_PX),),
            ),
        ]
        maps = (
            Panel("true s", true, is_map=True),
            Panel("s from focus", FOCUS_SHEARS[depths], is_map=True),
        )
        views = (Panel("rendered viewpoint", there), Panel("synthesised", seen))
        panels.append((Panel(f"{name}\nreference view", reference), *maps, *views))
        advance(1)
    return Outcome(("scene", "figure"), "see the rows", tuple(rows), tuple(panels))


FOCUS_STUDY = Study(
    "note2",
    (),
    "Depth from focus, and a viewpoint between the views",
    f"The paper has no figures. The viewpoint is (v, u) = {NOVEL_VIEW}, the truth a camera rendered there.",
    "none: these are true views, nothing is recovered",
    10,
    len(FOCUS_SCENES),
    run_light_field_processing,
    seeded=False,
)


PLATE_SHEAR, SIZE_PX = -0.6, 72.0
SHEAR_STEP = 0.3
STACK_SHEARS = np.arange(-1.2, 0.61, SHEAR_STEP)
PLATE_LIGHT_DIRECTION = (
    0.08,
    0.05,
    -1.0,
)  # mirrored towards the cameras by a plate that faces them
MATERIALS: Mapping[str, Callable[[Pattern], Lambertian]] = {
    "matt": Lambertian,
    "glossy": partial(Specular, gloss=0.6, exponent=150.0),
}


def run_glossy_plate(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Recover a plate of either kind from CLIP-1D at SR = 1; say how even its light is, and the
    errors.

    `library`: light fields and recordings by name; `seeds`: repeats with other random numbers;
    `advance`: called with the number of steps just done. Returns A row of figures for each case,
    and the pictures to show.
    """
    rows, panels = [], []
    pattern = make_text_pattern("TOF\nCLIP", 0.05, 0.35)
    for name, make_material in MATERIALS.items():
        rendered = render_light_field(_make_scene(library, make_material(pattern)), library.array)
        field, plate = rendered.light_field, _erode_mask(rendered.shears < 0)
        reference = field.pictures[int(np.argmin((field.views**2).sum(axis=1)))]
        pictures = [_recover_stack(field, seed, advance) for seed in range(seeds)]
        focused = [
            stack.pictures[int(np.argmin(abs(STACK_SHEARS - PLATE_SHEAR)))] for stack in pictures
        ]
        shears = [STACK_SHEARS[estimate_depth_from_focus(stack)] for stack in pictures]
        errors = tuple(100 * nmse(picture, reference, BORDER_PX) for picture in focused)
        right = tuple(
            100 * compute_depth_accuracy(found, rendered.shears, reference, SHEAR_STEP)
            for found in shears
        )
        rows += [
            Row((name, "unevenness over the views, %"), (100 * _measure_unevenness(field, plate),)),
            Row((name, "NMSE against the reference view, %"), errors),
            Row((name, "right plane, % of textured pixels"), right),
        ]
        truth = np.where(np.isfinite(rendered.shears), rendered.shears, 0)
        panels.append(
            (
                Panel(f"{name}\nreference view", reference),
                Panel("opposite view", field.pictures[0]),
                Panel(f"CLIP-1D, s = {PLATE_SHEAR:g}\n{np.mean(errors):.1f} %", focused[0]),
                Panel("true s", truth, is_map=True),
                Panel("s from focus", shears[0], is_map=True),
            )
        )
    return Outcome(("plate", "figure"), "see the rows", tuple(rows), tuple(panels))


def _make_scene(library: Library, material: Lambertian) -> Scene:
    array = library.array
    side = SIZE_PX * min(array.image_shape) / 128 / array.focal_length_px * array.depth(PLATE_SHEAR)
    plate = Body(Rectangle(side, side), material, array.point(0, 0, PLATE_SHEAR))
    wall = Body(Rectangle(9.0, 9.0), Lambertian(make_plain_pattern(0.02)), array.point(0, 0, 0.5))
    return Scene((wall, plate), PLATE_LIGHT_DIRECTION)


def _recover_stack(field: LightField, seed: int, advance: Advance) -> FocalStack:
    measurement = measure(field, CameraSetup("line", 1.0, seed))
    chosen = ClipRecovery().recover(measurement, PLATE_SHEAR)
    # One weight for all planes: depth from focus compares their contrast.
    recovery = replace(ClipRecovery(), weight=chosen.weight)
    pictures = list(
        map_parallel(
            lambda shear: recovery.recover(measurement, float(shear)).picture, list(STACK_SHEARS)
        )
    )
    advance(1)
    return FocalStack(np.stack(pictures), STACK_SHEARS)


def _measure_unevenness(field: LightField, where: NDArray[np.bool_]) -> float:
    """Standard deviation over the views, moved onto each other, relative to the mean; its mean
    square root.
    """
    shape = (field.pictures.shape[1], field.pictures.shape[2])
    moved = np.stack(
        [
            LinearShear(shape, PLATE_SHEAR, (float(v), float(u))).H(picture)
            for picture, (v, u) in zip(field.pictures, field.views, strict=True)
        ]
    )
    deviation, mean = moved.std(axis=0)[where], moved.mean(axis=0)[where]
    return float(np.sqrt(np.mean(deviation**2)) / mean.mean())


def _erode_mask(mask: NDArray[Any]) -> NDArray[np.bool_]:
    """The mask without its border, where views see past the body."""
    from scipy.ndimage import binary_erosion

    inner: NDArray[np.bool_] = binary_erosion(mask, iterations=4)
    return inner


GLOSSY_STUDY = Study(
    "note1",
    (),
    "A glossy plate: its intensity is wrong, its geometry survives",
    "The paper states it without figures.",
    "chosen by cross-validation at the plate's depth for every seed, without the truth, and kept for all depths",
    20,
    len(MATERIALS),
    run_glossy_plate,
)
