"""Returns: when light came back to each pixel, how much, and how surely."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera
from tofclip.errors import InputError, ShapeError


@dataclass(frozen=True)
class Returns:
    """A list of returns, pixel by pixel in raster order, nearest first within a pixel.

    Parameters
    ----------
    y, x : (n,) int32 array
        Row and column of the pixel.
    range : (n,) float64 array
        Distance from the camera along the line of sight, m.
    intensity : (n,) float32 array
        Counts of the return times (range / 1 m)^2: proportional to the surface's reflectance.
    confidence : (n,) float32 array
        Expected standard deviation of the range, m; smaller is surer.
    return_number : (n,) uint8 array
        1 for the nearest return of a pixel.
    time : (n,) float64 array
        Time of flight there and back, s.
    camera : Camera
        The camera that saw them.
    provenance : mapping
        How they came about.
    shear : (n,) float64 array, optional
        Shear at which the picture of that instant was recovered; 0 by default.
    """

    y: NDArray[np.int32]
    x: NDArray[np.int32]
    range: NDArray[np.float64]
    intensity: NDArray[np.float32]
    confidence: NDArray[np.float32]
    return_number: NDArray[np.uint8]
    time: NDArray[np.float64]
    camera: Camera
    provenance: Mapping[str, Any] = field(default_factory=dict)
    shear: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        if self.shear.size == 0:
            object.__setattr__(self, "shear", np.zeros(self.y.shape))
        for name in ("x", "range", "intensity", "confidence", "return_number", "time", "shear"):
            if getattr(self, name).shape != self.y.shape:
                raise ShapeError(f"{name} of the returns", self.y.shape, getattr(self, name).shape)

    def __len__(self) -> int:
        return self.y.size

    @property
    def line_of_sight_px(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(rows, columns) of the reference view's pixels in which the returns lie.

        A picture that was not recovered at the shear of its range is displaced by the parallax;
        here that is undone.
        """
        missing = self.camera.shear_at(self.range) - self.shear
        rows, columns = self.camera.displacement_per_shear
        known = self.camera.lenslet_pitch > 0
        return self.y - known * rows * missing, self.x - known * columns * missing

    def image(self, name: str) -> NDArray[np.float32]:
        """Picture (y, x) of one property of each pixel's most intense return; NaN where nothing
        came back.

        Parameters
        ----------
        name : str
            ``"range"``, ``"intensity"``, ``"confidence"``, ``"return_number"`` or ``"time"``.
        """
        if name not in ("range", "intensity", "confidence", "return_number", "time"):
            raise InputError(f"returns have no property '{name}' to show as a picture")
        picture = np.full(self.camera.image_shape, np.nan, dtype=np.float32)
        upwards = np.argsort(self.intensity, kind="stable")  # the last one written wins
        picture[self.y[upwards], self.x[upwards]] = getattr(self, name)[upwards]
        return picture
