"""Patterns for bodies beyond those of plates: writing, and mottled paint."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError

Pattern = NDArray[np.float32]

TEXELS = 384  # on the longer side
LINE_SPACING = 1.3  # of capital letters' height


def make_text_pattern(
    text: str, ink: float, paper: float = float("nan"), margin: float = 0.08
) -> Pattern:
    """Bold capitals that fill a rectangle; each line is as wide as the rectangle.

    Parameters
    ----------
    text : str
        Lines divided by line breaks.
    ink, paper : float
        Reflectances; a paper of NaN leaves letters that are cut out.
    margin : float
        Share of the rectangle left free at each side.
    """
    lines = text.split("\n")
    if not all(line.strip() for line in lines):
        raise InputError("every line of a writing needs at least one letter")
    step = (1 - 2 * margin) / (len(lines) * LINE_SPACING - LINE_SPACING + 1)
    inside = np.zeros((TEXELS, TEXELS), bool)
    for number, line in enumerate(lines):
        top = margin + number * step * LINE_SPACING
        inside |= _rasterise_line(line, (margin, 1 - margin), (top, top + step))
    return np.where(inside, ink, paper).astype(np.float32)


def make_mottled_pattern(dark: float, bright: float, grains: int, seed: int) -> Pattern:
    """Smooth random blotches, about `grains` across the pattern, with every brightness from dark to
    bright.
    """
    if not 0 < grains < TEXELS:
        raise InputError(
            f"a mottled pattern has from 1 to {TEXELS - 1} grains across, not {grains}"
        )
    random = np.random.default_rng(seed)
    spectrum = np.fft.rfft2(random.standard_normal((TEXELS, TEXELS)))
    frequency = np.hypot(np.fft.fftfreq(TEXELS)[:, np.newaxis], np.fft.rfftfreq(TEXELS)) * TEXELS
    field = np.fft.irfft2(spectrum * np.exp(-((frequency / grains) ** 2)), s=(TEXELS, TEXELS))
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
    middle = (np.arange(TEXELS) + 0.5) / TEXELS
    x = box.x0 + (middle - across[0]) / (across[1] - across[0]) * box.width
    y = box.y1 - (middle - down[0]) / (down[1] - down[0]) * box.height
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    inside: NDArray[np.bool_] = outline.contains_points(points).reshape(TEXELS, TEXELS)
    return inside
