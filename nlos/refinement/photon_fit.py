"""Albedo and background fitted to photons by expectation maximisation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.geometry import FloatArray
from nlos.refinement.counts import MIN_BACKGROUND, CountedPhotons, improve_background
from nlos.refinement.time_of_flight import TimeOfFlight

Array = NDArray[Any]

MIN_POINTS_PER_SUBSET = 16

MIN_GAIN = 1e-5
"""Gain of likelihood, relative to that over a dark scene, at which the iteration ends."""

OBLIQUITIES = (0, 1, 2)
"""Falls of light with the angle, of which the likeliest is taken."""

NOISE_SIGMAS = 3.0
"""A voxel whose neighbourhood is brighter than noise by this number of standard deviations pays little."""

FINE_SUBSETS = (4, 4, 4, 2, 2)
"""Subsets of the first passes on fine voxels; later ones treat all of the wall at once."""


class PhotonFit:
    """Albedo of some voxels, and background, fitted to photons.

    `voxels` (n,): flat indices into the model's grid; `albedo` (n,): to begin with, on any scale;
    nowhere 0; `prior_weight`: see `PhotonRefinement`. `albedo` (n,); `background` (points,):
    photons per bin; `likelihood`: logarithm of the likelihood before the last pass.
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

    def run(self, iterations: int, report_pass: Callable[[], None]) -> str:
        """Improve the albedo until the likelihood hardly grows; return why it ended.

        `iterations`: passes at most; `report_pass`: called after every pass.
        """
        for number in range(iterations):
            before = self.likelihood
            self.improve(FINE_SUBSETS[number] if number < len(FINE_SUBSETS) else 1)
            report_pass()
            if number > len(FINE_SUBSETS) and self.likelihood - before < MIN_GAIN * abs(before):
                return "converged"
        return "iteration limit"

    def improve(self, subsets: int, prior_weight: float | None = None) -> None:
        """Improve albedo and background once by every subset of the wall points.

        `prior_weight`: the fit's own by default.
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
        expected = self.expect(points)
        ratios = np.where(observed, counts / expected, 0).astype(np.float32)
        seen = self.model.backproject(ratios, self.voxels, points)
        own = self._sensitivity
        if subsets > 1:
            own = self.model.backproject(observed.astype(np.float32), self.voxels, points)
        share = len(points) / len(self._everyone)
        self.albedo *= seen / np.maximum(own + share * self._price, 1e-30)
        self.background[points] = improve_background(
            self.background[points], float(self.background.mean()), ratios, self._seen[points]
        )
        return float(np.sum(np.where(observed, counts * np.log(expected) - expected, 0)))

    def expect(self, points: Array | None = None) -> Array:
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
        known = np.where(self.photons.observed, 1 / self.expect(), 0)
        information = self.model.backproject(known, self.voxels, self._everyone, squared=True)
        return np.asarray(np.sqrt(np.maximum(information, 0)))

    def with_likeliest_model(self, sigmas: tuple[float, ...]) -> PhotonFit:
        """Return the same fit with the response and the fall with the angle under which the photons
        are likeliest.

        `sigmas`: standard deviations of responses, bins.
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
                response = build_response(sigma)
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


def compute_beam(fit: PhotonFit) -> FloatArray:
    """Return the standard deviations along z, y and x, m, to which arrival times tell the place of
    a thing in the middle of the light.

    Returns (3,).
    """
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
    # Response and the even spread over a bin, whose standard deviation is 1 / sqrt(12), add in
    # squares.
    path = spacing * np.hypot(fit.response_sigma, 12**-0.5)
    slopes = np.sqrt(np.average(gradients**2, axis=0, weights=np.broadcast_to(light, len(back))))
    return np.asarray(path / np.maximum(slopes[::-1], 1e-3))


def build_response(sigma: float) -> FloatArray:
    """Return a Gaussian response (n,), its standard deviation in bins."""
    if sigma <= 0.1:
        return np.ones(1)
    from scipy.special import ndtr

    reach = int(np.ceil(4 * sigma))
    response = np.diff(ndtr((np.arange(-reach, reach + 2) - 0.5) / sigma))
    return np.asarray(response / response.sum())
