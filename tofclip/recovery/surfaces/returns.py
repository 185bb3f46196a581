"""The returns of fitted surfaces: which points there are, and how far off each may be."""

from __future__ import annotations

import numpy as np
import scipy

from tofclip.camera import Camera
from tofclip.lidar import Detection
from tofclip.lidar.range_correction import correct_returns
from tofclip.recovery.surfaces.fit import SurfaceFit
from tofclip.recovery.surfaces.model import FloatArray, Image
from tofclip.shots import Returns
from tofclip.threads import limit_blas_threads
from tofclip.units import SPEED_OF_LIGHT

SURE_SIGMAS = 20.0  # points of which a surface certainly consists
UPPER_QUANTILE = 0.9
MIN_BRIGHTNESS_FRACTION = 0.25  # of the surface's usual brightness: light beside its border is less
EVEN_RATIO, EVEN_PX = 1.1, 31  # amplitudes as bright, and the side of the square where they count
NEIGHBOURHOOD_PX = 7  # side of the square whose measurements decide whether a point is there


@limit_blas_threads()
def list_returns(fit: SurfaceFit, detection: Detection, centre_error_px: float = 0.0) -> Returns:
    """List the points that stand out of the noise and of their neighbourhood, pixel by pixel.

    `detection`: which points are returned; `centre_error_px`: how far off the calibration had each
    slit centre, as for `tofclip.recovery.Shot`.
    """
    model, solver = fit.model, fit.solver
    camera = model.camera.replace(gains=model.state.gains)
    distance, amplitude = model.distance, solver.amplitude
    # A pixel alone is hardly above the photons' noise: its neighbours on the surface, which the
    # prior ties to it, count as well.
    pictures, information = np.zeros((2, *model.masks.shape), np.float32)
    information[model.masks] = model.gather(model.weights, squared=True)
    pictures[model.masks] = amplitude
    pooled = np.stack([pool_information(*one) for one in zip(information, pictures, strict=True)])
    # running sums may leave a rounding error below nothing
    pooled = np.maximum(pooled, 0)
    significance = amplitude * np.sqrt(pooled[model.masks] / solver.variance)
    deviation = model.estimate_deviation(fit.refinement.covariances)
    deviation = np.hypot(deviation, fit.remainder[model.surface])
    displacement = estimate_displacement(camera, centre_error_px)
    deviation = np.hypot(deviation, np.hypot(*(displacement * model.compute_slopes().T).T))
    # brightness is told as the reference view sees it
    intensity = model.shade(model.reference, amplitude) * distance**2
    limit = detection.signal_to_noise
    usual = np.zeros(len(model.masks))
    for one in range(usual.size):
        own = model.surface == one
        usual[one] = find_usual_brightness(amplitude[own], significance[own], limit)
    bright = np.flatnonzero(
        (significance > limit) & (amplitude > MIN_BRIGHTNESS_FRACTION * usual[model.surface])
    )
    strong = detection.find_significant(
        model.pixel[bright],
        2 * distance[bright] / SPEED_OF_LIGHT,
        intensity[bright],
        camera.pulse_fwhm,
    )
    chosen = bright[strong]
    chosen = chosen[np.lexsort((distance[chosen], model.pixel[chosen]))]
    y, x = np.divmod(model.pixel[chosen], camera.image_shape[1])
    starts = np.flatnonzero(np.diff(model.pixel[chosen], prepend=-1))
    rank = np.arange(chosen.size) - np.repeat(starts, np.diff(starts, append=chosen.size)) + 1
    measured = Returns(
        y=y.astype(np.int32),
        x=x.astype(np.int32),
        range=distance[chosen],
        intensity=intensity[chosen].astype(np.float32),
        confidence=deviation[chosen].astype(np.float32),
        return_number=rank.astype(np.uint8),
        time=2 * distance[chosen] / SPEED_OF_LIGHT,
        camera=camera,
        shear=np.asarray(camera.shear_at(distance[chosen])),
    )
    return correct_returns(measured)


def estimate_displacement(camera: Camera, centre_error_px: float) -> FloatArray:
    """Return how far errors of the slit centres displace the picture to the right and down, px.

    Of errors e_v a shot shows all but what looks like a displaced picture, ``e_v = dx - dy
    tan(angle_v)``. That part is taken to be that of errors which alternate, as of neighbouring
    lenslets measured in turns; independent ones would leave sqrt(views) as much.

    `centre_error_px`: how far off the calibration had each slit centre, as for
    `tofclip.recovery.Shot`. Returns (2,).
    """
    in_turns = (-1.0) ** np.arange(camera.views)
    looks = np.stack([np.ones(camera.views), -np.tan(camera.angles)], axis=1)
    found: FloatArray = np.abs(np.linalg.pinv(looks) @ in_turns) * centre_error_px
    return found


def pool_information(information: Image, picture: Image) -> Image:
    """Return the information about each pixel's amplitude, with that of pixels tied to it.

    These are the nearest ones, and those further off that the prior has made as bright: where little
    is known of each pixel it leaves large even pieces, whose amplitude all their pixels determine.

    `information` (rows, columns): of each pixel alone, one over the variance of its amplitude;
    `picture` (rows, columns): amplitudes. Returns (rows, columns).
    """

    def add_up(values: Image, side: int) -> Image:
        mean: Image = scipy.ndimage.uniform_filter(values, side, mode="constant")
        return side**2 * mean

    pooled = add_up(information, NEIGHBOURHOOD_PX)
    level = np.zeros(picture.shape, np.intp)
    lit = picture > 0
    level[lit] = np.floor(np.log(picture[lit]) / np.log(EVEN_RATIO)).astype(np.intp)
    for one in np.unique(level[lit]):
        even = lit & (np.abs(level - one) <= 1)
        own = lit & (level == one)
        wide = add_up(np.where(even, information, 0), EVEN_PX)
        pooled[own] = np.maximum(pooled[own], wide[own])
    found: Image = pooled
    return found


def find_usual_brightness(amplitude: Image, significance: Image, limit: float) -> float:
    """Return the usual amplitude of the points of which a surface certainly consists.

    `amplitude, significance` (points,): of the surface; significance in standard deviations;
    `limit`: standard deviations below which there is no point. Returns infinite if no point is
    sure.
    """
    if amplitude.size == 0:
        return float("inf")
    # In little light no point is that far out of the noise, but some are further than others.
    upper = float(np.quantile(significance, UPPER_QUANTILE))
    sure = amplitude[significance > min(SURE_SIGMAS, max(limit, upper / 2))]
    return float(np.median(sure)) if sure.size else float("inf")
