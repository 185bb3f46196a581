"""Refinement by photons: the hidden albedo that explains a few photons best, photon by photon.

The photons that a wall counts are a linear function of the hidden albedo, by time of flight. Counts
are read from a capture and some set apart to judge by; albedo and background are fitted to the
others by expectation maximisation, on coarse voxels first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from nlos.capture import Capture, select_lasers
from nlos.method import (
    FEWER_VOXELS,
    Method,
    PhasorMethod,
    Plan,
    Progress,
    require_memory,
    require_numpy_signal,
)
from nlos.preparation import remove_first_bounce
from nlos.refinement.kernels import VOXELS_PER_RUN, add_backprojected_light, add_expected_light
from nlos.volume import Grid, Volume
from tofclip.arrays import AnyArray, BoolArray, Float32Array, FloatArray
from tofclip.errors import InputError, require
from tofclip.threads import run_blocks, thread_count

# Photons of a bin; more are not counted one by one.
MAX_COUNT = 1 << 22
# What a sample may be off by: of the step between counts, and of itself.
STEP_TOLERANCE, ROUNDING = 1e-3, 2e-7
# Each wall point's background is drawn to the mean of all as by this number of photons.
BACKGROUND_PHOTONS = 50.0
# Photons per bin: nothing is impossible.
MIN_BACKGROUND = 1e-6
# Steps in which the brightness of light of a given shape is fitted.
BRIGHTNESS_STEPS = 10


# Wall points that a thread treats at a time.
POINTS_PER_BLOCK = 64


@dataclass(frozen=True, eq=False)
class TimeOfFlight:
    """Light of hidden voxels in the bins of a capture's wall points: of albedo a, ``a / (d_L *
    d_p)^2`` after the path ``d_L + d_p``, spread over the voxel's paths, the bin, and the response.
    """

    capture: Capture  # wall, lasers and time axis are what counts
    grid: Grid
    # (n,), instrument's response in bins, of sum 1; its middle element stands for no delay
    response: FloatArray
    # light also falls with this power of the cosines of both legs with z: 0 for points that scatter
    # evenly, 2 for matte surfaces that face a matte wall; 1 lies between
    obliquity: int = 0

    def compute_light(self, albedo: AnyArray, voxels: AnyArray, points: AnyArray) -> AnyArray:
        """Return the light (m, bins) of voxels (n,), flat indices, at points (m,)."""
        bins = self.capture.axis.bins
        light = np.empty((len(points), bins), np.float32)
        places, albedo = np.take(self._places, voxels, axis=1), np.asarray(albedo, np.float32)

        def process_block(some: slice) -> None:
            changes = np.zeros((some.stop - some.start, bins + 2))
            add_expected_light(*self._pairs(points[some]), *self._scale, places, albedo, changes)
            light[some] = np.cumsum(changes[:, :bins], axis=1)

        run_blocks(process_block, len(points), POINTS_PER_BLOCK)
        return self.spread(light, self.response)

    def backproject(
        self, values: AnyArray, voxels: AnyArray, points: AnyArray, squared: bool = False
    ) -> AnyArray:
        """Return what voxels (n,) see of values (m, bins): the adjoint of `compute_light`; of
        `squared` light and the inverse of the counts it is Fisher's information.
        """
        # Running sums from the end on: a box of light is the difference of two, see the kernel. The
        # response is turned around, as the adjoint of a convolution asks for.
        bins = self.capture.axis.bins
        sums = np.zeros((len(points), bins + 2), np.float32)
        spread = self.spread(values, self.response[::-1])
        np.cumsum(spread[:, ::-1], axis=1, out=sums[:, bins - 1 :: -1])
        places, pairs = np.take(self._places, voxels, axis=1), self._pairs(points)
        total = np.zeros(len(voxels), np.float32)

        def process_block(some: slice) -> None:
            block = np.ascontiguousarray(places[:, some])
            add_backprojected_light(*pairs, *self._scale, block, sums, squared, total[some])

        size = max(VOXELS_PER_RUN, -(-len(voxels) // (4 * thread_count())))
        run_blocks(process_block, max(len(voxels), 1), size)
        return total

    @cached_property
    def _places(self) -> Float32Array:
        return np.ascontiguousarray(self.grid.points.reshape(-1, 3).T, np.float32)

    @cached_property
    def _scale(self) -> tuple[AnyArray, np.float32, np.float32, int]:
        """Extent of a voxel, path of the record's beginning, bins per metre, obliquity."""
        axes = (self.grid.x, self.grid.y, self.grid.z)
        cell = [float(np.median(np.diff(axis))) if axis.size > 1 else 0.0 for axis in axes]
        axis = self.capture.axis
        start = np.float32(axis.start - axis.spacing / 2)
        return np.array(cell, np.float32), start, np.float32(1 / axis.spacing), self.obliquity

    def _pairs(self, points: AnyArray) -> tuple[AnyArray, AnyArray]:
        pairs = self.capture.points[points], select_lasers(self.capture, points)
        return pairs[0].astype(np.float32), pairs[1].astype(np.float32)

    def spread(self, values: AnyArray, response: FloatArray) -> AnyArray:
        """Convolve values (m, bins) with a response (n,) in time, whose middle is no delay."""
        from scipy.ndimage import convolve1d

        values = np.asarray(values, np.float32)
        if response.size > 1:
            values = convolve1d(values, response, axis=1, mode="constant")
        return values


