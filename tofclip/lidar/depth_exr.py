"""Depth pictures in OpenEXR: what renderers and compositors read."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tofclip.files import atomic_path
from tofclip.lidar.geometry import compute_ray_directions
from tofclip.shots import Returns


def save_depth(returns: Returns, path: str | Path) -> None:
    """Write each pixel's most intense return to an OpenEXR file, whole or not at all.

    Channel ``Z`` is the depth along the optical axis in metres, infinite where nothing came back,
    as renderers have it; ``Y`` the intensity in counts referred to 1 m, 0 there. Both are 32-bit
    floats, uncompressed.

    Parameters
    ----------
    returns : Returns
    path : path-like
        Ends in ``.exr``.
    """
    import OpenEXR

    distance, intensity = returns.image("range"), returns.image("intensity")
    seen = np.isfinite(distance)
    rows, columns = np.nonzero(seen)
    depth = np.full(distance.shape, np.inf, dtype=np.float32)
    depth[seen] = distance[seen] * compute_ray_directions(returns.camera, rows, columns)[:, 2]
    brightness = np.where(seen, intensity, 0).astype(np.float32)
    header = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {"Z": np.ascontiguousarray(depth), "Y": np.ascontiguousarray(brightness)}
    with atomic_path(path) as temporary:
        OpenEXR.File(header, channels).write(str(temporary))
