"""Where uniform angular intensity fails, geometry survives (supplement Note 1): a glossy plate
beside a matt one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apps.studies.cases import BORDER_PX, run_in_parallel
from apps.studies.library import Library
from apps.studies.light_field_processing import compute_depth_accuracy
from apps.studies.outcome import Advance, Outcome, Panel, Row, Study
from tofclip.light_field import FocalStack, LightField, estimate_depth_from_focus
from tofclip.light_field.measurement import CameraSetup, measure
from tofclip.metrics import nmse
from tofclip.operators import LinearShear
from tofclip.recovery.light_field import ClipRecovery
from tofclip.simulate.bodies import Body
from tofclip.simulate.light_fields import Lambertian, Rectangle, Scene, Specular, render_light_field
from tofclip.simulate.patterns import make_plain_pattern, make_text_pattern

SHEAR, SIZE_PX = -0.6, 72.0
SHEAR_STEP = 0.3
STACK_SHEARS = np.arange(-1.2, 0.61, SHEAR_STEP)
LIGHT_DIRECTION = (0.08, 0.05, -1.0)  # mirrored towards the cameras by a plate that faces them
TEXT_PATTERN = make_text_pattern("TOF\nCLIP", 0.05, 0.35)
MATERIALS = {
    "matt": Lambertian(TEXT_PATTERN),
    "glossy": Specular(TEXT_PATTERN, gloss=0.6, exponent=150.0),
}


def run_glossy_plate(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Recover a plate of either kind from CLIP-1D at SR = 1; tell how even its light is, and the
    errors.

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
    for name, material in MATERIALS.items():
        rendered = render_light_field(_make_scene(library, material), library.array)
        field, plate = rendered.light_field, _erode_mask(rendered.shears < 0)
        reference = field.pictures[int(np.argmin((field.views**2).sum(axis=1)))]
        pictures = [_recover_stack(field, seed, advance) for seed in range(seeds)]
        focused = [stack.pictures[int(np.argmin(abs(STACK_SHEARS - SHEAR)))] for stack in pictures]
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
                Panel(f"CLIP-1D, s = {SHEAR:g}\n{np.mean(errors):.1f} %", focused[0]),
                Panel("true s", truth, is_map=True),
                Panel("s from focus", shears[0], is_map=True),
            )
        )
    return Outcome(("plate", "figure"), "see the rows", tuple(rows), tuple(panels))


def _make_scene(library: Library, material: Lambertian) -> Scene:
    array = library.array
    side = SIZE_PX * min(array.image_shape) / 128 / array.focal_length_px * array.depth(SHEAR)
    plate = Body(Rectangle(side, side), material, array.point(0, 0, SHEAR))
    wall = Body(Rectangle(9.0, 9.0), Lambertian(make_plain_pattern(0.02)), array.point(0, 0, 0.5))
    return Scene((wall, plate), LIGHT_DIRECTION)


def _recover_stack(field: LightField, seed: int, advance: Advance) -> FocalStack:
    measurement = measure(field, CameraSetup("line", 1.0, seed))
    chosen = ClipRecovery().recover(measurement, SHEAR)
    recovery = replace(ClipRecovery(), weight=chosen.weight)
    pictures = run_in_parallel(
        lambda shear: recovery.recover(measurement, float(shear)).picture, list(STACK_SHEARS)
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
            LinearShear(shape, SHEAR, (float(v), float(u))).H(picture)
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


STUDY = Study(
    "note1",
    (),
    "A glossy plate: its intensity is wrong, its geometry survives",
    "The paper states it without figures.",
    20,
    len(MATERIALS),
    run_glossy_plate,
)
