"""Hidden volumes: bright voxels, their surface, their brightest depth, or slice after slice; and those
that come in while one looks.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from apps.viewer.clouds import make_cloud
from apps.viewer.source import DisplayModes, Gate, Source, TriangleMesh, View, make_empty_cloud
from nlos import Volume
from tofclip.errors import InputError
from tofclip.lidar import PointCloud

VOXEL_MODE, SURFACE_MODE, PROJECTION_MODE, SLICE_MODE = (
    "voxels",
    "surface",
    "maximum projection",
    "slices",
)
PLAY_TIME_S = 8.0


class VolumeSource(Source):
    """A volume; frame `n` is slice `n` in z, which matters where slices are shown.

    Memory: the magnitude of the volume.
    """

    def __init__(self, title: str, volume: Volume) -> None:
        super().__init__(title, max(1.0, volume.grid.z.size / PLAY_TIME_S), frame_name="slice")
        can_have_surface = min(volume.grid.shape) > 1 and bool(volume.magnitude.any())
        names = (
            (PROJECTION_MODE, VOXEL_MODE, SURFACE_MODE, SLICE_MODE)
            if can_have_surface
            else (PROJECTION_MODE, VOXEL_MODE, SLICE_MODE)
        )
        self.display_modes = DisplayModes(names, PROJECTION_MODE)
        self.volume = volume
        self._magnitude = volume.magnitude.astype(np.float32)
        self._views: dict[tuple[str, float, int], View] = {}

    def __len__(self) -> int:
        return int(self.volume.grid.z.size)

    @property
    def whole_name(self) -> str:
        return "" if self.display_modes.current == SLICE_MODE else self.display_modes.current

    def describe_frame(self, number: int) -> str:
        """Say where a slice lies, or that slices do not matter in this mode."""
        if self.whole_name:
            return f"of all {len(self)} slices"
        return f"z {self.volume.grid.z[number]:.3f} m"

    def view(self, number: int) -> View:
        chosen = self.display_modes.current
        key = (chosen, self.display_modes.threshold, number if chosen == SLICE_MODE else 0)
        if key not in self._views:
            self._views = {key: self._make_view(number)}
        return self._views[key]

    def pictures(self, number: int, gate: Gate) -> Mapping[str, NDArray[np.float32]]:
        """Return brightness and depth of the front view, or of slice `number`; see `Source`.

        `number`: slice in z; `gate`: not used. Returns depth in m, NaN where it is too dark.
        """
        projection = self.volume.maximum_projection()
        bright = projection.brightness >= self.display_modes.threshold * self._magnitude.max()
        return {
            "intensity": self._magnitude[number]
            if self.display_modes.current == SLICE_MODE
            else projection.brightness,
            "depth": np.where(bright, projection.depth, np.nan).astype(np.float32),
        }

    def surface(self) -> TriangleMesh | None:
        if self.display_modes.current != SURFACE_MODE:
            return None
        mesh = self.volume.surface(min(max(self.display_modes.threshold, 0.01), 0.99))
        return TriangleMesh(mesh.vertices, mesh.faces)

    def _make_view(self, number: int) -> View:
        if self.display_modes.current == SURFACE_MODE:
            found = self.surface()
            return View(
                make_empty_cloud()
                if found is None
                else self._make_cloud(found.vertices, np.ones(len(found.vertices)))
            )
        if self.display_modes.current not in self.display_modes.names:
            raise InputError(
                f"a volume is shown as {', '.join(self.display_modes.names)}, not as '{self.display_modes.current}'"
            )
        shown = self._select_voxels(number)
        z, y, x = np.nonzero(shown)
        grid = self.volume.grid
        xyz = np.stack([grid.x[x], grid.y[y], grid.z[z]], axis=-1)
        return View(self._make_cloud(xyz, self._magnitude[z, y, x]))

    def _select_voxels(self, number: int) -> NDArray[np.bool_]:
        """Which voxels are drawn, (z, y, x)."""
        bright: NDArray[np.bool_] = (
            self._magnitude >= self.display_modes.threshold * self._magnitude.max()
        ) & (self._magnitude > 0)
        if self.display_modes.current == SLICE_MODE:
            bright[:] = False
            bright[number] = True  # all of it: a slice shows the dark as well
        elif self.display_modes.current == PROJECTION_MODE:
            front = np.zeros_like(bright)
            np.put_along_axis(front, self._magnitude.argmax(axis=0)[np.newaxis], True, axis=0)
            bright &= front
        return bright

    def _make_cloud(self, xyz: NDArray[Any], brightness: NDArray[Any]) -> PointCloud:
        cloud = make_cloud(xyz, {"brightness": brightness})
        # Depth behind the wall is more useful than the distance from the origin of its coordinates.
        return replace(cloud, range=cloud.xyz[:, 2])


BRIGHT_FRACTION = 0.3
"""Of the brightest voxel: brighter ones are shown."""


class VolumeFeed(Protocol):
    """What a stream of volumes reports while it runs."""

    latency: float
    delivered: int
    failed: int
    ended: threading.Event

    latest: deque[Volume]
    """The newest alone."""


class VolumeStreamSource(Source):
    """The newest volume of a stream; every volume is a frame, and only the last one is kept.

    `feed`: with a volume.
    """

    def __init__(self, title: str, feed: VolumeFeed) -> None:
        super().__init__(title, 1.0, frame_name="volume")
        self._feed = feed

    def __len__(self) -> int:
        return max(self._feed.delivered, 1)

    @property
    def oldest(self) -> int:
        return len(self) - 1

    @property
    def is_live(self) -> bool:
        return not self._feed.ended.is_set()

    @property
    def latency(self) -> float:
        return self._feed.latency

    @property
    def lost(self) -> int:
        return self._feed.failed

    def view(self, number: int) -> View:
        xyz, brightness = self._feed.latest[-1].points(BRIGHT_FRACTION)
        return View(make_cloud(xyz, {"brightness": np.asarray(brightness)}))
