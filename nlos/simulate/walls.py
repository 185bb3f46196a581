"""Relay walls of known shape, which tests, studies and demonstrations share."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from tofclip.arrays import FloatArray
from tofclip.errors import InputError, require

DepthFunction = Callable[[FloatArray, FloatArray, float], FloatArray]
"""Depth z of the wall, m, at x and y in half wall widths, from -1 to 1; the third argument is that
half width, m.
"""

CYLINDER_RADIUS_M = 2.5
WAVE_HEIGHT_M = 0.1
RELIEF_DEPTH_M = 0.3
# Half the gap between the plates in half wall widths, and by how much the right one stands back, m.
PLATE_GAP_FRACTION, PLATE_STEP_M = 0.1, 0.25
MIN_POINTS = 2


def build_relay_wall(name: str, points: int = 64, width: float = 2.0) -> FloatArray:
    """Build one of the walls in `WALLS`.

    Parameters
    ----------
    name : str
        * ``"planar"``: z = 0;
        * ``"cylinder"``: upright, radius 2.5 m, bulging towards the scene, foremost at z = 0;
        * ``"wavy"``: waves of +-0.1 m in both directions;
        * ``"relief"``: smooth hills of 0.3 m from the lowest to the highest;
        * ``"plates"``: two that hang apart, the right one 0.25 m further back and turned towards
          the left.
    points : int
        Rows, and columns; at least 2.
    width : float
        Extent in x and y, m.

    Returns
    -------
    (rows, columns, 3) array
        m; x to the right, y down, z towards the hidden scene. Points in the gap between the plates
        are NaN.

    Raises
    ------
    InputError
        There is no such wall, too few points, or no width.
    """
    require(name in WALLS, f"no wall is called '{name}'; choose one of {', '.join(WALLS)}")
    if points < MIN_POINTS or not 0 < width < np.inf:
        raise InputError(
            f"a wall needs at least 2 x 2 points and a positive width, got {points} and {width} m"
        )
    half = width / 2
    if name == "cylinder" and half >= CYLINDER_RADIUS_M:
        raise InputError(
            f"a cylinder of radius {CYLINDER_RADIUS_M} m is narrower than {width:.3g} m"
        )
    x, y = np.meshgrid(*[np.linspace(-1, 1, points)] * 2)
    z = WALLS[name](x, y, half)
    wall = np.stack([half * x, half * y, z], axis=-1)
    wall[np.isnan(z)] = np.nan
    return wall


def compute_wall_normals(wall: FloatArray) -> FloatArray:
    """Unit normals to larger z of a wall (rows, columns, 3); +z where neighbours are unknown."""
    normals = np.zeros_like(wall)
    normals[..., 2] = 1.0
    if wall.ndim != 3 or min(wall.shape[:2]) < MIN_POINTS:
        return normals
    down, right = np.gradient(wall, axis=(0, 1))
    found = np.cross(right, down)
    found /= np.linalg.norm(found, axis=-1, keepdims=True)
    # normals point into the scene, towards +z
    return np.where(np.isfinite(found), found * np.sign(found[..., 2:]), normals)


def _relief_depth(x: FloatArray, y: FloatArray, half: float) -> FloatArray:
    hills = np.sin(3 * x + 0.7) * np.cos(2.5 * y - 0.4) + 0.5 * np.sin(5 * y + 2 * x)
    low, high = float(hills.min()), float(hills.max())
    return RELIEF_DEPTH_M * ((hills - low) / (high - low) - 0.5)


def _plates_depth(x: FloatArray, y: FloatArray, half: float) -> FloatArray:
    z = np.where(x > 0, 0.15 * (x - PLATE_GAP_FRACTION) - PLATE_STEP_M, 0.0)
    return np.where(np.abs(x) < PLATE_GAP_FRACTION, np.nan, z)


# Shapes by name.
WALLS: Mapping[str, DepthFunction] = {
    "planar": lambda x, y, half: np.zeros_like(x),
    "cylinder": lambda x, y, half: (
        np.sqrt(CYLINDER_RADIUS_M**2 - (half * x) ** 2) - CYLINDER_RADIUS_M
    ),
    "wavy": lambda x, y, half: WAVE_HEIGHT_M * np.sin(2 * np.pi * x) * np.cos(1.5 * np.pi * y),
    "relief": _relief_depth,
    "plates": _plates_depth,
}
