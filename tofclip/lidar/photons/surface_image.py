"""The picture of ranges that counted photons give, and the returns that it lists."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera
from tofclip.errors import CalibrationError
from tofclip.lidar.photons.photon_image import FloatArray
from tofclip.lidar.pulse import Pulse
from tofclip.lidar.range_correction import correct_ranges
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
    hot_pixels : (rows, columns) bool array, optional
        Pixels whose photons were left out; see `tofclip.lidar.photons.hot_pixels`.
    """

    range: FloatArray
    range_sigma: FloatArray
    intensity: FloatArray
    outlier_probability: FloatArray
    pulse: Pulse
    settings: dict[str, float | str]
    further: tuple[SurfaceImage, ...] = ()
    hot_pixels: NDArray[np.bool_] | None = None

    def calibrate(self, camera: Camera, first_time: float = 0.0) -> SurfaceImage:
        """Return the ranges from the camera's time zero, with its range calibration applied.

        Parameters
        ----------
        camera : Camera
        first_time : float
            Reading of the time axis at the middle of the first bin, s.

        Returns
        -------
        SurfaceImage

        Raises
        ------
        CalibrationError
            The camera has another number of pixels.
        """
        if camera.image_shape != self.range.shape:
            raise CalibrationError(
                f"the camera has {camera.image_shape} pixels, the photons {self.range.shape}"
            )
        further = tuple(one.calibrate(camera, first_time) for one in self.further)
        # Light travels the range twice, hence half the speed.
        distance = self.range - SPEED_OF_LIGHT / 2 * (camera.time_zero - first_time)
        sigma = self.range_sigma
        if camera.range_calibration is not None:
            y, x = np.indices(self.range.shape)
            distance, _, sigma = correct_ranges(
                camera.range_calibration, distance, self.intensity, sigma, (y, x)
            )
        return replace(self, range=distance, range_sigma=sigma, further=further)

    def to_returns(self, camera: Camera, provenance: Mapping[str, Any] | None = None) -> Returns:
        """List the pixels with a range.

        Parameters
        ----------
        camera : Camera
            Says where the pixels look, see `make_pinhole`.
        provenance : mapping, optional
            How they came about.

        Returns
        -------
        tofclip.lidar.Returns
        """
        columns = self.range.shape[1]
        layers = [self, *self.further]
        distance = np.stack([layer.range for layer in layers], axis=2).reshape(-1, len(layers))
        order = np.argsort(distance, axis=1)
        pixel, nearness = np.nonzero(np.isfinite(np.take_along_axis(distance, order, axis=1)))
        layer = order[pixel, nearness]
        sigma, signal, doubt = (
            np.stack([getattr(one, name) for one in layers], axis=2).reshape(distance.shape)
            for name in ("range_sigma", "intensity", "outlier_probability")
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
            camera=camera,
            provenance={} if provenance is None else provenance,
            false_alarm=doubt[pixel, layer],
        )


def make_pinhole(image_shape: tuple[int, int], focal_length_px: float, pulse_fwhm: float) -> Camera:
    """Return a camera that only says where its pixels look.

    Parameters
    ----------
    image_shape : (int, int)
        Rows and columns.
    focal_length_px : float
        Distance of the pinhole from the picture, in pixels; the optical axis meets pixel
        ``(rows // 2, columns // 2)``.
    pulse_fwhm : float
        Full width at half maximum of a return, s.

    Returns
    -------
    Camera
        Of one view.
    """
    columns = image_shape[1]
    return Camera(
        np.array([min(columns / 2, columns - 1)]),
        np.zeros(1),
        image_shape,
        columns,
        pulse_fwhm=pulse_fwhm,
        focal_length_px=focal_length_px,
    )
