"""The relay wall of a non-line-of-sight shot, and the focal length that it gives away."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import FileFormatError
from tofclip.io.archive import Archive
from tofclip.storage import Field, Record

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class RelayWall:
    """The wall as a window of the picture sees it."""

    # (rows, columns, 3), the wall point seen by each pixel of the window, m; NaN where unknown
    points: FloatArray
    # (3,), position of the camera and of the laser spot on the wall, m, in the same frame
    camera: FloatArray
    # (3,), position of the camera and of the laser spot on the wall, m, in the same frame
    laser: FloatArray
    offset_px: tuple[int, int]  # first row and column of the window in the picture
    axis_px: tuple[int, int]  # row and column of the optical axis in the picture
    # bins by which the record starts late: bin i stands for (i + delay) bin widths of travel
    receive_delay_bins: float

    def to_record(self) -> Record:
        """Return the attachment that travels with the shot."""
        return Record(
            "relay_wall",
            {
                "wall": Field(self.points, "m", ("y", "x", "xyz")),
                "camera": Field(self.camera, "m", ("xyz",)),
                "laser": Field(self.laser, "m", ("xyz",)),
            },
            {
                "row_offset": self.offset_px[0],
                "column_offset": self.offset_px[1],
                "receive_delay_bins": self.receive_delay_bins,
            },
        )

    def fit_focal_length(self) -> tuple[float, float]:
        """Fit a pinhole camera, free to turn, to the directions in which the pixels see the wall.

        A pixel at (X, Y) from the optical axis looks along (X, Y, f). For each trial f the rotation
        that aligns these directions best with the measured ones follows from a singular value
        decomposition, and the sum of the singular values tells how well they align (G. Wahba, SIAM
        Review 7, 409 (1965)); f is then found by zooming in.

        Returns `focal_length_px, residual_px`: in pixels of the picture; the residual is the root
        mean square distance on the picture.
        """
        pixels, directions = self._sight_lines()
        # From a fisheye of one pixel to a telephoto lens: any camera lies in between.
        low, high = 1.0, 1e5
        while high / low > 1 + 1e-6:
            # a geometric grid, narrowed about its best value until both ends agree
            trials = np.geomspace(low, high, 33)
            best = int(np.argmax([_align_directions(f, pixels, directions)[0] for f in trials]))
            low, high = trials[max(best - 1, 0)], trials[min(best + 1, trials.size - 1)]
        focal_length_px = float(np.sqrt(low * high))
        seen = _align_directions(focal_length_px, pixels, directions)[1] @ directions
        error_px = focal_length_px * seen[:2] / seen[2] - pixels
        return focal_length_px, float(np.sqrt(np.mean(np.sum(error_px**2, axis=0))))

    def _sight_lines(self) -> tuple[FloatArray, FloatArray]:
        """(X, Y) of the pixels from the optical axis and the unit vectors towards the wall; columns
        are pixels.
        """
        known = np.all(np.isfinite(self.points), axis=-1)
        row, column = np.nonzero(known)
        pixels = np.stack(
            [
                column + float(self.offset_px[1] - self.axis_px[1]),
                row + float(self.offset_px[0] - self.axis_px[0]),
            ]
        )
        directions = (self.points[known] - self.camera).T
        return pixels, directions / np.linalg.norm(directions, axis=0)


def read_relay_wall(archive: Archive, image_shape: tuple[int, int]) -> RelayWall:
    """Take the relay wall out of a LIFT archive; its window has the picture's middle pixel in its
    own middle.

    `archive`: A LIFT shot; `image_shape`: rows and columns of the recovered picture. Returns points
    (rows, columns, 3), m.
    """
    points = np.moveaxis(archive.array("wall_grid_m", 3, None, None), 0, -1).astype(np.float64)
    axis_px = (image_shape[0] // 2, image_shape[1] // 2)
    offset_px = (axis_px[0] - points.shape[0] // 2, axis_px[1] - points.shape[1] // 2)
    fits = min(offset_px) >= 0 and all(np.add(offset_px, points.shape[:2]) <= image_shape)
    if not fits or np.count_nonzero(np.all(np.isfinite(points), axis=-1)) < 4:
        raise FileFormatError(
            archive.path,
            f"field 'wall_grid_m' must hold wall points for at most {image_shape} pixels",
        )
    return RelayWall(
        points=np.ascontiguousarray(points),
        camera=archive.finite_array("camera_pos_m", 3),
        laser=archive.finite_array("laser_pos_m", 3),
        offset_px=offset_px,
        axis_px=axis_px,
        receive_delay_bins=float(archive.finite_array("receive_delay_bins")),
    )


def _align_directions(
    focal_length_px: float, pixels: FloatArray, directions: FloatArray
) -> tuple[float, FloatArray]:
    """How well the pixels' directions align with `directions` (1: exactly), and the rotation that
    does it.
    """
    looking = np.vstack([pixels, np.full(pixels.shape[1], focal_length_px)])
    looking /= np.linalg.norm(looking, axis=0)
    # Wahba's problem: the rotation that maximises the trace is the product of the singular vectors.
    left, values, right = np.linalg.svd(looking @ directions.T)
    return float(values.sum()) / pixels.shape[1], left @ right
