"""The points of fitted surfaces, and beside them the frames' returns, as the returns of a shot."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import partial

import numpy as np
import scipy
from numpy.polynomial import Polynomial

from tofclip.arrays import FloatArray
from tofclip.camera import Camera
from tofclip.camera.model import interpolate_linearly
from tofclip.lidar import Detection
from tofclip.lidar.range_calibration import correct_returns
from tofclip.recovery.surfaces.amplitudes import NEIGHBOURHOOD_PX, share_misfit
from tofclip.recovery.surfaces.extents import find_candidates
from tofclip.recovery.surfaces.fit import SurfaceFit
from tofclip.recovery.surfaces.model import SurfaceModel
from tofclip.recovery.surfaces.others import NEAR_BINS, find_near
from tofclip.recovery.surfaces.patches import rank_within_pixels
from tofclip.recovery.surfaces.pulse import Image
from tofclip.recovery.surfaces.ranges import estimate_border_shift
from tofclip.recovery.surfaces.shapes import TINY, Pixels
from tofclip.recovery.surfaces.shifts import SHIFT_SHOWN, follow_local_shifts, measure_local_shifts
from tofclip.shots import Returns
from tofclip.threads import limit_blas_threads
from tofclip.units import FWHM_PER_SIGMA, SPEED_OF_LIGHT

# Logarithm of the odds that a surface's point is false: nothing known, for each e-fold of the deviations
# by which it is out of the noise, where the frames have returns beside all points about it, for each
# e-fold of the part of its surface's light that may as well lie elsewhere, of the number of the surface's
# points, and of its place's brightness beside the brightest, times the part of the light that may as well
# lie elsewhere. Logistic regression on points of 58 simulated shots; docs tell what they miss.
FALSE_ODDS = np.array([11.21, -1.03, -4.85, 2.53, -0.49, -3.92])
# Less, and of light elsewhere more, makes no difference.
LEAST_ELSEWHERE, MOST_ELSEWHERE, LEAST_PART, LEAST_BRIGHT = 0.07, 0.5, 0.02, 0.01
ABOUT_PX = 5  # side of the square

# A surface that fills as little of the square over its length is a rod, whose roundness no pixel resolves; its
# radius if its light is within such a distance of its axis, root mean square: that of what is seen as a line;
# and by how much of a pixel's width, root mean square, its points are off: those of rods of 10 and 12 mm, whose
# radii are 0.3 to 0.8 px, by 0.05 to 0.1.
ROD_FRACTION, ROD_RADIUS_PX, ROD_SPREAD_PX, ROD_PX = 0.1, 0.6, 1.3, 0.06
# Of a pixel, root mean square, light lies higher or lower than where it is put: views tell rows only by how
# their lines lean. Tables that are turned are off by 0.02 to 0.05 of what a pixel spans.
ROW_ERROR_PX = 0.02
# Of how far apart surfaces are that share a pixel's light, by how much the mean of that is off: of bodies that touch.
SHARED_DOUBT = 0.5
# Middle of a part of a pixel from the pixel's own, root mean square over parts of all sizes.
PART_PX = 1 / np.sqrt(12)
SWEEP_PLACES = 10  # between views' centres, at which a sweep's course is looked at


@limit_blas_threads()
def list_returns(
    fit: SurfaceFit, detection: Detection, calibrated_px: FloatArray | None = None
) -> Returns:
    """List the points of surfaces that stand out of the noise, and beside them the frames' returns where
    no surface is, pixel by pixel.

    `calibrated_px`: slit centres as they were calibrated, (views,), if the fit's camera has others.
    """
    model, amplitude = fit.solver.model, fit.solver.amplitude
    centres = model.camera.centres_px + model.state.centres
    camera = model.camera.replace(gains=model.state.gains, centres_px=centres)
    distance, others = model.distance, fit.others
    # 6. Points.
    variance = fit.solver.estimate_local_variance()
    bright, doubt = _judge_points(fit, variance, detection.signal_to_noise)
    # brightness is told as the reference view sees it
    intensity = model.shade(model.reference, amplitude) * distance**2
    time = 2 * distance / SPEED_OF_LIGHT
    strong = detection.find_significant(
        model.pixel[bright], time[bright], intensity[bright], camera.pulse_fwhm
    )
    chosen = bright[strong]

    fitted = model.estimate_deviation(fit.refinement.covariances)
    begun_px = model.camera.centres_px if calibrated_px is None else calibrated_px
    displaced = np.hypot(estimate_displacement(camera, begun_px), (0, ROW_ERROR_PX))
    moved = displaced[:, np.newaxis] * model.compute_slopes()
    rest = model.image - fit.whole.model.render(fit.whole.amplitude)
    bent = measure_local_shifts(model, amplitude, rest) / SHIFT_SHOWN
    distance = distance + follow_local_shifts(fit.solver, rest, variance, bent)
    y, x = model.row[chosen], model.column[chosen]
    depth, rounded = np.zeros((2, distance.size))
    for surface in np.unique(model.surface[chosen]):
        own = model.surface[chosen] == surface
        true = 1 - doubt[strong][own]  # points that may be false fill a part
        if true.sum() < ROD_FRACTION * (np.ptp(y[own]) ** 2 + np.ptp(x[own]) ** 2):
            rod, pixel_m = chosen[own], distance[chosen[own]] / camera.focal_length_px
            light = true * fit.sparse.amplitude[rod] + TINY
            depth[rod] = pixel_m * round_rod(y[own], x[own], light)
            rounded[rod] = ROD_PX * pixel_m
    distance = distance + depth
    hidden = estimate_hidden_shift(model, amplitude)
    bordering = estimate_border_shift(model, amplitude)
    parts = np.stack([fitted, fit.remainder, *moved, bent, rounded, hidden, bordering])
    unswept = estimate_sweep_error(model, amplitude)
    deviation = np.sqrt(np.sum(parts**2, axis=0) + unswept**2)
    found = Returns(
        y=y.astype(np.int32),
        x=x.astype(np.int32),
        range=distance[chosen],
        intensity=intensity[chosen].astype(np.float32),
        confidence=deviation[chosen].astype(np.float32),
        return_number=np.ones(y.size, np.uint8),
        time=2 * distance[chosen] / SPEED_OF_LIGHT,
        camera=camera,
        false_alarm=doubt[strong],
    )
    pulse_m = FWHM_PER_SIGMA * model.pulse.sigma * model.row_m
    found = join_unresolved(found, pulse_m).merge(others)
    return correct_returns(replace(found, shear=np.asarray(camera.shear_at(found.range))))


def join_unresolved(found: Returns, pulse_m: float) -> Returns:
    """Make one return of those of a pixel whose ranges differ by less than a pulse is long, one from the next: a shot
    does not tell them apart, but it does tell where their light is on average. Surfaces that overlap, as those of a
    head and a torso do at a neck, share the light of a pixel as they like. A part of how far apart they are is not
    known of that either.
    """
    columns = found.camera.image_shape[1]
    pixel = found.y.astype(np.intp) * columns + found.x
    order, rank = rank_within_pixels(pixel, found.range)
    own = found[order]
    begins = (rank == 0) | (np.diff(own.range, prepend=0.0) >= pulse_m)
    first, group = np.flatnonzero(begins), np.cumsum(begins) - 1
    light = own.intensity / own.range**2
    whole = np.bincount(group, light)

    def average(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(group, light * values) / whole)

    distance = average(own.range)
    apart = SHARED_DOUBT * (own.range - distance[group])
    variance = average(own.confidence.astype(np.float64) ** 2 + apart**2)
    return replace(
        own[first],
        range=distance,
        time=2 * distance / SPEED_OF_LIGHT,
        intensity=(whole * distance**2).astype(np.float32),
        confidence=np.sqrt(variance).astype(np.float32),
        # that one is true is enough
        false_alarm=np.minimum.reduceat(own.false_alarm, first),
    )


def round_rod(y: Pixels, x: Pixels, light: FloatArray) -> FloatArray:
    """Return by how much farther than a line along it the pixels of a rod see it, (n,), px: what is as thin as
    pixels is taken to be round, and pixels at its sides see these. `light`: of the pixels, by which its axis, a
    parabola, is found; (n,).
    """
    place = np.stack([x, y], axis=1).astype(np.float64)
    place -= np.average(place, axis=0, weights=light)
    _, axes = np.linalg.eigh(place.T @ (place * light[:, np.newaxis]))
    across, along = (place @ axes).T
    course, root = np.vander(along, 3), np.sqrt(light)
    aside = across - course @ np.linalg.lstsq(course * root[:, np.newaxis], across * root)[0]
    if np.average(aside**2, weights=light) > ROD_SPREAD_PX**2:
        return np.zeros(light.size)
    # from its axis to its limb, the part that each pixel sees, as wide as a pixel looks from there
    reach = np.abs(axes[:, 0]).sum() / 2
    near = np.clip((aside - reach) / ROD_RADIUS_PX, -1, 0.9)
    far = np.clip((aside + reach) / ROD_RADIUS_PX, -0.9, 1)
    area = (
        far * np.sqrt(1 - far**2) + np.arcsin(far) - near * np.sqrt(1 - near**2) - np.arcsin(near)
    )
    # a line is where its light is, which faces the camera
    return ROD_RADIUS_PX * (8 / (3 * np.pi) - area / 2 / (far - near))


def estimate_hidden_shift(model: SurfaceModel, amplitude: Image) -> FloatArray:
    """Return how far off points are, (points,), m, because only a part of a pixel is theirs, and where their surface is
    steep another range than its middle's: each view sees them through other gaps of what lies before them, and all
    see what lies behind them through their own.
    """
    order, rank = rank_within_pixels(model.pixel, model.distance)
    light = amplitude[order].astype(np.float64)
    first, pixel = np.flatnonzero(rank == 0), np.cumsum(rank == 0) - 1
    total = np.add.reduceat(light, first)[pixel]
    before = np.cumsum(light) - light
    before -= before[first][pixel]
    after = total - before - light
    aside = np.empty(amplitude.size)
    aside[order] = np.hypot(
        before / np.sqrt(model.camera.views) / np.maximum(before + light, TINY),
        after / np.maximum(after + light, TINY),
    )
    return np.asarray(PART_PX * aside * np.hypot(*model.compute_slopes()))


def estimate_sweep_error(model: SurfaceModel, amplitude: Image) -> float:
    """Return how far all ranges may be off, m, because the sweep is known at the views' centres and is taken to be a
    parabola and straight from one to the next beyond it: how far these lines are from a smooth course.
    """
    camera, state = model.camera, model.state
    if camera.views <= 3:  # a parabola goes through all
        return 0.0
    time = 2 * float(np.average(model.distance, weights=amplitude + TINY)) / SPEED_OF_LIGHT
    row = np.interp(time + camera.time_zero, model.times, np.arange(float(model.times.size)))
    late, centres = state.delays + state.stretches * model.measure_height(row), camera.centres_px
    if camera.sweep is not None:
        late = late + camera.sweep.raw_position(np.full(centres.size, row), centres)[0]
    late = late - Polynomial.fit(centres, late, 2)(centres)
    slit = np.linspace(centres[0], centres[-1], SWEEP_PLACES * centres.size)
    smooth = scipy.interpolate.CubicSpline(centres, late)(slit)
    off = smooth - interpolate_linearly(slit, centres, late)
    # a range is seen by all views
    return float(np.sqrt(np.mean(off**2) / centres.size)) * model.row_m


def _judge_points(fit: SurfaceFit, variance: Image, limit: float) -> tuple[Pixels, FloatArray]:
    """Numbers of the candidates among the points, and how probable it is that each is false."""
    shown, known = _gather_evidence(fit, variance, limit)
    return shown, scipy.special.expit(FALSE_ODDS[0] + FALSE_ODDS[1:] @ known)


def _gather_evidence(fit: SurfaceFit, variance: Image, limit: float) -> tuple[Pixels, FloatArray]:
    """Numbers of the candidates among the points, and what `FALSE_ODDS` weighs of each, (5, candidates)."""
    solver, model, seen = fit.solver, fit.solver.model, fit.seen
    significance = solver.measure_significance(variance)
    shown = find_candidates(solver, significance, limit)
    surface = model.surface[shown]
    # Light of a line of one range may lie anywhere in a lens about it: of such a surface the two
    # explanations are unlike where they are as probable: a recorded shot, which neither explains to the
    # noise, lost a third of its points otherwise. Light that stays near on another surface counts as the
    # point's own.
    sparse = copy.copy(fit.sparse)
    stays, near = _add_up_near(model, np.array([sparse.amplitude, solver.amplitude]))
    sparse.amplitude = (stays / np.maximum(near, TINY) * solver.amplitude).astype(np.float32)
    places = np.array([one.compare_places() for one in (solver, sparse)])
    light, sparsely = (model.render(one.amplitude) for one in (solver, fit.sparse))
    change = (model.image - sparsely) ** 2 - (model.image - light) ** 2
    change *= model.weights / variance
    place = partial(scipy.ndimage.uniform_filter, size=NEIGHBOURHOOD_PX, mode="constant")
    worse = solver.map_pictures(place, share_misfit(model, solver.amplitude, light, change))
    (bright, narrow), brightest = places[:, 0], places[:, 1]
    moved = np.maximum(bright - narrow, 0)
    here, around = (solver.map_pictures(place, one)[shown] for one in (moved, bright))
    moved *= np.exp(-(NEIGHBOURHOOD_PX**2) * np.maximum(worse, 0) / 2)
    lost, whole = (
        np.bincount(model.surface, one, len(model.parts)) for one in (moved, solver.amplitude)
    )
    elsewhere = np.clip(lost / np.maximum(whole, TINY), LEAST_ELSEWHERE, MOST_ELSEWHERE)
    elsewhere, size = elsewhere[surface], np.bincount(surface)[surface]
    part = (elsewhere + np.clip(here / np.maximum(around, TINY), LEAST_PART, 1)) / 2
    dim = np.log(np.maximum(places[:, 0] / np.maximum(brightest, TINY), LEAST_BRIGHT))

    points = model.row[shown], model.column[shown], model.distance[shown]
    candidates, confirmed = shown.astype(np.float64), np.zeros(shown.size)
    confirmed[shown] = find_near(points, (seen.y, seen.x, seen.range), model.row_m)
    mean = partial(scipy.ndimage.uniform_filter, size=ABOUT_PX, mode="constant")
    about, near = (solver.map_pictures(mean, one)[shown] for one in (confirmed, candidates))
    known = [
        np.log(significance[shown]),
        about / near,
        np.log(elsewhere),
        np.log(size),
        part * dim.sum(axis=0)[shown],
    ]
    return np.flatnonzero(shown), np.array(known)


def _add_up_near(model: SurfaceModel, amplitudes: Image) -> FloatArray:
    """The light that lies in each point's pixel about its range, of all surfaces, by each of some
    amplitudes, (n, points).
    """
    reach = NEAR_BINS * model.row_m
    place = model.pixel * (model.distance.max() + 2 * reach) + model.distance
    order = np.argsort(place)
    total = np.zeros((len(amplitudes), order.size + 1))
    np.cumsum(amplitudes[:, order], axis=1, dtype=np.float64, out=total[:, 1:])
    first, last = (np.searchsorted(place[order], place + away) for away in (-reach, reach))
    return np.asarray(total[:, last] - total[:, first])


def estimate_displacement(camera: Camera, calibrated_px: FloatArray) -> FloatArray:
    """Return how far errors of calibrated slit centres, (views,), displace the picture to the right and
    down, px; `camera`: with those that a shot shows.

    Of errors e_v a shot shows all but what looks like a displaced picture, ``e_v = dx - dy
    tan(angle_v)``. They are taken to be independent: what is shown says how large they are, the less
    surely the fewer views there are, of which Student's distribution keeps account, and no less than
    the calibration says of itself.
    """
    looks = np.stack([np.ones(camera.views), -np.tan(camera.angles)], axis=1)
    freedom = max(camera.views - looks.shape[1], 1)
    shown_px = np.linalg.norm(camera.centres_px - calibrated_px) / np.sqrt(freedom)
    shown_px *= scipy.special.stdtrit(freedom, 0.75) / scipy.special.ndtri(0.75)
    stated_px = np.sqrt(np.mean(np.nan_to_num(camera.centre_uncertainty_px) ** 2))
    error_px = max(shown_px, stated_px)
    return np.asarray(error_px * np.linalg.norm(np.linalg.pinv(looks), axis=1))
