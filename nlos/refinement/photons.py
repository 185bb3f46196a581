"""Refinement by photons: the hidden albedo that explains a few photons best, photon by photon."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from nlos.geometry import FloatArray, Grid
from nlos.method import (
    MEMORY_LIMIT_BYTES,
    Method,
    PhasorMethod,
    Plan,
    Progress,
    require_numpy_signal,
)
from nlos.preparation import remove_first_bounce
from nlos.refinement.time_of_flight import TimeOfFlight
from nlos.volume import Volume
from tofclip.errors import InputError

Array = NDArray[Any]

SUBSETS = 16
"""Parts of the wall that the albedo is improved by in turns, at first."""

COARSE_PASSES = 2
"""Passes over the wall on coarse voxels; each improves the albedo once per subset."""

MIN_COARSE_VOXELS = 8
"""Along every axis; smaller grids are not made coarser."""

MIN_POINTS_PER_SUBSET = 16

FAINT_FRACTION, FAINT_SIGMAS = 2e-3, 1.0
"""Coarse voxels fainter than this, of the brightest voxel's photons or in standard deviations of the
noise, are not looked at more closely."""

START_FRACTION = 1e-3
"""Of the brightest voxel, the least that the albedo starts from: 0 would stay 0."""

MIN_GAIN = 1e-5
"""Gain of likelihood, relative to that over a dark scene, at which the iteration ends."""

RESPONSE_SIGMAS_BINS = (0.0, 0.6, 1.2, 2.5, 5.0)
OBLIQUITIES = (0, 1, 2)
"""Instrument's responses, and falls of light with the angle, of which the likeliest are taken."""

BACKGROUND_PHOTONS = 50.0
"""Each wall point's background is drawn to the mean of all as by this number of photons."""

MIN_BACKGROUND = 1e-6
"""Photons per bin: nothing is impossible."""

MAX_COUNT = 1 << 22
"""Photons of a bin; more are not counted one by one."""

STEP_TOLERANCE, ROUNDING = 1e-3, 2e-7
"""What a sample may be off by: of the step between counts, and of itself."""

NOISE_SIGMAS = 3.0
"""A voxel whose neighbourhood is brighter than noise by this number of standard deviations pays little."""

MIN_BEAM_VOXELS = 0.5
"""Standard deviation of the least sharpness that is shown, voxels."""

UNDECIDED_FRACTION = 1e-2
"""Of the brightest voxel: below, where photons decide little, voxels stand in the order of the
linear image."""

FINE_SUBSETS = (4, 4, 4, 2, 2)
"""Subsets of the first passes on fine voxels; later ones treat all of the wall at once."""

VOLUME_COPIES = 6
"""float32 volumes held at once."""


@dataclass(frozen=True)
class PhotonRefinement(Method):
    """The non-negative hidden albedo under which the photons that were counted are likeliest.

    Every bin's count is drawn by Poisson's law about ``b_p + sum_r h(r) * a(r, p, t)``: a
    background for each wall point, and light by its time of flight (`TimeOfFlight`), without a
    virtual pulse. Expectation maximisation (Shepp and Vardi 1982) starts from the image of
    `linear`, on coarse voxels and parts of the wall first (ordered subsets: Hudson and Larkin
    1994), then on the voxels that hold light. Faint voxels pay for their light as much as noise
    would bring them, less the more light their neighbours hold. A voxel's brightness is the number
    of photons that it sent to the wall, whose noise is the same near and far; it is shown with the
    sharpness that instrument and wall give it, as CLEAN's components are with its beam.

    Of the instrument's responses and the falls with the angle that may be, the likeliest are
    taken.

    Parameters
    ----------
    linear : PhasorMethod
        Gives the image to begin with; it is what comes back where no light stands out of the
        noise.
    iterations : int
        Passes over all photons at the end, at most.
    prior_weight : float
        What faint voxels pay, relative to one standard deviation of what noise brings them; 0: the
        likelihood alone.
    blank : float
        m of path after the wall's own light that are left out of account; they may hold anything.
    ramp : float
        m of path over which the linear image's signals rise after that.
    response_sigma : float, optional
        Standard deviation of the instrument's response, s; found from the photons by default.
    """

    linear: PhasorMethod
    iterations: int = 12
    prior_weight: float = 1.0
    blank: float = 0.0
    ramp: float = 0.0
    response_sigma: float | None = None

    def plan(self, capture: Capture, grid: Grid) -> PhotonPlan:
        """Make the refinement ready for captures like `capture` on `grid`.

        Parameters
        ----------
        capture : Capture
            Counts, or multiples of one step; any wall and lasers that `linear` can image.
        grid : Grid

        Returns
        -------
        PhotonPlan

        Raises
        ------
        InputError
            `linear` cannot image such a capture on the grid, or memory does not suffice.
        """
        require_numpy_signal("refining by photons", capture)
        needed = 4 * VOLUME_COPIES * grid.size + 16 * capture.signal.size
        if needed > MEMORY_LIMIT_BYTES:
            raise InputError(
                f"refining by photons needs {needed / 2**30:.1f} GiB for {grid.size} voxels and "
                f"{capture.signal.size} bins, more than the {MEMORY_LIMIT_BYTES >> 30} GiB allowed: "
                "use larger voxels, a smaller box, or put bins together"
            )
        return PhotonPlan(capture, grid, self, self.linear.plan(capture, grid))


