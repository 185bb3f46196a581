"""Whole light fields: recovered (Eq. 20) beside refocused pictures recovered directly (Eq. 21, Tables
3 and 4), and what a light field must and can do (supplement Notes 1 and 2): even light over the
views, depth from focus, and a viewpoint between the views.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from math import isqrt

import numpy as np

from apps.studies.cases import (
    BORDER_PX,
    CROSS_VALIDATED,
    LIGHT_FIELD_LABEL,
    Advance,
    Case,
    Library,
    Outcome,
    Panel,
    Row,
    find_reference_view,
    measure_case,
    read_cases,
    recover_stack,
    solve_cases,
    study,
)
from tofclip.arrays import AnyArray, BoolArray
from tofclip.light_field import FocalStack, LightField, estimate_depth_from_focus, make_focal_stack
from tofclip.light_field.views import CameraSetup, measure
from tofclip.metrics import nmse
from tofclip.operators import LinearShear
from tofclip.recovery.light_field import ClipRecovery
from tofclip.simulate.bodies import Body, Lambertian, Rectangle, Specular
from tofclip.simulate.light_fields import Scene, render_light_field, render_shear_map, render_view
from tofclip.simulate.patterns import Pattern, make_plain_pattern, make_text_pattern
from tofclip.simulate.scenes import make_scene
from tofclip.solvers.fista import LightFieldVariation
from tofclip.threads import map_parallel

# half the iterations leave single-pixel views a grey veil
TV_WEIGHT, ITERATIONS, ANGULAR_WEIGHT = 3e-3, 200, 0.5
WEIGHT_NOTE = f"for pictures {CROSS_VALIDATED}; for light fields fixed at {TV_WEIGHT:g}, the same for all of them"
REFOCUSED_LABEL, DIRECT_LABEL = "refocused from it", "direct"


def recover_light_field(case: Case, library: Library, seed: int) -> LightField:
    """Recover all views that got measurements, with total variation over pixels and views."""
    measurement = measure_case(case, library, seed)
    camera, views = measurement.camera(), measurement.views
    weighting = camera.weighting()
    used = views[list(camera.used_views)]
    # views without measurements break the grid: then each view stands on its own
    grid, angular = (1, len(used)), 0.0
    if len(used) == len(views):
        grid, angular = (round(np.sqrt(len(used))),) * 2, ANGULAR_WEIGHT
    method = LightFieldVariation(TV_WEIGHT, ITERATIONS, grid=grid, angular=angular)
    measurements = weighting(measurement.values)[:, np.newaxis]
    model = weighting @ camera.light_field_model()
    return LightField(method.recover(model, measurements).frames[0], used)


def _recover_light_fields(
    cases: Sequence[Case], library: Library, seeds: int, advance: Advance
) -> list[list[LightField]]:
    """One light field for each case and seed."""
    for case in cases:  # rendered once, before the threads start
        library.light_field(case.scene)

    def recover(job: tuple[Case, int]) -> LightField:
        light_field = recover_light_field(job[0], library, job[1])
        advance(1)
        return light_field

    fields = map_parallel(recover, [(case, seed) for case in cases for seed in range(seeds)])
    return [[next(fields) for _ in range(seeds)] for _ in cases]


def _tile_views(pictures: AnyArray) -> AnyArray:
    """As many views as fill a square, in one picture, as they stand on the grid."""
    from skimage.util import montage

    return montage(pictures[: isqrt(len(pictures)) ** 2])


@study(
    "table3",
    *("fig8", "fig9", "fig10"),
    title="CLIP-0D with 4 x 4 views: light field and refocused pictures",
    note="The paper's scenes were recorded; rendered words and letters at four depths stand for them.",
    weight=WEIGHT_NOTE,
    seconds=40,
    has_best=True,
)
def run_table3(library: Library, seeds: int, advance: Advance) -> Outcome:
    """CLIP-0D of printed letters with 4 x 4 views: the whole light field, and pictures at four
    depths.
    """
    cases = read_cases("table3")
    wholes = [case for case in cases if case.labels[-1] == LIGHT_FIELD_LABEL]
    pictures = [case for case in cases if case.labels[-1] != LIGHT_FIELD_LABEL]
    solved = solve_cases(pictures, library, seeds, advance)
    recovered = _recover_light_fields(wholes, library, seeds, advance)
    rows, panels = [], []
    for number, (whole, fields) in enumerate(zip(wholes, recovered, strict=True)):
        own = solved[4 * number : 4 * number + 4]
        truth = library.light_field(whole.scene).pictures
        percent = tuple(100 * nmse(field.pictures, truth, BORDER_PX) for field in fields)
        rows += [Row(whole.labels, percent, whole.paper), *(one.row() for one in own)]
        title = f"{whole.scene.partition(':')[0]} SR = {whole.sampling_ratio:g}"
        mosaic = _tile_views(fields[0].pictures)
        panels.append(
            [
                Panel(f"{title}\ntrue views", _tile_views(truth)),
                Panel(f"{title}, light field\n{np.mean(percent):.1f} %", mosaic),
                *(one.panel(f"direct, s = {one.case.shear:g}") for one in own),
            ]
        )
    return Outcome(("scene", "SR", "what"), "NMSE, %", rows, panels)


@study(
    "table4",
    "fig11",
    title="Refocusing a recovered light field beside direct recovery, SR = 1",
    note="'blocks' and 'letters' are our own scenes. The prior of the light field is total variation over pixels and "
    "views; the paper tuned its weight for each.",
    weight=WEIGHT_NOTE,
    seconds=40,
    steps=12,
    has_best=True,
)
def run_table4(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Pictures refocused from a recovered light field beside those recovered directly, at SR = 1."""
    cases = read_cases("table4")
    direct = [case for case in cases if case.labels[-1] == DIRECT_LABEL]
    refocused = [case for case in cases if case.labels[-1] == REFOCUSED_LABEL]
    solved = solve_cases(direct, library, seeds, advance)
    wholes = [replace(case, shear=0.0) for case in direct[::2]]  # two depths of each
    recovered = _recover_light_fields(wholes, library, seeds, advance)
    rows, panels = [], []
    for number, (whole, fields) in enumerate(zip(wholes, recovered, strict=True)):
        mosaic = _tile_views(fields[0].pictures)
        line = [Panel(f"{whole.labels[0]}, {whole.scene}\nrecovered light field", mosaic)]
        own = slice(2 * number, 2 * number + 2)
        for one, case in zip(solved[own], refocused[own], strict=True):
            pictures = [field.refocus(case.shear) for field in fields]
            percent = tuple(100 * nmse(picture, one.truth, BORDER_PX) for picture in pictures)
            rows += [Row(case.labels, percent, case.paper), one.row()]
            line += [
                Panel(f"true, s = {case.shear:g}", one.truth),
                Panel(f"{REFOCUSED_LABEL}\n{np.mean(percent):.1f} %", pictures[0]),
                one.panel(DIRECT_LABEL),
            ]
        panels.append(line)
    return Outcome(("camera", "scene", "s", "recovered"), "NMSE, %", rows, panels)


