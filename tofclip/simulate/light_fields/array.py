"""A grid of pinhole cameras, all looking the same way, their pictures shifted to agree at one
distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofclip.errors import InputError
from tofclip.operators.shear import View


@dataclass(frozen=True)
class CameraArray:
    """Cameras at ``(u, v) * view_step`` metres in the plane z = 0, looking along z; x points right
    and y down.

    Parameters
    ----------
    image_shape : (int, int)
        Rows and columns of each picture.
    view_count : int
        Cameras on a side; they are numbered ``-(n // 2), ...``.
    focal_length_px : float
    view_step : float
        Distance between neighbours, m.
    focus : float
        Distance at which all pictures agree (s = 0), m.
    samples : int
        Rays on a side of each pixel.
    view_rows : int, optional
        Rows of cameras, numbered alike; as many as `view_count` if not given.

    Raises
    ------
    InputError
        A count or length is not positive.
    """

    image_shape: tuple[int, int] = (128, 128)
    view_count: int = 8
    focal_length_px: float = 160.0
    view_step: float = 0.0125
    focus: float = 1.0
    samples: int = 2
    view_rows: int | None = None

    def __post_init__(self) -> None:
        counts = (*self.image_shape, *self._view_counts, self.samples)
        lengths = (*counts, self.focal_length_px, self.view_step, self.focus)
        if not all(np.isfinite(length) and length > 0 for length in lengths):
            raise InputError("every count and length of a camera array must be positive")

    @property
    def _view_counts(self) -> tuple[int, int]:
        """Cameras down and across."""
        return (self.view_count if self.view_rows is None else self.view_rows), self.view_count

    @property
    def views(self) -> NDArray[np.float64]:
        """(v, u) of each camera in raster order, (views, 2)."""
        numbers = (np.arange(count) - count // 2 for count in self._view_counts)
        return (
            np.stack(np.meshgrid(*numbers, indexing="ij"), axis=-1)
            .reshape(-1, 2)
            .astype(np.float64)
        )

    def position(self, view: View) -> NDArray[np.float64]:
        """Where the camera at (v, u) stands, (x, y, z) in metres; fractions are places between the
        array's.
        """
        return np.array([view[1] * self.view_step, view[0] * self.view_step, 0.0])

    def shear(self, depth: ArrayLike) -> NDArray[np.float64]:
        """Shear s in pixels per view step of points at `depth` metres along z (supplement Note 1, s
        = 0 at focus).
        """
        inverse = 1 / np.asarray(depth, np.float64)
        shear: NDArray[np.float64] = (
            self.focal_length_px * self.view_step * (1 / self.focus - inverse)
        )
        return shear

    def depth(self, shear: float) -> float:
        """Distance along z, in metres, of points with a shear.

        Raises
        ------
        InputError
            They would lie beyond infinity.
        """
        inverse = 1 / self.focus - shear / (self.focal_length_px * self.view_step)
        if not inverse > 0:
            raise InputError(
                f"shear {shear} lies beyond infinity for this camera array; take a smaller one"
            )
        return 1 / inverse

    def point(self, x: float, y: float, shear: float) -> NDArray[np.float64]:
        """The point (x, y, z) in metres that the reference view sees `x`, `y` pixels off its centre
        at a shear.

        Parameters
        ----------
        x, y : float
            Pixels off the centre, right and down.
        shear : float
            Pixels per view step.

        Returns
        -------
        (3,) float64 array
        """
        depth = self.depth(shear)
        return np.array([x / self.focal_length_px * depth, y / self.focal_length_px * depth, depth])

    def rays(self, view: View, samples: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rays of one camera.

        Parameters
        ----------
        view : (float, float)
            (v, u); fractions are cameras between those of the grid.
        samples : int
            Rays on a side of each pixel.

        Returns
        -------
        origin : (3,) array
        directions : (rows * samples * columns * samples, 3) array
            As long as the way from the camera to the plane in focus.
        """
        rows, columns = self.image_shape
        origin = self.position(view)
        y, x = (
            _sample_positions(count, samples) * self.focus / self.focal_length_px
            for count in (rows, columns)
        )
        # all views' pictures agree on the plane in focus: rays of one pixel meet there
        at_focus = np.stack(np.broadcast_arrays(x, y[:, np.newaxis], self.focus), axis=-1)
        return origin, at_focus.reshape(-1, 3) - origin


def _sample_positions(pixels: int, samples: int) -> NDArray[np.float64]:
    """Places of the samples in pixels from the middle of the picture's central pixel, number n //
    2.
    """
    places: NDArray[np.float64] = (np.arange(pixels * samples) + 0.5) / samples - 0.5 - pixels // 2
    return places
