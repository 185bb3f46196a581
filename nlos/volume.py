"""The grid of voxels on which a hidden scene is imaged, and the image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nlos.export import Mesh, export_volume, require_surface
from tofclip.arrays import (
    AnyArray,
    Array,
    ComputeDevice,
    Float32Array,
    FloatArray,
    is_numpy,
    namespace,
    to_numpy,
)
from tofclip.errors import InputError, ShapeError, require
from tofclip.notebook import make_data_array, plot_picture, render_html, require_package
from tofclip.storage import Storable, stored_array, stored_mapping, stored_part

if TYPE_CHECKING:
    from nlos.capture import Capture


# Deeper than this a wall is too narrow an aperture to resolve much.
MAX_DEPTH_WALL_WIDTHS = 2.0
# No computer holds an image of more; the axes themselves would fill its memory.
MAX_VOXELS_PER_AXIS = 1 << 20


@dataclass(frozen=True, eq=False)
class Grid:
    """Voxel centres, the product of three axes.

    Parameters
    ----------
    x, y, z : (n,) array
        Coordinates in m, strictly increasing; x to the right, y down, z from the wall into the
        hidden scene.

    Raises
    ------
    ShapeError, InputError
        An axis is empty or not one-dimensional, holds NaN or infinity, or does not increase.
    """

    x: FloatArray = field(metadata=stored_array("m", "x"))
    y: FloatArray = field(metadata=stored_array("m", "y"))
    z: FloatArray = field(metadata=stored_array("m", "z"))

    def __post_init__(self) -> None:
        for name in ("x", "y", "z"):
            axis = np.array(getattr(self, name), dtype=np.float64)
            if axis.ndim != 1 or axis.size == 0:
                raise ShapeError(f"grid axis {name}", "(n,) with n >= 1", axis.shape)
            if not np.all(np.isfinite(axis)) or np.any(np.diff(axis) <= 0):
                raise InputError(f"grid axis {name} must be finite and strictly increasing")
            axis.flags.writeable = False
            object.__setattr__(self, name, axis)

    @classmethod
    def box(
        cls,
        x: Sequence[float],
        y: Sequence[float],
        z: Sequence[float],
        voxel: float | Sequence[float],
    ) -> Grid:
        """Fill a box with voxels.

        Parameters
        ----------
        x, y, z : (float, float)
            First and last voxel centre along each axis, m.
        voxel : float or (float, float, float)
            Distance of neighbouring centres, m, for all axes or for x, y and z. It is met exactly:
            where a side is not a multiple of it, the voxels are centred in the box and the outer ones
            lie inside. `InputError` if a side has more than a million.

        Examples
        --------
        >>> Grid.box((-0.4, 0.4), (-0.4, 0.4), (0.6, 1.0), voxel=0.05).shape
        (9, 17, 17)
        """
        sizes = np.broadcast_to(np.asarray(voxel, dtype=np.float64), (3,))
        if not np.all(np.isfinite(sizes) & (sizes > 0)):
            raise InputError(f"the voxel size must be a positive number of metres, got {voxel}")
        sides = zip("xyz", (x, y, z), sizes, strict=True)
        return cls(*(_fill_axis(name, side, size) for name, side, size in sides))

    @classmethod
    def in_front_of(
        cls, capture: Capture, voxel: float, near: float | None = None, far: float | None = None
    ) -> Grid:
        """Fill the space in front of a capture's wall, as wide and as high as the wall.

        Parameters
        ----------
        capture : Capture
            `InputError` if its record ends before anything hidden could be seen.
        voxel : float
            Distance of neighbouring voxel centres, m.
        near, far : float, optional
            First and last z, m. They default to one voxel in front of the middle of the wall's
            relief, and to the depth that light reaches and returns from within the record, at most
            two wall widths.
        """
        if not hasattr(capture, "points"):
            raise InputError(f"a grid lies before a Capture's wall, not a {type(capture).__name__}")
        low, high = capture.points.min(axis=0), capture.points.max(axis=0)
        width = float(max(high[0] - low[0], high[1] - low[1]))
        middle = float(low[2] + high[2]) / 2
        if near is None:
            near = middle + voxel
        if far is None:
            # light of the longest path has turned back at half of it at the latest
            far = middle + min(float(capture.axis.paths[-1]) / 2, MAX_DEPTH_WALL_WIDTHS * width)
        if far < near:
            raise InputError(
                f"no room for a hidden scene: z would run from {near:.3g} to {far:.3g} m before a wall {width:.3g} m "
                f"wide; are wall, laser and start in m, and bins in s (paths up to {capture.axis.paths[-1]:.3g} m)?"
            )
        return cls.box((low[0], high[0]), (low[1], high[1]), (near, far), voxel)

    @classmethod
    def around(cls, volume: Volume, voxel: float, fraction: float = 0.15) -> Grid:
        """Fill the smallest box that holds everything bright in a coarse volume, with one of its
        voxels to spare: imaging coarsely first and then here finely costs a small part of imaging
        everything finely.

        Parameters
        ----------
        volume : Volume
            At least one voxel per half wavelength, or small objects may slip through; not dark.
        voxel : float
            Distance of neighbouring voxel centres, m.
        fraction : float
            What counts as bright, relative to the brightest voxel.
        """
        indices = np.nonzero(volume.threshold(fraction).magnitude)
        if indices[0].size == 0:
            raise InputError(
                "the volume is dark everywhere: there is nothing to look at more closely"
            )
        axes = zip((volume.grid.z, volume.grid.y, volume.grid.x), indices, strict=True)
        z, y, x = (
            axis[[max(bright.min() - 1, 0), min(bright.max() + 1, axis.size - 1)]].tolist()
            for axis, bright in axes
        )
        return cls.box(x, y, z, voxel)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along (z, y, x)."""
        return self.z.size, self.y.size, self.x.size

    @property
    def points(self) -> FloatArray:
        """Position of every voxel, m, shape (z, y, x, 3)."""
        z, y, x = np.meshgrid(self.z, self.y, self.x, indexing="ij")
        return np.stack([x, y, z], axis=-1)

    @property
    def size(self) -> int:
        """Number of voxels."""
        return self.z.size * self.y.size * self.x.size

    def find_nearest(self, point: Sequence[float]) -> tuple[int, int, int]:
        """Index (z, y, x) of the voxel nearest to a ``point`` (x, y, z) in m."""
        axes = zip((self.x, self.y, self.z), point, strict=True)
        x, y, z = (int(np.argmin(np.abs(axis - place))) for axis, place in axes)
        return z, y, x