class PhotonPlan(Plan):
    """A refinement by photons, ready for captures of one geometry.

    Parameters
    ----------
    capture : Capture
    grid : Grid
    method : PhotonRefinement
    linear : Plan
        Of the image to begin with.
    """

    def __init__(
        self, capture: Capture, grid: Grid, method: PhotonRefinement, linear: Plan
    ) -> None:
        super().__init__(capture, grid)
        self.method, self.linear = method, linear

    @property
    def cost(self) -> int:
        """The linear image's, and as much for each pass."""
        return self.linear.cost * (1 + COARSE_PASSES + self.method.iterations)

    @property
    def memory_bytes(self) -> int:
        signals = self._axis.bins * self._wall.size // 3
        return self.linear.memory_bytes + 4 * VOLUME_COPIES * self.grid.size + 16 * signals

    def _image(self, capture: Capture, progress: Progress) -> Volume:
        photons = CountedPhotons.of(capture, self.method.blank, self.method.ramp)
        image = self.linear.image(photons.capture, progress).magnitude
        passes = _PassProgress(progress, self.linear.cost, COARSE_PASSES + self.method.iterations)
        fit = self._look_over(photons, image.astype(np.float32) ** 2, passes)
        stopped = fit.run(self.method.iterations, passes)
        passes.finish()
        settings = {
            "method": "photon refinement",
            "linear": type(self.linear).__name__,
            "photons": float(photons.counts.sum()),
            "photons_of_hidden_things": float(fit.expected_photons.sum()),
            "background_per_bin": float(fit.background.mean()),
            "obliquity": fit.model.obliquity,
            "response_sigma_bins": fit.response_sigma,
            "iterations": fit.passes,
            "stopped_because": stopped,
        }
        values = show_with_beam(fit, image)
        return Volume(values, self.grid, {**capture.provenance, "imaging": settings})

    def _look_over(
        self, photons: CountedPhotons, start: Array, progress: _PassProgress
    ) -> PhotonFit:
        """Fit coarse voxels, choose response and fall of light by them, and return a fit of the
        fine voxels that hold light.
        """
        method, axis = self.method, photons.capture.axis
        sigmas: tuple[float, ...] = RESPONSE_SIGMAS_BINS
        if method.response_sigma is not None:
            sigmas = (method.response_sigma / axis.bin_width,)
        pairs = [(size + 1) // 2 for size in self.grid.shape]
        halved = min(pairs) >= MIN_COARSE_VOXELS
        grid = _merge_pairs_of_voxels(self.grid) if halved else self.grid
        albedo = _add_pairs(start) if halved else start
        if not albedo.any():
            raise InputError("the linear image is dark: there is nothing to refine")
        albedo = np.maximum(albedo, START_FRACTION * albedo.max()).ravel()
        model = TimeOfFlight(photons.capture, grid, _build_response(sigmas[len(sigmas) // 2]), 1)
        fit = PhotonFit(photons, model, np.arange(grid.size), albedo, 0.0)
        for number in range(COARSE_PASSES):
            fit.improve(SUBSETS, method.prior_weight if number else 0.0)
            if number == 0:
                fit = fit.with_likeliest_model(sigmas)
            progress.add()
        bright = fit.expected_photons >= FAINT_FRACTION * fit.expected_photons.max()
        significant = fit.albedo * fit.compute_sharpness() >= FAINT_SIGMAS
        if np.any(bright & significant):
            bright &= significant
        shape, values = grid.shape, np.zeros(grid.size, np.float32)
        values[bright] = fit.albedo[bright]
        values, kept = values.reshape(shape), bright.reshape(shape)
        if halved:
            values, kept = (_repeat_voxels(one, self.grid.shape) for one in (values / 8, kept))
        from scipy.ndimage import binary_dilation

        kept = binary_dilation(kept, np.ones((3, 3, 3), bool))
        voxels = np.flatnonzero(kept)
        albedo = np.maximum(values.ravel()[voxels], START_FRACTION * values.max())
        fine = replace(fit.model, grid=self.grid)
        made = PhotonFit(photons, fine, voxels, albedo, method.prior_weight)
        made.background, made.response_sigma = fit.background, fit.response_sigma
        return made


@dataclass(frozen=True, eq=False)
class CountedPhotons:
    """What was counted, and where.

    Parameters
    ----------
    capture : Capture
        For the linear image: with the wall's own light blanked.
    counts : (points, bins) float32 array
        Photons.
    observed : (points, bins) bool array
        Bins whose counts are taken into account.
    """

    capture: Capture
    counts: NDArray[np.float32]
    observed: NDArray[np.bool_]

    @classmethod
    def of(cls, capture: Capture, blank: float = 0.0, ramp: float = 0.0) -> CountedPhotons:
        """Read the counts of a capture.

        Parameters
        ----------
        capture : Capture
        blank, ramp : float
            See `PhotonRefinement`.

        Returns
        -------
        CountedPhotons

        Raises
        ------
        InputError
            The signals are not counts: some are negative, or not multiples of one step.
        """
        counts = np.ascontiguousarray(capture.traces())
        if counts.min() < 0:
            raise InputError(
                "--refine photons needs photon counts, and this capture holds negative signals, as "
                "where background was taken off: leave --refine out, or give the counts themselves"
            )
        lit = counts[counts > 0]
        if lit.size == 0:
            raise InputError("every signal is 0: there is nothing to image")
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
        return cls(
            capture, np.where(observed, counts / float(lit.min()), 0).astype(np.float32), observed
        )


class PhotonFit:
    """Albedo of some voxels, and background, fitted to photons.

    Parameters
    ----------
    photons : CountedPhotons
    model : TimeOfFlight
    voxels : (n,) int array
        Flat indices into the model's grid.
    albedo : (n,) array
        To begin with, on any scale; nowhere 0.
    prior_weight : float
        See `PhotonRefinement`.

    Attributes
    ----------
    albedo : (n,) float32 array
    background : (points,) float32 array
        Photons per bin.
    likelihood : float
        Logarithm of the likelihood before the last pass.
    passes : int
    """

    def __init__(
        self,
        photons: CountedPhotons,
        model: TimeOfFlight,
        voxels: Array,
        albedo: Array,
        prior_weight: float,
    ) -> None:
        self.photons, self.model, self.voxels = photons, model, voxels
        self.prior_weight, self.passes, self.likelihood = prior_weight, 0, -np.inf
        self.response_sigma = 0.0
        self._everyone = np.arange(len(photons.counts))
        self._seen = photons.observed.sum(axis=1)
        ones = photons.observed.astype(np.float32)
        self._sensitivity = np.maximum(model.backproject(ones, voxels, self._everyone), 1e-30)
        # As if half of all photons were background: either share is soon put right.
        half = 0.5 * float(photons.counts.sum())
        total = float(np.sum(self._sensitivity * albedo))
        self.albedo = (albedo * (half / total)).astype(np.float32)
        self.background = np.full(len(ones), half / max(self._seen.sum(), 1), np.float32)
        self._price: Array = np.zeros(len(voxels), np.float32)

    @property
    def expected_photons(self) -> Array:
        """Photons that every voxel sends to the wall, (n,)."""
        return self.albedo * self._sensitivity

    def place(self, values: Array) -> Array:
        """Put values (n,) of the voxels into a volume (z, y, x)."""
        volume = np.zeros(self.model.grid.size, np.float32)
        volume[self.voxels] = values
        return volume.reshape(self.model.grid.shape)

    def run(self, iterations: int, progress: _PassProgress) -> str:
        """Improve the albedo until the likelihood hardly grows; return why it ended.

        Parameters
        ----------
        iterations : int
            Passes at most.
        progress : _PassProgress

        Returns
        -------
        str
        """
        for number in range(iterations):
            before = self.likelihood
            self.improve(FINE_SUBSETS[number] if number < len(FINE_SUBSETS) else 1)
            progress.add()
            if number > len(FINE_SUBSETS) and self.likelihood - before < MIN_GAIN * abs(before):
                return "converged"
        return "iteration limit"

    def improve(self, subsets: int, prior_weight: float | None = None) -> None:
        """Improve albedo and background once by every subset of the wall points.

        Parameters
        ----------
        subsets : int
        prior_weight : float, optional
            The fit's own by default.
        """
        subsets = max(1, min(subsets, len(self._everyone) // MIN_POINTS_PER_SUBSET))
        weight = self.prior_weight if prior_weight is None else prior_weight
        if weight > 0:
            self._price = weight * self._compute_price()
        self.likelihood = sum(
            self._improve_by(self._everyone[first::subsets], subsets) for first in range(subsets)
        )
        self.passes += 1

    def _improve_by(self, points: Array, subsets: int) -> float:
        """One step of expectation maximisation on some wall points; return their likelihood."""
        counts, observed = self.photons.counts[points], self.photons.observed[points]
        expected = self._expect(points)
        ratios = np.where(observed, counts / expected, 0).astype(np.float32)
        seen = self.model.backproject(ratios, self.voxels, points)
        own = self._sensitivity
        if subsets > 1:
            own = self.model.backproject(observed.astype(np.float32), self.voxels, points)
        share = len(points) / len(self._everyone)
        self.albedo *= seen / np.maximum(own + share * self._price, 1e-30)
        # The background of every wall point, drawn to the mean of all.
        mean = float(self.background.mean())
        drawn = self.background[points] * ratios.sum(axis=1) + BACKGROUND_PHOTONS
        fitted = drawn / (self._seen[points] + BACKGROUND_PHOTONS / mean)
        self.background[points] = np.maximum(fitted, MIN_BACKGROUND)
        return float(np.sum(np.where(observed, counts * np.log(expected) - expected, 0)))

    def _expect(self, points: Array) -> Array:
        light = self.model.compute_light(self.albedo, self.voxels, points)
        return np.maximum(light, 0) + self.background[points, np.newaxis]

    def _compute_price(self) -> Array:
        """What a voxel pays for its albedo: one standard deviation of what noise brings it, and
        less where its neighbourhood is bright.
        """
        from scipy.ndimage import gaussian_filter

        sharpness = self.compute_sharpness()
        around = gaussian_filter(self.place(self.albedo), 1.0).ravel()[self.voxels]
        return np.asarray(sharpness / (1 + around * sharpness / NOISE_SIGMAS))

    def compute_sharpness(self) -> Array:
        """Return the inverse of the standard deviation that photon noise gives each voxel's albedo,
        were it alone, (n,): the root of Fisher's information.
        """
        known = np.where(self.photons.observed, 1 / self._expect(self._everyone), 0)
        information = self.model.backproject(known, self.voxels, self._everyone, squared=True)
        return np.asarray(np.sqrt(np.maximum(information, 0)))

    def with_likeliest_model(self, sigmas: tuple[float, ...]) -> PhotonFit:
        """Return the same fit with the response and the fall with the angle under which the photons
        are likeliest.

        Parameters
        ----------
        sigmas : tuple of float
            Standard deviations of responses, bins.

        Returns
        -------
        PhotonFit
        """
        some = self._everyone[:: max(1, len(self._everyone) // 512)]
        best: tuple[float, PhotonFit] | None = None
        for obliquity in OBLIQUITIES:
            bare = replace(self.model, response=np.ones(1), obliquity=obliquity)
            fit = PhotonFit(self.photons, bare, self.voxels, self.albedo, self.prior_weight)
            light = bare.compute_light(fit.albedo, fit.voxels, some)
            # As much light as this fit found, whatever the angles.
            light *= float(self.expected_photons.sum() / fit.expected_photons.sum())
            for sigma in sigmas:
                response = _build_response(sigma)
                expected = bare.spread(light, response) + self.background[some, np.newaxis]
                terms = self.photons.counts[some] * np.log(np.maximum(expected, MIN_BACKGROUND))
                likelihood = float(np.sum((terms - expected)[self.photons.observed[some]]))
                if best is None or likelihood > best[0]:
                    chosen = fit
                    chosen.model = replace(bare, response=response)
                    chosen.response_sigma = sigma
                    best = likelihood, chosen
        assert best is not None
        found = best[1]
        found.albedo *= np.float32(
            self.expected_photons.sum() / max(float(found.expected_photons.sum()), 1e-30)
        )
        found.background = self.background
        return found


def show_with_beam(fit: PhotonFit, linear: Array) -> Array:
    """Return the photons that every voxel sent to the wall, with the sharpness that response, wall
    and voxels give them.

    Parameters
    ----------
    fit : PhotonFit
    linear : (z, y, x) array
        Image in whose order voxels stand that the photons decide nothing about.

    Returns
    -------
    (z, y, x) float32 array
    """
    from scipy.ndimage import gaussian_filter

    grid, volume = fit.model.grid, fit.place(fit.expected_photons)
    widths = compute_beam(fit)
    axes = (grid.z, grid.y, grid.x)
    sigmas = [
        max(width / float(np.median(np.diff(axis))), MIN_BEAM_VOXELS) if axis.size > 1 else 0.0
        for width, axis in zip(widths, axes, strict=True)
    ]
    shown = gaussian_filter(volume, sigmas)
    undecided = (linear / max(float(linear.max()), 1e-30)) ** 2
    return np.asarray(
        np.maximum(shown, UNDECIDED_FRACTION * float(shown.max()) * undecided), np.float32
    )


def compute_beam(fit: PhotonFit) -> FloatArray:
    """Return the standard deviations along z, y and x, m, to which arrival times tell the place of
    a thing in the middle of the light.

    Parameters
    ----------
    fit : PhotonFit

    Returns
    -------
    (3,) array
    """
    capture, grid = fit.photons.capture, fit.model.grid
    volume = fit.place(fit.expected_photons).astype(np.float64)
    axes = (grid.z, grid.y, grid.x)
    weights = [volume.sum(axis=tuple({0, 1, 2} - {i})) for i in range(3)]
    middle = np.array([np.average(a, weights=w) for a, w in zip(axes, weights, strict=True)])
    place = middle[::-1]
    back, out = place - capture.points, place - capture.lasers
    far, near = (np.linalg.norm(one, axis=1, keepdims=True) for one in (back, out))
    gradients = back / far + out / near
    light = ((far * near) ** -2.0).ravel()
    spacing = capture.axis.spacing
    path = spacing * np.hypot(fit.response_sigma, 12**-0.5)
    slopes = np.sqrt(np.average(gradients**2, axis=0, weights=np.broadcast_to(light, len(back))))
    return np.asarray(path / np.maximum(slopes[::-1], 1e-3))


class _PassProgress:
    """Progress of passes, each of which counts as much as the linear image."""

    def __init__(self, progress: Progress, cost: int, passes: int) -> None:
        self._progress, self._cost, self._left = progress, cost, passes

    def add(self) -> None:
        """Report a pass."""
        self._progress(self._cost)
        self._left -= 1

    def finish(self) -> None:
        """Report the passes that were not needed."""
        self._progress(self._cost * self._left)
        self._left = 0


def _build_response(sigma: float) -> FloatArray:
    """Return a Gaussian response, its standard deviation in bins."""
    if sigma <= 0.1:
        return np.ones(1)
    from scipy.special import ndtr

    reach = int(np.ceil(4 * sigma))
    response = np.diff(ndtr((np.arange(-reach, reach + 2) - 0.5) / sigma))
    return np.asarray(response / response.sum())


def _merge_pairs_of_voxels(grid: Grid) -> Grid:
    """Return the grid of voxels twice as large along every axis."""
    x, y, z = (
        np.add.reduceat(axis, range(0, axis.size, 2))
        / np.add.reduceat(np.ones_like(axis), range(0, axis.size, 2))
        for axis in (grid.x, grid.y, grid.z)
    )
    return Grid(x, y, z)


def _add_pairs(values: Array) -> Array:
    """Add up a volume (z, y, x) over pairs of voxels along every axis."""
    for axis in range(3):
        values = np.add.reduceat(values, range(0, values.shape[axis], 2), axis=axis)
    return values


def _repeat_voxels(values: Array, shape: tuple[int, int, int]) -> Array:
    """Repeat every voxel of a volume along every axis, cut to `shape`."""
    for axis in range(3):
        values = np.repeat(values, 2, axis=axis)
    return values[: shape[0], : shape[1], : shape[2]]
