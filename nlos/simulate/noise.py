"""Photon noise: what a counter sees of an expected signal."""

from __future__ import annotations

import numpy as np

from nlos.capture import Capture
from tofclip.arrays import require_numpy
from tofclip.errors import InputError


def add_poisson_noise(
    capture: Capture, peak_counts: float, background: float = 0.0, seed: int = 0
) -> Capture:
    """Draw Poisson counts.

    Parameters
    ----------
    capture : Capture
        Expected signal, not negative; its largest measurement maps to `peak_counts`.
    peak_counts : float
        Expected counts in the brightest bin, without background.
    background : float
        Expected counts of background, added to every bin.
    seed : int
        Of the random numbers; recorded in the provenance.

    Returns
    -------
    Capture
        Counts.

    Raises
    ------
    InputError
        The peak is not positive, the background negative, or the signal negative or dark.
    """
    if not (
        np.isfinite(peak_counts) and peak_counts > 0 and np.isfinite(background) and background >= 0
    ):
        raise InputError(
            f"counts need a positive peak and a background of 0 or more, got {peak_counts}, {background}"
        )
    require_numpy("drawing photons", capture.signal)
    brightest = float(capture.signal.max())
    if brightest <= 0 or float(capture.signal.min()) < 0:
        raise InputError(
            "photons can only be drawn from a signal that is nowhere negative and not all dark"
        )
    expected = capture.signal * (peak_counts / brightest) + background
    signal = np.random.default_rng(seed).poisson(expected).astype(np.float32)
    history = {
        **capture.provenance,
        "noise": {"peak_counts": peak_counts, "background": background, "seed": seed},
    }
    return Capture(signal, capture.wall, capture.laser, capture.bin_width, capture.start, history)