@dataclass(frozen=True, eq=False)
class CountedPhotons:
    """What was counted, and where."""

    capture: Capture  # for the linear image: with the wall's own light blanked
    counts: Float32Array  # (points, bins), photons
    observed: BoolArray  # (points, bins), bins whose counts are taken into account

    @classmethod
    def of(cls, capture: Capture, blank: float = 0.0, ramp: float = 0.0) -> CountedPhotons:
        """Read the counts of a capture; `blank` and `ramp` as of `PhotonRefinement`."""
        counts = np.ascontiguousarray(capture.traces())
        if counts.min() < 0:
            raise InputError(
                "--refine photons needs photon counts, and this capture holds negative signals, as "
                "where background was taken off: leave --refine out, or give the counts themselves"
            )
        lit = counts[counts > 0]
        require(lit.size != 0, "every signal is 0: there is nothing to image")
        steps = lit.astype(np.float64) / float(lit.min())
        off = np.abs(steps - np.round(steps))
        if steps.max() > MAX_COUNT or np.any(off > STEP_TOLERANCE + ROUNDING * steps):
            raise InputError(
                "--refine photons needs photon counts, and this capture's signals are not multiples "
                "of one step: leave --refine out, or give the counts themselves"
            )
        observed = np.ones(counts.shape, bool)
        if blank > 0:
            direct = np.linalg.norm(capture.points - capture.lasers, axis=1)
            observed = capture.axis.paths > (direct + blank)[:, np.newaxis]
            capture = remove_first_bounce(capture, blank, ramp)
        counted = np.where(observed, counts / float(lit.min()), 0).astype(np.float32)
        return cls(capture, counted, observed)

    def hold_out(self, fraction: float, seed: int) -> tuple[CountedPhotons, Float32Array]:
        """Set some photons aside (points, bins) by chance: Poisson's law makes both parts
        independent.
        """
        lit, held = self.counts > 0, np.zeros_like(self.counts)
        counts = np.rint(self.counts[lit]).astype(np.int64)
        held[lit] = np.random.default_rng(seed).binomial(counts, fraction)
        kept = self.counts - held
        left = np.divide(kept, self.counts, out=np.ones_like(held), where=lit)
        capture = self.capture
        signal = capture.signal.reshape(capture.axis.bins, -1).copy()
        signal[:, capture.valid.ravel()] *= left.T
        thinned = replace(capture, signal=signal.reshape(capture.signal.shape))
        return replace(self, capture=thinned, counts=kept), held


