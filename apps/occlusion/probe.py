"""Small targets on the axis at set distances behind an occluder, to see where its inactive region
ends.

A target is so small that inside, at 0.8 of the region's length, all of it lies in the umbra, and
beyond, at 1.2 and more, the outermost views see all of it. A camera that is fitted to it looks
closely, with a short pulse and a gate at the known distance, and so tests the formula alone; one
fixed camera, with the instrument's pulse and gates that it finds in its own shot, tests what of
that an instrument keeps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apps.occlusion.experiment import VIEW_COUNT, make_rig
from tofclip.light_field.views import CameraSetup
from tofclip.metrics import correlation_coefficient
from tofclip.occlusion import (
    TV_WEIGHT,
    InactiveRegion,
    Rig,
    add_poisson_noise,
    measure_views,
    separate_occluder,
)
from tofclip.recovery.light_field import MAX_ITERATIONS, OBJECTIVE_TOLERANCE
from tofclip.simulate.bodies import Body, Lambertian, Rectangle
from tofclip.simulate.light_fields import (
    PulsedScene,
    TimeAxis,
    render_flash,
    render_flash_view,
)
from tofclip.simulate.patterns import cut_pattern, make_letter, make_plain_pattern
from tofclip.solvers import TotalVariation

Array = NDArray[Any]

DISTANCE_FACTORS = (0.8, 1.2, 2.0)  # behind the occluder, in lengths of the inactive region
TARGET_WIDTH_FRACTION = 0.15  # of the occluder's; the umbra is 0.2 of it wide at 0.8 of its length
MIN_CORRELATION = 0.8  # with the unoccluded truth: from there on a target counts as recovered

PICTURE_PX = 48
TARGET_PX = 20
PULSE_FWHM_S = 10e-12  # the nearest target of all trials answers 25 ps after its occluder
MAX_GATE_S = 80e-12
PEAK_PHOTONS = 2000.0  # of the brightest measurement, were there no occluder
BACKGROUND_PHOTONS = 20.0  # photons of every measurement that come at any time
SIGNIFICANCE_SIGMAS = 5.0  # standard deviations of the background
MIN_VIEW_FRACTION = 0.5  # a view with less light than this share of the brightest view's is blocked

FIXED_PICTURE_PX = 128
FIXED_FIELD_OF_VIEW_RAD = 0.45
FIXED_FOCUS_M = 0.1  # where pictures of all views agree; no target stands just there
FIXED_BIN_WIDTH_S, FIXED_PULSE_FWHM_S = 20e-12, 60e-12  # the paper's streak camera
FIXED_BACKGROUND_PHOTONS = BACKGROUND_PHOTONS * FIXED_BIN_WIDTH_S / MAX_GATE_S  # in every bin
BOARD_ROWS = 32  # of cells, four pixels each
RANGE_MARGIN_M = 20e-3  # of the sweep, before the occluder and behind the target


@dataclass(frozen=True)
class ProbeResult:
    """One target and what became of it."""

    distance: float  # from the views, m
    factor: float  # distance from the occluder in lengths of the inactive region
    # of the recovered picture with what the reference view would see without an occluder
    correlation: float
    views: int  # how many views got light from it
    picture: Array  # (rows, columns)
    truth: Array  # (rows, columns)

    @property
    def expected_visible(self) -> bool:
        """Whether the formula promises it."""
        return self.factor > 1

    @property
    def is_recovered(self) -> bool:
        """Whether it was."""
        return self.correlation >= MIN_CORRELATION


def probe_target(
    occluder: tuple[Body, ...], region: InactiveRegion, factor: float, seed: int = 0
) -> ProbeResult:
    """Put a target behind an occluder, at `factor` lengths of its region, which must have an end,
    and try to recover it; `seed`: of the line angles and the photons.
    """
    distance = region.distance + factor * region.length
    width = TARGET_WIDTH_FRACTION * region.width
    focal_length_px = distance * TARGET_PX / width
    setup = CameraSetup("line", 1.0, seed)
    rig = make_rig(region, PICTURE_PX, focal_length_px, distance, 2, setup)
    letter = Lambertian(cut_pattern(make_letter("L"), make_plain_pattern(0.9)))
    target = Body(Rectangle(width, width), letter, np.array([0.0, 0.0, distance]))
    # one bin about the target's return that opens halfway from the occluder's
    near, far = rig.compute_flight_time(np.array([region.distance, distance]))
    gate = TimeAxis(float(far), float(min(far - near, MAX_GATE_S)), 1, PULSE_FWHM_S)
    hidden, free = (
        render_flash(PulsedScene(bodies, rig.lamps), rig.array, gate)
        for bodies in ((target, *occluder), (target,))
    )
    light, unoccluded = (measure_views(one, rig, gate).values for one in (hidden, free))
    picture, views = _recover_target(rig, light, unoccluded.max(), seed)
    truth = free[VIEW_COUNT // 2, :, :, 0]
    correlation = correlation_coefficient(picture, truth)
    return ProbeResult(distance, factor, correlation, views, picture, truth)


def probe_with_fixed_camera(
    occluder: tuple[Body, ...], region: InactiveRegion, factor: float, seeds: int
) -> list[ProbeResult]:
    """Put a board behind an occluder, and look at its middle with a camera that knows neither.

    One focal length, one focus and one pulse for all boards; the exposure is that of the brightest
    measurement, of whatever body it is. Returns, gates and depths are found in the shot
    (`TimedMeasurements.find_returns`). Such a camera gets too little light from a speck, so that
    the board fills the picture; what is judged is a strip of it, as wide as the target of
    `probe_target`, whose pattern has nothing to do with that beside it.

    The occluder is upright, and so tall that no view sees its ends. Returns one result for each
    seed, its pictures those of the strip; a correlation of 0 where no second return was found.
    """
    distance = region.distance + factor * region.length
    width = TARGET_WIDTH_FRACTION * region.width
    focal_length_px = FIXED_PICTURE_PX / FIXED_FIELD_OF_VIEW_RAD
    rigs = [
        make_rig(region, FIXED_PICTURE_PX, focal_length_px, FIXED_FOCUS_M, 1, setup)
        for setup in (CameraSetup("line", 1.0, seed) for seed in range(seeds))
    ]
    array, lamps = rigs[0].array, rigs[0].lamps
    sweep = TimeAxis.for_ranges(
        region.distance - RANGE_MARGIN_M,
        distance + RANGE_MARGIN_M,
        FIXED_BIN_WIDTH_S,
        FIXED_PULSE_FWHM_S,
    )
    board = _make_board(width, FIXED_FIELD_OF_VIEW_RAD * distance, distance)
    # Light does not depend on what the seeds draw: it is cast once.
    pictures = render_flash(PulsedScene((board, *occluder), lamps), array, sweep)
    free = render_flash_view(PulsedScene((board,), lamps), array, sweep, (0.0, 0.0)).sum(axis=-1)
    half, axis = int(focal_length_px * width / distance / 2), FIXED_PICTURE_PX // 2
    strip = slice(axis - half, axis + half + 1)
    truth, results = free[:, strip], []
    for seed, rig in enumerate(rigs):
        clean = measure_views(pictures, rig, sweep)
        per_unit = PEAK_PHOTONS / float(clean.values.max())
        dark = np.float32(FIXED_BACKGROUND_PHOTONS / per_unit)
        noise = np.random.default_rng([seed, 4])
        noisy = add_poisson_noise(clean.values + dark, per_unit, noise) - dark
        picture = separate_occluder(replace(clean, values=noisy)).target[:, strip]
        correlation = correlation_coefficient(picture, truth)
        results.append(ProbeResult(distance, factor, correlation, VIEW_COUNT, picture, truth))
    return results


def _make_board(cell_width: float, side: float, distance: float) -> Body:
    """A board of random bright and dark cells; one column of them lies on the axis."""
    columns = 2 * round(side / cell_width / 2) + 1
    bright = np.random.default_rng(0).random((BOARD_ROWS, columns)) < 0.5
    return Body(
        Rectangle(columns * cell_width, side),
        Lambertian(np.where(bright, 0.9, 0.1)),
        np.array([0.0, 0.0, distance]),
    )


def _recover_target(rig: Rig, light: Array, brightest: float, seed: int) -> tuple[Array, int]:
    """Recover from noisy measurements, blocked views left out; nothing where no view got
    significant light.
    """
    camera, per_unit = rig.camera, PEAK_PHOTONS / brightest
    dark = BACKGROUND_PHOTONS / per_unit
    measurements = add_poisson_noise(
        light + dark, per_unit, np.random.default_rng([seed, 3])
    ) - np.float32(dark)
    sizes = [encoder.shape_out[0] for encoder in camera.encoders]
    parts = np.split(measurements[:, 0], np.cumsum(sizes)[:-1])
    lights = np.array([part.mean() for part in parts])
    doubt = np.sqrt(BACKGROUND_PHOTONS / np.array(sizes)) / per_unit
    seeing = (lights > SIGNIFICANCE_SIGMAS * doubt) & (lights > MIN_VIEW_FRACTION * lights.max())
    if not seeing.any():
        return np.zeros(rig.array.image_shape, np.float32), 0
    valid = np.repeat(seeing, sizes)[:, np.newaxis]
    method = TotalVariation(TV_WEIGHT, MAX_ITERATIONS, OBJECTIVE_TOLERANCE)
    return method.recover(camera.model(0.0), measurements, valid).frames[0], int(seeing.sum())
