"""Photons counted in every pixel of a picture, as histograms or as a list of events, without the
empty bins; which of its pixels are hot; and the picture of ranges that is made of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike
from scipy.sparse import csr_array

from tofclip.arrays import AnyArray, BoolArray, Float32Array, FloatArray, IntArray
from tofclip.camera import Camera
from tofclip.errors import CalibrationError, InputError, ShapeError, require_positive
from tofclip.lidar.pulse import Pulse
from tofclip.lidar.range_calibration import correct_ranges
from tofclip.shots import Returns
from tofclip.units import SPEED_OF_LIGHT, require_credible_bin_width

MIN_BIN_WIDTH_S = 1e-13  # half of the finest channel of time-correlated counters (0.2 ps)


@dataclass(frozen=True)
class Shading:
    """How bright the background is over its `mean`, photons of a pixel in a bin, smooth from cell to
    cell of picture and time: `level` (rows, columns, stretches) of cells that the picture's axes,
    `image_shape`, and its `bins` are divided into.
    """

    level: FloatArray
    image_shape: tuple[int, int]
    bins: int
    mean: float

    def at(self, pixel: IntArray, instant: ArrayLike) -> Float32Array:
        """Return the level at each `instant`, in bins, of each `pixel`, a raster number."""
        sides = *self.image_shape, self.bins
        place = (*np.divmod(pixel, self.image_shape[1]), np.asarray(instant))
        cells = [
            (axis + 0.5) * (number / side) - 0.5
            for axis, number, side in zip(place, self.level.shape, sides, strict=True)
        ]
        return scipy.ndimage.map_coordinates(self.level, cells, np.float32, 1, mode="nearest")

    def average(self) -> Shading:
        """Return the same of all times."""
        return replace(self, level=self.level.mean(axis=2, keepdims=True))


@dataclass(frozen=True)
class PhotonImage:
    """Photon events sorted by pixel.

    Parameters
    ----------
    offsets : (pixels + 1,) int64 array
        The events of pixel p, counted in raster order, are ``offsets[p] : offsets[p + 1]``.
    bin : (events,) float32 array
        Time of each event in bins after the middle of the first bin.
    count : (events,) float32 array
        Photons that the event stands for.
    image_shape : (int, int)
        Rows and columns.
    bins : int
        Bins of the time axis.
    bin_width : float
        Duration of a bin, s.
    axes : str
        Order of the axes of the cube that they were read from and how surely it was recognised;
        empty where it was known.
    cycles : float
        Laser cycles of each pixel, of a detector that counts the first photon of a cycle only; by
        default so many that none is missed; see `correct_pile_up`.
    shading : object, optional
        Course of the background over picture and time, as `estimate_surface` finds it; even by default.
    sampled : bool
        Whether a bin shows one instant, see `PhotonCube`: where in a step a return lies leaves no trace.
    bin_sigma : (bins,) array, optional
        How well the instant of each bin is known, in bins, of a converter whose bins are uneven; see
        `even_out`.

    Raises
    ------
    ShapeError, InputError
        Arrays that do not belong together, a bin width that is not positive, or no photon at all.
    """

    offsets: IntArray
    bin: Float32Array
    count: Float32Array
    image_shape: tuple[int, int]
    bins: int
    bin_width: float
    axes: str = ""
    cycles: float = np.inf
    shading: Any = None
    sampled: bool = False
    bin_sigma: FloatArray | None = None

    def __post_init__(self) -> None:
        pixels = self.image_shape[0] * self.image_shape[1]
        if self.offsets.shape != (pixels + 1,) or self.offsets[-1] != self.bin.size:
            raise ShapeError("the offsets of photon events", (pixels + 1,), self.offsets.shape)
        if self.count.shape != self.bin.shape:
            raise ShapeError("the counts of photon events", self.bin.shape, self.count.shape)
        require_positive("the width of a bin", self.bin_width, "time")
        require_credible_bin_width(self.bin_width, shortest=MIN_BIN_WIDTH_S)
        if not self.bin.size:
            raise InputError("no pixel counted a photon")
        if not self.cycles > 0:
            raise InputError(f"pile-up needs a cycle or more, got {self.cycles}")

    @classmethod
    def from_cube(cls, counts: ArrayLike, bin_width: float) -> PhotonImage:
        """Turn a histogram for each pixel into events: `counts` (rows, columns, bins) of photons in
        bins of `bin_width`, s. `ShapeError` or `InputError` where it is no cube, or counts are
        negative or not finite.
        """
        cube = np.asarray(counts)
        if cube.ndim != 3:
            raise ShapeError("counts", "(rows, columns, bins)", cube.shape)
        if not np.all(np.isfinite(cube)) or cube.min(initial=0) < 0:
            raise InputError("photon counts must be finite and not negative")
        rows, columns, bins = cube.shape
        histograms = cube.reshape(-1, bins)
        pixel, number = np.nonzero(histograms)
        photons = cls.from_events(pixel, number, (rows, columns), bin_width, bins)
        return replace(photons, count=histograms[pixel, number].astype(np.float32))

    @classmethod
    def from_events(
        cls,
        pixel: AnyArray,
        bin_number: AnyArray,
        image_shape: tuple[int, int],
        bin_width: float,
        bins: int | None = None,
    ) -> PhotonImage:
        """Sort single photons by pixel: `pixel` (photons,) is the raster number of the one that counted
        each, in a picture of `image_shape`, and `bin_number` (photons,) its time in bins of
        `bin_width`, s, 0 for the middle of the first one; there are `bins`, by default up to the
        latest photon. `InputError` for no photon, or a time that is negative or not finite.
        """
        when = np.asarray(bin_number, dtype=np.float32)
        if not np.all(np.isfinite(when)) or when.min(initial=0) < 0:
            raise InputError("photon times must be finite and not negative")
        length = int(when.max(initial=0)) + 1 if bins is None else bins
        order = np.argsort(pixel, kind="stable")
        offsets = np.searchsorted(pixel[order], np.arange(image_shape[0] * image_shape[1] + 1))
        own = offsets.astype(np.int64), when[order], np.ones(when.size, np.float32)
        return cls(*own, image_shape, length, float(bin_width))

    @property
    def pixels(self) -> int:
        """How many there are."""
        return self.offsets.size - 1

    @cached_property
    def pixel(self) -> IntArray:
        """Raster number of the pixel of each event."""
        return np.repeat(np.arange(self.pixels), np.diff(self.offsets))

    def times_after(self, surface: FloatArray) -> FloatArray:
        """Return by how many bins each event comes after its pixel's surface, (rows, columns)."""
        return self.bin - surface.ravel()[self.pixel]

    def sum_by_pixel(self, weights: AnyArray) -> FloatArray:
        """Return the sums over each pixel's events of their `weights`, (rows, columns)."""
        total = np.bincount(self.pixel, weights, self.pixels)
        return total.reshape(self.image_shape).astype(np.float64)

    @cached_property
    def relative(self) -> Float32Array:
        """Background at each event over its mean, (events,)."""
        if self.shading is None:
            return np.ones(self.bin.size, np.float32)
        return self.shading.at(self.pixel, self.bin)

    def relative_at(self, surface: FloatArray) -> Float32Array:
        """Return the background at each pixel's surface over its mean, (rows, columns)."""
        if self.shading is None:
            return np.ones(surface.shape, np.float32)
        found = self.shading.at(np.arange(surface.size), surface.ravel())
        return found.reshape(surface.shape)

    @cached_property
    def table(self) -> csr_array:
        """Photons by pixel and bin, (pixels, bins); bins of several events are not summed up yet."""
        whole = np.clip(np.rint(self.bin), 0, self.bins - 1).astype(np.int64)
        return csr_array((self.count, whole, self.offsets), (self.pixels, self.bins))

    @property
    def photons(self) -> float:
        """Photons of the whole picture."""
        return float(self.count.sum(dtype=np.float64))

    @cached_property
    def photons_per_pixel(self) -> FloatArray:
        """Photons of each pixel, (rows, columns)."""
        return self.sum_by_pixel(self.count)

    @cached_property
    def time_profile(self) -> FloatArray:
        """Photons of all pixels in each bin, (bins,)."""
        return np.bincount(self.table.indices, self.count, self.bins).astype(np.float64)

    def count_stretches(self, number: int) -> FloatArray:
        """Photons of each pixel in equal parts of the time axis, at most its bins, (pixels, parts)."""
        number = min(number, self.bins)
        part = np.clip(self.bin * (number / self.bins), 0, number - 1).astype(np.int64)
        counts = np.bincount(self.pixel * number + part, self.count, self.pixels * number)
        return np.asarray(counts.reshape(self.pixels, number), np.float64)

    def select(self, count: Float32Array) -> PhotonImage:
        """Return the events with other counts, (events,); those with none are left out."""
        kept = count > 0
        offsets = np.concatenate([[0], np.cumsum(kept)])[self.offsets]
        return replace(self, offsets=offsets, bin=self.bin[kept], count=count[kept], axes="")

    def join_bins(self, number: int) -> PhotonImage:
        """Return the same events, at the same instants, in bins a `number` of times as long."""
        if number == 1:
            return self
        # A bin's middle is its instant: half of the first new bin lies before the record.
        when, bins = self.bin / np.float32(number), (self.bins - 1 + number // 2) // number + 1
        return replace(self, bin=when, bins=bins, bin_width=self.bin_width * number, axes="")

    def split(self, fraction: float, seed: int) -> tuple[PhotonImage, PhotonImage]:
        """Divide the photons at random, by a `seed`, a fraction of them into the second part, so that one part
        can judge what the other part says.
        """
        from tofclip.lidar.photons.kernels import choose_cycles

        noise, second = np.random.default_rng(seed), np.zeros_like(self.count)
        if np.isinf(self.cycles):
            # binomial thinning of Poisson counts gives two independent Poisson counts
            second[:] = noise.binomial(np.rint(self.count).astype(np.int64), fraction)
        else:
            choose_cycles(self.offsets, self.count, self.cycles, fraction, noise, second)
        if not (second.any() and np.any(self.count > second)):
            raise InputError(
                f"{self.photons:g} photons are too few to find a surface and to hold some back "
                "that judge it; each pixel may be judged alone (`single_pixel`)"
            )
        return (
            replace(self.select(self.count - second), cycles=self.cycles * (1 - fraction)),
            replace(self.select(second), cycles=self.cycles * fraction),
        )

    def correct_pile_up(self, cycles: int) -> PhotonImage:
        """Return the same photons, in whole bins and in order, of a detector that counts the first one
        of each of so many cycles: what it was blind to is taken into account from here on.
        """
        if self.photons_per_pixel.max() > cycles:
            raise InputError(
                f"more photons than {cycles} cycles allow, of which each counts its first"
            )
        table = self.table.copy()
        table.sum_duplicates()
        offsets, bins = table.indptr.astype(np.int64), table.indices.astype(np.float32)
        return replace(self, offsets=offsets, bin=bins, count=table.data, cycles=float(cycles))

    def even_out(self, edges: FloatArray, sigma: FloatArray) -> PhotonImage:
        """Return the same photons, in whole bins, on an even time axis, on which bins begin and end at
        `edges` (bins + 1,), none of them longer than two; `sigma`: see `bin_sigma`. Which of two or
        three even bins a photon came in is left to chance: counts stay Poisson's.
        """
        code = self.bin.astype(np.int64)
        begin, length = edges[code], edges[code + 1] - edges[code]
        first = np.minimum(np.floor(begin), self.bins - 1)
        one, two = (np.clip((first + n - begin) / length, 0, 1) for n in (1, 2))
        noise, number = np.random.default_rng(0), np.rint(self.count).astype(np.int64)
        late = number - noise.binomial(number, one)
        last = noise.binomial(late, np.clip((1 - two) / np.maximum(1 - one, 1e-12), 0, 1))
        count = np.stack([number - late, late - last, last], axis=1).astype(np.float32).ravel()
        when = np.minimum(first[:, np.newaxis] + (0, 1, 2), self.bins - 1).astype(np.float32)
        spread = replace(
            self, offsets=3 * self.offsets, bin=when.ravel(), count=count, bin_sigma=sigma
        )
        return replace(spread.select(count), axes=self.axes)

    @property
    def bins_sigma_m(self) -> float:
        """Deviation of the usual bin's range, m; 0 where bins are even."""
        usual = 0.0 if self.bin_sigma is None else float(np.median(self.bin_sigma))
        return SPEED_OF_LIGHT / 2 * self.bin_width * usual

    def add_bin_errors(self, layers: FloatArray) -> FloatArray:
        """Add what is not known of bins' instants to the deviations of `layers` (..., 4)."""
        if self.bin_sigma is None:
            return layers
        bin_m = SPEED_OF_LIGHT / 2 * self.bin_width
        known = np.interp(layers[..., 0] / bin_m, np.arange(self.bins), self.bin_sigma)
        return add_errors(layers, bin_m * known)

    def histograms(self, pixels: slice) -> FloatArray:
        """Return the histograms of some pixels in raster order, (n, bins)."""
        return np.asarray(self.table[pixels].toarray(), np.float64)


@dataclass(frozen=True)
class PhotonCube:
    """Histograms of a picture, as an instrument counted them: `counts` (bins, rows, columns) of photons, not
    negative, of any number type, at `times` (bins,), the middle of each bin, s after the laser's pulse,
    evenly spaced. `camera` says where the pixels look (`Camera.pinhole` where only that is known), `pulse`
    how a return at one instant shows in successive bins, where the instrument knows; `sampled` whether a
    bin shows one instant, as a picture behind a gate does, not all up to the next bin; `source` where it
    came from, for messages, and `provenance` how it came about. `ShapeError` or `InputError` for no cube,
    a time axis of another length, or one that is not even or not credible.
    """

    counts: AnyArray
    times: FloatArray
    camera: Camera | None = None
    pulse: Pulse | None = None
    sampled: bool = False
    source: str = "histograms"
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.counts.ndim != 3 or self.counts.size == 0:
            raise ShapeError(f"{self.source}: counts", "(bins, rows, columns)", self.counts.shape)
        if self.times.shape != self.counts.shape[:1] or self.times.size < 2:
            raise ShapeError(f"{self.source}: times", self.counts.shape[:1], self.times.shape)
        steps = np.diff(self.times)
        if not (steps.min() > 0 and np.ptp(steps) < 1e-3 * self.bin_width):
            raise InputError(f"{self.source}: the bins of histograms are to be equally long")
        require_credible_bin_width(self.bin_width)

    @property
    def bin_width(self) -> float:
        """Duration of a bin, s."""
        return float(self.times[-1] - self.times[0]) / (self.times.size - 1)

    @property
    def image_shape(self) -> tuple[int, int]:
        """Rows and columns."""
        _, rows, columns = self.counts.shape
        return rows, columns

    @property
    def histograms(self) -> Float32Array:
        """Photons (pixels, bins), pixels in raster order."""
        flat = self.counts.reshape(self.times.size, -1).T
        return np.ascontiguousarray(flat, dtype=np.float32)

    def to_image(self) -> PhotonImage:
        """Return the photons as events, sorted by pixel."""
        image = PhotonImage.from_cube(np.moveaxis(self.counts, 0, -1), self.bin_width)
        return replace(image, sampled=self.sampled)


def add_errors(layers: FloatArray, errors: FloatArray) -> FloatArray:
    """Add errors, m, to the deviations of layers (..., 4)."""
    sigma = np.hypot(layers[..., 1], errors)
    return np.concatenate([layers[..., :1], sigma[..., np.newaxis], layers[..., 2:]], axis=-1)


# Photons of a hot pixel's fullest bin over those of the usual pixel's fullest bin, of the bins beside
# it, and of each neighbour at that time: light of a pulse is in several bins, a surface goes on.
PEAK_RATIO = 20.0
# photons of a hot pixel over a usual one; saves looking at the bins of all others
TOTAL_RATIO = 2.0
USUAL_QUANTILE = 0.9  # of the pixels: up to a tenth of them may be hot
SAMPLED_PIXELS = 4096
NEIGHBOUR_BINS = 2  # by which the same surface may lie earlier or later in the next pixel
# Stretches of the time axis, of which the fullest quarter may hold returns; how far beyond that of its
# neighbours a pixel's light in the others, or below that of its neighbours all its light, has to be,
# beside six standard deviations; and which neighbours, as up to two of them may be hot, or dead.
STRETCHES, FAULT_RATIO, FAULT_SIGMAS, NEIGHBOUR_RANK = 16, 3.0, 6.0, 2


def find_hot_pixels(photons: PhotonImage) -> BoolArray:
    """Say which pixels, (rows, columns), count what no light makes: far more than their neighbours
    at all times, or in one bin. Pairs of photons grow with the square of their number: one such pixel
    would say more about the pulse than all others together. They are found before anything is learnt.
    """
    light = np.sort(photons.count_stretches(STRETCHES), axis=1)
    quiet = light[:, : light.shape[1] - light.shape[1] // 4].sum(axis=1)
    quiet = quiet.reshape(photons.image_shape)
    around = _rank_neighbours(quiet, -1 - NEIGHBOUR_RANK)
    throughout = quiet > FAULT_RATIO * around + FAULT_SIGMAS * np.sqrt(around + 4)
    return throughout | _find_peaked_pixels(photons)


def find_dim_pixels(photons: PhotonImage) -> BoolArray:
    """Say which pixels, (rows, columns), count far less than their neighbours, dead ones among them."""
    light = photons.photons_per_pixel
    around = _rank_neighbours(light, NEIGHBOUR_RANK)
    return FAULT_RATIO * light + FAULT_SIGMAS * np.sqrt(light + 4) < around


def _rank_neighbours(values: FloatArray, rank: int) -> FloatArray:
    """Value of that rank among each pixel's eight neighbours, of a line along it."""
    if values.size == 1:
        return values
    line = np.where(np.array(values.shape) > 1, 9, 1)
    footprint = np.ones((3, 3) if min(values.shape) > 1 else line)
    footprint[footprint.shape[0] // 2, footprint.shape[1] // 2] = 0
    return scipy.ndimage.rank_filter(values, rank, footprint=footprint, mode="mirror")


def _find_peaked_pixels(photons: PhotonImage) -> BoolArray:
    rows, columns = photons.image_shape
    hot, table = np.zeros((rows, columns), np.bool_), photons.table
    total = photons.photons_per_pixel.ravel()
    usual_total = max(float(np.quantile(total, USUAL_QUANTILE)), 1.0)
    bright = np.flatnonzero(total > np.maximum(TOTAL_RATIO * usual_total, PEAK_RATIO))
    if not bright.size:
        return hot
    sampled = table[:: -(-total.size // SAMPLED_PIXELS)].max(axis=1).toarray()
    usual = max(float(np.quantile(sampled, USUAL_QUANTILE)), 1.0)
    peak = table[bright].max(axis=1).toarray().ravel()
    bright, peak = bright[peak > PEAK_RATIO * usual], peak[peak > PEAK_RATIO * usual]
    if not bright.size:
        return hot
    # A surface goes on in the next pixel or the next bin; what stands alone in both is the sensor's.
    y, x, when = (*np.divmod(bright, columns), table[bright].argmax(axis=1))
    down, right, later = np.mgrid[-1:2, -1:2, -NEIGHBOUR_BINS : NEIGHBOUR_BINS + 1].reshape(3, -1)
    y, x, when = y[:, np.newaxis] + down, x[:, np.newaxis] + right, when[:, np.newaxis] + later
    seen = (y >= 0) & (y < rows) & (x >= 0) & (x < columns) & (when >= 0) & (when < photons.bins)
    seen &= (down != 0) | (right != 0) | (later != 0)
    light = np.zeros(seen.shape)
    light[seen] = table[(y * columns + x)[seen], when[seen]]
    hot.ravel()[bright] = light.max(axis=1) * PEAK_RATIO < peak
    return hot


def leave_out_pixels(photons: PhotonImage, pixels: BoolArray) -> PhotonImage:
    """Return the photons of all but some pixels, (rows, columns)."""
    if not pixels.any():
        return photons
    count = np.where(pixels.ravel()[photons.pixel], np.float32(0), photons.count)
    if not count.any():
        raise InputError(f"only hot pixels counted photons ({int(pixels.sum())} of {pixels.size})")
    return photons.select(count)


@dataclass(frozen=True)
class SurfaceImage:
    """A range for every pixel, (rows, columns), NaN where there is none: `range` for a co-located source,
    m, the middle of the first bin being range 0; `range_sigma`, its standard deviation, m;
    `intensity`, expected photons of the return; `outlier_probability`, that the return is not of this
    pixel's surface, or that it has none: where nothing sends light back the neighbours' surface goes on.

    `pulse` is the response that was used, as bins show it; `settings` what was chosen from the data,
    by name; `further` weaker returns of the same pixels, the strongest first; `hot_pixels` (rows,
    columns) those whose photons were left out, see `find_hot_pixels`.
    """

    range: FloatArray
    range_sigma: FloatArray
    intensity: FloatArray
    outlier_probability: FloatArray
    pulse: Pulse
    settings: dict[str, float | str]
    further: tuple[SurfaceImage, ...] = ()
    hot_pixels: BoolArray | None = None

    @classmethod
    def from_layers(
        cls,
        layers: FloatArray,
        pulse: Pulse,
        settings: dict[str, float | str],
        hot: BoolArray,
    ) -> SurfaceImage:
        """Make one of range, deviation, photons and outlier probability of each pixel's returns, the
        strongest first, `layers` (layers, rows, columns, 4); `pulse` and `settings` are those that found
        them, and `hot` pixels, (rows, columns), those without.
        """
        first, *further = (
            cls(one[..., 0], one[..., 1], one[..., 2], one[..., 3], pulse, settings)
            for one in layers
        )
        return replace(first, further=tuple(further), hot_pixels=hot)

    def calibrate(self, camera: Camera, first_time: float = 0.0) -> SurfaceImage:
        """Return the ranges from the time zero of `camera`, with its range calibration applied, where
        the time axis reads `first_time`, s, at the middle of the first bin. `CalibrationError` where
        the camera has another number of pixels.
        """
        if camera.image_shape != self.range.shape:
            raise CalibrationError(
                f"the camera has {camera.image_shape} pixels, the photons {self.range.shape}"
            )
        further = tuple(one.calibrate(camera, first_time) for one in self.further)
        distance = self.range - SPEED_OF_LIGHT / 2 * (camera.time_zero - first_time)
        sigma = self.range_sigma
        if camera.range_calibration is not None:
            y, x = np.indices(self.range.shape)
            distance, _, sigma = correct_ranges(
                camera.range_calibration, distance, self.intensity, sigma, (y, x)
            )
        return replace(self, range=distance, range_sigma=sigma, further=further)

    def to_returns(self, camera: Camera, provenance: Mapping[str, Any] | None = None) -> Returns:
        """List the pixels with a range: `camera` says where they look, see `Camera.pinhole`, and
        `provenance` how they came about.
        """
        layers = [self, *self.further]
        distance, sigma, signal, doubt = (
            np.stack([getattr(one, name).ravel() for one in layers], axis=1)
            for name in ("range", "range_sigma", "intensity", "outlier_probability")
        )
        order = np.argsort(distance, axis=1)
        pixel, nearness = np.nonzero(np.isfinite(np.take_along_axis(distance, order, axis=1)))
        chosen = pixel, order[pixel, nearness]
        y, x = np.divmod(pixel.astype(np.int32), np.int32(self.range.shape[1]))
        return Returns(
            y=y,
            x=x,
            range=distance[chosen],
            intensity=(signal[chosen] * distance[chosen] ** 2).astype(np.float32),
            confidence=sigma[chosen].astype(np.float32),
            return_number=(nearness + 1).astype(np.uint8),
            time=2 * distance[chosen] / SPEED_OF_LIGHT,
            camera=camera,
            provenance={} if provenance is None else provenance,
            false_alarm=doubt[chosen],
        )
