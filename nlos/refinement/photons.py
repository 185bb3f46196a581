"""Refinement by photons: the hidden albedo that explains a few photons best, photon by photon."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from nlos.geometry import Grid
from nlos.method import (
    MEMORY_LIMIT_BYTES,
    Method,
    PhasorMethod,
    Plan,
    Progress,
    require_numpy_signal,
)
from nlos.refinement.counts import CountedPhotons, LikelihoodGain, fit_brightness
from nlos.refinement.photon_fit import PhotonFit, build_response, compute_beam
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

FAINT_FRACTION, FAINT_SIGMAS = 2e-3, 1.0
"""Coarse voxels fainter than this, of the brightest voxel's photons or in standard deviations of the
noise, are not looked at more closely."""

START_FRACTION = 1e-3
"""Of the brightest voxel, the least that the albedo starts from: 0 would stay 0."""

RESPONSE_SIGMAS_BINS = (0.0, 0.6, 1.2, 2.5, 5.0)
"""Instrument's responses of which the likeliest is taken."""

HELD_OUT_FRACTION, HELD_OUT_SEED = 0.1, 0
"""Of the photons, what is set aside to judge the refinement by, and the seed that chooses them."""

MIN_GAIN_SIGMAS = 3.0
"""Gain of likelihood of the photons set aside, in standard deviations, with which the refined image
is shown and not the linear one."""

FINAL_PASSES = 2
"""Passes over all photons, those that were set aside included."""

MIN_BEAM_VOXELS = 0.5
"""Standard deviation of the least sharpness that is shown, voxels."""

UNDECIDED_FRACTION = 1e-2
"""Of the brightest voxel: below, where photons decide little, voxels stand in the order of the
linear image."""

LINEAR_SHOWN = (
    "photons set aside are no likelier under the refined image: the linear image is shown"
)

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

    A tenth of the photons is set aside first and judges the fit of the others: unless these are
    likelier under it than under light as bright as in the linear image, and than under background
    alone, the linear image is what comes back (`LINEAR_SHOWN`). Otherwise the last passes take all
    photons.
    """

    linear: PhasorMethod  # gives the image to begin with
    iterations: int = 12  # passes over all photons at the end, at most
    # what faint voxels pay, relative to one standard deviation of what noise brings them; 0: the
    # likelihood alone
    prior_weight: float = 1.0
    # m of path after the wall's own light that are left out of account; they may hold anything
    blank: float = 0.0
    ramp: float = 0.0  # m of path over which the linear image's signals rise after that
    # standard deviation of the instrument's response, s; found from the photons by default
    response_sigma: float | None = None

    def plan(self, capture: Capture, grid: Grid) -> PhotonPlan:
        """Make the refinement ready for captures like `capture` on `grid`.

        `capture`: counts, or multiples of one step; any wall and lasers that `linear` can image.
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

    `linear`: of the image to begin with.
    """

    def __init__(
        self, capture: Capture, grid: Grid, method: PhotonRefinement, linear: Plan
    ) -> None:
        super().__init__(capture, grid)
        self.method, self.linear = method, linear

    @property
    def cost(self) -> int:
        """Two linear images, and as much for each pass."""
        return self.linear.cost * (2 + COARSE_PASSES + self.method.iterations)

    @property
    def memory_bytes(self) -> int:
        signals = self.geometry.axis.bins * self.geometry.wall.size // 3
        return self.linear.memory_bytes + 4 * VOLUME_COPIES * self.grid.size + 24 * signals

    def _image(self, capture: Capture, progress: Progress) -> Volume:
        photons = CountedPhotons.of(capture, self.method.blank, self.method.ramp)
        kept, held = photons.hold_out(HELD_OUT_FRACTION, HELD_OUT_SEED)
        linear = self.linear.image(photons.capture, progress)
        start = self.linear.image(kept.capture, progress).magnitude.astype(np.float32) ** 2
        passes = _PassProgress(progress, self.linear.cost, COARSE_PASSES + self.method.iterations)
        fit, linear_light = self._look_over(kept, start, passes)
        last = min(FINAL_PASSES, self.method.iterations - 1)
        stopped = fit.run(self.method.iterations - last, passes.add)
        gain = judge(fit, linear_light, held)
        values = linear.magnitude.astype(np.float32)
        if gain.nats > MIN_GAIN_SIGMAS * gain.sigma:
            fit.take(photons)
            for _ in range(last):
                fit.improve(1)
                passes.add()
            values = show_with_beam(fit, values)
        else:
            stopped = LINEAR_SHOWN
        passes.finish()
        settings = {
            "method": "photon refinement",
            "linear": type(self.linear).__name__,
            "photons": float(photons.counts.sum()),
            "photons_of_hidden_things": float(fit.expected_photons.sum()),
            "background_per_bin": float(fit.background.mean()),
            "obliquity": fit.model.obliquity,
            "response_sigma_bins": fit.response_sigma,
            "held_out_gain_nats": gain.nats,
            "held_out_gain_sigma": gain.sigma,
            "held_out_seed": HELD_OUT_SEED,
            "iterations": fit.passes,
            "stopped_because": stopped,
        }
        return Volume(values, self.grid, {**capture.provenance, "imaging": settings})

    def _look_over(
        self, photons: CountedPhotons, start: Array, progress: _PassProgress
    ) -> tuple[PhotonFit, Array]:
        """Fit coarse voxels, choose response and fall of light by them, and return a fit of the
        fine voxels that hold light, and the light (points, bins) of the linear image.
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
        seen = albedo.ravel()
        # Updates multiply: a voxel that begins at 0 would stay dark for ever.
        albedo = np.maximum(seen, START_FRACTION * seen.max())
        model = TimeOfFlight(photons.capture, grid, build_response(sigmas[len(sigmas) // 2]), 1)
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
        everyone = np.arange(len(photons.counts))
        return made, fit.model.compute_light(seen, fit.voxels, everyone)


def judge(fit: PhotonFit, linear_light: Array, held: Array) -> LikelihoodGain:
    """Compare a fit with light as bright as in the linear image, and with background alone, by
    photons that neither has seen.

    `fit`: of the photons that were kept; `linear_light` (points, bins): on any scale; `held`
    (points, bins): photons that were set aside, `HELD_OUT_FRACTION` of all. Returns over the better
    of the two.
    """
    share, photons = HELD_OUT_FRACTION / (1 - HELD_OUT_FRACTION), fit.photons
    expected = share * fit.expect()
    gains = [
        LikelihoodGain.of(held, expected, share * fit_brightness(photons, light), photons.observed)
        for light in (linear_light, np.zeros_like(linear_light))
    ]
    return min(gains, key=lambda gain: gain.nats)


def show_with_beam(fit: PhotonFit, linear: Array) -> Array:
    """Return the photons that every voxel sent to the wall, with the sharpness that response, wall
    and voxels give them.

    `linear` (z, y, x): image in whose order voxels stand that the photons decide nothing about.
    Returns (z, y, x).
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
