"""Scenes for studies, made anew for any camera array: the backdrop first, then what stands before
it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tofclip.errors import InputError
from tofclip.simulate.bodies import Body, Box, Lambertian, Material, Rectangle, Specular, Sphere
from tofclip.simulate.light_fields import CameraArray, Scene
from tofclip.simulate.patterns import (
    cut_pattern,
    make_checkerboard,
    make_letter,
    make_mottled_pattern,
    make_plain_pattern,
    make_rings,
    make_stripes,
    make_text_pattern,
)

DESIGN_WIDTH_PX = (
    128  # places and sizes below are pixels of a picture so wide, seen from the reference view
)
OCCLUDER_SHEAR = -3.0
BLACK_MATERIAL = Lambertian(make_plain_pattern(0.0))


@dataclass(frozen=True)
class _SceneBuilder:
    """Places bodies by what the reference view should see: pixels off the centre, and a shear."""

    array: CameraArray

    def plate(
        self,
        place: tuple[float, float],
        size: tuple[float, float],
        shear: float,
        material: Material,
    ) -> Body:
        """Return a flat plate that faces the cameras.

        `place`: pixels right and down of the centre of the reference view; `size`: width and height
        as the reference view sees them, pixels; `shear`: depth, as pixels per view step.
        """
        width, height = (self._length(side, shear) for side in size)
        return Body(Rectangle(width, height), material, self._point(place, shear))

    def ball(
        self, place: tuple[float, float], radius: float, shear: float, material: Material
    ) -> Body:
        """Return a ball whose centre lies at a shear.

        `place`: pixels right and down of the centre of the reference view; `radius`: pixels of the
        reference view; `shear`: depth, as pixels per view step.
        """
        return Body(Sphere(self._length(radius, shear)), material, self._point(place, shear))

    def block(
        self,
        place: tuple[float, float],
        size: tuple[float, float],
        shear: float,
        material: Material,
    ) -> Body:
        """Return a block as thick as it is wide.

        `place`: pixels right and down of the centre of the reference view; `size`: width and
        height, pixels of the reference view; `shear`: depth, as pixels per view step.
        """
        width, height = (self._length(side, shear) for side in size)
        return Body(Box(width, height, width), material, self._point(place, shear))

    def backdrop(self, shear: float, material: Material) -> Body:
        """Return a plate that fills every view.

        `shear`: depth, as pixels per view step.
        """
        return self.plate((0, 0), (2.2 * DESIGN_WIDTH_PX,) * 2, shear, material)

    def _length(self, pixels: float, shear: float) -> float:
        return pixels * self._scale() / self.array.focal_length_px * self.array.depth(shear)

    def _point(self, place: tuple[float, float], shear: float) -> np.ndarray:
        x, y = (self._scale() * side for side in place)
        return self.array.point(x, y, shear)

    def _scale(self) -> float:
        return min(self.array.image_shape) / DESIGN_WIDTH_PX


def make_scene(name: str, array: CameraArray) -> Scene:
    """Return a scene of `SCENES`, sized for a camera array.

    Parameters
    ----------
    name : str
        A key of `SCENES`.
    array : CameraArray

    Returns
    -------
    Scene

    Raises
    ------
    InputError
        No scene has that name.
    """
    if name not in SCENES:
        raise InputError(f"unknown scene '{name}'; take one of {', '.join(SCENES)}")
    return SCENES[name](_SceneBuilder(array))


def edit_scene(scene: Scene, edit: str) -> Scene:
    """Change what stands before the backdrop, in 3D (generalised flip test, supplement Note 6).

    `edit`: ``original``, ``shift``, ``flip`` or ``rotate``.
    """
    if edit not in EDITS:
        raise InputError(f"unknown edit '{edit}'; take one of {', '.join(EDITS)}")
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
    wall = stage.backdrop(0.5, Lambertian(make_mottled_pattern(0.1, 0.6, 18, seed=1)))
    board = stage.plate(
        (26, -14), (52, 52), -0.1, Lambertian(make_text_pattern("TOF\nCLIP", 0.05, 0.9))
    ).tilt(0.3)
    ball = stage.ball((-30, 18), 24, -0.8, Lambertian(make_checkerboard(12, 0.15, 0.95)))
    return Scene((wall, board, ball))


def _make_blocks(stage: _SceneBuilder) -> Scene:
    wall = stage.backdrop(0.8, Lambertian(make_stripes(18, 0.15, 0.45)))
    block = stage.block(
        (24, 16), (40, 44), 0.0, Lambertian(make_rings(4, 0.2, 0.9)[38:154, 38:154])
    ).tilt(-0.5)
    card = stage.plate(
        (-26, -14),
        (50, 56),
        -0.6,
        Lambertian(cut_pattern(make_letter("A"), make_plain_pattern(0.9))),
    )
    return Scene((wall, block, card))


def _make_letters(stage: _SceneBuilder) -> Scene:
    wall = stage.backdrop(0.5, Lambertian(make_plain_pattern(0.02)))
    plates = (
        stage.plate(
            place,
            (36, 44),
            shear,
            Lambertian(cut_pattern(make_letter(name), make_plain_pattern(0.9))),
        )
        for name, place, shear in (
            ("C", (-38, -22), -1.0),
            ("L", (0, 2), -0.4),
            ("A", (38, 26), -0.1),
        )
    )
    return Scene((wall, *plates))


def _make_slanted_text(stage: _SceneBuilder) -> Scene:
    wall = stage.backdrop(0.5, Lambertian(make_plain_pattern(0.02)))
    text = Lambertian(make_text_pattern("LIGHT\nFIELD\nVIEWS", 0.03, 0.85))
    sheet = stage.plate((-8, 0), (110, 84), -0.45, text).tilt(
        0.84
    )  # from s = -1 on the left to 0.3 on the right
    return Scene((wall, sheet))


def _make_bolt_and_letters(stage: _SceneBuilder) -> Scene:
    wall = stage.backdrop(0.5, Lambertian(make_plain_pattern(0.03)))
    metal = Specular(make_stripes(10, 0.1, 0.35), gloss=0.8, exponent=60)
    head = stage.ball((-34, 14), 18, -1.0, metal)
    shank = stage.block((-30, -24), (16, 40), -0.9, metal).tilt(0.6)
    near = stage.plate((8, 24), (30, 36), -0.5, Lambertian(make_text_pattern("B", 0.9)))
    far = stage.plate((40, -16), (40, 44), 0.2, Lambertian(make_text_pattern("T", 0.8)))
    return Scene((wall, far, near, shank, head))


def _make_printed_words(stage: _SceneBuilder) -> Scene:
    wall = stage.backdrop(1.0, Lambertian(make_plain_pattern(0.02)))
    lines = (
        stage.plate((0, -45 + 30 * row), (96, 26), shear, Lambertian(make_text_pattern(word, 0.85)))
        for row, (word, shear) in enumerate(
            (("NEAR", -1.0), ("CLIP", -0.3), ("VIEW", 0.3), ("FAR", 0.99))
        )
    )
    return Scene((wall, *lines))


def _make_printed_letters(stage: _SceneBuilder) -> Scene:
    wall = stage.backdrop(1.0, Lambertian(make_plain_pattern(0.02)))
    near = stage.plate((-26, -16), (44, 60), -0.3, Lambertian(make_text_pattern("U", 0.85)))
    far = stage.plate((28, 18), (44, 56), 0.3, Lambertian(make_text_pattern("L", 0.85)))
    return Scene((wall, near, far))


def _make_word(stage: _SceneBuilder) -> Body:
    return stage.plate((0, 0), (100, 40), -0.4, Lambertian(make_text_pattern("CLIP", 0.9)))


def _make_figure(stage: _SceneBuilder) -> tuple[Body, ...]:
    skin = Lambertian(make_mottled_pattern(0.5, 0.95, 10, seed=3))
    head, trunk = stage.ball((0, -34), 11, -0.4, skin), stage.plate((0, 2), (26, 46), -0.4, skin)
    arms = stage.plate((0, -12), (70, 9), -0.4, skin)
    legs = (stage.plate((side, 40), (9, 36), -0.4, skin) for side in (-8, 8))
    return (head, trunk, arms, *legs)


def _make_bars(stage: _SceneBuilder) -> tuple[Body, ...]:
    return tuple(
        stage.plate((x, 0), (9, 200), OCCLUDER_SHEAR, BLACK_MATERIAL) for x in (-45, -15, 15, 45)
    )


def _make_dark_plates(stage: _SceneBuilder) -> tuple[Body, ...]:
    return tuple(stage.plate((x, 0), (14, 200), OCCLUDER_SHEAR, BLACK_MATERIAL) for x in (-20, 26))


def _make_occluded_scene(
    target: tuple[Body, ...], occluder: tuple[Body, ...], stage: _SceneBuilder
) -> Scene:
    return Scene((stage.backdrop(0.5, Lambertian(make_plain_pattern(0.01))), *target, *occluder))


SCENES: dict[str, Callable[[_SceneBuilder], Scene]] = {
    "still-life": _make_still_life,
    "blocks": _make_blocks,
    "letters": _make_letters,
    "slanted-text": _make_slanted_text,
    "bolt-and-letters": _make_bolt_and_letters,
    "printed-words": _make_printed_words,
    "printed-letters": _make_printed_letters,
    "figure-behind-bars": lambda stage: _make_occluded_scene(
        _make_figure(stage), _make_bars(stage), stage
    ),
    "figure-behind-plates": lambda stage: _make_occluded_scene(
        _make_figure(stage), _make_dark_plates(stage), stage
    ),
    "word-behind-bars": lambda stage: _make_occluded_scene(
        (_make_word(stage),), _make_bars(stage), stage
    ),
    "word-behind-plates": lambda stage: _make_occluded_scene(
        (_make_word(stage),), _make_dark_plates(stage), stage
    ),
}
