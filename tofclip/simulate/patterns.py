"""Patterns of reflectance for simulated surfaces: letters made of polygons, textures, writing.

A pattern is a picture over the unit square, x to the right, y down; NaN marks a hole.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError

Outline = NDArray[np.float64]
Pattern = NDArray[np.float32]

STROKE_WIDTH = 0.26  # width of a letter's stroke
TEXELS = 192  # per side; finer than the rays at every range that the rest of this room uses
TEXT_TEXELS = 384  # per side of writing and mottled paint, which have finer detail
LINE_SPACING = 1.3  # of capital letters' height


def make_letter(name: str) -> list[Outline]:
    """Outlines of a capital letter: closed polygons, (corners, 2); a second one inside the first is
    a hole.

    `name`: ``"A"``, ``"C"``, ``"L"``, ``"U"`` or ``"V"``.
    """
    if name not in LETTERS:
        raise InputError(f"no outline is known for '{name}'; known are {', '.join(LETTERS)}")
    return LETTERS[name]


def cut_pattern(outlines: list[Outline], pattern: Pattern) -> Pattern:
    """Keep of `pattern` what lies inside the outlines (even-odd rule); the rest becomes NaN.

    `outlines`: polygons over the unit square, x to the right, y down; `pattern` (rows, columns):
    reflectance. Returns (rows, columns).
    """
    rows, columns = pattern.shape
    y, x = np.meshgrid(
        (np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij"
    )
    inside = np.zeros(pattern.shape, dtype=bool)
    for outline in outlines:
        # even-odd: an outline within another one cuts a hole
        inside ^= _is_within(outline, x, y)
    return np.where(inside, pattern, np.nan).astype(np.float32)


def make_plain_pattern(reflectance: float) -> Pattern:
    """An even surface."""
    return np.full((TEXELS, TEXELS), reflectance, dtype=np.float32)


def make_checkerboard(squares: int, dark: float, bright: float) -> Pattern:
    """A board of `squares` x `squares` fields, bright in the upper left corner.

    `squares`: fields on a side; `dark, bright`: reflectance, 0 to 1. Returns (texels, texels).
    """
    field = np.arange(TEXELS) * squares // TEXELS
    odd = (field[:, np.newaxis] + field) % 2 == 1
    return np.where(odd, dark, bright).astype(np.float32)


def make_stripes(number: int, dark: float, bright: float) -> Pattern:
    """Slanted stripes with smooth borders, `number` of them across the plate.

    `dark, bright`: reflectance, 0 to 1. Returns (texels, texels).
    """
    y, x = np.meshgrid(np.arange(TEXELS) / TEXELS, np.arange(TEXELS) / TEXELS, indexing="ij")
    wave = 0.5 + 0.5 * np.sin(2 * np.pi * number * (x + 0.5 * y))
    return (dark + (bright - dark) * wave).astype(np.float32)


def make_rings(number: int, dark: float, bright: float) -> Pattern:
    """A round plate with concentric rings; NaN outside the disc.

    `number`: rings from the centre to the rim; `dark, bright`: reflectance, 0 to 1; the centre is
    bright. Returns (texels, texels).
    """
    y, x = np.meshgrid(np.linspace(-1, 1, TEXELS), np.linspace(-1, 1, TEXELS), indexing="ij")
    radius = np.hypot(x, y)
    wave = 0.5 + 0.5 * np.cos(2 * np.pi * number * radius)
    return np.where(radius <= 1, dark + (bright - dark) * wave, np.nan).astype(np.float32)


def make_text_pattern(
    text: str, ink: float, paper: float = float("nan"), margin: float = 0.08
) -> Pattern:
    """Bold capitals that fill a rectangle; each line is as wide as the rectangle.

    `text`: lines divided by line breaks; `ink, paper`: reflectances; a paper of NaN leaves letters
    that are cut out; `margin`: share of the rectangle left free at each side. Returns (rows,
    columns).
    """
    lines = text.split("\n")
    if not all(line.strip() for line in lines):
        raise InputError("every line of a writing needs at least one letter")
    step = (1 - 2 * margin) / (len(lines) * LINE_SPACING - LINE_SPACING + 1)
    inside = np.zeros((TEXT_TEXELS, TEXT_TEXELS), bool)
    for number, line in enumerate(lines):
        top = margin + number * step * LINE_SPACING
        inside |= _rasterise_line(line, (margin, 1 - margin), (top, top + step))
    return np.where(inside, ink, paper).astype(np.float32)


def make_mottled_pattern(dark: float, bright: float, grains: int, seed: int) -> Pattern:
    """Smooth random blotches, about `grains` across the pattern, with every brightness from dark to
    bright.

    `dark, bright`: reflectance, 0 to 1; `seed`: of the pattern. Returns (texels, texels).
    """
    if not 0 < grains < TEXT_TEXELS:
        raise InputError(
            f"a mottled pattern has from 1 to {TEXT_TEXELS - 1} grains across, not {grains}"
        )
    random = np.random.default_rng(seed)
    spectrum = np.fft.rfft2(random.standard_normal((TEXT_TEXELS, TEXT_TEXELS)))
    frequency = (
        np.hypot(np.fft.fftfreq(TEXT_TEXELS)[:, np.newaxis], np.fft.rfftfreq(TEXT_TEXELS))
        * TEXT_TEXELS
    )
    field = np.fft.irfft2(
        # white noise through a Gaussian low-pass whose width is the number of grains
        spectrum * np.exp(-((frequency / grains) ** 2)),
        s=(TEXT_TEXELS, TEXT_TEXELS),
    )
    share = (field - field.min()) / np.ptp(field)
    pattern: Pattern = (dark + (bright - dark) * share).astype(np.float32)
    return pattern


def _rasterise_line(
    line: str, across: tuple[float, float], down: tuple[float, float]
) -> NDArray[np.bool_]:
    """Texels inside the letters of one line, stretched to a part of the unit square."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    outline = TextPath(
        (0, 0), line, size=10, prop=FontProperties(family="DejaVu Sans", weight="bold")
    )
    box = outline.get_extents()
    middle = (np.arange(TEXT_TEXELS) + 0.5) / TEXT_TEXELS
    x = box.x0 + (middle - across[0]) / (across[1] - across[0]) * box.width
    y = box.y1 - (middle - down[0]) / (down[1] - down[0]) * box.height
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    inside: NDArray[np.bool_] = outline.contains_points(points).reshape(TEXT_TEXELS, TEXT_TEXELS)
    return inside


