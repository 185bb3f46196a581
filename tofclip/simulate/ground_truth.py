"""What a perfect instrument would see from the reference viewpoint, and how near returns come to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.errors import InputError, ShapeError
from tofclip.lidar import Returns
from tofclip.shots import Frames
from tofclip.simulate.instrument import Instrument
from tofclip.simulate.rays import NO_BODY, bin_by_time, number_ray_pixels
from tofclip.simulate.render import compute_pulse_sigma_bins
from tofclip.simulate.scene import Scene
from tofclip.units import SPEED_OF_LIGHT

MIN_REFLECTANCE = 0.1  # a surface that reflects less says too little about where it is


@dataclass(frozen=True)
class GroundTruth:
    """The reference view, pixel by pixel.

    Parameters
    ----------
    range : (y, x) float32 array
        Distance along the line of sight, m, of the plate that fills most of the pixel; NaN where
        there is none.
    reflectance : (y, x) float32 array
        Diffuse reflectance times the cosine of incidence, averaged over the pixel.
    target : (y, x) bool array
        Pixels whose range can be asked for: the pixel and its eight neighbours lie on one and the
        same plate, with a reflectance of at least 0.1 everywhere.
    bin_width : float
        Duration of a bin of the shot, s, which sets the scale of range errors.
    """

    range: NDArray[np.float32]
    reflectance: NDArray[np.float32]
    target: NDArray[np.bool_]
    bin_width: float

    @classmethod
    def from_scene(cls, scene: Scene, instrument: Instrument) -> GroundTruth:
        """Look at `scene` from the reference viewpoint.

        Parameters
        ----------
        scene : Scene
        instrument : Instrument
            Its reference view, rays per pixel and detector.

        Returns
        -------
        GroundTruth
        """
        x, y = instrument.pixel_grid()
        hits = scene.trace(instrument.viewpoint(0.0), instrument.directions(x, y))
        plate, path, reflectance = (
            _group_by_pixel(values, instrument)
            for values in (hits.body, hits.path, hits.reflectance)
        )
        filled = np.stack(
            [np.mean(plate == number, axis=-1) for number in range(len(scene.bodies))]
        )
        most = np.argmax(filled, axis=0)[..., np.newaxis]
        own = plate == most
        count = own.sum(axis=-1)
        distance = np.full(count.shape, np.nan, dtype=np.float32)
        np.divide(
            (path * own).sum(axis=-1), count, out=distance, where=count > 0, casting="same_kind"
        )
        firm = np.all(reflectance >= MIN_REFLECTANCE, axis=-1)
        whole = (
            scipy.ndimage.binary_erosion((share == 1) & firm, np.ones((3, 3))) for share in filled
        )
        return cls(
            range=distance,
            reflectance=reflectance.mean(axis=-1).astype(np.float32),
            target=np.logical_or.reduce(list(whole)),
            bin_width=instrument.detector.bin_width,
        )


def render_true_frames(scene: Scene, instrument: Instrument, exposure: float = 1.0) -> Frames:
    """Transient frames that a perfect camera at the reference viewpoint would deliver, without
    noise or background.

    Parameters
    ----------
    scene : Scene
    instrument : Instrument
    exposure : float
        Photons for reflectance 1 at 1 m that fills a pixel.

    Returns
    -------
    Frames
        On the time axis of the instrument's streak images, time zero taken off.
    """
    camera, detector = instrument.camera, instrument.detector
    x, y = instrument.pixel_grid()
    hits = scene.trace(instrument.viewpoint(0.0), instrument.directions(x, y))
    pixel = number_ray_pixels(camera.image_shape, instrument.rays_per_pixel_side)
    seen = hits.body != NO_BODY
    brightness = (
        exposure
        / instrument.rays_per_pixel_side**2
        * hits.reflectance[seen]
        / hits.distance[seen] ** 2
    )
    row = (2 * hits.path[seen] / SPEED_OF_LIGHT + camera.time_zero) / detector.bin_width
    shape = (int(np.prod(camera.image_shape)), detector.rows)
    sigma = compute_pulse_sigma_bins(instrument)
    by_pixel = bin_by_time(pixel[seen], row, brightness, sigma, shape)
    values = np.ascontiguousarray(by_pixel.T, np.float32).reshape(-1, *camera.image_shape)
    times = detector.row_times - camera.time_zero
    # The reference view itself has no parallax: its pictures are those that the right shear would
    # give.
    shears = camera.shear_at(
        np.maximum(SPEED_OF_LIGHT * times / 2, detector.bin_width * SPEED_OF_LIGHT)
    )
    return Frames(values, times, camera, shears=shears)


def _group_by_pixel(values: NDArray[Any], instrument: Instrument) -> NDArray[Any]:
    """Sort flat sub-pixel values into (rows, columns, rays of the pixel)."""
    (rows, columns), side = instrument.camera.image_shape, instrument.rays_per_pixel_side
    return values.reshape(rows, side, columns, side).swapaxes(1, 2).reshape(rows, columns, side**2)


MEDIAN_PER_SIGMA = 0.6745
"""Median of the absolute value of a normal variate in units of its deviation."""


def score_returns(returns: Returns, truth: GroundTruth) -> dict[str, float]:
    """Compare each target pixel's most intense return with the true range.

    Parameters
    ----------
    returns : Returns
    truth : GroundTruth

    Returns
    -------
    dict
        ``median_depth_error_m``: median absolute range error of the target pixels that have a
        return; ``share_within_one_bin``: fraction of all target pixels whose return is within ``c *
        bin_width / 2`` of the truth, so that a missing return counts against it;
        ``share_with_return``: fraction of the target pixels that have a return;
        ``false_return_share``: fraction of all returns that lie more than a pixel away from anything
        in the scene; ``range_z``: robust standard deviation of the range errors of the target
        pixels in units of what each return says of its own, 1 if that is true; ``bin_m``: ``c *
        bin_width / 2``.

    Raises
    ------
    ShapeError, InputError
        Another picture size, or no target pixel with a return.
    """
    distance = returns.image("range")
    if distance.shape != truth.range.shape:
        raise ShapeError("the returns' picture", truth.range.shape, distance.shape)
    error = np.abs(distance - truth.range)[truth.target]
    found = np.isfinite(error)
    if not found.any():
        raise InputError("no target pixel of the truth has a return")
    sigma = returns.image("confidence")[truth.target]
    surest = np.finfo(np.float32).tiny
    ratio = error[found] / np.maximum(sigma[found], surest)
    z = float(np.median(ratio) / MEDIAN_PER_SIGMA)
    bin_m = SPEED_OF_LIGHT * truth.bin_width / 2
    # a return beside a border may belong to either side
    near_anything = scipy.ndimage.binary_dilation(np.isfinite(truth.range), np.ones((3, 3)))
    return {
        "median_depth_error_m": float(np.median(error[found])),
        "share_within_one_bin": float(np.mean(error <= bin_m)),
        "share_with_return": float(np.mean(found)),
        "false_return_share": float(np.mean(~near_anything[returns.y, returns.x])),
        "range_z": z,
        "bin_m": bin_m,
    }
