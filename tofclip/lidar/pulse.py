"""The shape of a single return, the instrument's response to a short pulse; and what the search for
returns needs to know of it and of traces on one time axis: bins, windows, filters, a table.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from tofclip.arrays import BoolArray, Float32Array, FloatArray, IntArray
from tofclip.errors import InputError, require_positive
from tofclip.units import FWHM_PER_SIGMA

SAMPLES_PER_FWHM = 128  # linear interpolation then errs by less than 2e-5 of the peak
EXTENT_FWHM = 2.0  # a Gaussian is 1.5e-5 of its peak there
EXTENT_DECAYS = 11.0  # an exponential is 1.7e-5 of its start there
SAMPLES_PER_BIN = 64  # of a pulse that was summed over bins
MAX_SAMPLES = 1 << 23
"""Of a pulse: 10,000 times as long as a bin and as long as its tail may be."""
SUPPORT_THRESHOLD = 0.01  # below this fraction of its peak a pulse says nothing about where it is

Table = tuple[FloatArray, tuple[float, float, float, float]]


@dataclass(frozen=True)
class Pulse:
    """A pulse shape as a finely sampled curve; between samples it is linear, beyond them zero.

    Parameters
    ----------
    samples : (n,) array
        Brightness, evenly sampled; scaled to a peak of one.
    spacing : float
        Time between samples, s.
    origin : float
        Position, in samples, of the instant that counts as the arrival.

    Raises
    ------
    InputError
        Fewer than three samples, nothing positive, a spacing that is not positive, or an origin
        outside.
    """

    samples: FloatArray
    spacing: float
    origin: float

    def __post_init__(self) -> None:
        samples = np.array(self.samples, dtype=np.float64)
        usable = samples.ndim == 1 and samples.size >= 3 and np.all(np.isfinite(samples))
        if not (usable and samples.max() > 0):
            raise InputError("a pulse needs at least three finite samples, one of them positive")
        require_positive("the spacing of a pulse's samples", self.spacing, "time")
        if not 0 <= self.origin <= samples.size - 1:
            raise InputError(
                f"the origin of a pulse must lie within its samples, got {self.origin}"
            )
        samples /= samples.max()
        samples.flags.writeable = False
        object.__setattr__(self, "samples", samples)

    @classmethod
    def gaussian(cls, fwhm: float) -> Pulse:
        """Return a Gaussian of full width at half maximum `fwhm`, s, whose arrival is its peak."""
        require_positive("the width of a pulse", fwhm, "time")
        half = int(EXTENT_FWHM * SAMPLES_PER_FWHM)
        widths = np.arange(-half, half + 1) / SAMPLES_PER_FWHM
        return cls(np.exp2(-((2 * widths) ** 2)), fwhm / SAMPLES_PER_FWHM, float(half))

    @classmethod
    def exponentially_modified(cls, fwhm: float, decay: float) -> Pulse:
        """Return a Gaussian convolved with an exponential decay, as photon-counting diodes answer a
        short pulse: of full width at half maximum `fwhm`, s, its middle, before the decay, being the
        arrival, and a time constant `decay`, s. `InputError` where these are no positive times, or
        the decay is thousands of widths.
        """
        from scipy.stats import exponnorm

        require_positive("the width of a pulse", fwhm, "time")
        require_positive("the decay of a pulse", decay, "time")
        if not EXTENT_DECAYS * decay * SAMPLES_PER_FWHM <= MAX_SAMPLES * fwhm:
            raise InputError(
                f"a decay of {decay:g} s does not go with a width of {fwhm:g} s; check their units"
            )
        before = int(EXTENT_FWHM * SAMPLES_PER_FWHM)
        after = before + int(EXTENT_DECAYS * decay / fwhm * SAMPLES_PER_FWHM)
        spacing, sigma = fwhm / SAMPLES_PER_FWHM, fwhm / FWHM_PER_SIGMA
        time = np.arange(-before, after + 1) * spacing
        return cls(exponnorm.pdf(time, decay / sigma, scale=sigma), spacing, float(before))

    def integrate_bins(self, bin_width: float) -> Pulse:
        """Return the shape that bins of `bin_width`, s, show: its light summed from half a bin
        before to half after. Sampled at the middles of bins it is, up to one factor, each bin's
        fraction of the light. `InputError` where the width is not positive, or so far from the
        pulse's that one of the units is wrong.
        """
        require_positive("the width of a bin", bin_width, "time")
        spacing = min(self.spacing, bin_width / SAMPLES_PER_BIN)
        length = (self.samples.size - 1) * self.spacing + bin_width
        if not length <= MAX_SAMPLES * spacing:
            raise InputError(
                f"a bin of {bin_width:g} s does not go with a pulse of {self.fwhm:g} s; check their units"
            )
        before, after = (
            int(np.ceil((samples * self.spacing + bin_width / 2) / spacing))
            for samples in (self.origin, self.samples.size - 1 - self.origin)
        )
        time = np.arange(-before, after + 1) * spacing
        # Integral up to each sample, by trapezoids; the light of a bin is the difference at its
        # edges.
        arrived = np.concatenate([[0.0], np.cumsum((self.samples[1:] + self.samples[:-1]) / 2)])
        edges = time[:, np.newaxis] + np.array([-0.5, 0.5]) * bin_width
        position = edges / self.spacing + self.origin
        start, end = np.interp(position, np.arange(self.samples.size), arrived).T
        return Pulse(end - start, spacing, float(before))

    def compress(self, factor: float) -> Pulse:
        """Return the same shape, `factor` times shorter."""
        return Pulse(self.samples, self.spacing / factor, self.origin)

    def __call__(self, time: ArrayLike) -> FloatArray:
        """Brightness at `time`, s, after the arrival; the peak is 1."""
        return self._interpolate(time, self.samples)

    def slope_at(self, time: ArrayLike) -> FloatArray:
        """Change of brightness per second at `time`, s, after the arrival."""
        return self._interpolate(time, self.slope)

    def _interpolate(self, time: ArrayLike, values: FloatArray) -> FloatArray:
        position = np.asarray(time, dtype=np.float64) / self.spacing + self.origin
        return np.interp(position, np.arange(values.size), values, left=0.0, right=0.0)

    @property
    def area(self) -> float:
        """Brightness summed over time, s."""
        return float(np.sum(self.samples[1:] + self.samples[:-1]) / 2 * self.spacing)

    @property
    def slope(self) -> FloatArray:
        """Change of brightness per second at each sample."""
        return np.gradient(self.samples, self.spacing)

    @property
    def fwhm(self) -> float:
        """Full width at half maximum, s."""
        first, last = self.extent(0.5)
        return last - first

    @property
    def support(self) -> tuple[float, float]:
        """First and last instant, s after the arrival, at which the pulse matters."""
        return self.extent(SUPPORT_THRESHOLD)

    def kernel_table(self, level: float = SUPPORT_THRESHOLD) -> Table:
        """Return what the compiled loops take: (n, 2) samples and their slopes, per second; and samples
        per second, origin, and the `extent` of `level`.
        """
        curve = np.stack([self.samples, self.slope], axis=1)
        return curve, (1 / self.spacing, self.origin, *self.extent(level))

    def extent(self, level: float) -> tuple[float, float]:
        """Return when the curve first rises and last falls through `level` of its peak, s."""
        above = np.flatnonzero(self.samples >= level)
        first, last = float(above[0]), float(above[-1])
        if above[0] > 0:
            low, high = self.samples[above[0] - 1 : above[0] + 1]
            first -= (high - level) / (high - low)
        if above[-1] < self.samples.size - 1:
            high, low = self.samples[above[-1] : above[-1] + 2]
            last += (high - level) / (high - low)
        return (first - self.origin) * self.spacing, (last - self.origin) * self.spacing


@dataclass(frozen=True)
class TraceBins:
    """Which bins of a time axis traces hold."""

    numbers: IntArray  # (n,), increasing
    # (n,), whether a return may lie there. Wherever one may, all bins that its search and its fit
    # look at are held
    search_mask: BoolArray
    # (n,), for how many bins of the axis each one stands where background and noise are concerned
    bin_weights: Float32Array

    @classmethod
    def all_bins(cls, bins: int) -> TraceBins:
        """Return all bins of an axis, every one for itself."""
        return cls(np.arange(bins), np.ones(bins, bool), np.ones(bins, np.float32))


class Traces(Protocol):
    """Anything that hands out pixels' traces."""

    pixels: IntArray
    """Numbers of the pixels, counted in raster order, in the order in which their traces are
    cheapest to have.
    """

    bins: TraceBins
    """The bins that they hold."""

    def fill(self, piece: slice, traces: Float32Array) -> None:
        """Write the traces of ``pixels[piece]`` into (n, bins) contiguous memory."""
        ...


