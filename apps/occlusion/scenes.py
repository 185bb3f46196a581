"""Scenes of the demonstration: something worth seeing, and an occluder before it with a solid part
on the axis.

Sizes follow the paper's experiment (supplement Note 10): a row of views 15 mm long, occluders some
6 mm wide at 50 mm, what is hidden 70 mm behind them. Views, axis and solid part lie at y = 0, where
the formula of the inactive region is exact for occluders of any shape.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError
from tofclip.occlusion import InactiveRegion
from tofclip.simulate.bodies import Body, Lambertian, Rectangle, Sphere
from tofclip.simulate.patterns import (
    cut_pattern,
    make_letter,
    make_mottled_pattern,
    make_plain_pattern,
    make_rings,
    make_text_pattern,
)

BASELINE_M = 15e-3
OCCLUDER_DISTANCE_M = 50e-3
TARGET_DEPTH_M = 70e-3
TARGET_Z_M = OCCLUDER_DISTANCE_M + TARGET_DEPTH_M
OCCLUDER_REFLECTANCE = 0.6  # of all but the tree

LEAF_COUNT, BUSH_RADIUS_M = 60, 8.5e-3
# half width and half height of a slot in which nothing hangs but the middle leaf, so that the
# formula holds there
LEAF_CLEARANCE_M = 3.7e-3, 0.5e-3


@dataclass(frozen=True)
class OcclusionScene:
    """What stands where."""

    name: str
    title: str
    occluder: tuple[Body, ...]
    target: tuple[Body, ...]
    region: InactiveRegion  # of the occluder's solid part on the axis
    behind: float = TARGET_DEPTH_M  # from the occluder to the target, m

    @property
    def distance(self) -> float:
        """From the views to the target, m."""
        return self.region.distance + self.behind

    def move_target(self, across: float) -> OcclusionScene:
        """Return the scene with its target moved to the right, m."""
        return replace(self, target=tuple(body.shift(across, 0.0) for body in self.target))

    def widen_occluder(self, width: float) -> OcclusionScene:
        """Return the scene with its occluder scaled about the axis until its solid part is as wide, m."""
        factor = width / self.region.width
        return replace(
            self,
            occluder=tuple(_scale_plate(body, factor) for body in self.occluder),
            region=replace(self.region, width=width),
        )


def make_walking_scene(name: str) -> OcclusionScene:
    """Return a scene of `SCENES` with a person behind its occluder, instead of what stands there."""
    scene = make_occlusion_scene(name)
    behind = scene.title.partition(" behind ")[2]
    return replace(scene, title=f"a person behind {behind}", target=_make_figure())


def make_occlusion_scene(name: str) -> OcclusionScene:
    """Return a scene of `SCENES`."""
    if name not in SCENES:
        raise InputError(f"unknown scene '{name}'; take one of {', '.join(SCENES)}")
    title, make_occluder, make_target, solid_width = SCENES[name]
    region = InactiveRegion(BASELINE_M, solid_width, OCCLUDER_DISTANCE_M)
    return OcclusionScene(name, title, make_occluder(), make_target(), region)


def make_upright_bar(width: float, distance: float = OCCLUDER_DISTANCE_M) -> Body:
    """Return a bar on the axis, so long that no view sees its ends; width and distance in m."""
    return _make_plate(width, 40 * width, z=distance)


def _make_plate(
    width: float,
    height: float,
    pattern: NDArray[Any] | None = None,
    x: float = 0.0,
    y: float = 0.0,
    z: float = OCCLUDER_DISTANCE_M,
) -> Body:
    plain = make_plain_pattern(OCCLUDER_REFLECTANCE) if pattern is None else pattern
    return Body(Rectangle(width, height), Lambertian(plain), np.array([x, y, z]))


def _scale_plate(body: Body, factor: float) -> Body:
    assert isinstance(body.shape, Rectangle)  # as all occluders are
    shape = Rectangle(factor * body.shape.width, factor * body.shape.height)
    return replace(body, shape=shape, centre=body.centre * (factor, factor, 1.0))


def _make_word() -> tuple[Body, ...]:
    return (_make_plate(40e-3, 18e-3, make_text_pattern("CLIP", 0.9), z=TARGET_Z_M),)


def _make_disc() -> tuple[Body, ...]:
    return (_make_plate(24e-3, 24e-3, make_rings(3, 0.15, 0.95), z=TARGET_Z_M),)


def _make_figure() -> tuple[Body, ...]:
    """A mannequin, 36 mm tall."""
    skin = make_mottled_pattern(0.6, 0.95, 8, seed=3)
    parts = (  # trunk, arms, legs: width, height and place
        (9e-3, 15e-3, 0.0, -1e-3),
        (26e-3, 3.4e-3, 0.0, -6e-3),
        (3.4e-3, 12e-3, -2.8e-3, 12e-3),
        (3.4e-3, 12e-3, 2.8e-3, 12e-3),
    )
    head = Body(Sphere(4e-3), Lambertian(skin), np.array([0.0, -13e-3, TARGET_Z_M]))
    return (head, *(_make_plate(w, h, skin, x, y, TARGET_Z_M) for w, h, x, y in parts))


V_SIDE_M, V_HEIGHT_M = 13e-3, 16e-3


def _make_v_letter() -> tuple[Body, ...]:
    """Supplementary Figure 14c: the axis meets the V where its strokes have joined, below 0.6 of
    the height; at 0.75 it is 0.46 of its side wide.
    """
    pattern = cut_pattern(make_letter("V"), make_plain_pattern(OCCLUDER_REFLECTANCE))
    return (_make_plate(V_SIDE_M, V_HEIGHT_M, pattern, y=-0.25 * V_HEIGHT_M),)


def _make_small_plate() -> tuple[Body, ...]:
    return (_make_plate(6e-3, 20e-3),)


def _make_board() -> tuple[Body, ...]:
    """Wider than the views are apart: the formula promises nothing."""
    return (_make_plate(21e-3, 60e-3),)


def _make_tree() -> tuple[Body, ...]:
    """A trunk with branches and rough bark."""
    bark = make_mottled_pattern(0.25, 0.85, 14, seed=5)
    branches = (  # side, height and tilt
        (1, -4.6e-3, 0.5),
        (-1, -3.9e-3, 0.6),
        (1, 4.4e-3, 0.4),
        (-1, 6e-3, 0.5),
    )
    behind = OCCLUDER_DISTANCE_M + 1e-3
    return (
        _make_plate(4.5e-3, 40e-3, bark),
        *(
            _make_plate(11e-3, 1.3e-3, bark, side * 6e-3, y, behind).rotate(-side * tilt)
            for side, y, tilt in branches
        ),
    )


SLAT_M = 1.6e-3


def _make_trellis() -> tuple[Body, ...]:
    """Slats at right angles with holes between them, standing on a corner: one of them crosses the
    axis.
    """
    pitch, side = 4e-3, 13.6e-3
    across = np.linspace(-side / 2, side / 2, 340)
    on_slat = abs((across + pitch / 2) % pitch - pitch / 2) < SLAT_M / 2
    off_slat = abs(across % pitch - pitch / 2) < SLAT_M / 2
    frame = abs(across) > side / 2 - SLAT_M / 2
    slats = (on_slat | frame) | (off_slat | frame)[:, np.newaxis]
    lattice = np.where(slats, OCCLUDER_REFLECTANCE, np.nan)
    return (_make_plate(side, side, lattice).rotate(np.pi / 4),)


def _make_bush() -> tuple[Body, ...]:
    """Leaves at random between 48 and 52 mm, every one turned its own way; one hangs on the axis."""
    random = np.random.default_rng(7)
    down = np.linspace(0, np.pi, 40)
    edge = 0.5 * np.sin(down)  # a leaf fills its rectangle from tip to tip, widest at its middle
    outline = np.stack(
        [0.5 + np.concatenate([edge, -edge[::-1]]), np.concatenate([down, down[::-1]]) / np.pi],
        axis=-1,
    )
    leaf = cut_pattern([outline], make_plain_pattern(OCCLUDER_REFLECTANCE))
    hung = [_make_plate(4e-3, 6e-3, leaf)]
    while len(hung) < LEAF_COUNT:
        place = random.uniform(
            (-9e-3, -9e-3, OCCLUDER_DISTANCE_M - 2e-3), (9e-3, 9e-3, OCCLUDER_DISTANCE_M + 2e-3)
        )
        length = random.uniform(3e-3, 4.5e-3)
        body = _make_plate(0.55 * length, length, leaf, *place)
        body = body.tilt(random.uniform(-0.6, 0.6)).rotate(random.uniform(0, 2 * np.pi))
        inside = np.hypot(*place[:2]) < BUSH_RADIUS_M
        if inside and np.any(abs(place[:2]) > np.array(LEAF_CLEARANCE_M) + length / 2):
            hung.append(body)
    return tuple(hung)


MakeBodies = Callable[[], tuple[Body, ...]]
# title, occluder, target, and the width of the occluder's solid part on the axis, m
SCENES: dict[str, tuple[str, MakeBodies, MakeBodies, float]] = {
    "v-letter": ("a disc behind a letter V", _make_v_letter, _make_disc, 0.46 * V_SIDE_M),
    "plate": ("a word behind a plate", _make_small_plate, _make_word, 6e-3),
    "person": ("a figure behind a plate", _make_small_plate, _make_figure, 6e-3),
    "tree": ("a figure behind a tree", _make_tree, _make_figure, 4.5e-3),
    "bush": ("a word behind a bush", _make_bush, _make_word, 4e-3),
    "trellis": ("a disc behind a trellis", _make_trellis, _make_disc, SLAT_M * np.sqrt(2)),
    "board": ("a disc behind a board", _make_board, _make_disc, 21e-3),
}
