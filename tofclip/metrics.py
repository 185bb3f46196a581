"""How far a picture is from the truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tofclip.arrays import FloatArray
from tofclip.errors import ShapeError, require


def nmse(estimate: ArrayLike, truth: ArrayLike, border_px: int = 0) -> float:
    """Normalised mean square error, relative to the variance of the truth.

    ``sum (h - g)^2 / sum (g - mean(g))^2``. Fitting the "data error" columns of the paper's
    Supplementary Table 5 to its stated corruption selects this form over the energy-normalised one.

    Parameters
    ----------
    estimate, truth : (..., y, x) array
        Pictures in the same scale.
    border_px : int
        Pixels left out on each of the four sides of the last two axes.

    Raises
    ------
    ShapeError, InputError
        The shapes differ, the border leaves nothing, or the truth is constant.

    Examples
    --------
    >>> nmse([[0.0, 1.0]], [[0.0, 2.0]])
    0.5
    """
    h, g = _crop_borders(estimate, truth, border_px)
    spread = float(np.sum((g - g.mean()) ** 2))
    require(
        spread != 0,
        "the truth is constant: its variance cannot normalise an error; use nmse_energy",
    )
    return float(np.sum((h - g) ** 2)) / spread


def nmse_energy(estimate: ArrayLike, truth: ArrayLike, border_px: int = 0) -> float:
    """Squared error over the truth's energy, ``sum (h - g)^2 / sum g^2``; else as `nmse`."""
    h, g = _crop_borders(estimate, truth, border_px)
    energy = float(np.sum(g**2))
    require(energy != 0, "the truth is zero everywhere: its energy cannot normalise an error")
    return float(np.sum((h - g) ** 2)) / energy


def correlation_coefficient(estimate: ArrayLike, truth: ArrayLike, border_px: int = 0) -> float:
    """Pearson's correlation of two pictures, whatever their scales; 0 where the estimate is one
    even tone. Arguments as in `nmse`.
    """
    h, g = _crop_borders(estimate, truth, border_px)
    h, g = h - h.mean(), g - g.mean()
    require(g.any(), "the truth is constant: nothing can correlate with it")
    spread = float(np.linalg.norm(h) * np.linalg.norm(g))
    return float(np.sum(h * g)) / spread if spread > 0 else 0.0


def _crop_borders(
    estimate: ArrayLike, truth: ArrayLike, border_px: int
) -> tuple[FloatArray, FloatArray]:
    h, g = np.asarray(estimate, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    if h.shape != g.shape:
        raise ShapeError("the estimate", f"{g.shape} like the truth", h.shape)
    if border_px:
        inner = (..., slice(border_px, -border_px), slice(border_px, -border_px))
        h, g = h[inner], g[inner]
    require(g.size != 0, f"a border of {border_px} px leaves nothing of the picture")
    require(
        np.all(np.isfinite(h)) and np.all(np.isfinite(g)), "pictures must not hold NaN or infinity"
    )
    return h, g
