"""Time zero, range walk, the pixels' offsets and response, and reflectance, from shots of a target at
known distances; and returns corrected by what their camera knows of them.

The target is flat, faces the camera and shows in most pixels. A measured range is

    ``R / cos(angle) + time zero + walk(signal) + jitter of the shot + offset of the pixel + noise``

with the distance R along the optical axis. So a measurement of pixel p in shot s is ``A theta + b_s +
o_p + noise``: fixed effects theta, and shots and pixels whose own effects are drawn from normal
distributions with unknown variances. These variances are estimated with the effects (restricted maximum
likelihood by the EM algorithm: Laird and Ware, Biometrics 38, 963 (1982)), so that an effect that the
measurements do not show is pulled to zero and standard deviations hold whatever varies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import AnyArray, BoolArray, FloatArray, IntArray
from tofclip.camera import Camera, RangeCalibration
from tofclip.camera.model import compute_ray_directions
from tofclip.errors import CalibrationError, InputError, require_positive
from tofclip.shots import Returns
from tofclip.units import MAD_TO_SIGMA, MILLIMETRE, SPEED_OF_LIGHT

# at most: a rough estimate to tell what does not belong, then the one that counts
EM_ROUNDS = 10, 60
EM_TOLERANCE = 5e-3  # relative change of the variances below which they are known
MAX_FITTED_PIXELS = 4096  # that say how large the variances are; all pixels are solved for
OUTLIER_SIGMA = 4.5  # a measurement beyond is left out: of normal errors, one in 150,000
CORRELATION_BLOCK_PX = 6
TINY = 1e-30

MIN_WALK_SHOTS = 3
# of the returns' intensities, a factor of two; a walk from less would be noise drawn out
MIN_WALK_SPAN_DECADES = 0.3
# from here on the walk is a parabola of the decades, below a straight line
MIN_CURVED_WALK_SHOTS, CURVED_WALK_SPAN_DECADES = 6, 1.0
SPAN_PERCENTILES = (2.0, 98.0)

WINDOW_PULSES = 0.5  # returns of one surface lie within this many pulse widths

# In the dark a detector announces a return in a pixel of a hundred, at any range; rays and false
# alarms agree by chance in patches of a few pixels across.
MIN_TARGET_PIXELS, MIN_TARGET_FRACTION = 3, 0.005
# Of the whole picture's brightest returns. What is dimmer may be a trace that a recovery leaves of
# them elsewhere: in the dark corners of a recorded scene these had 0.2 to 0.5 % (method tv).
MIN_TARGET_BRIGHTNESS, BRIGHTEST_PERCENTILE = 0.02, 99.0
# Of the returns that are not that dim: a plate is most of what is seen, cluttered scenes 0.05 to 0.5.
MIN_TARGET_SHARE = 0.5
# Returns up to a window's width before and behind the target, over the target's: none beside a plate,
# as many as within on a surface that goes on in depth.
MAX_FLANK_RATIO = 0.25
# Median distance from the target's plane in half widths of the window, which holds six deviations: a
# plate's noise makes 0.11 of it at most, depths that fill the window evenly make 0.5.
MAX_ROUGHNESS = 0.2
MAX_RIVAL_FRACTION = 0.7  # of the target's returns, that another surface may have
MAX_SHOT_SPREAD_PULSES = 1.0  # by which the shots' time zeros may differ
MAX_BRIGHTNESS_RATIO = 1.5  # of shots that are said to show one reflectance
SHOW_A_PLATE = "show a flat plate that faces the camera, or cut the picture to it (`region`)"


class Measurements(NamedTuple):
    """Measurements of one quantity in many pixels and several shots, (n,) each."""

    value: FloatArray
    sigma: FloatArray  # one standard deviation, right up to a factor
    design: FloatArray  # (n, effects), fixed effects
    shot: IntArray  # numbers from 0
    pixel: IntArray  # numbers from 0
    y: IntArray  # row and column of the pixel
    x: IntArray

    def keep(self, chosen: BoolArray) -> Measurements:
        return Measurements._make(part[chosen] for part in self)


class Effects(NamedTuple):
    """What was found."""

    fixed: FloatArray
    shots: FloatArray  # each shot's own
    pixels: FloatArray  # each pixel's own, and its variance
    pixel_variance: FloatArray
    covariance: FloatArray  # of the fixed effects; while it is solved for of these and the shots'
    residual: FloatArray
    fitted_variance: FloatArray  # of what is fitted to each measurement
    # factor of the measurements' own variances, variances of the shots' and of the pixels' effects
    variances: FloatArray
    inliers: BoolArray  # measurements that were used


def fit_effects(data: Measurements, with_shots: bool, with_pixels: bool) -> Effects:
    """Estimate all effects and what they vary by; shots and pixels have effects of their own or not."""
    sizes = int(data.shot.max()) + 1, int(data.pixel.max()) + 1
    step = -(-sizes[1] // MAX_FITTED_PIXELS)
    inliers = np.ones(data.value.size, bool)
    for rounds in EM_ROUNDS:
        some = data.keep(inliers & (data.pixel % step == 0))
        variances = _estimate_variances(
            some, sizes, np.array([True, with_shots, with_pixels]), rounds
        )
        found = _solve(data.keep(inliers), variances, sizes)
        predicted = data.design @ found.fixed + found.shots[data.shot] + found.pixels[data.pixel]
        distance = np.abs(data.value - predicted) / (data.sigma * np.sqrt(variances[0]))
        inliers = distance < OUTLIER_SIGMA
    used = data.keep(inliers)
    found = _solve(used, variances, sizes)
    # Errors that neighbours share do not average out: as many measurements as are independent.
    shared = measure_correlation(found.residual / (used.sigma * np.sqrt(variances[0])), used)
    effects = data.design.shape[1]
    fewer = variances * [shared, 1, 1]
    covariance = _solve(used, fewer, sizes).covariance[:effects, :effects]
    without = _solve(used, fewer * [1, 0, 1], sizes).covariance[:effects, :effects]
    # What a handful of shots say of their own spread is uncertain itself: Student's t.
    freedom = max(sizes[0] - effects, 1)
    widened = float(scipy.special.stdtrit(freedom, scipy.special.ndtr(1.0))) ** 2
    covariance = without + widened * (covariance - without)
    return found._replace(covariance=covariance, inliers=inliers)


def measure_correlation(standardised: FloatArray, data: Measurements) -> float:
    """Return how many neighbouring pixels share one error: variance of the sums of residuals, in
    standard deviations, over blocks of pixels, over that of independent errors; 1 where the difference
    is within chance.
    """
    blocks = np.stack([data.shot, *(np.stack(data[-2:]) // CORRELATION_BLOCK_PX)])
    _, block, number = np.unique(blocks, axis=1, return_inverse=True, return_counts=True)
    sums = np.bincount(block.ravel(), standardised)
    large = number > CORRELATION_BLOCK_PX
    if large.sum() < 2:
        return 1.0
    mean_square = float(np.mean(standardised**2))
    excess = float(np.mean(sums[large] ** 2 / number[large])) / max(mean_square, TINY)
    # The mean of m squares of normal numbers varies by the root of 2 / m.
    chance = 3 * np.sqrt(2 / large.sum())
    return excess if excess > 1 + chance else 1.0


def _estimate_variances(
    data: Measurements, sizes: tuple[int, int], present: BoolArray, rounds: int
) -> FloatArray:
    """Estimate what varies, from the scatter of the means over shots and over pixels. `sizes`:
    numbers of shots and of pixels; `present`: that there is noise, and whether these have effects of
    their own.
    """
    alone = np.array([1.0, 0.0, 0.0])
    effects = data.design.shape[1]
    if data.value.size <= effects:
        # Nothing is left over that would tell the noise: the measurements' own deviations hold.
        return alone
    start = _solve(data, alone, sizes)
    scatter = float(np.mean(start.residual**2 / data.sigma**2))
    typical, spread = scatter * float(np.median(data.sigma**2)), [scatter]
    for group in (data.shot, data.pixel):
        number = np.bincount(group)
        seen = number > 0
        means = np.bincount(group, start.residual)[seen] / number[seen]
        # at least what the noise alone makes of the means
        spread.append(max(float(np.var(means)), typical * means.size / group.size))
    least = TINY * alone
    now: FloatArray = np.maximum(present * spread, least)
    pixels = np.unique(data.pixel)
    for _ in range(rounds):
        found, before = _solve(data, now, sizes), now
        squares = (
            (found.residual**2 + found.fitted_variance) / data.sigma**2,
            found.shots**2 + np.diagonal(found.covariance)[effects:],
            (found.pixels**2 + found.pixel_variance)[pixels],
        )
        now = np.maximum(present * [np.mean(one) for one in squares], least)
        if np.all(np.abs(now - before) <= EM_TOLERANCE * before):
            break
    return now


def _solve(data: Measurements, variances: FloatArray, sizes: tuple[int, int]) -> Effects:
    """Solve for all effects at once; those of pixels are eliminated first. What does not vary is held
    at zero by a variance of next to nothing.
    """
    shots, pixels = sizes
    noise, *own_variances = variances
    for_shots, for_pixels = 1 / np.maximum(own_variances, TINY)
    weight, effects = 1 / (noise * data.sigma**2), data.design.shape[1]
    design = np.hstack([data.design, data.shot[:, np.newaxis] == np.arange(shots)])
    weighted = design * weight[:, np.newaxis]
    total = np.bincount(data.pixel, weight, pixels) + for_pixels
    gathered = np.stack([np.bincount(data.pixel, part, pixels) for part in weighted.T], 1)
    leverage = gathered / total[:, np.newaxis]
    own_moment = np.bincount(data.pixel, weight * data.value, pixels) / total
    normal = design.T @ weighted - gathered.T @ leverage
    normal += np.diag(np.repeat([0, for_shots], [effects, shots]))
    # Columns of very different units are scaled, so that none is lost in rounding.
    scale = 1 / np.sqrt(np.maximum(np.diagonal(normal), TINY))
    scales = np.outer(scale, scale)
    covariance = np.linalg.pinv(normal * scales, hermitian=True) * scales
    theta = covariance @ (weighted.T @ data.value - gathered.T @ own_moment)
    own = own_moment - leverage @ theta
    # effects as they are seen beside the measurement's pixel
    beside = design - leverage[data.pixel]
    return Effects(
        theta[:effects],
        theta[effects:],
        own,
        1 / total + np.einsum("pi,ij,pj->p", leverage, covariance, leverage),
        covariance,
        data.value - design @ theta - own[data.pixel],
        np.einsum("ni,ij,nj->n", beside, covariance, beside) + 1 / total[data.pixel],
        variances,
        np.ones(data.value.size, bool),
    )


def correct_returns(returns: Returns) -> Returns:
    """Undo range walk and the pixels' offsets where the camera knows them, where returns are
    listed. Ranges, times and intensities are corrected; deviations get the calibration's.
    """
    known = returns.camera.range_calibration
    if known is None:
        return returns
    seen = returns.range, count_signal(returns), returns.confidence.astype(np.float64)
    distance, intensity, sigma = correct_ranges(known, *seen, (returns.y, returns.x))
    return replace(
        returns,
        range=distance,
        intensity=intensity.astype(np.float32),
        confidence=sigma.astype(np.float32),
        time=2 * distance / SPEED_OF_LIGHT,
    )


def correct_ranges(
    known: RangeCalibration,
    distance: FloatArray,
    signal: FloatArray,
    sigma: FloatArray,
    pixel: tuple[NDArray[np.integer], NDArray[np.integer]],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Undo range walk and the pixels' offsets; return ranges, counts referred to 1 m, and
    deviations. `distance, sigma` (n,): ranges as they were measured and one standard deviation, m;
    `signal` (n,): counts of the returns; `pixel`: rows and columns.
    """
    excess, further = known.compute_excess(signal, *pixel)
    corrected = distance - excess
    return corrected, signal * corrected**2, np.hypot(sigma, further)


