"""From a scene to the expected streak image, ray by ray.

Nothing here uses the projection operator that recovery inverts: rays are cast from each lenslet,
and each ray's light is put on the slit where the ray falls and when it arrives.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera
from tofclip.simulate.instrument import Instrument
from tofclip.simulate.rays import FWHM_PER_SIGMA, NO_BODY, accumulate_cells, spread_pulse
from tofclip.simulate.scene import Scene
from tofclip.units import SPEED_OF_LIGHT

FloatArray = NDArray[np.float64]


class RayBundle(NamedTuple):
    """The light that one view receives."""

    x: FloatArray  # (n,), where the rays fall in the view's picture, pixels from its optical axis
    y: FloatArray  # (n,), where the rays fall in the view's picture, pixels from its optical axis
    time: FloatArray  # (n,), arrival, s after time zero
    # (n,), arbitrary units, the same for all views; proportional to reflectance / range^2
    brightness: FloatArray


def cast_view_rays(scene: Scene, instrument: Instrument, position: float) -> RayBundle:
    """Cast the rays of the view at `position` view steps; those that bring no light are left out.

    `position`: of the view, in view steps. Returns picture point in pixels, time of flight in
    seconds and brightness of each ray.
    """
    x, y = instrument.pixel_grid()
    hits = scene.trace(instrument.viewpoint(position), instrument.directions(x, y, position))
    bright = (hits.body != NO_BODY) & (hits.reflectance > 0)
    share = 1 / instrument.rays_per_pixel_side**2
    return RayBundle(
        x[bright],
        y[bright],
        2 * hits.path[bright] / SPEED_OF_LIGHT,
        # light falls with the square of the distance, on the way back from a matt surface
        share * hits.reflectance[bright] / hits.distance[bright] ** 2,
    )


def render_streak(rays: RayBundle, view: int, instrument: Instrument) -> FloatArray:
    """Put one view's light on the streak image: (rows, columns), in the units of the rays'
    brightness.

    `rays`: of the view, from `cast_view_rays`; `view`: number of the lenslet, counted from 0.
    Returns (rows, columns): time runs along the rows.
    """
    camera, detector = instrument.camera, instrument.detector
    # a cylindrical lenslet turned by the angle images a point as a slanted line, which crosses the
    # slit here
    slit = camera.centres_px[view] + rays.x - rays.y * np.tan(camera.angles[view])
    row = (rays.time + camera.time_zero) / detector.bin_width
    row, slit, stretch = _apply_sweep(camera, row, slit)
    ray, column, light = _split_over_columns(
        slit, camera.gains[view] * rays.brightness, instrument.rays_per_pixel_side
    )
    first, pulse = spread_pulse(row, stretch * compute_pulse_sigma_bins(instrument))
    reach, width = pulse.shape[1], camera.slit_width_px
    seen = (first[ray] > -reach) & (first[ray] < detector.rows) & (column >= 0) & (column < width)
    ray, column, light = ray[seen], column[seen], light[seen]
    rows = first[ray][:, np.newaxis] + np.arange(
        reach, 2 * reach
    )  # the screen has a margin for pulses it cuts off
    amount = light[:, np.newaxis] * pulse[ray]
    with_margin = accumulate_cells(
        rows * width + column[:, np.newaxis], amount, (detector.rows + 2 * reach, width)
    )
    return with_margin[reach:-reach]


def _apply_sweep(
    camera: Camera, row: FloatArray, slit: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Raw row and column of rectified positions, and how many raw rows a rectified one takes there."""
    if camera.sweep is None:
        return row, slit, np.ones_like(row)
    raw_row, raw_column = camera.sweep.raw_position(row, slit)
    # raw rows for one rectified row, which lengthen the pulse as well
    stretch = (
        camera.sweep.raw_position(row + 0.5, slit)[0]
        - camera.sweep.raw_position(row - 0.5, slit)[0]
    )
    return raw_row, raw_column, stretch


def _split_over_columns(
    position: FloatArray, light: FloatArray, side: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
    """Split each ray, 1/side of a pixel wide, exactly between the one or two slit pixels that it
    covers.

    Slit pixel j reaches from j - 1/2 to j + 1/2. Returns ray number, slit pixel and amount of
    light, piece by piece.
    """
    left_edge = position - 0.5 / side
    column = np.floor(left_edge + 0.5)
    on_next = np.clip((left_edge + 1 / side - (column + 0.5)) * side, 0.0, 1.0)
    crossing = np.flatnonzero(on_next > 0)
    return (
        np.concatenate([np.arange(position.size), crossing]),
        np.concatenate([column, column[crossing] + 1]).astype(np.intp),
        np.concatenate([light * (1 - on_next), light[crossing] * on_next[crossing]]),
    )


def compute_pulse_sigma_bins(instrument: Instrument) -> float:
    """Standard deviation of the Gaussian pulse in rows of the rectified streak image."""
    return float(instrument.camera.pulse_fwhm / FWHM_PER_SIGMA / instrument.detector.bin_width)
