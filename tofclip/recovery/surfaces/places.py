"""Where light of surface points falls on the raw streak image, view by view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera
from tofclip.lidar import compute_ray_directions
from tofclip.recovery.surfaces.state import SurfaceState
from tofclip.units import SPEED_OF_LIGHT

FloatArray = NDArray[np.float64]
Image = NDArray[np.float32]

SLIT_PIXELS, SUBROWS = 4, 3


class BetweenCentres(NamedTuple):
    """Between which two views' centres points fall on the slit."""

    before: NDArray[np.intp]  # (points,), the centre before each
    # (points,), the way from there to the next centre, 0 to 1; outside the outer centres below or
    # beyond, as the sweep goes on linearly there
    fraction: FloatArray

    @classmethod
    def find(cls, centres: FloatArray, column: FloatArray) -> BetweenCentres:
        """Return where places on the slit lie between the centres.

        `centres` (views,); `column` (points,).
        """
        if centres.size == 1:
            return cls(np.zeros(column.size, np.intp), np.zeros(column.size))
        before = np.clip(np.searchsorted(centres, column) - 1, 0, centres.size - 2)
        return cls(before, (column - centres[before]) / (centres[before + 1] - centres[before]))

    def interpolate(self, values: FloatArray) -> FloatArray:
        """Return what each point has of values at the centres, (views,)."""
        after = np.minimum(self.before + 1, values.size - 1)
        found: FloatArray = (1 - self.fraction) * values[self.before] + self.fraction * values[
            after
        ]
        return found

    def weigh_centre(self, view: int) -> FloatArray:
        """Return how much each point has of the value at one centre."""
        upto = np.where(self.before == view, 1 - self.fraction, 0.0)
        return upto + np.where(self.before + 1 == view, self.fraction, 0.0)


class PointPlaces(NamedTuple):
    """Where points fall in one view."""

    row: FloatArray  # (points,), of the raw streak image; row i reaches from i - 1/2 to i + 1/2
    column: FloatArray  # (points,), of the raw streak image; row i reaches from i - 1/2 to i + 1/2
    between: BetweenCentres
    rows_per_instant: float  # raw rows in the time of one, on average


@dataclass(frozen=True)
class PointRays:
    """The rays on which surface points lie."""

    directions: FloatArray  # (points, 3), of length 1
    x: NDArray[Any]  # (points,), pixels from the optical axis
    y: NDArray[Any]  # (points,), pixels from the optical axis

    @classmethod
    def of_pixels(cls, camera: Camera, y: NDArray[np.intp], x: NDArray[np.intp]) -> PointRays:
        """Return the rays of some pixels.

        `y, x` (points,).
        """
        axis_row, axis_column = camera.optical_axis_px
        return cls(compute_ray_directions(camera, y, x), x - axis_column, y - axis_row)

    def locate(
        self,
        view: int,
        distance: FloatArray,
        camera: Camera,
        state: SurfaceState,
        times: FloatArray,
    ) -> PointPlaces:
        """Return where the points fall in a view.

        `distance` (points,): range of each point, m; `state`: with the delays and stretches of the
        views; `times` (rows,): time axis of the streak image, s.
        """
        points, position = self.directions * distance[:, np.newaxis], camera.view_positions[view]
        viewpoint = np.array([camera.lenslet_pitch * position, 0.0, 0.0])
        back = np.linalg.norm(points - viewpoint, axis=1)
        time = (distance + back) / SPEED_OF_LIGHT + camera.time_zero
        column = (
            camera.centres_px[view]
            + self.x
            - self.y * np.tan(camera.angles[view])
            + camera.shear_at(points[:, 2]) * position
        )
        between = BetweenCentres.find(camera.centres_px, column)
        row, pace = find_rows(times, time), 1.0
        if camera.sweep is not None:
            later, _ = camera.sweep.raw_position(row + 0.5, column)
            row, raw_column = camera.sweep.raw_position(row, column)
            pace = 2 * float(np.mean(later - row)) if row.size else 1.0
            column = np.array(raw_column, np.float64)
        delay, stretch = (between.interpolate(one) for one in (state.delays, state.stretches))
        row = row + delay + stretch * measure_height(row, times.size)
        return PointPlaces(row, column, between, pace)