def count_signal(returns: Returns) -> FloatArray:
    """Counts of returns, which list what they would have at 1 m."""
    return returns.intensity / np.maximum(returns.range**2, np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class TargetShot:
    """What was seen of a target at a known distance."""

    returns: Returns  # as measured, without a range calibration, from the camera's time zero
    distance: float  # of the target along the optical axis, m
    record: tuple[float, float]  # its first and last time of flight, s, from the same time zero
    name: str = "the shot"  # for messages
    reflectance_percent: float = np.nan  # of the target; NaN where it is not known
    # counts of the whole picture's brightest returns, where `returns` are those of a part of it
    brightest: float = np.nan

    def __post_init__(self) -> None:
        require_positive("a target's distance", self.distance, "length")
        percent = self.reflectance_percent
        if not (np.isnan(percent) or 0 < percent <= 1000):
            raise InputError(f"a reflectance must be a positive percentage, got {percent}")

    def cut(self, inside: BoolArray) -> TargetShot:
        """Return the shot with a part of its returns, and what is known of the others."""
        return replace(self, returns=self.returns[inside], brightest=self.measure_brightest())

    def measure_brightest(self) -> float:
        """Counts of the whole picture's brightest returns."""
        if not np.isnan(self.brightest) or not len(self.returns):
            return float(np.nan_to_num(self.brightest))
        return float(np.percentile(count_signal(self.returns), BRIGHTEST_PERCENTILE))


@dataclass(frozen=True)
class RangeFit:
    """A camera whose ranges are calibrated, and what the fit looked like."""

    camera: Camera  # with its time zero and range calibration
    jitter: float  # one standard deviation of the shots' own time zeros, s; NaN of a single shot
    offset_spread: float  # one standard deviation of the pixels' offsets, m; NaN of a single shot
    signal: FloatArray  # (n,), counts of the returns that were fitted
    excess: FloatArray  # (n,), m that they measured too long, but for offsets of pixels and shots
    target_fraction: float  # of the pixels with a return, those whose return is the target's
    walk_note: str  # why a part was not fitted; empty where it was
    offsets_note: str  # of the response as well

    @property
    def calibration(self) -> RangeCalibration:
        """The camera's range calibration."""
        known = self.camera.range_calibration
        assert known is not None
        return known


class _Sample(NamedTuple):
    """The target's returns of one shot or of all, side by side."""

    shot: IntArray
    pixel: IntArray
    y: IntArray
    x: IntArray
    excess: FloatArray
    sigma: FloatArray
    signal: FloatArray
    cosine: FloatArray


def fit_range_calibration(shots: Sequence[TargetShot], walk: bool | None = None) -> RangeFit:
    """Calibrate ranges by shots of a target at known distances.

    From three shots on, of different brightness, they give the range walk; from two on the pixels'
    offsets and response. `walk`: whether it must be fitted, or must not; by default where the shots
    can tell it.
    """
    if not shots:
        raise InputError("a range calibration needs a shot of a target")
    base = shots[0].returns.camera
    pulse = SPEED_OF_LIGHT / 2 * base.pulse_fwhm
    distances = [shot.distance for shot in shots]
    length = min(shot.record[1] - shot.record[0] for shot in shots) * SPEED_OF_LIGHT / 2
    if np.ptp(distances) > length:
        raise CalibrationError(
            f"the targets lie {np.ptp(distances):.3g} m apart, and the record shows {length:.3g} m: "
            "one of them is out of the record"
        )
    found = [_select_target(number, shot, base, pulse) for number, shot in enumerate(shots)]
    samples, shares = zip(*found, strict=True)
    sample = _Sample(*map(np.concatenate, zip(*samples, strict=True)))
    _require_agreement(shots, sample, pulse)
    span = np.percentile(np.log10(sample.signal), SPAN_PERCENTILES)
    walk_note = _explain_missing_walk(len(shots), span, walk)
    curved = len(shots) >= MIN_CURVED_WALK_SHOTS and np.ptp(span) >= CURVED_WALK_SPAN_DECADES
    order = 0 if walk_note else 1 + int(curved)
    reference = float(10 ** np.median(np.log10(sample.signal)))
    # What shifts a return with its brightness, a threshold on an edge above all, goes by factors of
    # brightness: hence decades. From the usual brightness, so that the constant is the time zero of
    # a usual return.
    decades = np.log10(sample.signal / reference)
    walks = np.vander(decades, order + 1, increasing=True)
    data = Measurements(sample.excess, sample.sigma, walks, *sample[:4])
    repeated = len(shots) > 1
    effects = fit_effects(data, repeated, repeated)
    calibration = RangeCalibration(
        time_zero_sigma=float(np.sqrt(effects.covariance[0, 0]) * 2 / SPEED_OF_LIGHT),
        walk=effects.fixed[1:],
        walk_covariance=effects.covariance[1:, 1:],
        reference_signal=reference,
        signal_range=10**span,
    )
    jitter, spread = np.sqrt(effects.variances[1:]) if repeated else (np.nan, np.nan)
    if repeated:
        sigma = np.sqrt(effects.pixel_variance)
        calibration = replace(
            calibration,
            offsets=_to_picture(effects.pixels, base.image_shape),
            offset_sigma=_to_picture(sigma, base.image_shape, spread),
        )
    calibration = _add_brightness(calibration, shots, sample, effects, base)
    late = float(effects.fixed[0]) * 2 / SPEED_OF_LIGHT
    excess = sample.excess - effects.shots[sample.shot] - effects.pixels[sample.pixel]
    once = "one shot does not tell the pixels' own from noise: give two or more"
    return RangeFit(
        base.replace(time_zero=late, range_calibration=calibration),
        float(jitter) * 2 / SPEED_OF_LIGHT,
        float(spread),
        sample.signal[effects.inliers],
        excess[effects.inliers] - effects.fixed[0],
        min(shares),
        walk_note,
        "" if repeated else once,
    )


def _select_target(
    number: int, shot: TargetShot, camera: Camera, pulse: float
) -> tuple[_Sample, float]:
    """Keep the strongest return of each pixel where it is the target's, with its excess over the
    target's range, from the start of the time axis rather than any time zero; and return the share of
    pixels with a return in which it is. `pulse`: its width, m.
    """
    if shot.returns.camera.image_shape != camera.image_shape:
        raise CalibrationError(
            f"{shot.name}: its picture has {shot.returns.camera.image_shape} pixels, the camera's "
            f"{camera.image_shape}"
        )
    found = shot.returns.select("strongest")
    pixels = camera.image_shape[0] * camera.image_shape[1]
    needed = min(max(MIN_TARGET_PIXELS, round(MIN_TARGET_FRACTION * pixels)), pixels)
    missing = CalibrationError(
        f"{shot.name}: no return stands out in {needed} or more pixels: is the target in the record "
        "and in the picture, and large enough?"
    )
    if len(found) == 0:
        raise missing
    signal, brightest = count_signal(found), shot.measure_brightest()
    clear = signal >= MIN_TARGET_BRIGHTNESS * brightest
    if not clear.any():
        raise CalibrationError(
            f"{shot.name}: no plate: its returns have {np.median(signal):.3g} counts at "
            f"most places, the picture's brightest {brightest:.3g}: a trace of these; {SHOW_A_PLATE}"
        )
    found, signal = found[clear], np.maximum(signal[clear], TINY)
    # A plate across the axis is farther along slanted lines of sight: its distance is over the
    # cosine.
    cosine = compute_ray_directions(camera, found.y, found.x)[:, 2]
    excess = found.range - shot.distance / cosine
    sigma = np.maximum(found.confidence.astype(np.float64), np.finfo(np.float32).tiny)
    # In few photons ranges scatter by more than a pulse: six standard deviations hold them.
    width = max(WINDOW_PULSES * pulse, 6 * float(np.median(sigma)))
    target = _find_cluster(excess, width, shot.name)
    if target.sum() < needed:
        raise missing
    _require_plate(excess, sigma, target, width, (found.y, found.x), shot.name)
    arrival = 2 / SPEED_OF_LIGHT * float(np.median(found.range[target]))
    margin = camera.pulse_fwhm / 2
    if not shot.record[0] + margin <= arrival <= shot.record[1] - margin:
        raise CalibrationError(
            f"{shot.name}: the target's return is cut off by the end of the record; move the "
            "target or the record"
        )
    # Whatever time zero the shot was recovered with is put back: it is what is to be found.
    zero = SPEED_OF_LIGHT / 2 * shot.returns.camera.time_zero
    y, x = found.y[target].astype(np.int64), found.x[target].astype(np.int64)
    place = np.full(y.size, number), y * camera.image_shape[1] + x, y, x
    seen = (part[target] for part in (excess + zero, sigma, signal, cosine))
    return _Sample(*place, *seen), float(target.mean())


def _require_plate(
    excess: FloatArray,
    sigma: FloatArray,
    target: BoolArray,
    width: float,
    place: tuple[AnyArray, AnyArray],
    name: str,
) -> None:
    """Refuse returns that agree by chance, or as those of a slanted or uneven surface do."""
    share = float(target.mean())
    middle = float(np.median(excess[target]))
    flank = np.count_nonzero(~target & (np.abs(excess - middle) <= 3 * width)) / target.sum()
    y, x = (np.asarray(axis[target], dtype=np.float64) for axis in place)
    plane = np.stack([np.ones(y.size), y - y.mean(), x - x.mean()], axis=1)
    slope, *_ = np.linalg.lstsq(plane, excess[target], rcond=None)
    left = excess[target] - plane @ slope
    rough = float(np.median(np.abs(left - np.median(left))))
    if share < MIN_TARGET_SHARE:
        fault = "clutter"
    elif flank > MAX_FLANK_RATIO:
        fault = "a surface that goes on in depth"
    elif rough > MAX_ROUGHNESS * width:
        fault = "an uneven surface"
    else:
        return
    raise CalibrationError(
        f"{name}: no plate but {fault}: {target.sum()} of {target.size} returns ({share:.0%}) agree to "
        f"{width / MILLIMETRE:.2g} mm, {flank:.0%} as many lie just before and behind, and they scatter by "
        f"{MAD_TO_SIGMA * rough / MILLIMETRE:.2g} mm about a plane where "
        f"{np.median(sigma[target]) / MILLIMETRE:.2g} mm is stated; {SHOW_A_PLATE}"
    )


def _find_cluster(excess: FloatArray, width: float, name: str) -> BoolArray:
    """Say which returns lie in the window that holds most of them, and refuse a rival to it."""

    def find_fullest(values: FloatArray) -> FloatArray:
        """What lies in the fullest of the windows that begin at each value."""
        order = np.sort(values)
        inside = np.searchsorted(order, order + width, side="right") - np.arange(order.size)
        first = int(np.argmax(inside))
        return order[first : first + inside[first]]

    middle = float(np.median(find_fullest(excess)))
    target: BoolArray = np.abs(excess - middle) <= width
    rival = excess[~target]
    if rival.size and (rival := find_fullest(rival)).size > MAX_RIVAL_FRACTION * target.sum():
        raise CalibrationError(
            f"{name}: two surfaces as large as each other, {abs(rival[0] - middle):.3g} m apart: "
            "which is the target? Cut the picture to it (`region`)"
        )
    return target


def _require_agreement(shots: Sequence[TargetShot], sample: _Sample, pulse: float) -> None:
    """Refuse a shot whose target is not where its distance and the other shots put it."""
    places = np.array([np.median(sample.excess[sample.shot == n]) for n in range(len(shots))])
    off = places - np.median(places)
    worst = int(np.argmax(np.abs(off)))
    limit = max(MAX_SHOT_SPREAD_PULSES * pulse, 6 * float(np.median(sample.sigma)))
    if abs(off[worst]) > limit:
        raise CalibrationError(
            f"{shots[worst].name}: its target comes {off[worst]:+.3g} m from where the other shots "
            "put it: check its distance (`target`)"
        )


def _explain_missing_walk(shots: int, span: FloatArray, asked: bool | None) -> str:
    """Say why no walk can be fitted, if so; refuse where one is asked for."""
    if asked is False:
        return "not asked for"
    if shots < MIN_WALK_SHOTS:
        note = f"a range walk needs {MIN_WALK_SHOTS} shots of different brightness, got {shots}"
    elif np.ptp(span) < MIN_WALK_SPAN_DECADES:
        note = (
            f"the returns' intensities span a factor of {10 ** np.ptp(span):.2g}, a range walk needs "
            f"{10**MIN_WALK_SPAN_DECADES:.2g}: take shots through a grey filter or at other distances"
        )
    else:
        return ""
    if asked:
        raise CalibrationError(note)
    return note


def _add_brightness(
    calibration: RangeCalibration,
    shots: Sequence[TargetShot],
    sample: _Sample,
    effects: Effects,
    camera: Camera,
) -> RangeCalibration:
    """Add the pixels' response and the scale of reflectance, from logarithms of intensities; `effects`
    of the ranges say what belongs to the target.
    """
    used = _Sample._make(part[effects.inliers] for part in sample)
    # The range that the calibration gives: that of the target, up to noise.
    distance = np.array([one.distance for one in shots])[used.shot] / used.cosine
    # A surface that faces the camera looks darker at an angle, by Lambert's law.
    value = np.log(used.signal * distance**2 / used.cosine)
    sigma = 1 / np.sqrt(np.maximum(used.signal, 1.0))
    design = (used.shot[:, np.newaxis] == np.arange(len(shots))).astype(np.float64)
    data = Measurements(value, sigma, design, *used[:4])
    brightness = fit_effects(data, with_shots=False, with_pixels=len(shots) > 1)
    if len(shots) > 1:
        response = _to_picture(np.exp(brightness.pixels), camera.image_shape, 1.0)
        calibration = replace(calibration, response=response)
    percent = np.array([one.reflectance_percent for one in shots])
    known = np.isfinite(percent)
    if not known.any():
        return calibration
    scales = (np.log(percent) - brightness.fixed)[known]
    ratio = float(np.exp(np.ptp(scales)))
    if ratio > MAX_BRIGHTNESS_RATIO:
        raise CalibrationError(
            f"the shots' brightness differs by a factor of {ratio:.3g} at the reflectance given: "
            "give each shot's own, with the transmission of its filter"
        )
    doubt = float(np.sqrt(brightness.covariance[np.ix_(known, known)].mean()))
    if scales.size > 1:
        doubt = max(doubt, float(np.std(scales, ddof=1) / np.sqrt(scales.size)))
    scale = float(np.exp(scales.mean()))
    return replace(calibration, reflectance_scale=scale, reflectance_scale_sigma=doubt)


def _to_picture(values: FloatArray, shape: tuple[int, int], missing: float = 0.0) -> FloatArray:
    """Lay the values of pixels out as a picture; those behind the last one were never seen."""
    behind = shape[0] * shape[1] - values.size
    return np.pad(values, (0, behind), constant_values=missing).reshape(shape)
