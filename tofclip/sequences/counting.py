"""Histograms of a picture to clouds while they come: photons of a pixel are summed over the shots in
which nothing jumps there, its return is found by these photons alone, and moved to where it is by now:
how fast a surface moves its newer photons and its older ones say, with those of pixels around it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tofclip.arrays import BoolArray, Float32Array, FloatArray, IntArray
from tofclip.camera import Camera
from tofclip.errors import InputError, require_shape
from tofclip.lidar.photons import PhotonCube, PhotonDetector, SurfaceImage
from tofclip.lidar.photons.scene import prepare_photons
from tofclip.lidar.pulse import Pulse
from tofclip.shots import Returns
from tofclip.units import SPEED_OF_LIGHT

SUMMED_SHOTS = 16  # of a pixel at most: a block of shots and the block before
# Standard deviations by which a window of a pixel's light has to differ, in a shot from all before it
# and in a block from the block before. Chance drops 4 pixels of 10 000 in a shot of 64 windows, and
# leaves out the older half of every sixth pixel.
SHOT_SIGMAS, BLOCK_SIGMAS = 4.5, 3.0
POOL_PX = 5  # along the square in which pixels of one surface move alike
MIN_BACKGROUND_PHOTONS = 0.1  # of a shot in all bins of a pixel
TINY = 1e-12  # in the place of nothing that is known
DRIFT_ROUNDS = 2  # a shift that is as far as the pulse is long is underestimated by the first one


class StillSum:
    """Sums the histograms of each pixel over an older block of shots and a newer one, which follow each
    other, and forgets both where a shot shows something else.

    Numbers are compared in windows as long as a pulse, by their square roots, whose deviation is a
    half at any mean. `most`: shots at most. Memory: two cubes.
    """

    def __init__(self, pixels: int, bins: int, window: int, most: int = SUMMED_SHOTS) -> None:
        self._block_shots = -(-most // 2)
        self._starts = np.arange(0, bins, min(max(window, 1), bins))
        # the older block and the newer one, with and without windows, and their shots
        self.blocks = np.zeros((2, pixels, bins), np.float32)
        self._windows = np.zeros((2, pixels, self._starts.size), np.float32)
        self.shots = np.zeros((2, pixels), np.int64)

    def add(self, histograms: Float32Array) -> BoolArray:
        """Add a shot (pixels, bins); say of which pixels the older block shows what the newer does."""
        seen = np.add.reduceat(histograms, self._starts, axis=1)
        moved = _differ(seen, 1, self._windows.sum(axis=0), self.shots.sum(axis=0), SHOT_SIGMAS)
        full = self.shots[1] >= self.shots[0]
        grown = full & (self.shots[0] < self._block_shots)
        for held in (self.blocks, self._windows, self.shots):
            held[:, moved] = 0
            held[0, grown] += held[1, grown]
            held[0, full & ~grown] = held[1, full & ~grown]
            held[1, full] = 0
        self.blocks[1] += histograms
        self._windows[1] += seen
        self.shots[1] += 1
        older, newer = zip(self._windows, self.shots, strict=True)
        return ~_differ(*newer, *older, BLOCK_SIGMAS)

    def average(self, still: BoolArray) -> Float32Array:
        """Return the mean of a shot (pixels, bins), of both blocks where that is `still` the same."""
        older, newer = self.blocks
        before, shots = self.shots
        sums = newer + older * still[:, np.newaxis]
        return np.asarray(sums / (shots + before * still)[:, np.newaxis], np.float32)


def _differ(
    one: Float32Array,
    shots: int | IntArray,
    other: Float32Array,
    others: IntArray,
    limit: float,
) -> BoolArray:
    """Say of which pixels, seen in some shots, a window differs from what it was in others."""
    first = np.asarray(shots, np.float32).reshape(-1, 1)
    second = np.maximum(others, 1).astype(np.float32).reshape(-1, 1)
    change = np.sqrt((np.maximum(one, 0) + 0.375) / first) - np.sqrt(
        (np.maximum(other, 0) + 0.375) / second
    )
    # of a square root the variance is a quarter, whatever the mean
    most = (np.abs(change) / np.sqrt(0.25 / first + 0.25 / second)).max(axis=1)
    return (most > limit) & (others > 0)


class PhotonPipeline:
    """Makes clouds of histograms of one picture (`tofclip.lidar.photons.PhotonCube`).

    The pulse's width, the background's shape and hot pixels are learnt from the first shot that
    shows a pulse; where none does, the camera's pulse holds. Deviations are the Cramer-Rao bounds of
    the photons that were summed, what is not known of a surface's speed, and, of a gate, where between
    two of its steps an edge lies. Shots are taken in order. Memory: `StillSum`, and a copy of a shot.
    """

    in_order = True
    method_name = "photons"

    def __init__(
        self,
        camera: Camera,
        times: FloatArray,
        detector: PhotonDetector,
        hot: BoolArray,
        sampled: bool = False,
    ) -> None:
        self.camera, self.times, self.detector, self.hot = camera, times, detector, hot
        self.sampled = sampled
        window = round(detector.shape.fwhm / detector.bin_width)
        self._sum = StillSum(hot.size, times.size, window)

    @classmethod
    def for_shot(
        cls, shot: PhotonCube, camera: Path | Camera | None = None, time_zero: float | None = None
    ) -> PhotonPipeline:
        """Prepare for shots like this one; of no `camera` with its own, or `Camera.pinhole`."""
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
        require_shape("the camera's picture", shot.image_shape, seen_by.image_shape)
        if time_zero is not None:
            seen_by = seen_by.replace(time_zero=time_zero)
        detector = PhotonDetector(pulse, photons.bin_width, photons.bins)
        return cls(seen_by, shot.times, detector.learn(photons), hot, shot.sampled)

    def rectify(self, shot: PhotonCube) -> Float32Array:
        """Put the bins of a pixel side by side, (pixels, bins)."""
        expected = self.times.size, *self.camera.image_shape
        require_shape("histograms", expected, shot.counts.shape)
        return shot.histograms

    def recover(self, histograms: Float32Array) -> BoolArray:
        """Add a shot to those before it, pixel by pixel, as far as nothing has jumped."""
        return self._sum.add(histograms)

    def search(self, still: BoolArray) -> Returns:
        """Find the returns of the sums where they are now; their intensity is that of one shot."""
        (older, newer), (before, shots) = self._sum.blocks, self._sum.shots
        used = before * still
        sums = newer + older * still[:, np.newaxis]
        layers = self.detector.locate_pixels(lambda piece: sums[piece], shots.size)
        layers[..., 2] /= used + shots
        layers[:, self.hot.ravel()] = np.nan
        age = (used * (shots + (used - 1) / 2) + shots * (shots - 1) / 2) / (used + shots)
        speed, speed_sigma = self._measure_speed(layers[0], sums.sum(axis=1) / (used + shots), age)
        if self.sampled:
            layers = self.detector.add_step_errors(layers)
        layers[0, :, 0] += speed * age
        layers[0, :, 1] = np.hypot(layers[0, :, 1], speed_sigma * age)
        picture = layers.reshape(-1, *self.camera.image_shape, 4)
        image = SurfaceImage.from_layers(picture, self.detector.shape, {}, self.hot)
        return image.calibrate(self.camera, float(self.times[0])).to_returns(self.camera)

    def _measure_speed(
        self, layer: FloatArray, photons: FloatArray, age: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """How far the surface of each pixel moves in a shot, m, and the standard deviation, by newer and
        older photons of the pixels around it that lie on the same surface. `photons`: of all bins in a
        shot; `age`: of what gave the range, in shots.
        """
        from tofclip.lidar.photons.kernels import weigh_shifts

        sums, metres, shape = self._sum, SPEED_OF_LIGHT / 2, self.detector.shape
        before, shots = sums.shots
        ages = np.stack([shots + (before - 1) / 2, (shots - 1) / 2])
        gap = ages[0] - ages[1]
        level = np.maximum(photons - layer[:, 2], MIN_BACKGROUND_PHOTONS) / self.times.size
        curve = self.detector.relative_background, *shape.kernel_table(), self.detector.times
        speed = sigma = np.zeros(shots.size)
        for _ in range(DRIFT_ROUNDS):
            found = np.zeros((2, shots.size, 2))
            for block, number, old, own in zip(sums.blocks, sums.shots, ages, found, strict=True):
                arrival = (layer[:, 0] + speed * (age - old)) / metres
                weigh_shifts(block, arrival, layer[:, 2] * number, level * number, *curve, own)
            slope, known = np.moveaxis(found, -1, 0)
            # of the difference of both blocks' shifts; an empty block knows nothing
            weight = known[0] * known[1] / np.maximum(known[0] + known[1], TINY) / metres**2
            older, newer = metres * slope / np.maximum(known, TINY)
            terms = np.stack([weight * gap * (newer - older + speed * gap), weight * gap**2])
            pushed, held = self._pool(terms, layer[:, 0], shape.fwhm * metres / 2)
            held = np.maximum(held, TINY)
            speed, sigma = pushed / held, 1 / np.sqrt(held)
        return speed, sigma

    def _pool(self, terms: FloatArray, ranges: FloatArray, near: float) -> FloatArray:
        """Add up what the pixels around each one say, (terms, pixels), that are as near as that, m."""
        rows, columns = self.camera.image_shape
        stack = np.concatenate([ranges[np.newaxis], terms]).reshape(-1, rows, columns)
        edge, total = POOL_PX // 2, np.zeros_like(stack[1:])
        padded = np.pad(stack, ((0, 0), (edge, edge), (edge, edge)), constant_values=np.nan)
        for down, right in np.ndindex(POOL_PX, POOL_PX):
            around = padded[:, down : down + rows, right : right + columns]
            total += np.where(np.abs(around[0] - stack[0]) < near, around[1:], 0)
        return total.reshape(len(terms), -1)
