"""From a capture and what is given about its imaging to a volume: every open setting found, every
step under a bar.
"""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from apps.nlos.methods import Imaging, ImagingSettings, build_method, choose_quickest_method
from apps.progress import show_progress
from nlos import Grid
from nlos.band import BAND_EDGE_LEVEL, VirtualPulse
from nlos.illumination_groups import group_by_illumination
from nlos.preparation import rebin_capture, remove_first_bounce
from tofclip.units import MILLIMETRE

if TYPE_CHECKING:
    from nlos import Capture, Volume
    from nlos.geometry import FloatArray
    from nlos.method import Reconstructor

VOXELS_PER_WAVELENGTH = 8
MAX_VOXELS_PER_SIDE = 256
"""A default voxel is not so small that more would fit along the longest side of the wall."""

SIGMAS_PER_WAVELENGTH = 4
WAVELENGTH_DIGITS = 2
"""Of the default wavelength in mm, rounded up."""


def preprocess_capture(capture: Capture, settings: ImagingSettings) -> Capture:
    """Blank the wall's own light and put bins together, as the settings say.

    Parameters
    ----------
    capture : Capture
    settings : ImagingSettings

    Returns
    -------
    Capture
    """
    if settings.gate_m is not None:
        capture = remove_first_bounce(capture, settings.gate_m)
    return (
        capture if settings.bins_together == 1 else rebin_capture(capture, settings.bins_together)
    )


def find_shortest_wavelength(capture: Capture, cycles: float) -> float:
    """Carrier of the shortest virtual pulse of `cycles` cycles whose whole band a capture carries,
    m.

    The band's shortest wave is sampled twice along the wall (four times in a confocal scan, where
    the path grows on both legs) and twice along the record.

    Parameters
    ----------
    capture : Capture
    cycles : float
        Of the pulse.

    Returns
    -------
    float
        Metres.
    """
    pulse = VirtualPulse(1.0, cycles)
    # the wavenumber at which the pulse's Gaussian spectrum falls to `BAND_EDGE_LEVEL`, over the
    # carrier's
    highest = 1 + math.sqrt(-2 * math.log(BAND_EDGE_LEVEL)) / (pulse.sigma * pulse.wavenumber)
    confocal = len(capture.lasers) > 1 and np.array_equal(capture.lasers, capture.points)
    across = find_sampling_step(capture) * (4 if confocal else 2)
    return highest * max(across, 2 * capture.axis.spacing)


def find_sampling_step(capture: Capture) -> float:
    """Distance of neighbouring wall points, or of the laser spots where one wall point sees them
    all, m; else 0.
    """
    if math.isfinite(capture.spacing):
        return capture.spacing
    if capture.laser.ndim == 1:
        return 0.0
    # Light runs either way: the spots sample the scene as wall points would.
    swapped = replace(capture, wall=capture.laser, laser=capture.wall).spacing
    return swapped if math.isfinite(swapped) else 0.0


class SamplingScales(NamedTuple):
    """Lengths that follow from how finely the wall is sampled, mm."""

    wavelength_mm: float
    voxel_mm: float
    sigma_mm: float


def find_scales(settings: ImagingSettings, capture: Capture) -> SamplingScales:
    """Find the lengths that are not given.

    Parameters
    ----------
    settings : ImagingSettings
    capture : Capture

    Returns
    -------
    SamplingScales
        Wavelength, voxel and sigma, mm.
    """
    wavelength, voxel, sigma = settings.wavelength_mm, settings.voxel_mm, settings.sigma_mm
    if wavelength is None:
        wavelength = _round_up(find_shortest_wavelength(capture, settings.cycles) / MILLIMETRE)
    if voxel is None:
        widest = float((capture.points.max(axis=0) - capture.points.min(axis=0)).max()) / MILLIMETRE
        voxel = max(wavelength / VOXELS_PER_WAVELENGTH, widest / MAX_VOXELS_PER_SIDE)
    return SamplingScales(
        wavelength, voxel, wavelength / SIGMAS_PER_WAVELENGTH if sigma is None else sigma
    )


