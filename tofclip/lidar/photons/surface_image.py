"""The picture of ranges that counted photons give, and the returns that it lists."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from tofclip.camera import Camera
from tofclip.lidar.photons.photon_image import FloatArray
from tofclip.lidar.pulse import Pulse
from tofclip.shots import Returns
from tofclip.units import SPEED_OF_LIGHT


@dataclass(frozen=True)
class SurfaceImage:
    """A range for every pixel.

    Parameters
    ----------
    range : (rows, columns) float64 array
        Distance for a co-located source, m; the middle of the first bin is range 0. NaN where there
        is none.
    range_sigma : (rows, columns) float64 array
        One standard deviation of the range, m.
    intensity : (rows, columns) float64 array
        Expected photons of the return.
    outlier_probability : (rows, columns) float64 array
        That the return is not of this pixel's surface.
    pulse : Pulse
        The response that was used, as bins show it.
    settings : mapping
        What was chosen from the data, by name.
    further : tuple of SurfaceImage
        Weaker returns of the same pixels, the strongest first; NaN where there is none.
    """

    range: FloatArray
    range_sigma: FloatArray
    intensity: FloatArray
    outlier_probability: FloatArray
    pulse: Pulse
    settings: dict[str, float | str]
    further: tuple[SurfaceImage, ...] = ()

    def to_returns(
        self, focal_length_px: float, provenance: Mapping[str, Any] | None = None
    ) -> Returns:
        """List the pixels with a range, as seen by a pinhole camera.

        Parameters
        ----------
        focal_length_px : float
            Distance of the pinhole from the picture, in pixels; the optical axis meets pixel
            ``(rows // 2, columns // 2)``.
        provenance : mapping, optional
            How they came about.

        Returns
        -------
        tofclip.lidar.Returns
        """
        rows, columns = self.range.shape
        pinhole = Camera(
            np.array([columns / 2]),
            np.zeros(1),
            (rows, columns),
            columns,
            pulse_fwhm=self.pulse.fwhm,
            focal_length_px=focal_length_px,
        )
        layers = [self, *self.further]
        distance = np.stack([layer.range for layer in layers], axis=2).reshape(-1, len(layers))
        order = np.argsort(distance, axis=1)
        pixel, nearness = np.nonzero(np.isfinite(np.take_along_axis(distance, order, axis=1)))
        layer = order[pixel, nearness]
        sigma, signal = (
            np.stack([getattr(one, name) for one in layers], axis=2).reshape(distance.shape)
            for name in ("range_sigma", "intensity")
        )
        found = distance[pixel, layer]
        y, x = np.divmod(pixel, columns)
        return Returns(
            y=y.astype(np.int32),
            x=x.astype(np.int32),
            range=found,
            intensity=(signal[pixel, layer] * found**2).astype(np.float32),
            confidence=sigma[pixel, layer].astype(np.float32),
            return_number=(nearness + 1).astype(np.uint8),
            time=2 * found / SPEED_OF_LIGHT,
            camera=pinhole,
            provenance={} if provenance is None else provenance,
        )
