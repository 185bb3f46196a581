"""The return of every pixel by its own photons alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from tofclip.lidar.photons.detector import PhotonDetector
from tofclip.lidar.photons.hot_pixels import find_hot_pixels, leave_out_pixels
from tofclip.lidar.photons.photon_image import PhotonImage
from tofclip.lidar.photons.response import (
    find_time_step,
    measure_pulse_width,
    require_plausible_pulse,
)
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
    max_returns: int = 1,
) -> SurfaceImage:
    """Find the strongest returns of every pixel by its own photons alone.

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
    max_returns : int
        Returns looked for in every pixel.

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
    if background is None:  # which has the photons' own bins
        photons = photons.join_bins(find_time_step(photons))
    shape = Pulse.gaussian(measure_pulse_width(photons)) if pulse is None else pulse
    require_plausible_pulse(photons, shape)
    detector = PhotonDetector(
        shape,
        photons.bin_width,
        photons.bins,
        false_alarm_rate,
        max_returns,
        background=background,
    )
    pixels = photons.offsets.size - 1
    if background is None:
        # once for the whole picture, from pixels all over it
        some = photons.histograms(slice(0, pixels, -(-pixels // SAMPLED_PIXELS)))
        learnt = detector.adapt(some).relative_background
        detector = replace(detector, background=learnt)
    found = np.full((max_returns, 3, pixels), np.nan)
    for piece in split_blocks(pixels, DETECTED_PIXELS_PER_BLOCK):
        arrivals = detector.locate(photons.histograms(piece), piece.start, cycles)
        located = np.stack([arrivals.range, arrivals.confidence, arrivals.photons])
        found[..., piece] = np.moveaxis(located, -1, 0)
    settings: dict[str, float | str] = {
        "response": "learnt" if pulse is None else "given",
        "pulse_fwhm_ps": detector.shape.fwhm * 1e12,
        "false_alarm_rate": false_alarm_rate,
        "background": "given"
        if background is not None
        else "learnt"
        if np.ptp(detector.relative_background)
        else "even",
        "hot_pixels": int(hot.sum()),
    }
    images = []
    for distance, sigma, signal in found.reshape(max_returns, 3, *photons.image_shape):
        seen = np.isfinite(distance)
        false_share = min(false_alarm_rate * pixels / max(int(seen.sum()), 1), 1.0)
        doubt = np.where(seen, false_share, np.nan)
        images.append(SurfaceImage(distance, sigma, signal, doubt, detector.shape, settings))
    return replace(images[0], further=tuple(images[1:]), hot_pixels=hot)
