"""Scenes of the demonstration: something worth seeing, and an occluder before it with a solid part on the axis.

Sizes follow the paper's experiment (supplement Note 10): a row of views 15 mm long, occluders some 6 mm wide at 50 mm,
what is hidden 70 mm behind them. Views, axis and solid part lie at y = 0, where the formula of the inactive region is
exact for occluders of any shape.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError
from tofclip.occlusion.region import InactiveRegion
from tofclip.simulate.light_fields import Body, Lambertian, Rectangle, Sphere
from tofclip.simulate.light_fields.patterns import mottled, written
from tofclip.simulate.shapes import cut_out, letter, plain, rings

BASELINE = 15e-3
DISTANCE = 50e-3
BEHIND = 70e-3
OCCLUDER = 0.6
"""Reflectance of all occluders but the tree."""

LEAVES, BUSH_RADIUS = 60, 8.5e-3
LEAF_CLEARANCE = 3.7e-3, 0.5e-3
"""Half width and half height of a slot in which nothing hangs but the middle leaf, so that the formula holds there."""


@dataclass(frozen=True)
class OcclusionScene:
    """What stands where.

    Parameters
    ----------
    name, title : str
    occluder, target : tuple of Body
    region : InactiveRegion
        Of the occluder's solid part on the axis.
    behind : float
        From the occluder to the target, m.
    """

    name: str
    title: str
    occluder: tuple[Body, ...]
    target: tuple[Body, ...]
    region: InactiveRegion
    behind: float = BEHIND

    @property
    def distance(self) -> float:
        """From the views to the target, m."""
        return self.region.distance + self.behind

    def with_target_moved(self, across: float) -> OcclusionScene:
        """Return the scene with its target so many metres further right."""
        return replace(self, target=tuple(body.shifted(across, 0.0) for body in self.target))


def occlusion_scene(name: str) -> OcclusionScene:
    """Return a scene of `SCENES`.

    Raises
    ------
    InputError
        No scene has that name.
    """
    if name not in SCENES:
        raise InputError(f"unknown scene '{name}'; take one of {', '.join(SCENES)}")
    return SCENES[name]()


def upright_bar(width: float, distance: float = DISTANCE) -> Body:
    """Return a bar on the axis, so long that no view sees its ends."""
    return _plate(width, 40 * width, plain(OCCLUDER), z=distance)


def _plate(width: float, height: float, pattern: NDArray[Any], x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Body:
    return Body(Rectangle(width, height), Lambertian(pattern), np.array([x, y, z]))


def _region(width: float) -> InactiveRegion:
    return InactiveRegion(BASELINE, width, DISTANCE)


def _word(text: str, width: float, height: float) -> tuple[Body, ...]:
    return (_plate(width, height, written(text, 0.9), z=DISTANCE + BEHIND),)


def _disc() -> tuple[Body, ...]:
    return (_plate(24e-3, 24e-3, rings(3, 0.15, 0.95), z=DISTANCE + BEHIND),)


def _figure() -> tuple[Body, ...]:
    """A mannequin, 36 mm tall."""
    skin, z = Lambertian(mottled(0.6, 0.95, 8, seed=3)), DISTANCE + BEHIND
    head = Body(Sphere(4e-3), skin, np.array([0.0, -13e-3, z]))
    trunk, arms = ((9e-3, 15e-3), (0.0, -1e-3)), ((26e-3, 3.4e-3), (0.0, -6e-3))
    legs = (((3.4e-3, 12e-3), (x, 12e-3)) for x in (-2.8e-3, 2.8e-3))
    return (head, *(Body(Rectangle(*size), skin, np.array([*place, z])) for size, place in (trunk, arms, *legs)))


def _v_letter() -> OcclusionScene:
    """Supplementary Figure 14c: a disc behind a V; the axis meets the V where its strokes have joined."""
    side, height = 13e-3, 16e-3
    # strokes have joined below 0.6 of the height; at 0.75 the V is 0.46 of its side wide
    shape = _plate(side, height, cut_out(letter("V"), plain(OCCLUDER)), y=-0.25 * height, z=DISTANCE)
    return OcclusionScene("v-letter", "a disc behind a letter V", (shape,), _disc(), _region(0.46 * side))


def _behind_plate() -> OcclusionScene:
    bar = _plate(6e-3, 20e-3, plain(OCCLUDER), z=DISTANCE)
    return OcclusionScene("plate", "a word behind a plate", (bar,), _word("CLIP", 40e-3, 18e-3), _region(6e-3))


def _figure_behind_plate() -> OcclusionScene:
    bar = _plate(6e-3, 20e-3, plain(OCCLUDER), z=DISTANCE)
    return OcclusionScene("person", "a figure behind a plate", (bar,), _figure(), _region(6e-3))


def _tree() -> OcclusionScene:
    """A trunk with branches and rough bark, a mannequin behind it."""
    bark, z = mottled(0.25, 0.85, 14, seed=5), DISTANCE
    trunk = _plate(4.5e-3, 40e-3, bark, z=z)
    branches = (
        _plate(11e-3, 1.3e-3, bark, x=side * 6e-3, y=y, z=z + 1e-3).turned(-side * tilt)
        for side, y, tilt in ((1, -4.6e-3, 0.5), (-1, -3.9e-3, 0.6), (1, 4.4e-3, 0.4), (-1, 6e-3, 0.5))
    )
    return OcclusionScene("tree", "a figure behind a tree", (trunk, *branches), _figure(), _region(4.5e-3))


def _trellis() -> OcclusionScene:
    """Slats at right angles with holes between them, standing on a corner: one of them crosses the axis."""
    slat, pitch, side = 1.6e-3, 4e-3, 13.6e-3
    across = np.linspace(-side / 2, side / 2, 340)
    on_slat = abs((across + pitch / 2) % pitch - pitch / 2) < slat / 2
    off_slat = abs(across % pitch - pitch / 2) < slat / 2
    frame = abs(across) > side / 2 - slat / 2
    slats = (on_slat | frame) | (off_slat | frame)[:, np.newaxis]
    lattice = np.where(slats, OCCLUDER, np.nan)
    trellis = _plate(side, side, lattice, z=DISTANCE).turned(np.pi / 4)
    return OcclusionScene("trellis", "a disc behind a trellis", (trellis,), _disc(), _region(slat * np.sqrt(2)))


def _bush() -> OcclusionScene:
    """Leaves at random between 48 and 52 mm, every one turned its own way; one hangs on the axis."""
    random, leaf = np.random.default_rng(7), _leaf()
    hung = [replace(_plate(4e-3, 6e-3, leaf, z=DISTANCE))]
    while len(hung) < LEAVES:
        place = random.uniform((-9e-3, -9e-3, DISTANCE - 2e-3), (9e-3, 9e-3, DISTANCE + 2e-3))
        length = random.uniform(3e-3, 4.5e-3)
        body = Body(Rectangle(0.55 * length, length), Lambertian(leaf), place)
        body = body.tilted(random.uniform(-0.6, 0.6)).turned(random.uniform(0, 2 * np.pi))
        inside = np.hypot(*place[:2]) < BUSH_RADIUS
        if inside and np.any(abs(place[:2]) > np.array(LEAF_CLEARANCE) + length / 2):
            hung.append(body)
    return OcclusionScene("bush", "a word behind a bush", tuple(hung), _word("CLIP", 40e-3, 18e-3), _region(4e-3))


def _leaf() -> NDArray[Any]:
    """A leaf that fills its rectangle from tip to tip; widest at its middle."""
    down = np.linspace(0, np.pi, 40)
    edge = 0.5 * np.sin(down)
    outline = np.stack([0.5 + np.concatenate([edge, -edge[::-1]]), np.concatenate([down, down[::-1]]) / np.pi], axis=-1)
    return cut_out([outline], plain(OCCLUDER))


def _board() -> OcclusionScene:
    """Wider than the views are apart: the formula promises nothing."""
    width = 21e-3
    board = _plate(width, 60e-3, plain(OCCLUDER), z=DISTANCE)
    return OcclusionScene("board", "a disc behind a board", (board,), _disc(), _region(width))


SCENES: dict[str, Callable[[], OcclusionScene]] = {
    "v-letter": _v_letter,
    "plate": _behind_plate,
    "person": _figure_behind_plate,
    "tree": _tree,
    "bush": _bush,
    "trellis": _trellis,
    "board": _board,
}