def improve_background(
    background: AnyArray, mean: float, ratios: AnyArray, seen: AnyArray
) -> AnyArray:
    """One step of expectation maximisation of the background (n,), photons per bin, drawn to the
    `mean`; `ratios` (n, bins): counts over what is expected; `seen` (n,): bins that count.
    """
    drawn = background * ratios.sum(axis=1) + BACKGROUND_PHOTONS
    return np.maximum(drawn / (seen + BACKGROUND_PHOTONS / mean), MIN_BACKGROUND)


def fit_brightness(photons: CountedPhotons, light: AnyArray) -> AnyArray:
    """Expected photons (points, bins) by the brightest likely light of a given shape."""
    counts, observed = photons.counts, photons.observed
    seen, lit = observed.sum(axis=1), float(light[observed].sum())
    half = 0.5 * float(counts.sum())
    # As if half of all photons were background: either part is soon put right.
    scale = half / max(lit, 1e-30)
    background = np.full(len(counts), half / max(int(seen.sum()), 1), np.float32)
    expected = scale * light + background[:, np.newaxis]
    for _ in range(BRIGHTNESS_STEPS):
        ratios = np.where(observed, counts / np.maximum(expected, MIN_BACKGROUND), 0)
        scale *= float(np.sum(light * ratios)) / max(lit, 1e-30)
        mean = float(np.sum(background * ratios.sum(axis=1))) / max(int(seen.sum()), 1)
        background = improve_background(background, mean, ratios, seen)
        expected = scale * light + background[:, np.newaxis]
    return np.maximum(expected, MIN_BACKGROUND)


def compare_likelihoods(
    photons: AnyArray, expected: AnyArray, other: AnyArray, observed: AnyArray
) -> tuple[float, float]:
    """Gain of the logarithm of the likelihood of photons (points, bins) by one expectation over
    another, where observed, nats, and the standard deviation that their noise gives it.
    """
    counted, first, second = (
        one[observed].astype(np.float64) for one in (photons, expected, other)
    )
    logarithm = np.log(first / second)
    gain = np.sum(counted * logarithm - (first - second))
    return float(gain), float(np.sqrt(np.sum(counted * logarithm**2)))


MIN_POINTS_PER_SUBSET = 16

# Gain of likelihood, relative to that over a dark scene, at which the iteration ends.
MIN_GAIN = 1e-5
# Falls of light with the angle, of which the likeliest is taken.
OBLIQUITIES = (0, 1, 2)
# A voxel whose neighbourhood is brighter than noise by so many standard deviations pays little.
NOISE_SIGMAS = 3.0
# Subsets of the first passes on fine voxels; later ones treat all of the wall at once.
FINE_SUBSETS = (4, 4, 4, 2, 2)


