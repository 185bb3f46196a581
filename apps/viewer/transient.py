"""The recovered frames of one shot: a cloud that grows while light travels."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from apps.viewer.linear_recovery import (
    SHEAR_LIMITS,
    LinearRecovery,
    Readings,
    find_min_intensity,
    make_view,
)
from apps.viewer.source import Capabilities, Gate, Source, View, Waveform
from tofclip.lidar import PointCloud, depth
from tofclip.shots import Frames
from tofclip.units import SPEED_OF_LIGHT

PLAY_TIME_S = 12.0
"""A whole transient at natural speed."""


class TransientSource(Source):
    """Recovered frames: frame `n` of the source is instant `n`; the cloud is that of all instants.

    Refocusing needs measurements. Where they are not at hand, as with a file of frames,
    the camera predicts them from the frames, which explain the measured ones but for the recovery's
    residual.

    Parameters
    ----------
    title : str
    frames : Frames
    measurements : (columns, frames) array, optional
        Rectified measurements from which the frames were recovered.

    Notes
    -----
    Memory: the frames, and on the first refocus their measurements (columns, frames).
    """

    def __init__(self, title: str, frames: Frames, measurements: Readings | None = None) -> None:
        shears = SHEAR_LIMITS if frames.camera.views > 1 else None
        super().__init__(title, frames.times.size / PLAY_TIME_S, Capabilities(frames.times, shears))
        self.frames = frames
        self._linear = LinearRecovery(frames.camera, frames.times)
        self._measured = measurements

    def __len__(self) -> int:
        return int(self.frames.times.size)

    def view(self, number: int) -> View:
        return self._full_view

    def pictures(self, number: int, gate: Gate) -> Mapping[str, NDArray[np.float32]]:
        """Return streak image, intensity in a gate and depth; see `Source`.

        Parameters
        ----------
        number : int
            Not used: the gate says which frames are shown.
        gate : Gate

        Returns
        -------
        dict of (rows, columns) float32 arrays
            Depth in m.
        """
        distance = np.maximum(self.frames.times[gate.frames], 0) * SPEED_OF_LIGHT / 2
        # As the intensity of a point, referred to 1 m: far objects would be lost beside near ones.
        light = np.tensordot((distance**2).astype(np.float32), self.frames.values[gate.frames], 1)
        return {
            "streak": self._measurements.T,
            "intensity": light,
            "depth": render_depth(self._full_view),
        }

    def waveform(self, number: int, pixel: tuple[int, int]) -> Waveform:
        """Return the signal of a pixel; see `Source`.

        Parameters
        ----------
        number : int
            Not used: the signal runs through all frames.
        pixel : (int, int)
            Row and column.

        Returns
        -------
        Waveform
        """
        row, column = pixel
        return Waveform(self.frames.times, self.frames.values[:, row, column])

    def refocus(self, number: int, shear: float, gate: Gate) -> View:
        """Recover the frames of a gate at another shear; see `Source`.

        Parameters
        ----------
        number : int
            Not used.
        shear : float
            Pixels per view step.
        gate : Gate

        Returns
        -------
        View
        """
        return self._linear.view(
            self._measurements, shear, gate, find_min_intensity(self._full_view)
        )

    @functools.cached_property
    def _full_view(self) -> View:
        return make_view(depth(self.frames))

    @functools.cached_property
    def _measurements(self) -> Readings:
        """What the camera read or would read, (columns, frames); neighbouring frames of one shear
        share an operator.
        """
        if self._measured is not None:
            return self._measured
        frames, shears = self.frames, self.frames.shears
        measurements = np.empty((frames.camera.slit_width_px, frames.times.size), np.float32)
        cuts = np.flatnonzero(np.concatenate([[True], np.diff(shears) != 0, [True]]))
        for first, stop in pairwise(cuts.tolist()):
            operator = frames.camera.operator(float(shears[first]))
            measurements[:, first:stop] = operator(
                np.ascontiguousarray(np.moveaxis(frames.values[first:stop], 0, -1))
            )
        return measurements


def render_depth(view: View) -> NDArray[np.float32]:
    """Return the range of each pixel's most intense return, (rows, columns) in m; NaN where nothing
    came back.
    """
    if view.pixels is None or len(view.cloud) == 0:
        return np.full((1, 1), np.nan, np.float32)
    return _scatter_depth(view.cloud, view.pixels)


def _scatter_depth(cloud: PointCloud, pixels: NDArray[np.int32]) -> NDArray[np.float32]:
    picture = np.full(tuple(pixels.max(axis=0) + 1), np.nan, np.float32)
    upwards = np.argsort(cloud.intensity, kind="stable")  # the last one written wins
    row, column = pixels[upwards].T
    picture[row, column] = cloud.range[upwards]
    return picture