def fill_box(settings: Imaging, capture: Capture, voxel: float) -> tuple[Imaging, Grid]:
    """Fill the box that is given, or the space in front of the wall where it is not, with voxels of
    `voxel` m.

    Parameters
    ----------
    settings : ImagingSettings
    capture : Capture
    voxel : float
        Metres.

    Returns
    -------
    settings : ImagingSettings
        With the limits of the box.
    grid : Grid
    """
    front = Grid.in_front_of(capture, voxel, settings.near_m, settings.far_m)
    x = _axis_limits(front.x) if settings.x_m is None else settings.x_m
    y = _axis_limits(front.y) if settings.y_m is None else settings.y_m
    near = float(front.z[0]) if settings.near_m is None else settings.near_m
    far = float(front.z[-1]) if settings.far_m is None else settings.far_m
    return replace(settings, x_m=x, y_m=y, near_m=near, far_m=far), Grid.box(
        x, y, (near, far), voxel
    )


def choose_grid(settings: Imaging, capture: Capture) -> tuple[Imaging, Grid]:
    """Find the voxels: all that the box holds, or the part that coarse voxels show to be bright.

    Half a wavelength is coarse. The quickest method with a virtual pulse looks, whichever images
    later: lct and fk make up for the loss of light with distance, and would take the noise of the
    farthest depths for the brightest things. The settings that come back hold the box itself and
    find the same voxels once more.

    Parameters
    ----------
    settings : ImagingSettings
    capture : Capture

    Returns
    -------
    settings : ImagingSettings
    grid : Grid
    """
    scales = find_scales(settings, capture)
    voxel, coarse = scales.voxel_mm * MILLIMETRE, scales.wavelength_mm * MILLIMETRE / 2
    bounded, _ = fill_box(settings, capture, voxel)
    if not settings.everywhere and voxel < coarse:
        _, whole = fill_box(bounded, capture, coarse)
        scout = build_method(choose_quickest_method(settings, capture, whole), settings)
        part = Grid.around(image_capture("looking over", scout, capture, whole), voxel)
        near, far = _axis_limits(part.z)
        bounded = replace(
            bounded, x_m=_axis_limits(part.x), y_m=_axis_limits(part.y), near_m=near, far_m=far
        )
    return fill_box(replace(bounded, everywhere=True), capture, voxel)


def image_capture(title: str, imaging: Reconstructor, capture: Capture, grid: Grid) -> Volume:
    """Image the hidden scene under a progress bar that counts look-ups or voxels, whichever the
    method does.

    Parameters
    ----------
    title : str
    imaging : Reconstructor
    capture : Capture
    grid : Grid

    Returns
    -------
    Volume

    Raises
    ------
    InputError
        The method cannot image the capture on the grid.
    """
    imaging.supports(capture, grid).require()
    lookups = getattr(imaging, "lookups", None)
    total = lookups(capture, grid) if lookups else grid.size * len(group_by_illumination(capture))
    with show_progress(title, total) as advance:
        return imaging.reconstruct(capture, grid, advance)


@contextmanager
def warnings_to_stderr() -> Iterator[None]:
    """Print what the methods warn of on standard error, each warning once and on one line."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    for text in dict.fromkeys(str(one.message) for one in caught):
        print(f"tofclip: warning: {' '.join(text.split())}", file=sys.stderr)


def _axis_limits(axis: FloatArray) -> tuple[float, float]:
    return float(axis[0]), float(axis[-1])


def _round_up(value: float) -> float:
    step = math.floor(math.log10(value)) - WAVELENGTH_DIGITS + 1
    # A value that is round already stays, whatever its last bit.
    return float(round(math.ceil(value / 10**step - 1e-9) * 10**step, max(0, -step)))
