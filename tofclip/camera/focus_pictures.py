"""Slit centres and line angles from pictures of a point source, taken with the sweep standing still
(focus mode).

With the slit open the source makes one bright line for each cylindrical lenslet: its angle is the
view's. With the slit closed only the crossing of line and slit remains: its column is the view's
centre.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tofclip.arrays import FloatArray, IndexArray, IntArray
from tofclip.camera.model import Camera
from tofclip.errors import CalibrationError, ShapeError, require
from tofclip.units import MAD_TO_SIGMA

DOT_HALF_WIDTH_PX = 14  # the core of a dot; aberrated tails beyond it would pull the centre
SLIT_HALF_HEIGHT_PX = 6
LINE_THRESHOLD = 0.15  # of the line's brightness at the slit
LINE_SEGMENT_COUNT = 12  # pieces whose scatter about the line tells how straight it is
MIN_DOT_SNR = 8.0  # standard deviations of the picture's noise


@dataclass(frozen=True)
class FocusCalibration:
    """What the four pictures say about a camera, of each view: `centres_px`, slit columns (0-based), and
    `angles` from the vertical, rad, positive where the column grows with the row, with their standard
    deviations, `centre_uncertainty_px` and `angle_uncertainty`; `dot_rows_px`, row of the dot, as the
    slit is not exactly horizontal; `line_rows_px` (views, 2), first and last row of the line;
    `line_columns_px`, where it crosses the dot's row. `signal` and `dots` (rows, columns) are the
    pictures without background, for drawing.
    """

    centres_px: FloatArray
    angles: FloatArray
    centre_uncertainty_px: FloatArray
    angle_uncertainty: FloatArray
    dot_rows_px: FloatArray
    line_rows_px: IntArray
    line_columns_px: FloatArray
    signal: FloatArray
    dots: FloatArray

    def camera(self, **settings: Any) -> Camera:
        """Make a `Camera`; the picture is as high as the longest line and as wide as the views' pitch.
        `settings` are further entries of `Camera`, such as ``time_zero`` or another
        ``image_shape``.
        """
        width = height = int(np.ptp(self.line_rows_px, axis=1).max()) // 2 * 2
        if self.centres_px.size > 1:
            width = int(np.median(np.diff(self.centres_px))) // 2 * 2
        names = ("centres_px", "angles", "centre_uncertainty_px", "angle_uncertainty")
        known = {name: getattr(self, name) for name in names}
        known |= {"image_shape": (height, width), "slit_width_px": self.signal.shape[1]}
        return Camera(**known | settings)


def calibrate_views(
    line: ArrayLike,
    line_background: ArrayLike,
    dot: ArrayLike,
    dot_background: ArrayLike,
    views: int = 7,
) -> FocusCalibration:
    """Find slit centre and line angle of each of so many `views` from pictures of a point source: `line`, with
    the slit open, and `dot`, with it closed, and of each the same without the source, `line_background`
    and `dot_background`.

    A centre is the middle of a Gaussian fitted to the core of the dot's profile along the slit; its
    uncertainty comes from the fit. An angle is that of the line's principal axis (total least
    squares weighted by brightness); its uncertainty comes from the scatter of the line's segments
    about it, so that a bent line counts as an uncertain one. `ShapeError` where the pictures differ in
    shape, `CalibrationError` where fewer dots than views stand out, or a dot lies on no line.
    """
    signal = _subtract_background(line, line_background)
    dots = _subtract_background(dot, dot_background)
    if signal.shape != dots.shape:
        raise ShapeError("the dot pictures", f"{signal.shape} like the line pictures", dots.shape)
    slit_row, columns = _find_dots(dots, views)
    fits = [_fit_view(signal, dots, slit_row, column) for column in columns]
    by_view = [np.array(values) for values in zip(*fits, strict=True)]
    return FocusCalibration(*[*by_view, signal, dots])


def _subtract_background(picture: ArrayLike, background: ArrayLike) -> FloatArray:
    a, b = np.asarray(picture, dtype=np.float64), np.asarray(background, dtype=np.float64)
    if a.ndim != 2 or a.shape != b.shape:
        raise ShapeError("a background picture", a.shape, b.shape)
    require(
        np.all(np.isfinite(a)) and np.all(np.isfinite(b)),
        "calibration pictures must not hold NaN or infinity",
    )
    return a - b


def _find_dots(dots: FloatArray, views: int) -> tuple[int, IndexArray]:
    """Row of the slit and the columns of the `views` strongest dots, from left to right."""
    from scipy.ndimage import gaussian_filter1d, median_filter
    from scipy.signal import find_peaks

    clean = median_filter(dots, 3)  # single hot pixels survive no 3 x 3 median
    slit_row = int(gaussian_filter1d(clean.sum(axis=1), 2).argmax())
    profile = gaussian_filter1d(_crop_slit_band(clean, slit_row).sum(axis=0), 4)
    noise = MAD_TO_SIGMA * float(np.median(np.abs(profile - np.median(profile))))
    distance = max(1, dots.shape[1] // (2 * views + 1))
    height = np.median(profile) + MIN_DOT_SNR * noise
    peaks, _ = find_peaks(profile, height=height, distance=distance)
    if peaks.size < views:
        raise CalibrationError(
            f"found {peaks.size} dots on the slit, expected {views}: check that the dot picture was taken with the "
            "slit closed and that its background belongs to it"
        )
    strongest = peaks[np.argsort(profile[peaks])[-views:]]
    return slit_row, np.sort(strongest)


def _crop_slit_band(picture: FloatArray, row: int) -> FloatArray:
    return picture[max(0, row - SLIT_HALF_HEIGHT_PX) : row + SLIT_HALF_HEIGHT_PX + 1]


def _fit_view(signal: FloatArray, dots: FloatArray, slit_row: int, column: int) -> tuple[Any, ...]:
    """A view's fields of a `FocusCalibration`, in their order."""
    centre, centre_error = _fit_dot(_crop_slit_band(dots, slit_row).sum(axis=0), column)
    around = slice(column - DOT_HALF_WIDTH_PX, column + DOT_HALF_WIDTH_PX + 1)
    band = np.maximum(_crop_slit_band(dots, slit_row)[:, around], 0)
    rows = np.arange(band.shape[0]) + max(0, slit_row - SLIT_HALF_HEIGHT_PX)
    dot_row = float(np.average(rows, weights=band.sum(axis=1)))
    row, col, brightness = _find_line_pixels(signal, slit_row, column)
    slope, crossing, slope_error = _fit_principal_line(row - dot_row, col, brightness)
    angle, angle_error = float(np.arctan(slope)), slope_error / (1 + slope**2)
    ends = row.min(), row.max()
    return centre, angle, centre_error, angle_error, dot_row, ends, crossing


