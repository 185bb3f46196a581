"""Volumes in the formats that other programs read: VTK images, points, meshes, EXR pictures and
NumPy archives.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nlos.plane import axis_step, is_evenly_spaced
from tofclip.arrays import AnyArray, Float32Array, to_numpy
from tofclip.errors import InputError, require
from tofclip.files import atomic_path, require_suffix

if TYPE_CHECKING:
    from nlos.volume import Volume

# m; thickness given to a volume that is a single voxel deep.
FLAT_VOXEL_M = 1e-3


@dataclass(frozen=True, eq=False)
class Mesh:
    """A surface of triangles.

    Parameters
    ----------
    vertices : (v, 3) float32 array
        x, y, z in m.
    faces : (m, 3) int32 array
        Corners of each triangle.
    """

    vertices: Float32Array
    faces: NDArray[np.int32]

    def save(self, path: str | Path) -> None:
        """Write the mesh to ``path`` as binary PLY, whole or not at all."""
        write_ply(path, tuple("xyz"), self.vertices, self.faces)


def write_ply(
    path: str | Path,
    names: Sequence[str],
    vertices: Float32Array,
    faces: NDArray[np.int32],
    comment: str = "",
) -> None:
    """Write vertices (v, names) and triangles (m, 3) as binary PLY, whole or not at all."""
    require_suffix(path, ".ply")
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment units: m",
        *([f"comment {comment}"] if comment else []),
        f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in names),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    rows = np.empty(len(faces), np.dtype([("corners", "u1"), ("faces", "<i4", 3)]))
    rows["corners"], rows["faces"] = 3, faces
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(("\n".join(header) + "\n").encode())
        file.write(vertices.astype("<f4").tobytes())
        file.write(rows.tobytes())


def require_surface(magnitude: AnyArray, fraction: float, voxels: int) -> None:
    """Refuse volumes that hold no surface or less than some `voxels` along an axis, and no fraction."""
    require(
        0 < fraction < 1,
        f"a surface lies at a fraction between 0 and 1 of the brightest, got {fraction}",
    )
    lit = min(magnitude.shape) >= voxels and magnitude.any()
    require(lit, f"a surface needs at least {voxels} voxels along every axis, and light")


def export_volume(volume: Volume, path: str | Path, fraction: float) -> None:
    """Write a volume for other programs; see `Volume.export`."""
    suffix = Path(path).suffix.lower()
    if suffix in POINT_SUFFIXES:
        from tofclip.lidar.export import Column, write_table

        xyz, brightness = volume.points(fraction)
        x, y, z = (Column(n, "m", np.ascontiguousarray(xyz[:, i])) for i, n in enumerate("xyz"))
        write_table(path, [x, y, z, Column("brightness", "", brightness)])
        return
    require_suffix(path, *WRITERS, *POINT_SUFFIXES)
    WRITERS[suffix](volume, Path(path))


def _write_vti(volume: Volume, path: Path) -> None:
    import pyvista

    axes = [getattr(volume.grid, name) for name in "xyz"]
    for name, axis in zip("xyz", axes, strict=True):
        if not is_evenly_spaced(axis):
            raise InputError(
                f"a VTK image needs evenly spaced voxels along {name}; write .npz or .h5 instead"
            )
    steps = [axis_step(axis) if axis.size > 1 else FLAT_VOXEL_M for axis in axes]
    origin = [axis[0] for axis in axes]
    image = pyvista.ImageData(dimensions=volume.grid.shape[::-1], spacing=steps, origin=origin)
    image["brightness"] = volume.magnitude.astype(np.float32).ravel()
    with atomic_path(path) as temporary:
        image.save(temporary)


def _write_npz(volume: Volume, path: Path) -> None:
    axes: dict[str, Any] = {f"{name}_m": getattr(volume.grid, name) for name in "xyz"}
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, values=to_numpy(volume.values), **axes)


def _write_exr(volume: Volume, path: Path) -> None:
    from tofclip.io.light_fields import write_exr_parts

    front = volume.maximum_projection()
    write_exr_parts({"": {"Y": front.brightness, "Z": front.depth}}, path)


WRITERS: Mapping[str, Callable[[Volume, Path], None]] = {
    ".vti": _write_vti,
    ".npz": _write_npz,
    ".exr": _write_exr,
}
POINT_SUFFIXES = (".ply", ".pcd", ".csv")
