"""Several returns of a pixel: what a surface explains is taken out, and the next one is looked for in
the rest.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.lidar.photons.photon_image import FloatArray, PhotonImage
from tofclip.lidar.photons.scene import Scene
from tofclip.lidar.photons.surface_image import SurfaceImage

MIN_EXPLAINED_DENSITY = 0.003
"""Of the response's peak: photons where it is brighter belong to the surface."""

MAX_OWN_CHANCE, MAX_POOLED_CHANCE = 0.02, 1e-4
"""That the background alone shows as many photons at a further surface, in the pixel and in the
nine pixels around it."""


def remove_return(photons: PhotonImage, scene: Scene, layer: FloatArray) -> PhotonImage:
    """Leave out the photons that a surface explains better than the background does.

    `layer` (rows, columns, 4): see `SurfacePlan.locate`.
    """
    response = scene.response
    times = response.start + response.step * np.arange(response.density.size)
    bright = response.density >= MIN_EXPLAINED_DENSITY * response.density.max()
    first, last = times[bright][0], times[bright][-1]
    late = photons.bin - layer[..., 0].ravel()[photons.pixel]
    outside = ~((late >= first) & (late <= last))
    return photons.select(photons.count * outside)


def keep_significant(photons: PhotonImage, scene: Scene, layer: FloatArray) -> FloatArray:
    """Drop a further surface where the background alone would explain its photons.

    `photons`: those that no nearer surface explains; `layer` (rows, columns, 4): see
    `SurfacePlan.locate`. Returns (rows, columns, 4): naN where the surface does not stand out of
    the background.
    """
    reach = 0.5 * scene.response.width + 1
    late = photons.bin - layer[..., 0].ravel()[photons.pixel]
    seen = np.bincount(
        photons.pixel, photons.count * (np.abs(late) <= reach), layer[..., 0].size
    ).reshape(layer.shape[:2])
    expected = scene.background * (2 * reach + 1)
    pooled = scipy.ndimage.uniform_filter(seen, 3, mode="nearest") * 9
    own = _find_chance(seen, expected) < MAX_OWN_CHANCE
    around = _find_chance(np.rint(pooled), 9 * expected) < MAX_POOLED_CHANCE
    return np.where((own & around)[..., np.newaxis], layer, np.nan)


def _find_chance(seen: NDArray[Any], expected: NDArray[Any] | float) -> FloatArray:
    """Chance of that many photons or more where a Poisson law with that mean holds."""
    found = scipy.special.gammainc(np.maximum(seen, 1), expected)  # scipy.stats loads for a second
    return np.where(seen > 0, found, 1.0)


def combine_layers(
    layers: list[FloatArray],
    max_returns: int,
    scene: Scene,
    to_range: float,
    settings: dict[str, float | str],
) -> SurfaceImage:
    """Turn the returns found one after the other into images, each pixel's strongest first.

    `layers`: see `SurfacePlan.locate`; `max_returns`: of these the strongest in each pixel are
    returned; `to_range`: metres in a bin. Returns the strongest layer of each pixel, the others in
    ``further``.
    """
    stack = np.stack(layers, axis=2)
    order = np.argsort(-np.nan_to_num(stack[..., 2], nan=-1.0), axis=2, kind="stable")
    stack = np.take_along_axis(stack, order[..., np.newaxis], axis=2)
    images = [
        SurfaceImage(
            range=stack[:, :, k, 0] * to_range,
            range_sigma=stack[:, :, k, 1] * to_range,
            intensity=stack[:, :, k, 2],
            outlier_probability=stack[:, :, k, 3],
            pulse=scene.response.pulse,
            settings=settings,
        )
        for k in range(min(max_returns, len(layers)))
    ]
    return replace(images[0], further=tuple(images[1:]))
