"""What bodies are made of: patterns of reflectance, and two laws of reflection."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError

Array = NDArray[Any]

AMBIENT_FRACTION = 0.4
"""Share of the light that comes from everywhere."""


@dataclass(frozen=True)
class Lambertian:
    """A matt surface: as bright from every side.

    Parameters
    ----------
    pattern : (rows, columns) array
        Reflectance from 0 to 1; NaN where there is a hole.

    Raises
    ------
    InputError
        The pattern is no picture or a reflectance lies outside 0 to 1.
    """

    pattern: Array

    def __post_init__(self) -> None:
        known = self.pattern[np.isfinite(self.pattern)]
        if self.pattern.ndim != 2 or known.size == 0 or known.min() < 0 or known.max() > 1:
            raise InputError("a pattern is a picture of reflectances from 0 to 1, NaN in its holes")

    def reflectance(self, place: Array) -> Array:
        """Return the pattern's values at (points, 2) places from 0 to 1, right and down."""
        size = np.array(self.pattern.shape[::-1])
        column, row = np.clip((np.nan_to_num(place) * size).astype(np.int64), 0, size - 1).T
        found: Array = self.pattern[row, column]
        return found

    def is_solid(self, place: Array) -> Array:
        """Tell where there is no hole."""
        return np.isfinite(self.reflectance(place))

    def radiance(self, place: Array, normal: Array, directions: Array, light: Array) -> Array:
        """Return the light that goes back along rays.

        Parameters
        ----------
        place : (points, 2) array
        normal, directions : (points, 3) arrays
            Of the surface, length 1; of the rays towards it, any length.
        light : (3,) array
            Towards the lamp, length 1.
        """
        lit: Array = AMBIENT_FRACTION + (1 - AMBIENT_FRACTION) * np.maximum(normal @ light, 0)
        return self.reflectance(place) * lit


@dataclass(frozen=True)
class Specular(Lambertian):
    """A glossy surface: a matt one, and a lobe about the mirror's direction (B. T. Phong, Commun.
    ACM 18, 311, 1975).

    Parameters
    ----------
    gloss : float
        Brightness of the lobe at its peak.
    exponent : float
        The larger, the more like a mirror.
    """

    gloss: float = 1.0
    exponent: float = 200.0

    def radiance(self, place: Array, normal: Array, directions: Array, light: Array) -> Array:
        """Return the light that goes back along rays; arguments as for a matt surface."""
        matt = super().radiance(place, normal, directions, light)
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        mirrored = unit - 2 * np.einsum("ij,ij->i", unit, normal)[:, np.newaxis] * normal
        shine: Array = self.gloss * np.maximum(mirrored @ light, 0) ** self.exponent
        return matt + shine


Material = Lambertian
"""Any of the two."""
