"""The recovered frames of one shot: a cloud that grows while light travels."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from apps.viewer.shot_recovery import (
    SHEAR_LIMITS,
    Readings,
    ShotRecovery,
    find_min_intensity,
    leave_out_rays,
    list_recovery_notes,
    make_view,
)
from apps.viewer.source import (
    LINEAR_FRAMES_NOTE,
    LINEAR_NOTE,
    Capabilities,
    Gate,
    Source,
    View,
    Waveform,
    list_camera_notes,
)
from tofclip.lidar import depth
from tofclip.shots import Frames
from tofclip.solvers import LinearInverse, Method
from tofclip.units import SPEED_OF_LIGHT

PLAY_TIME_S = 12.0
"""A whole transient at natural speed."""


class TransientSource(Source):
    """Recovered frames: frame `n` of the source is instant `n`; the cloud is that of all instants.

    Refocusing needs measurements. Where they are not at hand, as with a file of frames,
    the camera predicts them from the frames, which explain the measured ones but for the recovery's
    residual.

    `measurements` (columns, frames): rectified measurements from which the frames were recovered;
    `method`: of a refocus; the linear inverse by default.

    Memory: the frames, and on the first refocus their measurements (columns, frames).
    """

    def __init__(
        self,
        title: str,
        frames: Frames,
        measurements: Readings | None = None,
        method: Method | None = None,
    ) -> None:
        shears = SHEAR_LIMITS if frames.camera.views > 1 else None
        capabilities = Capabilities(frames.times, shears)
        super().__init__(title, frames.times.size / PLAY_TIME_S, capabilities)
        self.frames = frames
        self._recovery = ShotRecovery(frames.camera, frames.times, method)
        self.notes = list_camera_notes(frames.camera)
        if measurements is not None:
            self.notes = list_recovery_notes(self._recovery)
        elif frames.figures.get("method") == LinearInverse.name:
            self.notes = (LINEAR_FRAMES_NOTE, *self.notes)
        self._measured = measurements

    def __len__(self) -> int:
        return int(self.frames.times.size)

    def view(self, number: int) -> View:
        return self._full_view

    def recover_frames(self, number: int) -> Frames:
        """Return the frames of the one shot that there is."""
        return self.frames

    def pictures(self, number: int, gate: Gate) -> Mapping[str, NDArray[np.float32]]:
        """Return streak image, intensity in a gate and depth; see `Source`.

        `number`: not used: the gate says which frames are shown. Returns depth in m.
        """
        distance = np.maximum(self.frames.times[gate.frames], 0) * SPEED_OF_LIGHT / 2
        # As the intensity of a point, referred to 1 m: far objects would be lost beside near ones.
        light = np.tensordot((distance**2).astype(np.float32), self.frames.values[gate.frames], 1)
        return {
            "streak": self._measurements.T,
            "intensity": light,
            "depth": render_depth(self._full_view, self.frames.camera.image_shape),
        }

    @property
    def refocus_note(self) -> str:
        """What is said while a refocus is shown."""
        return LINEAR_NOTE if self._recovery.is_linear else ""

    def waveform(self, number: int, pixel: tuple[int, int]) -> Waveform:
        """Return the signal of a pixel; see `Source`.

        `number`: not used: the signal runs through all frames; `pixel`: row and column.
        """
        row, column = pixel
        return Waveform(self.frames.times, self.frames.values[:, row, column])

    def refocus(self, number: int, shear: float, gate: Gate) -> View:
        """Recover the frames of a gate at another shear; see `Source`.

        `number`: not used; `shear`: pixels per view step.
        """
        return self._recovery.view(
            self._measurements, shear, gate, find_min_intensity(self._full_view.cloud)
        )

    @functools.cached_property
    def _full_view(self) -> View:
        # Surfaces were found with their points; frames are searched for theirs.
        if self.frames.returns is not None:
            return make_view(self.frames.returns)
        # Of these the dim ones, rays that few views leave around bright things, would hide the others.
        return leave_out_rays(make_view(depth(self.frames)))

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


def render_depth(view: View, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return the range of each pixel's most intense return, m; NaN where nothing came back.

    `shape`: rows and columns of the camera's picture. Returns (rows, columns).
    """
    picture = np.full(shape, np.nan, np.float32)
    if view.pixels is not None:
        upwards = np.argsort(view.cloud.intensity, kind="stable")  # the last one written wins
        row, column = view.pixels[upwards].T
        picture[row, column] = view.cloud.range[upwards]
    return picture