class PictureTraces:
    """Traces of pictures, (bins, rows, columns), that are there already."""

    def __init__(self, pictures: Float32Array, bins: TraceBins) -> None:
        self.pictures = pictures.reshape(len(pictures), -1).astype(np.float32, copy=False)
        self.pixels, self.bins = np.arange(self.pictures.shape[1]), bins

    def fill(self, piece: slice, traces: Float32Array) -> None:
        """Write traces of neighbours in raster order."""
        from tofclip.solvers.kernels import copy_lanes_to_frames

        # contiguous: the loop is compiled for solvers' blocks, and copying short runs costs little
        copy_lanes_to_frames(np.ascontiguousarray(self.pictures[:, piece]), 0, traces)


def list_windows(
    times: FloatArray, scale: tuple[float, float, float, float], distance: float
) -> IntArray:
    """List the bins that a return at each bin reaches, and those too near for another return:
    (bins, 4) first bin reached and the one after the last; first bin nearer than `distance`, s, and
    the one after the last. `scale`: of the pulse, `tofclip.lidar.Pulse.kernel_table`. Bins are
    often just `distance` apart; what then is nearer is for the rounding of their difference to say,
    and not for that of a sum with the distance.
    """
    first = np.searchsorted(times, times - distance)
    last = np.searchsorted(times, times + distance, side="right")
    first += times - times[first] >= distance
    last -= times[last - 1] - times >= distance
    claimed = [np.searchsorted(times, times + reach) for reach in scale[2:]]
    return np.stack([*claimed, first, last], axis=1).astype(np.int64)


