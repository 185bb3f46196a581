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

    `nearest, farthest`: lengths of path, m.
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

    Returns its bins are `factor` times wider.
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


def remove_first_bounce(capture: Capture, margin: float, ramp: float = 0.0) -> Capture:
    """Set to 0 what arrives straight from the laser spot, by way of no hidden thing.

    That light reaches wall point r_p after the path ``|r_L - r_p|``; everything up to `margin`
    later goes with it: the instrument's response and what the wall sends on.

    `margin`: m of path, 0 or more; `ramp`: m of path over which signals then rise to their whole
    strength, as a raised cosine; a sharp edge would show as a plane at half the margin.
    """
    for name, value in (("margin after the first bounce", margin), ("ramp after it", ramp)):
        if not (np.isfinite(value) and value >= 0):
            raise InputError(f"the {name} must be 0 m or more, got {value}")
    direct = np.linalg.norm(capture.wall - capture.laser, axis=-1)
    paths = capture.axis.paths.reshape(-1, *[1] * direct.ndim)
    late = paths - (direct + margin)
    early = capture.device.put(late <= 0)
    signal = namespace(capture.signal).where(early, 0.0, capture.signal)
    if ramp > 0:
        rising = (1 - np.cos(np.pi * np.clip(np.nan_to_num(late) / ramp, 0, 1))) / 2
        signal = signal * capture.device.put(rising.astype(np.float32))
    return Capture(
        signal, capture.wall, capture.laser, capture.bin_width, capture.start, capture.provenance
    )


def flip_capture(capture: Capture, axis: str) -> Capture:
    """Mirror a capture's coordinates, and with them the picture.

    `axis`: its coordinates change sign.
    """
    if axis not in ("x", "y"):
        raise InputError(f"a capture is mirrored along x or y, not along '{axis}'")
    sign = np.ones(3)
    sign["xy".index(axis)] = -1.0
    return Capture(
        capture.signal,
        capture.wall * sign,
        capture.laser * sign,
        capture.bin_width,
        capture.start,
        capture.provenance,
    )


def fade_record_end(capture: Capture, length: float) -> Capture:
    """Let signals fade out towards the end of the record, as a raised cosine.

    Where light still comes when the record ends, its end would show as a plane.

    `length`: m of path before the end.
    """
    if not (np.isfinite(length) and length > 0):
        raise InputError(f"the record's end must fade over more than 0 m, got {length}")
    paths = capture.axis.paths
    weight = (1 - np.cos(np.pi * np.clip((paths[-1] - paths) / length, 0, 1))) / 2
    shape = (-1, *[1] * (capture.wall.ndim - 1))
    signal = capture.signal * capture.device.put(weight.reshape(shape).astype(np.float32))
    return Capture(
        signal, capture.wall, capture.laser, capture.bin_width, capture.start, capture.provenance
    )


def _select_bins(capture: Capture, bins: slice) -> Capture:
    start = float(capture.axis.paths[bins.start])
    signal = capture.signal[bins, ...]
    return Capture(
        signal, capture.wall, capture.laser, capture.bin_width, start, capture.provenance
    )