FOCUS_SCENES = ("letters", "blocks", "still-life", "slanted-text")
FOCUS_SHEARS = np.arange(-1.4, 1.01, 0.2)
NOVEL_VIEW = (-1.5, 2.5)
FOCUS_BORDER_PX = 6
SEARCH_RADIUS_PX = 2
TEXTURE_THRESHOLD = 0.2  # of the steepest slopes


def compute_depth_accuracy(
    found: AnyArray, true: AnyArray, picture: AnyArray, step: float
) -> float:
    """Share of a picture's textured pixels whose shear is right to three quarters of the stack's step;
    at an object's border, where both are in focus, that of either side counts.
    """
    slope = np.hypot(*np.gradient(picture))
    textured = slope > TEXTURE_THRESHOLD * np.quantile(slope, 0.99)
    # At an edge the focus measure answers for a neighbour, so that the best shear within a few
    # pixels counts.
    near = range(-SEARCH_RADIUS_PX, SEARCH_RADIUS_PX + 1)
    errors = [np.abs(found - np.roll(true, (y, x), (0, 1))) for y in near for x in near]
    right = np.min(errors, axis=0) <= 0.75 * step
    inner = (slice(FOCUS_BORDER_PX, -FOCUS_BORDER_PX),) * 2
    return right[inner][textured[inner]].mean()


