"""Patterns of reflectance for simulated surfaces: letters made of polygons, textures, writing.

A pattern is a picture over the unit square, x to the right, y down; NaN marks a hole.
"""

from __future__ import annotations

import numpy as np

from tofclip.arrays import Float32Array, FloatArray
from tofclip.errors import require, require_known

Outline = FloatArray
Pattern = Float32Array

STROKE_WIDTH = 0.26  # width of a letter's stroke
TEXELS = 192  # per side; finer than the rays at every range that the rest of this room uses
TEXT_TEXELS = 384  # per side of writing and mottled paint, which have finer detail
LINE_SPACING, MARGIN = 1.3, 0.08  # of capital letters' height; of the rectangle


def _make_arc(
    radius: tuple[float, float], centre: tuple[float, float], start: float, stop: float
) -> list[tuple[float, float]]:
    """Points of an ellipse from angle `start` to `stop`, degrees, 0 to the right and 90 down."""
    angle = np.radians(np.linspace(start, stop, 33))
    x, y = centre[0] + radius[0] * np.cos(angle), centre[1] + radius[1] * np.sin(angle)
    return list(zip(x, y, strict=True))


_W, _ROUND = STROKE_WIDTH, (0.5 - STROKE_WIDTH, 0.5 - STROKE_WIDTH)
_LEFT, _RIGHT, _FOOT = 0.1, 0.1 + STROKE_WIDTH, 1 - STROKE_WIDTH
# Outlines of capital letters: closed polygons, (corners, 2); a second one inside the first is a hole.
LETTERS: dict[str, list[Outline]] = {
    name: [np.array(outline, np.float64) for outline in outlines]
    for name, outlines in {
        "A": [
            [
                *[(0.36, 0), (0.64, 0), (1, 1), (0.72, 1)],
                *[(0.65, 0.78), (0.35, 0.78), (0.28, 1), (0, 1)],
            ],
            [(0.5, 0.24), (0.6, 0.58), (0.4, 0.58)],
        ],
        "C": [_make_arc((0.5, 0.5), (0.5, 0.5), 40, 320) + _make_arc(_ROUND, (0.5, 0.5), 320, 40)],
        "L": [[(_LEFT, 0), (_RIGHT, 0), (_RIGHT, _FOOT), (0.95, _FOOT), (0.95, 1), (_LEFT, 1)]],
        "U": [
            [
                *[(0, 0), *_make_arc((0.5, 0.45), (0.5, 0.55), 180, 0), (1, 0), (1 - _W, 0)],
                *[*_make_arc((0.5 - _W, 0.45 - _W), (0.5, 0.55), 0, 180), (_W, 0)],
            ]
        ],
        "V": [[(0, 0), (0.28, 0), (0.5, 0.6), (0.72, 0), (1, 0), (0.64, 1), (0.36, 1)]],
    }.items()
}


def cut_pattern(outlines: list[Outline], pattern: Pattern) -> Pattern:
    """Keep of `pattern` what lies inside polygons (corners, 2) over the unit square; the rest becomes
    NaN. An outline within another one cuts a hole (even-odd rule).
    """
    rows, columns = pattern.shape
    x = (np.arange(columns) + 0.5) / columns
    y = (np.arange(rows)[:, np.newaxis] + 0.5) / rows
    inside = np.zeros(pattern.shape, bool)
    for outline in outlines:
        for (x0, y0), (x1, y1) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
            if y0 != y1:  # the edge is crossed on the way to the right
                crossing = x0 + (y - y0) * (x1 - x0) / (y1 - y0)
                inside ^= ((y0 > y) != (y1 > y)) & (x < crossing)
    return np.where(inside, pattern, np.nan).astype(np.float32)


def make_plain_pattern(reflectance: float) -> Pattern:
    """An even surface."""
    return np.full((TEXELS, TEXELS), reflectance, dtype=np.float32)


def make_letter(name: str, reflectance: float) -> Pattern:
    """An even capital letter of `LETTERS`, cut out."""
    require_known("letter", name, LETTERS)
    return cut_pattern(LETTERS[name], make_plain_pattern(reflectance))


def make_checkerboard(squares: int, dark: float, bright: float) -> Pattern:
    """A board of `squares` x `squares` fields, bright in the upper left corner."""
    field = np.arange(TEXELS) * squares // TEXELS
    odd = (field[:, np.newaxis] + field) % 2 == 1
    return np.where(odd, dark, bright).astype(np.float32)


def make_stripes(number: int, dark: float, bright: float) -> Pattern:
    """Slanted stripes with smooth borders, `number` of them across the plate."""
    y, x = np.meshgrid(np.arange(TEXELS) / TEXELS, np.arange(TEXELS) / TEXELS, indexing="ij")
    wave = 0.5 + 0.5 * np.sin(2 * np.pi * number * (x + 0.5 * y))
    return (dark + (bright - dark) * wave).astype(np.float32)


def make_rings(number: int, dark: float, bright: float) -> Pattern:
    """A round plate with `number` rings from its bright centre to the rim; NaN outside the disc."""
    y, x = np.meshgrid(np.linspace(-1, 1, TEXELS), np.linspace(-1, 1, TEXELS), indexing="ij")
    radius = np.hypot(x, y)
    wave = 0.5 + 0.5 * np.cos(2 * np.pi * number * radius)
    return np.where(radius <= 1, dark + (bright - dark) * wave, np.nan).astype(np.float32)


def make_text_pattern(text: str, ink: float, paper: float = float("nan")) -> Pattern:
    """Bold capitals that fill a rectangle but for a margin; each line is as wide as the rectangle. A
    paper of NaN leaves letters that are cut out.
    """
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    lines = text.split("\n")
    require(
        all(line.strip() for line in lines), "every line of a writing needs at least one letter"
    )
    font = FontProperties(family="DejaVu Sans", weight="bold")
    step = (1 - 2 * MARGIN) / (len(lines) * LINE_SPACING - LINE_SPACING + 1)
    middle = (np.arange(TEXT_TEXELS) + 0.5) / TEXT_TEXELS
    inside = np.zeros((TEXT_TEXELS, TEXT_TEXELS), bool)
    for number, line in enumerate(lines):
        outline = TextPath((0, 0), line, size=10, prop=font)
        box, top = outline.get_extents(), MARGIN + number * step * LINE_SPACING
        x = box.x0 + (middle - MARGIN) / (1 - MARGIN - MARGIN) * box.width
        y = box.y1 - (middle - top) / (top + step - top) * box.height
        points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        inside |= outline.contains_points(points).reshape(inside.shape)
    return np.where(inside, ink, paper).astype(np.float32)


def make_mottled_pattern(dark: float, bright: float, grains: int, seed: int) -> Pattern:
    """Smooth random blotches, about `grains` across the pattern, with every brightness from dark to
    bright: white noise through a Gaussian low-pass whose width is the number of grains.
    """
    require(
        0 < grains < TEXT_TEXELS,
        f"a mottled pattern has from 1 to {TEXT_TEXELS - 1} grains across, not {grains}",
    )
    shape = (TEXT_TEXELS, TEXT_TEXELS)
    spectrum = np.fft.rfft2(np.random.default_rng(seed).standard_normal(shape))
    down, across = np.fft.fftfreq(TEXT_TEXELS)[:, np.newaxis], np.fft.rfftfreq(TEXT_TEXELS)
    frequency = np.hypot(down, across) * TEXT_TEXELS
    field = np.fft.irfft2(spectrum * np.exp(-((frequency / grains) ** 2)), s=shape)
    level = (field - field.min()) / np.ptp(field)
    return (dark + (bright - dark) * level).astype(np.float32)
