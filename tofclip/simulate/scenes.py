"""Scenes for studies, made anew for any camera array: the backdrop first, then what stands before
it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from tofclip.errors import require_known
from tofclip.simulate.bodies import (
    Body,
    Box,
    Lambertian,
    Material,
    Rectangle,
    Shape,
    Specular,
    Sphere,
)
from tofclip.simulate.light_fields import CameraArray, Scene
from tofclip.simulate.patterns import (
    Pattern,
    make_checkerboard,
    make_letter,
    make_mottled_pattern,
    make_plain_pattern,
    make_rings,
    make_stripes,
    make_text_pattern,
)

# Places and sizes below are pixels of a picture so wide, seen from the reference view; depths are
# shears, pixels per view step.
DESIGN_WIDTH_PX = 128
OCCLUDER_SHEAR = -3.0
BLACK_MATERIAL = Lambertian(make_plain_pattern(0.0))


@dataclass(frozen=True)
class _SceneBuilder:
    """Places bodies by what the reference view sees: pixels from the centre, and a shear."""

    array: CameraArray

    def plate(
        self,
        place: tuple[float, float],
        size: tuple[float, ...],
        shear: float,
        material: Material,
        shape: Callable[..., Shape] = Rectangle,
    ) -> Body:
        """Return a body that faces the cameras: a plate, `size` wide and high, or another shape whose
        sides these are; its centre lies at the shear.
        """
        scale = min(self.array.image_shape) / DESIGN_WIDTH_PX
        unit = scale / self.array.focal_length_px * self.array.depth(shear)
        centre = self.array.point(scale * place[0], scale * place[1], shear)
        return Body(shape(*(side * unit for side in size)), material, centre)

    def scene(self, shear: float, backdrop: Pattern, *bodies: Body) -> Scene:
        """Return a scene before a plate that fills every view."""
        sides = (2.2 * DESIGN_WIDTH_PX,) * 2
        return Scene((self.plate((0, 0), sides, shear, Lambertian(backdrop)), *bodies))


def make_scene(name: str, array: CameraArray) -> Scene:
    """Return a scene of `SCENES`, sized for a camera array."""
    require_known("scene", name, SCENES)
    return SCENES[name](_SceneBuilder(array))


def edit_scene(scene: Scene, edit: str) -> Scene:
    """Change what stands before the backdrop, in 3D (generalised flip test, supplement Note 6).
    `edit`: ``original``, ``shift``, ``flip`` or ``rotate``.
    """
    require_known("edit", edit, EDITS)
    backdrop, *others = scene.bodies
    return replace(scene, bodies=(backdrop, *(EDITS[edit](body) for body in others)))


def remove_occluder(scene: Scene) -> Scene:
    """Return an occlusion scene without its black bodies."""
    return replace(
        scene, bodies=tuple(body for body in scene.bodies if body.material is not BLACK_MATERIAL)
    )


def _shift_body(body: Body) -> Body:
    step = 0.05 * float(body.centre[2])  # the same 5 % of the focal length, 8 px, for near and far
    return body.shift(step, -step)


EDITS: dict[str, Callable[[Body], Body]] = {
    "original": lambda body: body,
    "shift": _shift_body,
    "flip": lambda body: body.flip(),
    "rotate": lambda body: body.rotate(np.pi / 9),
}


def _make_still_life(stage: _SceneBuilder) -> Scene:
    text, squares = make_text_pattern("TOF\nCLIP", 0.05, 0.9), make_checkerboard(12, 0.15, 0.95)
    board = stage.plate((26, -14), (52, 52), -0.1, Lambertian(text)).tilt(0.3)
    ball = stage.plate((-30, 18), (24,), -0.8, Lambertian(squares), Sphere)
    return stage.scene(0.5, make_mottled_pattern(0.1, 0.6, 18, seed=1), board, ball)


def _make_blocks(stage: _SceneBuilder) -> Scene:
    rings = Lambertian(make_rings(4, 0.2, 0.9)[38:154, 38:154])
    block = stage.plate((24, 16), (40, 44, 40), 0.0, rings, Box).tilt(-0.5)
    card = stage.plate((-26, -14), (50, 56), -0.6, Lambertian(make_letter("A", 0.9)))
    return stage.scene(0.8, make_stripes(18, 0.15, 0.45), block, card)


def _make_letters(stage: _SceneBuilder) -> Scene:
    letters = (("C", (-38, -22), -1.0), ("L", (0, 2), -0.4), ("A", (38, 26), -0.1))
    plates = (
        stage.plate(place, (36, 44), shear, Lambertian(make_letter(name, 0.9)))
        for name, place, shear in letters
    )
    return stage.scene(0.5, make_plain_pattern(0.02), *plates)


def _make_slanted_text(stage: _SceneBuilder) -> Scene:
    text = _print_text("LIGHT\nFIELD\nVIEWS", 0.03, 0.85)
    # from s = -1 on the left to 0.3 on the right
    sheet = stage.plate((-8, 0), (110, 84), -0.45, text).tilt(0.84)
    return stage.scene(0.5, make_plain_pattern(0.02), sheet)


def _make_bolt_and_letters(stage: _SceneBuilder) -> Scene:
    metal = Specular(make_stripes(10, 0.1, 0.35), gloss=0.8, exponent=60)
    head = stage.plate((-34, 14), (18,), -1.0, metal, Sphere)
    shank = stage.plate((-30, -24), (16, 40, 16), -0.9, metal, Box).tilt(0.6)
    near = stage.plate((8, 24), (30, 36), -0.5, _print_text("B", 0.9))
    far = stage.plate((40, -16), (40, 44), 0.2, _print_text("T", 0.8))
    return stage.scene(0.5, make_plain_pattern(0.03), far, near, shank, head)


def _make_printed_words(stage: _SceneBuilder) -> Scene:
    words = (("NEAR", -1.0), ("CLIP", -0.3), ("VIEW", 0.3), ("FAR", 0.99))
    lines = (
        stage.plate((0, -45 + 30 * row), (96, 26), shear, _print_text(word, 0.85))
        for row, (word, shear) in enumerate(words)
    )
    return stage.scene(1.0, make_plain_pattern(0.02), *lines)


def _make_printed_letters(stage: _SceneBuilder) -> Scene:
    near = stage.plate((-26, -16), (44, 60), -0.3, _print_text("U", 0.85))
    far = stage.plate((28, 18), (44, 56), 0.3, _print_text("L", 0.85))
    return stage.scene(1.0, make_plain_pattern(0.02), near, far)


def _make_occluded_scene(stage: _SceneBuilder, target: str, occluder: str) -> Scene:
    """A figure or a word behind black bars or plates."""
    if target == "word":
        bodies = [stage.plate((0, 0), (100, 40), -0.4, _print_text("CLIP", 0.9))]
    else:
        skin = Lambertian(make_mottled_pattern(0.5, 0.95, 10, seed=3))
        # trunk, arms and legs
        parts = (((0, 2), (26, 46)), ((0, -12), (70, 9)), ((-8, 40), (9, 36)), ((8, 40), (9, 36)))
        bodies = [stage.plate((0, -34), (11,), -0.4, skin, Sphere)]
        bodies += [stage.plate(place, size, -0.4, skin) for place, size in parts]
    width, places = (9, (-45, -15, 15, 45)) if occluder == "bars" else (14, (-20, 26))
    bodies += [stage.plate((x, 0), (width, 200), OCCLUDER_SHEAR, BLACK_MATERIAL) for x in places]
    return stage.scene(0.5, make_plain_pattern(0.01), *bodies)


def _print_text(text: str, ink: float, paper: float = float("nan")) -> Lambertian:
    return Lambertian(make_text_pattern(text, ink, paper))


SCENES: dict[str, Callable[[_SceneBuilder], Scene]] = {
    "still-life": _make_still_life,
    "blocks": _make_blocks,
    "letters": _make_letters,
    "slanted-text": _make_slanted_text,
    "bolt-and-letters": _make_bolt_and_letters,
    "printed-words": _make_printed_words,
    "printed-letters": _make_printed_letters,
    **{
        f"{target}-behind-{occluder}": partial(
            _make_occluded_scene, target=target, occluder=occluder
        )
        for target in ("figure", "word")
        for occluder in ("bars", "plates")
    },
}