@study(
    "note2",
    title="Depth from focus, and a viewpoint between the views",
    note=f"The paper has no figures. The viewpoint is (v, u) = {NOVEL_VIEW}, the truth a camera rendered there.",
    weight="none: these are true views, nothing is recovered",
    seconds=10,
    steps=len(FOCUS_SCENES),
    seeded=False,
)
def run_light_field_processing(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Score depth from focus against the exact shears and a viewpoint against a camera rendered
    there.
    """
    rows, panels = [], []
    for name in FOCUS_SCENES:
        scene, light_field = make_scene(name, library.array), library.light_field(name)
        reference = render_view(scene, library.array, (0.0, 0.0))
        depths = estimate_depth_from_focus(make_focal_stack(light_field, FOCUS_SHEARS))
        moved = make_focal_stack(light_field, FOCUS_SHEARS, NOVEL_VIEW)
        synthesised = moved.all_in_focus(estimate_depth_from_focus(moved))
        there = render_view(scene, library.array, NOVEL_VIEW)
        shears, true = FOCUS_SHEARS[depths], render_shear_map(scene, library.array)
        figures = {
            "right plane, % of textured pixels": compute_depth_accuracy(
                shears, true, reference, float(FOCUS_SHEARS[1] - FOCUS_SHEARS[0])
            ),
            "viewpoint between the views, NMSE in %": nmse(synthesised, there, FOCUS_BORDER_PX),
            "reference view in its place, NMSE in %": nmse(reference, there, FOCUS_BORDER_PX),
        }
        rows += [Row((name, figure), (100 * value,)) for figure, value in figures.items()]
        panels.append(
            [
                Panel(f"{name}\nreference view", reference),
                Panel("true s", true, is_map=True),
                Panel("s from focus", shears, is_map=True),
                Panel("rendered viewpoint", there),
                Panel("synthesised", synthesised),
            ]
        )
        advance(1)
    return Outcome(("scene", "figure"), "see the rows", rows, panels)


PLATE_SHEAR, SIZE_PX = -0.6, 72.0
SHEAR_STEP = 0.3
STACK_SHEARS = np.arange(-1.2, 0.61, SHEAR_STEP)
PLATE_LIGHT_DIRECTION = (0.08, 0.05, -1.0)  # mirrored to the cameras by a plate that faces them
MATERIALS: Mapping[str, Callable[[Pattern], Lambertian]] = {
    "matt": Lambertian,
    "glossy": partial(Specular, gloss=0.6, exponent=150.0),
}


@study(
    "note1",
    title="A glossy plate: its intensity is wrong, its geometry survives",
    note="The paper states it without figures.",
    weight="chosen by cross-validation at the plate's depth for every seed, without the truth, and kept for all depths",
    seconds=20,
    steps=len(MATERIALS),
)
def run_glossy_plate(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Recover a plate of either kind by CLIP-1D at SR = 1; how even its light is, and errors."""
    from scipy.ndimage import binary_erosion

    rows, panels = [], []
    pattern = make_text_pattern("TOF\nCLIP", 0.05, 0.35)
    for name, make_material in MATERIALS.items():
        rendered = render_light_field(_make_scene(library, make_material(pattern)), library.array)
        field = rendered.light_field
        # without its border, where views see past the plate
        plate = binary_erosion(rendered.shears < 0, iterations=4)
        reference = find_reference_view(field)
        stacks = [_recover_stack(field, seed, advance) for seed in range(seeds)]
        in_focus = np.argmin(abs(STACK_SHEARS - PLATE_SHEAR))
        shears = [STACK_SHEARS[estimate_depth_from_focus(stack)] for stack in stacks]
        errors = tuple(100 * nmse(one.pictures[in_focus], reference, BORDER_PX) for one in stacks)
        right = tuple(
            100 * compute_depth_accuracy(map_, rendered.shears, reference, SHEAR_STEP)
            for map_ in shears
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
                Panel(
                    f"CLIP-1D, s = {PLATE_SHEAR:g}\n{np.mean(errors):.1f} %",
                    stacks[0].pictures[in_focus],
                ),
                Panel("true s", truth, is_map=True),
                Panel("s from focus", shears[0], is_map=True),
            )
        )
    return Outcome(("plate", "figure"), "see the rows", rows, panels)


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
    stack = recover_stack(ClipRecovery(weight=chosen.weight), measurement, STACK_SHEARS)
    advance(1)
    return stack


def _measure_unevenness(field: LightField, where: BoolArray) -> float:
    """Standard deviation over the views, moved onto each other, relative to the mean."""
    shape = (field.pictures.shape[1], field.pictures.shape[2])
    moved = np.stack(
        [
            LinearShear(shape, PLATE_SHEAR, (float(v), float(u))).H(picture)
            for picture, (v, u) in zip(field.pictures, field.views, strict=True)
        ]
    )
    deviation, mean = moved.std(axis=0)[where], moved.mean(axis=0)[where]
    return np.sqrt(np.mean(deviation**2)) / mean.mean()
