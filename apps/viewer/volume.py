"""Hidden volumes: bright voxels, their surface, their brightest depth, or slice after slice."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apps.viewer.clouds import cloud_of
from apps.viewer.source import Gate, Source, Triangles, View, Ways, nothing
from nlos import Volume
from tofclip.errors import InputError
from tofclip.lidar import PointCloud

VOXELS, SURFACE, PROJECTION, SLICE = "voxels", "surface", "maximum projection", "slices"
SECONDS_TO_PLAY = 8.0


class VolumeSource(Source):
    """A volume; frame `n` is slice `n` in z, which matters where slices are shown.

    Parameters
    ----------
    title : str
    volume : Volume

    Notes
    -----
    Memory: the magnitude of the volume.
    """

    def __init__(self, title: str, volume: Volume) -> None:
        super().__init__(title, max(1.0, volume.grid.z.size / SECONDS_TO_PLAY))
        can_have_surface = min(volume.grid.shape) > 1 and bool(volume.magnitude.any())
        names = (VOXELS, SURFACE, PROJECTION, SLICE) if can_have_surface else (VOXELS, PROJECTION, SLICE)
        self.ways = Ways(names, VOXELS)
        self.volume = volume
        self._magnitude = volume.magnitude.astype(np.float32)
        self._views: dict[tuple[str, float, int], View] = {}

    def __len__(self) -> int:
        return int(self.volume.grid.z.size)

    def view(self, number: int) -> View:
        chosen = self.ways.chosen
        key = (chosen, self.ways.threshold, number if chosen == SLICE else 0)
        if key not in self._views:
            self._views = {key: self._made(number)}
        return self._views[key]

    def pictures(self, number: int, gate: Gate) -> Mapping[str, NDArray[np.float32]]:
        projection = self.volume.maximum_projection()
        bright = projection.brightness >= self.ways.threshold * self._magnitude.max()
        return {
            "intensity": self._magnitude[number] if self.ways.chosen == SLICE else projection.brightness,
            "depth": np.where(bright, projection.depth, np.nan).astype(np.float32),
        }

    def surface(self) -> Triangles | None:
        if self.ways.chosen != SURFACE:
            return None
        mesh = self.volume.surface(min(max(self.ways.threshold, 0.01), 0.99))
        return Triangles(mesh.vertices, mesh.faces)

    def _made(self, number: int) -> View:
        if self.ways.chosen == SURFACE:
            found = self.surface()
            return View(nothing() if found is None else self._cloud(found.vertices, np.ones(len(found.vertices))))
        if self.ways.chosen not in self.ways.names:
            raise InputError(f"a volume is shown as {', '.join(self.ways.names)}, not as '{self.ways.chosen}'")
        shown = self._shown(number)
        z, y, x = np.nonzero(shown)
        grid = self.volume.grid
        xyz = np.stack([grid.x[x], grid.y[y], grid.z[z]], axis=-1)
        return View(self._cloud(xyz, self._magnitude[z, y, x]))

    def _shown(self, number: int) -> NDArray[np.bool_]:
        """Which voxels are drawn, (z, y, x)."""
        bright: NDArray[np.bool_] = (self._magnitude >= self.ways.threshold * self._magnitude.max()) & (
            self._magnitude > 0
        )
        if self.ways.chosen == SLICE:
            bright[:] = False
            bright[number] = True  # all of it: a slice shows the dark as well
        elif self.ways.chosen == PROJECTION:
            front = np.zeros_like(bright)
            np.put_along_axis(front, self._magnitude.argmax(axis=0)[np.newaxis], True, axis=0)
            bright &= front
        return bright

    def _cloud(self, xyz: NDArray[Any], brightness: NDArray[Any]) -> PointCloud:
        cloud = cloud_of(xyz, {"brightness": brightness})
        # Depth behind the wall tells more than the distance from the origin of its coordinates.
        return replace(cloud, range=cloud.xyz[:, 2])
