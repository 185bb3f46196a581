"""What is done to a capture before it is imaged: cutting the record, putting bins together, gating
the wall's glare.

All of it where the capture's signal lives.
"""

from __future__ import annotations

import numpy as np

from nlos.capture import Capture
from tofclip.arrays import namespace
from tofclip.errors import InputError


def crop_capture(capture: Capture, nearest: float, farthest: float) -> Capture:
    """Keep the bins that hold paths from `nearest` to `farthest`.

    Parameters
    ----------
    capture : Capture
    nearest, farthest : float
        Lengths of path, m.

    Returns
    -------
    Capture

    Raises
    ------
    InputError
        Fewer than two bins are left.
    """
    paths = capture.axis.paths
    kept = np.flatnonzero((paths >= nearest) & (paths <= farthest))
    if kept.size < 2:
        raise InputError(
            f"fewer than two bins hold paths from {nearest:.4g} to {farthest:.4g} m; the record runs from "
            f"{paths[0]:.4g} to {paths[-1]:.4g} m"
        )
    return _select_bins(capture, slice(int(kept[0]), int(kept[-1]) + 1))


def rebin_capture(capture: Capture, factor: int) -> Capture:
    """Add up every `factor` neighbouring bins; bins left over at the end are dropped.

    Counts stay counts. Bins much finer than the wall's sampling carry noise and cost time: path per
    bin of about the distance of neighbouring wall points loses nothing.

    Parameters
    ----------
    capture : Capture
    factor : int

    Returns
    -------
    Capture
        Its bins are `factor` times wider.

    Raises
    ------
    InputError
        Fewer than two bins are left.
    """
    bins = capture.axis.bins // factor if factor >= 1 else 0
    if bins < 2:
        raise InputError(
            f"{capture.axis.bins} bins cannot be put together by {factor}; at least two must be left"
        )
    xp = namespace(capture.signal)
    kept = xp.reshape(
        capture.signal[: bins * factor, ...], (bins, factor, *capture.signal.shape[1:])
    )
    # A bin stands for its middle.
    start = capture.start + (factor - 1) / 2 * capture.axis.spacing
    bin_width = factor * capture.bin_width
    return Capture(
        xp.sum(kept, axis=1), capture.wall, capture.laser, bin_width, start, capture.provenance
    )


def remove_first_bounce(capture: Capture, margin: float) -> Capture:
    """Set to 0 what arrives straight from the laser spot, without a hidden thing on its path.

    That light reaches wall point r_p after the path ``|r_L - r_p|``; everything up to `margin`
    later goes with it: the instrument's response and what the wall sends on.

    Parameters
    ----------
    capture : Capture
    margin : float
        Length of path, m.

    Returns
    -------
    Capture

    Raises
    ------
    InputError
        The margin is negative or not finite.
    """
    if not (np.isfinite(margin) and margin >= 0):
        raise InputError(f"the margin after the first bounce must be 0 m or more, got {margin}")
    direct = np.linalg.norm(capture.wall - capture.laser, axis=-1)
    paths = capture.axis.paths.reshape(-1, *[1] * direct.ndim)
    early = capture.device.put(paths <= direct + margin)
    signal = namespace(capture.signal).where(early, 0.0, capture.signal)
    return Capture(
        signal, capture.wall, capture.laser, capture.bin_width, capture.start, capture.provenance
    )


def _select_bins(capture: Capture, bins: slice) -> Capture:
    start = float(capture.axis.paths[bins.start])
    signal = capture.signal[bins, ...]
    return Capture(
        signal, capture.wall, capture.laser, capture.bin_width, start, capture.provenance
    )
