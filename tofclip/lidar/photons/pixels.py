"""The return of every pixel by its own photons alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from tofclip.lidar.photons.detector import PhotonDetector
from tofclip.lidar.photons.hot_pixels import find_hot_pixels, leave_out_pixels
from tofclip.lidar.photons.photon_image import PhotonImage
from tofclip.lidar.photons.response import measure_pulse_width
from tofclip.lidar.photons.surface_image import SurfaceImage
from tofclip.lidar.pulse import Pulse
from tofclip.threads import split_blocks

SAMPLED_PIXELS = 8192
"""That say what the pixels' background has in common."""

DETECTED_PIXELS_PER_BLOCK = 1 << 10


def estimate_pixels(
    photons: PhotonImage,
    pulse: Pulse | None = None,
    false_alarm_rate: float = 0.01,
    background: ArrayLike | None = None,
    cycles: int | None = None,
) -> SurfaceImage:
    """Find the strongest return of every pixel by its own photons alone.

    Parameters
    ----------
    photons : PhotonImage
    pulse : Pulse, optional
        Shape of a return; by default as wide as pairs of photons say.
    false_alarm_rate : float
        Share of the pixels without a return in which one is announced; see `PhotonDetector`.
    background : (bins,) array, optional
        Shape of the background over the bins, as of a dark frame; by default what the pixels have
        in common.
    cycles : int, optional
        Laser cycles of each pixel, of a detector that counts the first photon of a cycle only.

    Returns
    -------
    SurfaceImage
        NaN where no return stands out, and in hot pixels. The probability of an outlier is that of a false alarm.

    Raises
    ------
    InputError
        No pulse is given and none can be recognised, or the time axis is shorter than two pulses.
    """
    hot = find_hot_pixels(photons)
    photons = leave_out_pixels(photons, hot)
    shape = Pulse.gaussian(measure_pulse_width(photons)) if pulse is None else pulse
    detector = PhotonDetector(
        shape, photons.bin_width, photons.bins, false_alarm_rate, background=background
    )
    pixels = photons.offsets.size - 1
    if background is None:
        # once for the whole picture, from pixels all over it
        some = photons.histograms(slice(0, pixels, -(-pixels // SAMPLED_PIXELS)))
        learnt = detector.adapt(some).relative_background
        detector = replace(detector, background=learnt)
    found = np.full((3, pixels), np.nan)
    for piece in split_blocks(pixels, DETECTED_PIXELS_PER_BLOCK):
        arrivals = detector.locate(photons.histograms(piece), piece.start, cycles)
        found[:, piece] = (
            arrivals.range[:, 0],
            arrivals.confidence[:, 0],
            arrivals.photons[:, 0],
        )
    distance, sigma, signal = found.reshape(3, *photons.image_shape)
    seen = np.isfinite(distance)
    false_share = min(false_alarm_rate * pixels / max(int(seen.sum()), 1), 1.0)
    return SurfaceImage(
        range=distance,
        range_sigma=sigma,
        intensity=signal,
        outlier_probability=np.where(seen, false_share, np.nan),
        pulse=detector.shape,
        settings={
            "response": "learnt" if pulse is None else "given",
            "pulse_fwhm_ps": detector.shape.fwhm * 1e12,
            "false_alarm_rate": false_alarm_rate,
            "background": "given"
            if background is not None
            else "learnt"
            if np.ptp(detector.relative_background)
            else "even",
            "hot_pixels": int(hot.sum()),
        },
        hot_pixels=hot,
    )