def _fill_axis(name: str, side: Sequence[float], voxel: float) -> FloatArray:
    first, last = (float(end) for end in side)
    if not (np.isfinite(first) and np.isfinite(last) and first <= last):
        raise InputError(
            f"side {name} of the box must run from a smaller to a larger number, got {first}, {last}"
        )
    # A side that is a whole number of voxels up to rounding keeps its outer voxel.
    steps = int(np.floor(min((last - first) / voxel, MAX_VOXELS_PER_AXIS) + 1e-6))
    if steps >= MAX_VOXELS_PER_AXIS:
        raise InputError(
            f"side {name} of the box, {last - first:.3g} m, has millions of voxels of {voxel:.3g} m: "
            "use larger voxels, and check their unit"
        )
    return (first + last) / 2 + voxel * (np.arange(steps + 1, dtype=np.float64) - steps / 2)


AXES = ("z", "y", "x")


@dataclass(frozen=True, eq=False)
class Projection:
    """Pictures (y, x) of a volume from the wall: the `brightness` of the brightest voxel along z, and
    its `depth`, z in m.
    """

    brightness: AnyArray
    depth: FloatArray


@dataclass(frozen=True, eq=False)
class Volume(Storable):
    """Brightness, or complex phasor field, on a grid of voxels.

    Pictures of it look along +z, from the relay wall into the hidden scene, x to the right and y
    down.

    What is left and what is right follows from the capture's coordinates alone. If +z leaves the
    wall on the room's side (and x, y, z are right-handed, y down), the picture is what someone
    standing at the wall sees. If the coordinates are those of a camera facing the wall (x right and
    y down in its picture, z into the wall, as in the LIFT captures), the volume is the scene's
    mirror image behind the wall, and the picture is what that camera would see if the wall were a
    mirror: the camera's left stays left, and writing that faces the wall appears reversed.

    Parameters
    ----------
    values : (z, y, x) array
        Real or complex; float32 or complex64 unless given in double precision. An array of another
        library stays where it is; what looks at the volume or writes it fetches a copy.
    grid : Grid
    provenance : mapping
        How it came about.

    Raises
    ------
    ShapeError, InputError
        Values and grid disagree, or a value is not a finite number.
    """

    RECORD_KIND = "volume"

    values: Array = field(metadata=stored_array("", *AXES, dtype=None))
    grid: Grid = field(metadata=stored_part(Grid))
    provenance: Mapping[str, Any] = stored_mapping("provenance")

    def __post_init__(self) -> None:
        values = np.ascontiguousarray(self.values) if is_numpy(self.values) else self.values
        xp = namespace(values)
        if not xp.isdtype(values.dtype, ("real floating", "complex floating")):
            values = xp.astype(values, xp.float32)
        if tuple(values.shape) != self.grid.shape:
            raise ShapeError("volume", f"(z, y, x) = {self.grid.shape}", tuple(values.shape))
        require(xp.all(xp.isfinite(values)), "a volume must not hold NaN or infinity")
        object.__setattr__(self, "values", values)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> AnyArray:
        return np.asarray(to_numpy(self.values), dtype=dtype)

    def __getitem__(self, voxels: Any) -> Any:
        """Pick from the values (z, y, x) as NumPy does: ``volume[10]`` is the slice at ``grid.z[10]``."""
        try:
            return self.values[voxels]
        except (IndexError, TypeError) as fault:
            raise InputError(f"a volume is (z, y, x) = {self.grid.shape}: {fault}") from fault

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.grid.shape))
        return f"Volume({shape} voxels (z, y, x), {self.values.dtype})"

    def _repr_html_(self) -> str:
        rows = {"voxels (z, y, x)": " x ".join(map(str, self.grid.shape))}
        for name in AXES:
            first, last = getattr(self.grid, name)[[0, -1]]
            rows[name] = f"{first:.3g} to {last:.3g} m"
        picture = np.abs(to_numpy(self.values)).max(axis=0)
        return render_html("Volume, seen from the wall", rows, picture)

    @property
    def device(self) -> ComputeDevice:
        """Where the values live: library and device."""
        return ComputeDevice.of(self.values)

    def on(self, device: ComputeDevice) -> Volume:
        """Return the volume with its values on ``device``; ``ComputeDevice()`` is NumPy."""
        return replace(self, values=device.put(self.values))

    @property
    def magnitude(self) -> AnyArray:
        """Brightness (z, y, x), not negative; a NumPy array wherever the values live."""
        return to_numpy(abs(self.values))

    def find_brightest(self) -> tuple[float, float, float]:
        """Position (x, y, z) of the brightest voxel, m."""
        z, y, x = np.unravel_index(int(np.argmax(self.magnitude)), self.grid.shape)
        return float(self.grid.x[x]), float(self.grid.y[y]), float(self.grid.z[z])

    def maximum_projection(self) -> Projection:
        """Find the brightest of every column (y, x) along z, and its depth."""
        magnitude = self.magnitude
        return Projection(magnitude.max(axis=0), self.grid.z[magnitude.argmax(axis=0)])

    def threshold(self, fraction: float) -> Volume:
        """Set every voxel to 0 that is weaker than ``fraction`` (0..1) of the brightest."""
        require(0 <= fraction <= 1, f"a threshold is a fraction between 0 and 1, got {fraction}")
        xp, magnitude = namespace(self.values), abs(self.values)
        bright = magnitude >= fraction * xp.max(magnitude)
        return replace(self, values=xp.where(bright, self.values, xp.zeros_like(self.values)))

    def surface(self, fraction: float = 0.3) -> Mesh:
        """Draw the surface on which the magnitude is ``fraction`` (0..1) of the largest."""
        magnitude = self.magnitude
        require_surface(magnitude, fraction, 2)
        found = self.to_pyvista().contour([fraction * float(magnitude.max())])  # marching cubes
        faces = np.asarray(found.regular_faces, np.int32).reshape(-1, 3)
        return Mesh(np.asarray(found.points, np.float32), faces)

    def points(self, fraction: float = 0.3) -> tuple[Float32Array, Float32Array]:
        """Positions (n, 3), m, and magnitudes (n,) of voxels from ``fraction`` (0..1) on."""
        z, y, x = np.nonzero(self.threshold(fraction).magnitude)
        xyz = np.stack([self.grid.x[x], self.grid.y[y], self.grid.z[z]], axis=-1)
        return xyz.astype(np.float32), self.magnitude[z, y, x].astype(np.float32)

    def export(self, path: str | Path, fraction: float = 0.3) -> None:
        """Write the magnitude for other programs, in the format that the suffix names, whole or not
        at all; `InputError` for another suffix, or voxels that the format cannot hold.

        Parameters
        ----------
        path : path-like
            * ``.vti``: all voxels as a VTK image (evenly spaced ones only);
            * ``.npz``: ``values``, complex where they are, and ``x_m``, ``y_m``, ``z_m``;
            * ``.exr``: front view, channel Y, and its depth in m, channel Z;
            * ``.ply``, ``.pcd``, ``.csv``: bright voxels as points.
        fraction : float
            Which voxels become points: those with at least this fraction of the brightest.
        """
        export_volume(self, path, fraction)

    def save_picture(self, path: str | Path) -> None:
        """Draw front view, depth map, top and side view, axes in m, to ``path``: PNG, PDF or SVG."""
        from nlos.picture import save_picture

        save_picture(self, path)

    def plot(self, ax: Any = None) -> Any:
        """Draw the brightest voxel along every line of sight, as seen from the wall, to matplotlib Axes `ax`,
        by default the current figure's, and return these.
        """
        picture, sides = self.maximum_projection().brightness, (self.grid.x, self.grid.y)
        return plot_picture(picture, "seen from the wall", ax, unit="brightness", sides=sides)

    def to_xarray(self) -> Any:
        """Return an `xarray.DataArray` (z, y, x), places in m as coordinates; needs xarray."""
        axes = {name: (getattr(self.grid, name), "m") for name in AXES}
        return make_data_array(to_numpy(self.values), axes, "brightness", "")

    def to_pyvista(self) -> Any:
        """Return a `pyvista.RectilinearGrid`, places in m, with the magnitude as ``brightness``."""
        axes = self.grid.x, self.grid.y, self.grid.z
        shown = require_package("pyvista").RectilinearGrid(*axes)
        # VTK lists points with x fastest, as a (z, y, x) array lies in memory.
        shown["brightness"] = self.magnitude.ravel()
        return shown

    def to_torch(self) -> Any:
        """Return the values (z, y, x) as a PyTorch tensor, sharing memory; needs PyTorch."""
        return require_package("torch").as_tensor(to_numpy(self.values))

    def save(self, path: str | Path, compressed: bool = True) -> None:
        """Write the volume to an HDF5 file ``path``, ``compressed`` or not, whole or not at all."""
        self.to_record().save(path, compressed)