PHASES_PER_BIN = 64
MAX_OFFSET_BINS = 1.5  # of a return from the bin of its peak; beyond, that bin follows it
VECTOR_BINS = 16  # the table's width is a multiple of a vector's length (`tofclip.vectors`)
MAX_UNEVENNESS = 1e-3  # of a bin, over the length of a pulse: moves no return by more


class PhaseTable(NamedTuple):
    """A pulse in the bins around the one in which it has its peak, at each phase. A streak camera's
    rows last equally long, so that the pulse and its slope in the bins around a return depend on
    one number, by what part of a bin it arrives after the middle of its bin.
    """

    # (phases, width), pulse, and its change from bin to bin; zero where the pulse does not matter and
    # in the bins that fill up a whole vector. Bin w lies ``w - half`` bins after the peak's
    shapes: Float32Array
    slopes: Float32Array
    # (phases, 4 * half + width), pulse, wherever it ends. Bin w lies ``w - 3 * half`` bins after it
    tails: Float32Array
    # (phases, 7), over the bins: of squared pulse, pulse times slope, and squared slope; of the
    # pulse; of the pulse as far as the fit leaves it, and of the pulse times the square of the
    # slope across it (`tofclip.lidar.fit_kernels.estimate_deviation`); number of bins
    sums: FloatArray
    half: int  # bins on either side. 0: the axis is uneven, and the table empty
    bin_width: float  # s

    @classmethod
    def tabulate(cls, pulse: Pulse, times: FloatArray) -> PhaseTable:
        """Tabulate a pulse for a time axis of instants `times`, s."""
        width = float(times[-1] - times[0]) / (times.size - 1)
        first, last = pulse.support
        half = int(np.ceil(max(-first, last) / width + MAX_OFFSET_BINS))
        if np.ptp(np.diff(times)) * half > MAX_UNEVENNESS * width:
            nothing = np.zeros((0, VECTOR_BINS), np.float32)
            return cls(nothing, nothing, nothing, np.zeros((0, 7)), 0, width)
        phases = np.arange(round(2 * MAX_OFFSET_BINS * PHASES_PER_BIN) + 1) / PHASES_PER_BIN
        arrival = (phases - MAX_OFFSET_BINS)[:, np.newaxis]
        padded = -(-(2 * half + 1) // VECTOR_BINS) * VECTOR_BINS
        after = width * (np.arange(padded) - half - arrival)
        matters = (after >= first) & (after < last)
        shape = np.where(matters, pulse(after), 0)
        slope = np.where(matters, width * pulse.slope_at(after), 0)
        tails = pulse(width * (np.arange(4 * half + padded) - 3 * half - arrival))
        squares, mixed = np.sum(shape**2, axis=1), np.sum(shape * slope, axis=1)
        steepness = np.sum(slope**2, axis=1)
        # what a change of height cannot mimic
        across = slope - shape * (mixed / squares)[:, np.newaxis]
        across_energy = steepness - mixed**2 / squares
        # the fit's leverages
        fitted = shape**2 / squares[:, np.newaxis] + across**2 / across_energy[:, np.newaxis]
        unfitted, weighted = shape * (1 - fitted), across**2 * shape
        further = (np.sum(one, axis=1) for one in (shape, unfitted, weighted, matters))
        sums = np.stack([squares, mixed, steepness, *further], 1)
        single = (one.astype(np.float32) for one in (shape, slope, tails))
        return cls._make([*single, sums, half, width])

    def find_even_bins(self, bins: TraceBins) -> BoolArray:
        """Say around which of the bins, (n,), all those of the table are held."""
        even = np.zeros(bins.numbers.size, bool)
        if self.half > 0:
            span = bins.numbers[2 * self.half :] - bins.numbers[: -2 * self.half]
            even[self.half : self.half + span.size] = span == 2 * self.half
        return even


# of the filter that looks for candidates; it costs a tenth of the matched filter's sensitivity
SHARPENING_FACTOR = 2.0


@dataclass(frozen=True)
class PulseFilters:
    """A pulse as the search for returns on a time axis needs it."""

    # (width, bins), filter that shows candidates, and the one that judges them. Entry w is the weight
    # of bin ``j + w - width // 2`` for a return at bin j
    sharp: Float32Array
    matched: Float32Array
    sums: FloatArray  # (bins,), of the matched filters
    gains: tuple[float, float]  # (2,), largest sums of either
    table: PhaseTable
    kernel: Table  # (curve, scale), `tofclip.lidar.Pulse.kernel_table`
    fwhm: float  # of the pulse, s

    @classmethod
    def build(cls, pulse: Pulse, times: FloatArray) -> PulseFilters:
        """Work them out for instants `times`, s."""
        sharp = _build_filter(pulse.compress(SHARPENING_FACTOR), times)
        matched = _build_filter(pulse, times)
        sums = matched.sum(axis=0)
        return cls(
            sharp,
            matched,
            sums.astype(np.float64),
            (float(sharp.sum(axis=0).max()), float(sums.max())),
            PhaseTable.tabulate(pulse, times),
            pulse.kernel_table(),
            pulse.fwhm,
        )


def _build_filter(pulse: Pulse, times: FloatArray) -> Float32Array:
    """Unit-energy filter for a return at each bin, (width, bins); the time axis may be uneven. What
    a measured pulse has below zero is noise and left out. Where the axis cuts off most of the pulse
    the energy stays below one: little would be known of such a return.
    """
    before, after = pulse.support
    # what lies between two bins is reached by neither: without it rows of zeros would be applied
    half = int(np.floor(max(-before, after) / np.diff(times).min())) + 1
    filters = np.zeros((2 * half, times.size))
    for row, shift in enumerate(range(-half, half)):
        here = np.arange(max(0, -shift), min(times.size, times.size - shift))
        filters[row, here] = np.maximum(pulse(times[here + shift] - times[here]), 0)
    energy = np.sum(filters**2, axis=0)
    filters /= np.sqrt(np.maximum(energy, np.median(energy) / 2))
    return filters.astype(np.float32)
