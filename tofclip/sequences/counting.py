"""Histograms of a picture to clouds while they come: photons of a pixel are summed over the shots in
which nothing moves there, and its returns found by these photons alone.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera
from tofclip.errors import InputError, ShapeError
from tofclip.lidar.photons import PhotonCube, PhotonDetector, SurfaceImage
from tofclip.lidar.photons.scene import prepare_photons
from tofclip.lidar.pulse import Pulse
from tofclip.shots import Returns

FloatArray = NDArray[np.float32]

BLOCK_SHOTS = 8  # a pixel is summed over this block of shots and the block before
# Standard deviations by which a window of a pixel's light has to differ, in a shot from all before it
# and in a block from the block before. Chance drops 4 pixels of 10 000 in a shot of 64 windows, and the
# older half of every sixth pixel in a block: what drifts is noticed before it is late by its deviation.
SHOT_SIGMAS, BLOCK_SIGMAS = 4.5, 3.0


class StillSum:
    """Sums the histograms of each pixel over up to two blocks of shots, and forgets what no longer
    holds: all of it where a shot shows something else, the older block where the newer one does.

    Numbers are compared in windows as long as a pulse, by their square roots, whose deviation is a
    half at any mean. Memory: two cubes.
    """

    def __init__(self, pixels: int, bins: int, window: int) -> None:
        self._starts = np.arange(0, bins, min(max(window, 1), bins))
        # the older block and the newer one, with and without windows, and their shots
        self._blocks = np.zeros((2, pixels, bins), np.float32)
        self._windows = np.zeros((2, pixels, self._starts.size), np.float32)
        self.shots = np.zeros((2, pixels), np.int64)

    def add(self, histograms: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
        """Add a shot (pixels, bins); return the sums, and of how many shots they are."""
        seen = np.add.reduceat(histograms, self._starts, axis=1)
        known = self.shots.sum(axis=0)
        moved = _differ(seen, 1, self._windows.sum(axis=0), known, SHOT_SIGMAS)
        self._forget(slice(None), moved)
        self._blocks[1] += histograms
        self._windows[1] += seen
        self.shots[1] += 1
        newer, older = self._windows[1], self._windows[0]
        full = self.shots[1] == BLOCK_SHOTS
        if full.any():
            drifted = full & _differ(newer, self.shots[1], older, self.shots[0], BLOCK_SIGMAS)
            self._forget(0, drifted)
        total, shots = self._blocks.sum(axis=0), self.shots.sum(axis=0)
        if full.any():
            for held in (self._blocks, self._windows, self.shots):
                held[0, full] = held[1, full]
            self._forget(1, full)
        return total, shots

    def _forget(self, block: int | slice, pixels: NDArray[np.bool_]) -> None:
        if pixels.any():
            for held in (self._blocks, self._windows, self.shots):
                held[block, pixels] = 0


def _differ(
    one: FloatArray,
    shots: int | NDArray[np.int64],
    other: FloatArray,
    others: NDArray[np.int64],
    limit: float,
) -> NDArray[np.bool_]:
    """Say of which pixels, seen in some shots, a window differs from what it was in others."""
    first = np.asarray(shots, np.float32).reshape(-1, 1)
    second = np.maximum(others, 1).astype(np.float32).reshape(-1, 1)
    change = np.sqrt((one + 0.375) / first) - np.sqrt((other + 0.375) / second)
    # of a square root the variance is a quarter, whatever the mean
    most = (np.abs(change) / np.sqrt(0.25 / first + 0.25 / second)).max(axis=1)
    return np.asarray((most > limit) & (others > 0))


class PhotonPipeline:
    """Makes clouds of histograms of one picture (`tofclip.lidar.photons.PhotonCube`).

    The pulse's width, the background's shape and hot pixels are learnt from the first shot that
    shows a pulse; where none does, the camera's pulse holds. Deviations are the Cramer-Rao bounds of
    the photons that were summed. Shots are taken in order. Memory: `StillSum`, and a copy of a shot.
    """

    in_order = True
    method_name = "photons"

    def __init__(
        self,
        camera: Camera,
        times: NDArray[np.float64],
        detector: PhotonDetector,
        hot: NDArray[np.bool_],
    ) -> None:
        self.camera, self.times, self.detector, self.hot = camera, times, detector, hot
        window = round(detector.shape.fwhm / detector.bin_width)
        self._sum = StillSum(hot.size, times.size, window)

    @classmethod
    def for_shot(
        cls, shot: PhotonCube, camera: Path | Camera | None = None, time_zero: float | None = None
    ) -> PhotonPipeline:
        """Prepare for shots like this one. The camera is by default the one that the shot carries, or
        `Camera.pinhole`.
        """
        known = Camera.load(camera) if isinstance(camera, Path) else camera or shot.camera
        photons, pulse = shot.to_image(), shot.pulse
        try:
            photons, pulse, hot = prepare_photons(photons, pulse, join=False)
        except InputError:
            if known is None:
                raise
            photons, pulse, hot = prepare_photons(
                photons, Pulse.gaussian(known.pulse_fwhm), join=False
            )
        seen_by = known or Camera.pinhole(shot.image_shape, pulse_fwhm=pulse.fwhm)
        if seen_by.image_shape != shot.image_shape:
            raise ShapeError("the camera's picture", shot.image_shape, seen_by.image_shape)
        if time_zero is not None:
            seen_by = seen_by.replace(time_zero=time_zero)
        detector = PhotonDetector(pulse, photons.bin_width, photons.bins).learn(photons)
        return cls(seen_by, shot.times, detector, hot)

    def rectify(self, shot: PhotonCube) -> FloatArray:
        """Put the bins of a pixel side by side, (pixels, bins)."""
        if shot.counts.shape != (self.times.size, *self.camera.image_shape):
            expected = self.times.size, *self.camera.image_shape
            raise ShapeError("histograms", expected, shot.counts.shape)
        return shot.histograms

    def recover_shot(
        self, shot: PhotonCube, rectified: FloatArray
    ) -> tuple[FloatArray, NDArray[np.int64]]:
        """Add the shots before it, pixel by pixel, as far as nothing has moved."""
        return self._sum.add(rectified)

    def search(self, found: tuple[FloatArray, NDArray[np.int64]]) -> Returns:
        """Find the returns of the sums; their intensity is that of one shot."""
        sums, shots = found
        layers = self.detector.locate_pixels(lambda piece: sums[piece], shots.size)
        layers[..., 2] /= shots
        layers[:, self.hot.ravel()] = np.nan
        picture = layers.reshape(-1, *self.camera.image_shape, 4)
        image = SurfaceImage.from_layers(picture, self.detector.shape, {}, self.hot)
        return image.calibrate(self.camera, float(self.times[0])).to_returns(self.camera)
