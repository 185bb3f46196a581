"""Photons that a wall counted: read from a capture, set apart, and explained by light and background."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from nlos.preparation import remove_first_bounce
from tofclip.errors import InputError

Array = NDArray[Any]

MAX_COUNT = 1 << 22
"""Photons of a bin; more are not counted one by one."""

STEP_TOLERANCE, ROUNDING = 1e-3, 2e-7
"""What a sample may be off by: of the step between counts, and of itself."""

BACKGROUND_PHOTONS = 50.0
"""Each wall point's background is drawn to the mean of all as by this number of photons."""

MIN_BACKGROUND = 1e-6
"""Photons per bin: nothing is impossible."""

BRIGHTNESS_STEPS = 10
"""Steps in which the brightness of light of a given shape is fitted."""


@dataclass(frozen=True, eq=False)
class CountedPhotons:
    """What was counted, and where."""

    capture: Capture  # for the linear image: with the wall's own light blanked
    counts: NDArray[np.float32]  # (points, bins), photons
    observed: NDArray[np.bool_]  # (points, bins), bins whose counts are taken into account

    @classmethod
    def of(cls, capture: Capture, blank: float = 0.0, ramp: float = 0.0) -> CountedPhotons:
        """Read the counts of a capture.

        `blank, ramp`: see `PhotonRefinement`.
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

    def hold_out(self, fraction: float, seed: int) -> tuple[CountedPhotons, NDArray[np.float32]]:
        """Set some photons aside, each with the same chance.

        Both parts follow Poisson's law, and one says nothing of the other's noise.

        `fraction`: the chance, 0 to 1. Returns `held` (points, bins): photons that were set aside.
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


def improve_background(background: Array, mean: float, ratios: Array, seen: Array) -> Array:
    """One step of expectation maximisation of every wall point's background, drawn to the mean.

    `background` (n,): photons per bin of some wall points, to begin with; `mean`: mean background
    of all wall points; `ratios` (n, bins): what was counted over what is expected; `seen` (n,):
    bins that are taken into account. Returns (n,).
    """
    drawn = background * ratios.sum(axis=1) + BACKGROUND_PHOTONS
    return np.asarray(np.maximum(drawn / (seen + BACKGROUND_PHOTONS / mean), MIN_BACKGROUND))


def fit_brightness(photons: CountedPhotons, light: Array) -> Array:
    """Explain photons by light of a given shape, as bright as suits them, and background.

    `light` (points, bins): on any scale. Returns (points, bins): expected photons.
    """
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
    return np.asarray(np.maximum(expected, MIN_BACKGROUND))


@dataclass(frozen=True)
class LikelihoodGain:
    """How much likelier photons are under one expectation than under another."""

    nats: float  # gain of the likelihood's logarithm
    sigma: float  # standard deviation that the photons' noise gives it

    @classmethod
    def of(cls, photons: Array, expected: Array, other: Array, observed: Array) -> LikelihoodGain:
        """Compare two expectations of the same photons.

        `photons, expected, other` (points, bins); `observed` (points, bins): bins that are taken
        into account.
        """
        counted, first, second = (
            one[observed].astype(np.float64) for one in (photons, expected, other)
        )
        logarithm = np.log(first / second)
        return cls(
            float(np.sum(counted * logarithm - (first - second))),
            float(np.sqrt(np.sum(counted * logarithm**2))),
        )
