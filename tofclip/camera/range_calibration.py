"""What a target at a known distance tells of an instrument's ranges and intensities.

A detector reports a strong return earlier than a weak one (range walk), every pixel has a delay and
a gain of its own, and counts become a reflectance only beside a target whose reflectance is known.
The corrections are made where returns are listed, see `tofclip.lidar.range_calibration`; time zero is
the camera's own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofclip.arrays import FloatArray
from tofclip.errors import CalibrationError, require_consistent
from tofclip.storage import Storable, stored_array, stored_value
from tofclip.units import SPEED_OF_LIGHT


def empty_array(units: str, *axes: str, **options: Any) -> Any:
    """Return the field of a stored array that is empty where nothing is known."""
    metadata = stored_array(units, *axes, **options)
    return field(default_factory=lambda: np.empty((0,) * len(axes)), metadata=metadata)


@dataclass(frozen=True)
class RangeCalibration(Storable):
    """Corrections of ranges and intensities, each with its standard deviation; arrays are empty where nothing
    is known.

    `time_zero_sigma` is that of the camera's time zero, s. `walk` (order,) is the range walk, what is
    measured too long: coefficients a_1, a_2... of ``sum a_n log10(signal / reference_signal)^n``, m, of
    covariance `walk_covariance` (order, order), m^2. Time zero holds as it is for a return of
    `reference_signal` counts; beyond the weakest and the strongest return of the calibration,
    `signal_range` (2,), counts, the walk is that of the nearer one. `offsets` and `offset_sigma` (rows,
    columns) are each pixel's, m, and `response` (rows, columns) its relative brightness, 1 on average.
    `reflectance_scale` is the reflectance, percent, of a surface that faces the camera and returns one
    count from 1 m, of relative deviation `reflectance_scale_sigma`; NaN where not known.
    `CalibrationError` where arrays disagree in shape, or a number is not finite or not positive where it
    has to be.
    """

    RECORD_KIND = "range_calibration"

    time_zero_sigma: float = field(metadata=stored_value("time_zero_sigma_s"))
    walk: FloatArray = empty_array("m", "power")
    walk_covariance: FloatArray = empty_array("m^2", "power", "power")
    reference_signal: float = field(default=1.0, metadata=stored_value("reference_signal_counts"))
    signal_range: FloatArray = field(
        default_factory=lambda: np.array([1.0, 1.0]), metadata=stored_array("count", "end")
    )
    offsets: FloatArray = empty_array("m", "y", "x")
    offset_sigma: FloatArray = empty_array("m", "y", "x")
    response: FloatArray = empty_array("", "y", "x")
    reflectance_scale: float = field(
        default=np.nan, metadata=stored_value("reflectance_percent_of_one_count_at_1_m")
    )
    reflectance_scale_sigma: float = field(
        default=np.nan, metadata=stored_value("reflectance_relative_sigma")
    )

    def __post_init__(self) -> None:
        pixels = ("offsets", "offset_sigma", "response")
        for name in ("walk", "walk_covariance", "signal_range", *pixels):
            array = np.array(getattr(self, name), dtype=np.float64)
            array.flags.writeable = False
            object.__setattr__(self, name, array)
            if not np.all(np.isfinite(array)):
                raise CalibrationError(f"{name} of a range calibration must be finite")
        require_consistent(self._list_conditions())

    def _list_conditions(self) -> Iterator[tuple[Any, str]]:
        """What holds of every calibration, and what to say where it does not."""
        order, signals = self.walk.size, self.signal_range
        of_one_order = self.walk.ndim == 1 and self.walk_covariance.shape == (order, order)
        yield of_one_order, "the range walk and its covariance must be of one order"
        alike = self.offsets.ndim == 2 and self.offsets.shape == self.offset_sigma.shape
        yield alike, "the pixels' offsets and their deviations must be of one shape"
        positive = self.response.ndim == 2 and np.all(self.response > 0)
        yield positive, "the pixels' response must be positive numbers (rows, columns)"
        ordered = signals.shape == (2,) and 0 < signals[0] <= signals[1]
        ordered &= self.reference_signal > 0
        yield ordered, "the signals of a range calibration must be positive, weak first"
        known = 0 <= self.time_zero_sigma < np.inf
        yield known, "the deviation of time zero must be a number of seconds"

    def require_shape(self, image_shape: tuple[int, int]) -> None:
        """Raise `CalibrationError` where the pixels are those of another picture."""
        for name in ("offsets", "response"):
            known = getattr(self, name)
            if known.size and known.shape != image_shape:
                what = f"{name} of the range calibration are of {known.shape} pixels"
                raise CalibrationError(f"{what}, the picture has {image_shape}")

    def compute_walk(self, signal: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return what returns of so many counts, (n,), are measured too long, m, and its deviation."""
        strength = np.clip(np.asarray(signal, dtype=np.float64), *self.signal_range)
        decades = np.log10(strength / self.reference_signal)
        powers = decades[..., np.newaxis] ** np.arange(1, self.walk.size + 1)
        variance = np.einsum("...i,ij,...j->...", powers, self.walk_covariance, powers)
        return powers @ self.walk, np.sqrt(np.maximum(variance, 0))

    def compute_excess(
        self, signal: ArrayLike, y: NDArray[np.integer], x: NDArray[np.integer]
    ) -> tuple[FloatArray, FloatArray]:
        """Return what returns of so many counts, `signal`, at pixels (y, x), (n,) each, are measured too long, m, by
        walk and pixel, and its deviation: with that of time zero, which all returns share.
        """
        excess, sigma = self.compute_walk(signal)
        sigma = np.hypot(sigma, SPEED_OF_LIGHT / 2 * self.time_zero_sigma)
        if self.offsets.size:
            excess = excess + self.offsets[y, x]
            sigma = np.hypot(sigma, self.offset_sigma[y, x])
        return excess, sigma

    def compute_reflectance(
        self, intensity: ArrayLike, y: NDArray[np.integer], x: NDArray[np.integer]
    ) -> FloatArray:
        """Return the reflectance of surfaces as if they faced the camera, percent, (n,): of `intensity`,
        counts referred to a range of 1 m, at pixels (y, x). NaN where no target of known reflectance was seen.
        """
        gain = self.response[y, x] if self.response.size else 1.0
        counts = np.asarray(intensity, dtype=np.float64)
        return np.asarray(self.reflectance_scale * counts / gain)