def _fit_dot(profile: FloatArray, column: int) -> tuple[float, float]:
    """Centre and its standard deviation, from a Gaussian on a constant fitted to the core."""
    from scipy.optimize import curve_fit

    first = max(0, column - DOT_HALF_WIDTH_PX)
    x = np.arange(first, min(profile.size, column + DOT_HALF_WIDTH_PX + 1), dtype=np.float64)
    y = profile[first : first + x.size]

    def model(
        x: FloatArray, height: float, centre: float, width: float, floor: float
    ) -> FloatArray:
        return height * np.exp(-((x - centre) ** 2) / (2 * width**2)) + floor

    try:
        # A dot is some 3 px wide where the fit begins; only the core is given to it.
        best, covariance = curve_fit(model, x, y, (np.ptp(y), column, 3.0, y.min()))
    except RuntimeError as fault:
        raise CalibrationError(f"the dot near column {column} has no clear centre") from fault
    return float(best[1]), float(np.sqrt(covariance[1, 1]))


def _find_line_pixels(
    signal: FloatArray, slit_row: int, column: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rows, columns and brightness of the connected bright region that crosses the slit there."""
    from scipy.ndimage import gaussian_filter, label

    # Smoothed, or noise would cut a faint line into pieces.
    smooth = gaussian_filter(signal, 1.5)
    # The slit is a few pixels high and not exactly horizontal, and the open slit's line is wider
    # than the dot: the brightest pixel near the crossing is where the region begins.
    near = smooth[max(0, slit_row - 5) : slit_row + 6, max(0, column - 6) : column + 7]
    if near.max() <= 0:
        raise CalibrationError(f"no line crosses the slit near column {column}: is its slit open?")
    regions, _ = label(smooth > LINE_THRESHOLD * near.max())
    top, left = np.unravel_index(int(near.argmax()), near.shape)
    inside = regions == regions[max(0, slit_row - 5) + top, max(0, column - 6) + left]
    rows, columns = np.nonzero(inside)
    if np.ptp(rows) < 2 * LINE_SEGMENT_COUNT:
        length = f"the line near column {column} is only {np.ptp(rows)} px long"
        raise CalibrationError(f"{length}; no angle can be fitted")
    return rows.astype(np.float64), columns.astype(np.float64), signal[rows, columns]


def _fit_principal_line(
    rows: FloatArray, columns: FloatArray, brightness: FloatArray
) -> tuple[float, float, float]:
    """Slope (columns per row), column at row 0 and the slope's standard deviation."""
    # Negative light is the background's noise; as a weight it would push the line away.
    weights = np.maximum(brightness, 0)
    points = np.stack([rows, columns])
    middle = np.average(points, axis=1, weights=weights)
    # Distances across the line count, not along rows or columns: a line may be steep or flat. eigh
    # sorts upwards, so that the last axis runs along the line.
    _, axes = np.linalg.eigh(np.cov(points, aweights=weights))
    down, right = axes[:, 1]
    slope = float(right / down)
    along = (points - middle[:, np.newaxis]).T @ axes[:, 1]
    across = (points - middle[:, np.newaxis]).T @ axes[:, 0]
    # Pixels of one piece err alike, by the lens: the pieces' middles, not the pixels, are what
    # scatters independently.
    cuts = np.quantile(along, np.linspace(0, 1, LINE_SEGMENT_COUNT + 1))
    piece = np.clip(np.searchsorted(cuts, along, side="right") - 1, 0, LINE_SEGMENT_COUNT - 1)
    total = np.bincount(piece, weights, LINE_SEGMENT_COUNT)
    position = np.bincount(piece, weights * along, LINE_SEGMENT_COUNT) / total
    deviation = np.bincount(piece, weights * across, LINE_SEGMENT_COUNT) / total
    # Two degrees of freedom went into the line.
    scatter = np.sqrt(np.sum(deviation**2) / (LINE_SEGMENT_COUNT - 2))
    tilt_error = scatter / np.sqrt(np.sum((position - position.mean()) ** 2))
    # d tan(a) = (1 + tan(a)^2) da turns the error of the angle into that of the slope.
    return slope, float(middle[1] - slope * middle[0]), float(tilt_error * (1 + slope**2))