def _is_within(
    outline: Outline, x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Points with an odd number of the polygon's edges on their right."""
    inside = np.zeros(x.shape, dtype=bool)
    for (x0, y0), (x1, y1) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if y0 != y1:
            crossing = x0 + (y - y0) * (x1 - x0) / (y1 - y0)
            inside ^= ((y0 > y) != (y1 > y)) & (x < crossing)
    return inside


def _make_arc(
    radius: tuple[float, float], centre: tuple[float, float], start: float, stop: float
) -> Outline:
    """Points of an ellipse from angle `start` to `stop`, degrees, 0 to the right and 90 down."""
    angle = np.radians(np.linspace(start, stop, 33))
    return np.stack(
        [centre[0] + radius[0] * np.cos(angle), centre[1] + radius[1] * np.sin(angle)], axis=-1
    )


def _make_letter_u() -> list[Outline]:
    outer = _make_arc((0.5, 0.45), (0.5, 0.55), 180, 0)
    inner = _make_arc((0.5 - STROKE_WIDTH, 0.45 - STROKE_WIDTH), (0.5, 0.55), 0, 180)
    return [
        np.vstack([[(0, 0)], outer, [(1, 0), (1 - STROKE_WIDTH, 0)], inner, [(STROKE_WIDTH, 0)]])
    ]


def _make_letter_c() -> list[Outline]:
    outer = _make_arc((0.5, 0.5), (0.5, 0.5), 40, 320)
    inner = _make_arc((0.5 - STROKE_WIDTH, 0.5 - STROKE_WIDTH), (0.5, 0.5), 320, 40)
    return [np.vstack([outer, inner])]


def _make_letter_l() -> list[Outline]:
    return [
        np.array(
            [
                (0.1, 0),
                (0.1 + STROKE_WIDTH, 0),
                (0.1 + STROKE_WIDTH, 1 - STROKE_WIDTH),
                (0.95, 1 - STROKE_WIDTH),
                (0.95, 1),
                (0.1, 1),
            ]
        )
    ]


def _make_letter_a() -> list[Outline]:
    outer = [(0.36, 0), (0.64, 0), (1, 1), (0.72, 1), (0.65, 0.78), (0.35, 0.78), (0.28, 1), (0, 1)]
    return [np.array(outer), np.array([(0.5, 0.24), (0.6, 0.58), (0.4, 0.58)])]


def _make_letter_v() -> list[Outline]:
    return [np.array([(0, 0), (0.28, 0), (0.5, 0.6), (0.72, 0), (1, 0), (0.64, 1), (0.36, 1)])]


LETTERS = {
    "A": _make_letter_a(),
    "C": _make_letter_c(),
    "L": _make_letter_l(),
    "U": _make_letter_u(),
    "V": _make_letter_v(),
}