class PhotonFit:
    """Albedo (n,) of voxels, flat indices into the model's grid, and background (points,), photons
    per bin, fitted to photons; the albedo begins on any scale, nowhere 0.
    """

    def __init__(
        self,
        photons: CountedPhotons,
        model: TimeOfFlight,
        voxels: AnyArray,
        albedo: AnyArray,
        prior_weight: float,
    ) -> None:
        self.photons, self.model, self.voxels = photons, model, voxels
        self.prior_weight, self.passes, self.likelihood = prior_weight, 0, -np.inf
        self.response_sigma = 0.0
        self._everyone = np.arange(len(photons.counts))
        self._seen = photons.observed.sum(axis=1)
        ones = photons.observed.astype(np.float32)
        self._sensitivity = np.maximum(model.backproject(ones, voxels, self._everyone), 1e-30)
        # As if half of all photons were background: either part is soon put right.
        half = 0.5 * float(photons.counts.sum())
        total = float(np.sum(self._sensitivity * albedo))
        self.albedo = (albedo * (half / total)).astype(np.float32)
        self.background = np.full(len(ones), half / max(self._seen.sum(), 1), np.float32)
        self._penalty: AnyArray = np.zeros(len(voxels), np.float32)

    @property
    def expected_photons(self) -> AnyArray:
        """Photons that every voxel sends to the wall, (n,)."""
        return self.albedo * self._sensitivity

    def place(self, values: AnyArray) -> AnyArray:
        """Put values (n,) of the voxels into a volume (z, y, x)."""
        volume = np.zeros(self.model.grid.size, values.dtype)
        volume[self.voxels] = values
        return volume.reshape(self.model.grid.shape)

    def run(self, iterations: int, report_pass: Callable[[], None]) -> str:
        """Improve the albedo until the likelihood hardly grows; return why it ended."""
        for number in range(iterations):
            before = self.likelihood
            self.improve(FINE_SUBSETS[number] if number < len(FINE_SUBSETS) else 1)
            report_pass()
            if number > len(FINE_SUBSETS) and self.likelihood - before < MIN_GAIN * abs(before):
                return "converged"
        return "iterations done"

    def improve(self, subsets: int, prior_weight: float | None = None) -> None:
        """Improve albedo and background once by every subset of the wall points."""
        from scipy.ndimage import gaussian_filter

        subsets = max(1, min(subsets, len(self._everyone) // MIN_POINTS_PER_SUBSET))
        weight = self.prior_weight if prior_weight is None else prior_weight
        if weight > 0:
            # Noise's standard deviation, less where neighbours are bright.
            sharpness = self.compute_sharpness()
            around = gaussian_filter(self.place(self.albedo), 1.0).ravel()[self.voxels]
            self._penalty = weight * sharpness / (1 + around * sharpness / NOISE_SIGMAS)
        self.likelihood = sum(
            self._improve_by(self._everyone[first::subsets], subsets) for first in range(subsets)
        )
        self.passes += 1

    def _improve_by(self, points: AnyArray, subsets: int) -> float:
        """One step of expectation maximisation on some wall points; return their likelihood."""
        counts, observed = self.photons.counts[points], self.photons.observed[points]
        expected = self.expect(points)
        ratios = np.where(observed, counts / expected, 0).astype(np.float32)
        seen = self.model.backproject(ratios, self.voxels, points)
        own = self._sensitivity
        if subsets > 1:
            own = self.model.backproject(observed.astype(np.float32), self.voxels, points)
        fraction = len(points) / len(self._everyone)
        self.albedo *= seen / np.maximum(own + fraction * self._penalty, 1e-30)
        self.background[points] = improve_background(
            self.background[points], float(self.background.mean()), ratios, self._seen[points]
        )
        return float(np.sum(np.where(observed, counts * np.log(expected) - expected, 0)))

    def expect(self, points: AnyArray | None = None) -> AnyArray:
        """Return the photons expected at some wall points, all by default, (points, bins)."""
        points = self._everyone if points is None else points
        light = self.model.compute_light(self.albedo, self.voxels, points)
        return np.maximum(light, 0) + self.background[points, np.newaxis]

    def take(self, photons: CountedPhotons) -> None:
        """Go on with other photons of the same scene and bins, and as bright a scene as they say."""
        more = float(photons.counts.sum() / self.photons.counts.sum())
        self.photons = photons
        self.albedo *= np.float32(more)
        self.background *= np.float32(more)

    def compute_sharpness(self) -> AnyArray:
        """Return the root of Fisher's information (n,): over it, noise of a lone voxel's albedo."""
        known = np.where(self.photons.observed, 1 / self.expect(), 0)
        information = self.model.backproject(known, self.voxels, self._everyone, squared=True)
        return np.sqrt(np.maximum(information, 0))

    def with_likeliest_model(self, sigmas: tuple[float, ...]) -> PhotonFit:
        """Return the same fit with the response, of `sigmas` in bins, and the obliquity that are
        likeliest.
        """
        some = self._everyone[:: max(1, len(self._everyone) // 512)]
        found, best = self, -np.inf
        for obliquity in OBLIQUITIES:
            bare = replace(self.model, response=np.ones(1), obliquity=obliquity)
            fit = PhotonFit(self.photons, bare, self.voxels, self.albedo, self.prior_weight)
            light = bare.compute_light(fit.albedo, fit.voxels, some)
            # As much light as this fit found, whatever the angles.
            light *= float(self.expected_photons.sum() / fit.expected_photons.sum())
            for sigma in sigmas:
                response = build_response(sigma)
                expected = bare.spread(light, response) + self.background[some, np.newaxis]
                terms = self.photons.counts[some] * np.log(np.maximum(expected, MIN_BACKGROUND))
                likelihood = float(np.sum((terms - expected)[self.photons.observed[some]]))
                if likelihood > best:
                    found, best = fit, likelihood
                    found.model = replace(bare, response=response)
                    found.response_sigma = sigma
        found.albedo *= np.float32(
            self.expected_photons.sum() / max(float(found.expected_photons.sum()), 1e-30)
        )
        found.background = self.background
        return found


def compute_beam(fit: PhotonFit) -> FloatArray:
    """Return the standard deviations along z, y and x, m, to which arrival times tell a place."""
    capture, grid = fit.photons.capture, fit.model.grid
    volume = fit.place(fit.expected_photons).astype(np.float64)
    axes = (grid.z, grid.y, grid.x)
    weights = [volume.sum(axis=tuple({0, 1, 2} - {i})) for i in range(3)]
    middle = np.array([np.average(a, weights=w) for a, w in zip(axes, weights, strict=True)])
    place = middle[::-1]
    back, out = place - capture.points, place - capture.lasers
    far, near = (np.linalg.norm(one, axis=1, keepdims=True) for one in (back, out))
    # The path's gradient at a place is the sum of both legs' unit vectors.
    gradients = back / far + out / near
    light = ((far * near) ** -2.0).ravel()
    spacing = capture.axis.spacing
    # Response and even spread over a bin, of 1 / sqrt(12), add in squares.
    path = spacing * np.hypot(fit.response_sigma, 12**-0.5)
    slopes = np.sqrt(np.average(gradients**2, axis=0, weights=np.broadcast_to(light, len(back))))
    return path / np.maximum(slopes[::-1], 1e-3)


def build_response(sigma: float) -> FloatArray:
    """Return a Gaussian response (n,), its standard deviation in bins."""
    if sigma <= 0.1:
        return np.ones(1)
    from scipy.special import ndtr

    reach = int(np.ceil(4 * sigma))
    response = np.diff(ndtr((np.arange(-reach, reach + 2) - 0.5) / sigma))
    return response / response.sum()


# Parts of the wall that the albedo is improved by in turns, at first.
SUBSETS = 16
# Passes over the wall on coarse voxels; each improves the albedo once per subset.
COARSE_PASSES = 2
# Along every axis; smaller grids are not made coarser.
MIN_COARSE_VOXELS = 8
# Coarse voxels fainter than this, of the brightest's photons or of noise, are left at that.
FAINT_FRACTION, FAINT_SIGMAS = 2e-3, 1.0
# Of the brightest voxel, the least that the albedo starts from: 0 would stay 0.
START_FRACTION = 1e-3
# Instrument's responses of which the likeliest is taken.
RESPONSE_SIGMAS_BINS: tuple[float, ...] = (0.0, 0.6, 1.2, 2.5, 5.0)
# Of the photons, what is set aside to judge the refinement by, and the seed that chooses them.
HELD_OUT_FRACTION, HELD_OUT_SEED = 0.1, 0
# Gain of the held-out photons' likelihood, in its noise, that shows the refined image.
MIN_GAIN_SIGMAS = 3.0
# Passes over all photons, those that were set aside included.
FINAL_PASSES = 2
# Standard deviation of the least sharpness that is shown, voxels.
MIN_BEAM_VOXELS = 0.5
# Of the brightest voxel: below, voxels stand in the order of the linear image.
UNDECIDED_FRACTION = 1e-2
LINEAR_SHOWN = (
    "photons set aside are no likelier under the refined image: the linear image is shown"
)

# float32 volumes held at once.
VOLUME_COPIES = 6


@dataclass(frozen=True)
class PhotonRefinement(Method):
    """The non-negative hidden albedo under which the photons that were counted are likeliest.

    Counts are drawn by Poisson's law about ``b_p + sum_r h(r) * a(r, p, t)``: a background for each
    wall point, and light by its time of flight (`TimeOfFlight`). Expectation maximisation (Shepp
    and Vardi 1982) starts from the image of `linear`, on coarse voxels and parts of the wall first
    (ordered subsets: Hudson and Larkin 1994), then on the voxels that hold light. Faint voxels pay
    for their light as much as noise would bring them, less where neighbours are bright. Brightness
    is the number of photons that a voxel sent to the wall, shown with the sharpness that instrument
    and wall give it. Of responses and falls with the angle the likeliest are taken.

    A tenth of the photons is set aside and judges the fit of the others: unless these are likelier
    under it than under light as bright as in the linear image, and than under background alone, the
    linear image comes back (`LINEAR_SHOWN`). Otherwise the last passes take all photons.
    """

    linear: PhasorMethod  # gives the image to begin with
    iterations: int = 12  # passes over all photons at the end, at most
    # what faint voxels pay, in standard deviations of noise; 0: the likelihood alone
    prior_weight: float = 1.0
    # m of path after the wall's own light that are left out of account; they may hold anything
    blank: float = 0.0
    ramp: float = 0.0  # m of path over which the linear image's signals rise after that
    # standard deviation of the instrument's response, s; found from the photons by default
    response_sigma: float | None = None

    def plan(self, capture: Capture, grid: Grid) -> PhotonPlan:
        require_numpy_signal("refining by photons", capture)
        needed = 4 * VOLUME_COPIES * grid.size + 16 * capture.signal.size
        what = f"{grid.size} voxels and {capture.signal.size} bins to refine by photons"
        require_memory(needed, what, f"{FEWER_VOXELS}, or put bins together")
        return PhotonPlan(capture, grid, self, self.linear.plan(capture, grid))


class PhotonPlan(Plan):
    """A refinement by photons, ready for captures of one geometry; begins with a linear image."""

    def __init__(
        self, capture: Capture, grid: Grid, method: PhotonRefinement, linear: Plan
    ) -> None:
        super().__init__(capture, grid)
        self.method, self.linear = method, linear
        # two linear images, and as much for each pass
        self.cost = linear.cost * (2 + COARSE_PASSES + method.iterations)
        signals = capture.axis.bins * capture.valid.size
        self.memory_bytes = linear.memory_bytes + 4 * VOLUME_COPIES * grid.size + 24 * signals

    def _image(self, capture: Capture, progress: Progress) -> Volume:
        photons = CountedPhotons.of(capture, self.method.blank, self.method.ramp)
        kept, held = photons.hold_out(HELD_OUT_FRACTION, HELD_OUT_SEED)
        linear = self.linear.image(photons.capture, progress)
        start = self.linear.image(kept.capture, progress).magnitude.astype(np.float32) ** 2
        report_pass = partial(progress, self.linear.cost)
        fit, linear_light = self._look_over(kept, start, report_pass)
        last = min(FINAL_PASSES, self.method.iterations - 1)
        stopped = fit.run(self.method.iterations - last, report_pass)
        gain, noise = judge(fit, linear_light, held)
        values = linear.magnitude.astype(np.float32)
        if gain > MIN_GAIN_SIGMAS * noise:
            fit.take(photons)
            for _ in range(last):
                fit.improve(1)
                report_pass()
            values = show_with_beam(fit, values)
        else:
            stopped = LINEAR_SHOWN
        # those that were not needed
        progress(self.linear.cost * (self.method.iterations - fit.passes))
        settings = {
            "method": "photon refinement",
            "linear": type(self.linear).__name__,
            "photons": float(photons.counts.sum()),
            "photons_of_hidden_things": float(fit.expected_photons.sum()),
            "background_per_bin": float(fit.background.mean()),
            "obliquity": fit.model.obliquity,
            "response_sigma_bins": fit.response_sigma,
            "held_out_gain_nats": gain,
            "held_out_gain_sigma": noise,
            "held_out_seed": HELD_OUT_SEED,
            "iterations": fit.passes,
            "stopped_because": stopped,
        }
        return Volume(values, self.grid, {**capture.provenance, "imaging": settings})

    def _look_over(
        self, photons: CountedPhotons, start: AnyArray, report_pass: Callable[[], None]
    ) -> tuple[PhotonFit, AnyArray]:
        """Fit coarse voxels, choose the model by them, and return a fit of the fine voxels that
        hold light, and the linear image's light (points, bins).
        """
        from scipy.ndimage import binary_dilation

        method, sigmas = self.method, RESPONSE_SIGMAS_BINS
        if method.response_sigma is not None:
            sigmas = (method.response_sigma / photons.capture.bin_width,)
        grid, halved = self.grid, min(self.grid.shape) >= 2 * MIN_COARSE_VOXELS - 1
        if halved:
            axes = (grid.x, grid.y, grid.z)
            last = (np.append(axis[1::2], axis[-1])[: (axis.size + 1) // 2] for axis in axes)
            grid = Grid(*((a[::2] + b) / 2 for a, b in zip(axes, last, strict=True)))
            for axis in range(3):
                start = np.add.reduceat(start, range(0, start.shape[axis], 2), axis=axis)
        require(start.any(), "the linear image is dark: there is nothing to refine")
        seen = start.ravel()
        # Updates multiply: a voxel that begins at 0 would stay dark for ever.
        albedo = np.maximum(seen, START_FRACTION * seen.max())
        model = TimeOfFlight(photons.capture, grid, build_response(sigmas[len(sigmas) // 2]), 1)
        fit = PhotonFit(photons, model, np.arange(grid.size), albedo, 0.0)
        for number in range(COARSE_PASSES):
            fit.improve(SUBSETS, method.prior_weight if number else 0.0)
            if number == 0:
                fit = fit.with_likeliest_model(sigmas)
            report_pass()
        bright = fit.expected_photons >= FAINT_FRACTION * fit.expected_photons.max()
        significant = fit.albedo * fit.compute_sharpness() >= FAINT_SIGMAS
        if np.any(bright & significant):
            bright &= significant
        values, kept = fit.place(np.where(bright, fit.albedo, 0)), fit.place(bright)
        if halved:
            halves = np.ix_(*(np.arange(n) // 2 for n in self.grid.shape))
            values, kept = values[halves] / 8, kept[halves]
        voxels = np.flatnonzero(binary_dilation(kept, np.ones((3, 3, 3), bool)))
        albedo = np.maximum(values.ravel()[voxels], START_FRACTION * values.max())
        fine = replace(fit.model, grid=self.grid)
        made = PhotonFit(photons, fine, voxels, albedo, method.prior_weight)
        made.background, made.response_sigma = fit.background, fit.response_sigma
        return made, fit.model.compute_light(seen, fit.voxels, np.arange(len(photons.counts)))


def judge(fit: PhotonFit, linear_light: AnyArray, held: AnyArray) -> tuple[float, float]:
    """Return the smaller gain of a fit, by photons held out, over light (points, bins) as bright as
    in the linear image and over background alone, and its standard deviation.
    """
    ratio, photons = HELD_OUT_FRACTION / (1 - HELD_OUT_FRACTION), fit.photons
    expected = ratio * fit.expect()
    others = [fit_brightness(photons, one) for one in (linear_light, np.zeros_like(linear_light))]
    return min(compare_likelihoods(held, expected, ratio * o, photons.observed) for o in others)


def show_with_beam(fit: PhotonFit, linear: AnyArray) -> AnyArray:
    """Return the photons that voxels sent, as sharp as response and wall tell; where they decide
    nothing, voxels stand in the order of `linear`.
    """
    from scipy.ndimage import gaussian_filter

    grid = fit.model.grid
    sigmas = [
        max(width / float(np.median(np.diff(axis))), MIN_BEAM_VOXELS) if axis.size > 1 else 0.0
        for width, axis in zip(compute_beam(fit), (grid.z, grid.y, grid.x), strict=True)
    ]
    shown = gaussian_filter(fit.place(fit.expected_photons), sigmas)
    undecided = (linear / max(float(linear.max()), 1e-30)) ** 2
    least = UNDECIDED_FRACTION * float(shown.max()) * undecided
    return np.asarray(np.maximum(shown, least), np.float32)
