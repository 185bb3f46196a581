"""The pictures of all views, and the picture that refocusing makes of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError, ShapeError
from tofclip.operators import LinearShear
from tofclip.records import Storable, stored_array


@dataclass(frozen=True)
class LightField(Storable):
    """The sub-aperture pictures of a scene.

    Parameters
    ----------
    pictures : (views, rows, columns) float32 array
    views : (views, 2) array
        (v, u) of each picture on the view grid.

    Raises
    ------
    ShapeError, InputError
        Views and pictures do not match, or the pictures hold NaN or are constant.
    """

    RECORD_KIND = "light_field"

    pictures: NDArray[Any] = field(metadata=stored_array("", "view", "y", "x", dtype=np.float32))
    views: NDArray[np.float64] = field(metadata=stored_array("", "view", "vu"))

    def __post_init__(self) -> None:
        if self.pictures.ndim != 3:
            raise ShapeError(
                "the pictures of a light field", "(views, rows, columns)", self.pictures.shape
            )
        if self.views.shape != (len(self.pictures), 2):
            raise ShapeError(
                "the views of a light field", (len(self.pictures), 2), self.views.shape
            )
        if not np.all(np.isfinite(self.pictures)):
            raise InputError("a light field must not hold NaN or infinity")
        if np.ptp(self.pictures) == 0:
            raise InputError(
                "a light field whose pictures are all one even tone shows nothing to recover"
            )

    def refocus(self, shear: float, reference: tuple[float, float] = (0.0, 0.0)) -> NDArray[Any]:
        """Shift and add: each view is shifted back and the mean taken of those that see the pixel.

        Parameters
        ----------
        shear : float
            s, pixels per view step.
        reference : (float, float)
            (v, u) of the view whose picture it becomes.

        Returns
        -------
        (rows, columns) float32 array
        """
        shape = (self.pictures.shape[1], self.pictures.shape[2])
        total, seen = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        inside = np.ones(shape, np.float32)
        for picture, (v, u) in zip(self.pictures, self.views, strict=True):
            back = LinearShear(shape, shear, (float(v), float(u)), reference).H
            total += back(picture)
            seen += back(inside)
        return total / np.maximum(seen, 1e-6)