def measure_height(row: NDArray[Any], rows: int) -> FloatArray:
    """Return rows as fractions of the streak image from its middle.

    `rows`: of the streak image.
    """
    height: FloatArray = row / rows - 0.5
    return height


def find_rows(times: FloatArray, time: FloatArray) -> FloatArray:
    """Return where instants lie on a time axis, which need not be even, in rows.

    `times` (rows,): rising, s; beyond its ends the axis goes on as there; `time`: s.
    """
    first, last = times[1] - times[0], times[-1] - times[-2]
    before, after = np.minimum(time - times[0], 0) / first, np.maximum(time - times[-1], 0) / last
    rows: FloatArray = np.interp(time, times, np.arange(times.size)) + before + after
    return rows


class Footprint(NamedTuple):
    """The rows and columns of a view on which points have light, and in which fractions."""

    # (points,), first of those that a point reaches; columns count from `first_column`
    row: NDArray[np.int32]
    row_shares: Image  # (points, 3), before the pulse smooths them
    # (points,), first of those that a point reaches; columns count from `first_column`
    column: NDArray[np.int32]
    slit_shares: Image  # (points, 4)
    first_column: int  # of the slit, of which the view has a part
    columns: int  # of the slit, of which the view has a part
    lit_rows: NDArray[np.int64]  # (n,), of the streak image, which smoothed light reaches
    # (n,), those that light reaches before it is smoothed, counted from `margin` above the first
    # one
    reached_rows: NDArray[np.int64]
    between: BetweenCentres
    rows_per_instant: float  # as of `PointPlaces`

    def overlap(self, slit_width: int) -> tuple[slice, slice]:
        """Return the part of the view's columns that lies on the slit, and where."""
        left, right = max(self.first_column, 0), min(self.first_column + self.columns, slit_width)
        right = max(left, right)
        return slice(left - self.first_column, right - self.first_column), slice(left, right)


def spread_points(
    places: PointPlaces, tangent: float, shape: tuple[int, ...], margin: int, half: int
) -> Footprint:
    """Return which rows and columns the light of points reaches.

    Nothing of what misses the streak image is kept: a surface may run off without end, and one that
    comes close is spread over all of the slit's plane.

    `tangent`: of the view's line angle; `shape`: rows and columns of the streak image; `margin`:
    rows above and below it that may hold light; `half`: rows to either side over which the pulse
    smooths it.
    """
    from tofclip.recovery.surfaces.kernels import (
        SPLINE_SAMPLES,
        split_between_rows,
        split_over_slit,
    )

    rows, columns = shape
    row, column = places.row, places.column
    away, last = margin + SPLINE_SAMPLES, rows + margin - SPLINE_SAMPLES
    first, shares = split_between_rows(np.clip(row, -away, rows + away))
    shares[(first < -margin) | (first > last)] = 0
    np.clip(first, -margin, last, out=first)
    slit_first = np.empty(row.size, np.int32)
    slit = np.empty((row.size, SLIT_PIXELS), np.float32)
    along = np.clip(column, -SLIT_PIXELS, columns + SLIT_PIXELS)
    split_over_slit(along, tangent, SUBROWS, slit_first, slit)
    slit[along != column] = 0
    left = int(slit_first.min(initial=0))
    right = int(slit_first.max(initial=0)) + SLIT_PIXELS
    hit = np.bincount(first + margin, minlength=rows + 2 * margin)
    reached = np.convolve(hit, np.ones(SPLINE_SAMPLES))[: hit.size] > 0
    lit = np.convolve(reached, np.ones(2 * half + 1), "same")
    return Footprint(
        first,
        shares,
        slit_first - np.int32(left),
        slit,
        left,
        right - left,
        np.flatnonzero(lit[margin:-margin] > 0),
        np.flatnonzero(reached),
        places.between,
        places.rows_per_instant,
    )
