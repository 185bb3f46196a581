"""The hidden scene that a simulated capture shows: it travels inside the capture's file, for others
to compare with.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tofclip.errors import FileFormatError, InputError
from tofclip.storage import HDF5_SIGNATURE, Field, Record

if TYPE_CHECKING:
    from nlos import Capture, Grid

RECORD_KIND = "hidden_scene"
FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class HiddenTruth:
    """Where hidden things scatter light."""

    positions: FloatArray  # (n, 3), points, or the centres of facets, m
    spacing: float  # distance of neighbouring facets, m; 0 for points

    def attach_to_record(self, capture: Capture) -> Record:
        """Put the truth into the record of its capture."""
        own = {"positions": Field(self.positions, "m", ("point", "xyz"))}
        return replace(
            capture.to_record(),
            children={RECORD_KIND: Record(RECORD_KIND, own, {"spacing_m": self.spacing})},
        )

    @classmethod
    def load(cls, path: Path) -> HiddenTruth | None:
        """Read the truth that a capture's file carries; None where there is none."""
        if not path.is_file():
            return None
        with open(path, "rb") as file:
            if file.read(len(HDF5_SIGNATURE)) != HDF5_SIGNATURE:
                return None
        return cls._read(path)

    @classmethod
    def _read(cls, path: Path) -> HiddenTruth | None:
        try:
            found = Record.load(path).children.get(RECORD_KIND)
        except FileFormatError:  # another laboratory's HDF5
            return None
        if found is None:
            return None
        return cls(found.array("positions", np.float64, 2, "m"), found.number("spacing_m"))

    def mask_near(self, grid: Grid, reach: float) -> NDArray[np.bool_]:
        """Voxels (z, y, x) whose centres lie within `reach` m of something hidden.

        `reach`: metres. Returns (z, y, x).
        """
        if reach <= 0:
            raise InputError(f"the reach about hidden things must be positive, got {reach} m")
        z, y, x = np.meshgrid(grid.z, grid.y, grid.x, indexing="ij")
        voxels = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
        found, _ = cKDTree(self.positions).query(voxels, distance_upper_bound=reach)
        return np.asarray(np.isfinite(found).reshape(grid.shape))
