"""Time zero, range walk, offsets and reflectance from shots of a target whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, chi2

from tofclip.camera import Camera, RangeCalibration
from tofclip.errors import CalibrationError, InputError
from tofclip.lidar import Returns, compute_ray_directions, depth, point_cloud
from tofclip.lidar.range_calibration import TargetShot, correct_returns, fit_range_calibration
from tofclip.shots import Frames
from tofclip.units import SPEED_OF_LIGHT

SHAPE = (15, 18)
CAMERA = Camera(np.array([9.0]), np.zeros(1), SHAPE, 18, pulse_fwhm=400e-12, focal_length_px=40.0)
LATE_S = 300e-12
WALK_M = 2e-3
"""A decade."""
OFFSET_M = 1e-3
RECORD = (0.0, 40e-9)
NOISE_M = 20e-3
"""Of a return of one photon."""
REFERENCE = 300.0


def walk_at(signal):
    """True range walk of returns, m."""
    return WALK_M * np.log10(signal / REFERENCE)


def list_returns(y, x, measured, signal, sigma, camera):
    """One return in each of these pixels."""
    return Returns(
        y=y.astype(np.int32),
        x=x.astype(np.int32),
        range=measured,
        intensity=(signal * measured**2).astype(np.float32),
        confidence=sigma.astype(np.float32),
        return_number=np.ones(y.size, np.uint8),
        time=2 * measured / SPEED_OF_LIGHT,
        camera=camera,
    )


class World:
    """An instrument whose faults are known, in front of a target."""

    def __init__(self, seed, jitter_m=0.0):
        self.random = np.random.default_rng(seed)
        self.offsets = self.random.normal(0, OFFSET_M, SHAPE)
        self.response = np.exp(self.random.normal(0, 0.05, SHAPE))
        self.jitter_m = jitter_m

    def see(self, distance, photons, percent=np.nan):
        """A shot of a plate that sends back this many photons from the axis."""
        y, x = np.indices(SHAPE).reshape(2, -1)
        cosine = compute_ray_directions(CAMERA, y, x)[:, 2]
        true = distance / cosine
        bright = photons * cosine * (distance / true) ** 2 * self.response.ravel()
        signal = self.random.poisson(bright).clip(1).astype(float)
        sigma = NOISE_M / np.sqrt(bright)
        measured = true + LATE_S * SPEED_OF_LIGHT / 2 + walk_at(signal) + self.offsets.ravel()
        measured += self.random.normal(0, self.jitter_m) + self.random.normal(0, sigma)
        returns = list_returns(y, x, measured, signal, sigma, CAMERA)
        return TargetShot(returns, distance, RECORD, f"a plate at {distance:g} m", percent)

    def see_all(self):
        """Five shots whose brightness spans a factor of 100."""
        return list(map(self.see, (1.0, 1.5, 2.0, 2.5, 3.0), (5000, 1500, 500, 150, 50)))


def find_lateness(fit):
    """Time zero that a fit should have found: it holds at the reference signal, which it chooses."""
    return LATE_S + 2 / SPEED_OF_LIGHT * walk_at(fit.calibration.reference_signal)


@pytest.mark.parametrize("jitter_m", [0.0, 1e-3])
@pytest.mark.nightly
def test_deviations_are_true_over_seeds(jitter_m):
    """Time zero off by 300 ps, 2 mm of walk a decade, offsets of 1 mm, with and without jitter of
    1 mm: what a thousand of a thousand and one runs of 64 seeds would give.
    """
    seeds = 64
    zero, walk, offsets, errors = [], [], [], []
    for seed in range(seeds):
        world = World(seed, jitter_m)
        fit = fit_range_calibration(world.see_all())
        known = fit.calibration
        zero.append((fit.camera.time_zero - find_lateness(fit)) / known.time_zero_sigma)
        measured, sigma = known.compute_walk(known.signal_range)
        truth = walk_at(known.signal_range) - walk_at(known.reference_signal)
        walk.append(((measured - truth) / sigma)[0])  # that at the other end is the same
        offsets.append((known.offsets - world.offsets) / known.offset_sigma)
        errors.append(np.std(known.offsets - world.offsets))
    for scores in (zero, walk):
        fewest, most = binom.interval(0.999, seeds, 0.6827)
        assert fewest <= np.count_nonzero(np.abs(scores) < 1) <= most
        if jitter_m == 0:  # else Student's distribution of few shots, whose squares have no limit
            assert chi2.ppf(5e-4, seeds) < np.sum(np.square(scores)) < chi2.isf(5e-4, seeds)
    # Of 17,280 pixels.
    assert 0.94 < np.sqrt(np.mean(np.square(offsets))) < 1.06
    assert np.mean(errors) < 0.3 * OFFSET_M


def test_corrected_ranges_are_true():
    """A plate that the fit never saw, by the camera that it made."""
    world = World(3)
    camera = fit_range_calibration(world.see_all()).camera
    seen = world.see(1.7, 800).returns
    # Ranges count from the new time zero, as those of a recovery with this camera.
    late = SPEED_OF_LIGHT / 2 * camera.time_zero
    signal = seen.intensity / seen.range**2
    shifted = replace(
        seen,
        camera=camera,
        range=seen.range - late,
        intensity=(signal * (seen.range - late) ** 2).astype(np.float32),
    )
    corrected = correct_returns(shifted)
    true = 1.7 / compute_ray_directions(CAMERA, seen.y, seen.x)[:, 2]
    scores = (corrected.range - true) / corrected.confidence
    assert 0.9 < np.sqrt(np.mean(scores**2)) < 1.1
    uncorrected = (shifted.range - true) / shifted.confidence
    assert np.sqrt(np.mean(uncorrected**2)) > 1.5
    np.testing.assert_allclose(corrected.time, 2 * corrected.range / SPEED_OF_LIGHT)
    np.testing.assert_allclose(corrected.intensity, signal * corrected.range**2, rtol=1e-5)


def test_one_shot_gives_time_zero_and_reflectance():
    shot = World(0).see(1.0, 2000, percent=40.0)
    fit = fit_range_calibration([shot])
    known = fit.calibration
    assert known.walk.size == known.offsets.size == known.response.size == 0
    assert "three shots" in fit.walk_note.replace("3", "three")
    assert "one shot" in fit.offsets_note
    # Offsets of 1 mm in 270 pixels are noise here, and the walk of 2000 counts is part of it.
    assert abs(fit.camera.time_zero - find_lateness(fit)) < 4 * known.time_zero_sigma
    assert 0.1e-12 < known.time_zero_sigma < 1e-12
    # 2000 photons from 1 m are 40 %; light and gain of 270 pixels vary by 5 %.
    assert known.reflectance_scale == pytest.approx(40 / 2000, rel=0.02)
    # whatever time zero the shot was recovered with is put back
    earlier = CAMERA.replace(time_zero=100e-12)
    moved = shot.returns.range - SPEED_OF_LIGHT / 2 * 100e-12
    again = replace(shot, returns=replace(shot.returns, range=moved, camera=earlier))
    found = fit_range_calibration([again]).camera.time_zero
    assert found == pytest.approx(fit.camera.time_zero, abs=1e-15)


def test_one_return_of_a_single_pixel_is_as_sure_as_it_says():
    shot = World(0).see(1.0, 2000)
    chosen = np.zeros(len(shot.returns), bool)
    chosen[0] = True
    alone = replace(
        shot.returns[chosen],
        y=np.zeros(1, np.int32),
        x=np.zeros(1, np.int32),
        camera=Camera(np.zeros(1), np.zeros(1), (1, 1), 1, pulse_fwhm=400e-12),
    )
    fit = fit_range_calibration([replace(shot, returns=alone)])
    sigma = float(alone.confidence[0]) * 2 / SPEED_OF_LIGHT
    assert fit.calibration.time_zero_sigma == pytest.approx(sigma, rel=1e-6)


def test_response_and_reflectance_of_several_shots():
    world = World(1)
    shots = [world.see(d, n, p) for d, n, p in ((1, 2000, 40), (1.5, 1000, 45), (2, 500, 40))]
    known = fit_range_calibration(shots).calibration
    np.testing.assert_allclose(known.response / world.response, 1, atol=0.15)
    assert np.std(np.log(known.response / world.response)) < 0.03
    assert known.reflectance_scale == pytest.approx(0.02, rel=0.02)
    brightness = known.compute_reflectance(np.array([2000.0]), np.array([0]), np.array([0]))
    assert brightness[0] == pytest.approx(40 / known.response[0, 0], rel=0.02)


def test_neighbours_that_share_errors_and_stray_returns():
    """Deviations grow where errors are shared; other things in the picture, a tenth far off and a
    sixtieth 20 mm before the target, do not pull.
    """
    world = World(2)
    shot = world.see(1.0, 1000)
    shared = np.kron(world.random.normal(0, 2e-3, (5, 6)), np.ones((3, 3))).ravel()
    alone = fit_range_calibration([shot]).calibration.time_zero_sigma
    rough = replace(shot, returns=replace(shot.returns, range=shot.returns.range + shared))
    together = fit_range_calibration([rough]).calibration.time_zero_sigma
    assert together > 2 * alone
    strays = shot.returns.range.copy()
    strays[::10] = world.random.uniform(0.5, 3, strays[::10].size)
    strays[5::60] -= 0.02
    fit = fit_range_calibration([replace(shot, returns=replace(shot.returns, range=strays))])
    assert abs(fit.camera.time_zero - find_lateness(fit)) < 4 * fit.calibration.time_zero_sigma
    assert fit.target_fraction == pytest.approx(0.9, abs=0.03)
    assert fit.calibration.time_zero_sigma < 2 * alone


def test_what_cannot_be_told_is_refused():
    world = World(4)
    one = world.see(1.0, 1000)
    nothing = np.zeros(one.returns.y.size, bool)
    two = one.returns.range + np.where(one.returns.x < 9, 0.0, 0.5)
    few = nothing.copy()
    few[:2] = True
    other, far = world.see(1.5, 1000), replace(world.see(2.0, 99), distance=2.3)
    refused = {
        "no return stands out": [replace(one, returns=one.returns[nothing])],
        "in 3 or more pixels": [replace(one, returns=one.returns[few])],
        "needs 3 shots": [one, world.see(1.5, 100)],
        "grey filter": [one, other, world.see(2.0, 1100)],
        "out of the record": [one, replace(one, distance=20.0)],
        "where the other shots": [one, other, far],
        "two surfaces": [replace(one, returns=replace(one.returns, range=two))],
        "cut off": [replace(one, record=(0.0, float(np.median(one.returns.time))))],
        "give each shot's own": [world.see(1.0, 1000, 50), world.see(1.0, 100, 50)],
    }
    for words, shots in refused.items():
        with pytest.raises(CalibrationError, match=words):
            fit_range_calibration(shots, walk=True if "shots" in words or "grey" in words else None)
    for wrong in ({"distance": -1.0}, {"reflectance_percent": 0.0}):
        with pytest.raises(InputError, match="positive"):
            replace(one, **wrong)


ROOM = (40, 48)
ROOM_CAMERA = Camera(
    np.array([24.0]), np.zeros(1), ROOM, 48, pulse_fwhm=400e-12, focal_length_px=40.0
)


def draw_scene(kind, random):
    """Depths of a scene without a plate, m; NaN where nothing comes back."""
    y, x = np.indices(ROOM).reshape(2, -1)
    ray = compute_ray_directions(ROOM_CAMERA, y, x)
    ray = ray / ray[:, 2:]
    if kind == "room":
        ends = np.array([random.uniform(0.8, 1.1), random.uniform(0.6, 0.9), 3.0])
        depth_m = np.min(ends / np.maximum(np.abs(ray), 1e-9), axis=1)
        for _ in range(3):
            middle = np.array([*random.uniform(-0.5, 0.5, 2), random.uniform(1.5, 2.5)])
            along = ray @ middle / np.sum(ray**2, axis=1)
            miss = np.sum((along[:, np.newaxis] * ray - middle) ** 2, axis=1)
            half = np.sqrt(np.maximum(random.uniform(0.2, 0.5) ** 2 - miss, 0))
            front = along - half / np.linalg.norm(ray, axis=1)
            depth_m = np.where(half > 0, np.minimum(front, depth_m), depth_m)
    elif kind == "slanted":
        slope = np.tan(np.deg2rad(random.uniform(10, 60)))
        turn = random.uniform(0, 2 * np.pi)
        depth_m = 2 / (
            1 - slope * (np.cos(turn) * ray[:, 0] + np.sin(turn) * ray[:, 1]).clip(-9, 0.4)
        )
    elif kind == "bush":
        depth_m = 2 + random.uniform(-0.3, 0.3, y.size)
    elif kind == "relief":
        shape = np.hypot(y - 20, x - 24) / 30
        depth_m = 2 + random.uniform(0.055, 0.08) * shape**2 / np.max(shape**2)
    elif kind == "walls":
        edges = np.cumsum([0, random.integers(18, 22), random.integers(12, 15)])
        depth_m = np.array([1.5, 2.1, 2.8])[np.searchsorted(edges, x, side="right") - 1]
    else:
        depth_m = np.where(random.random(y.size) < 0.01, random.uniform(0, 6, y.size), np.nan)
    return depth_m


def see_depths(depth_m, photons, random):
    """A shot of these depths, said to be of a target at 2 m."""
    y, x = np.indices(ROOM).reshape(2, -1)
    y, x, depth_m = (part[np.isfinite(depth_m)] for part in (y, x, depth_m))
    true = depth_m / compute_ray_directions(ROOM_CAMERA, y, x)[:, 2]
    signal = random.poisson(photons * (2 / true) ** 2).clip(1).astype(float)
    sigma = NOISE_M / np.sqrt(signal)
    measured = true + LATE_S * SPEED_OF_LIGHT / 2 + random.normal(0, sigma)
    return TargetShot(list_returns(y, x, measured, signal, sigma, ROOM_CAMERA), 2.0, RECORD)


@pytest.mark.parametrize("kind", ["room", "slanted", "bush", "relief", "walls", "empty"])
def test_a_scene_without_a_plate_is_refused(kind):
    """Twelve seeds, bright and dim; a picosecond was stated for ranges wrong by metres."""
    for seed in range(12):
        random = np.random.default_rng(seed)
        shot = see_depths(draw_scene(kind, random), (1000, 30)[seed % 2], random)
        with pytest.raises(CalibrationError, match=r"^.*(plate|no return|two surfaces|cut off).*$"):
            fit_range_calibration([shot])


@pytest.mark.parametrize("kind", ["near", "dim", "tilted", "small", "before a wall"])
def test_a_plate_is_one(kind):
    """Seven seeds: time zero is within four of its deviations, which are what photons make them."""
    for seed in range(7):
        random = np.random.default_rng(seed)
        y, x = np.indices(ROOM).reshape(2, -1)
        depth_m = np.full(y.size, 2.0)
        if kind == "tilted":  # 30 mm, half of a pulse's length, from edge to edge
            depth_m += 0.03 * (x - 23.5) / 47
        if kind == "small":
            depth_m[(np.abs(y - 20) > 5) | (np.abs(x - 24) > 5)] = np.nan
        if kind == "before a wall":
            depth_m[x > 28] = 2.6
        shot = see_depths(depth_m, {"near": 5000, "dim": 5}.get(kind, 500), random)
        fit = fit_range_calibration([shot])
        late = (fit.camera.time_zero - LATE_S) / fit.calibration.time_zero_sigma
        # A tilt is an error that neighbours share, and the deviation holds it.
        assert abs(late) < 4
        if kind == "near":
            ideal = NOISE_M / np.sqrt(5000 * y.size) * 2 / SPEED_OF_LIGHT
            assert fit.calibration.time_zero_sigma == pytest.approx(ideal, rel=0.15)


def test_traces_of_something_bright_are_no_plate():
    """Flat, but with a hundredth of the counts that the picture shows elsewhere."""
    random = np.random.default_rng(0)
    shot = see_depths(np.full(ROOM[0] * ROOM[1], 2.0), 20, random)
    corner = (shot.returns.y < 20) & (shot.returns.x < 20)
    bright = shot.returns.intensity * np.where(corner, 1, 100)
    shot = replace(shot, returns=replace(shot.returns, intensity=bright.astype(np.float32)))
    assert fit_range_calibration([shot]).target_fraction == 1
    with pytest.raises(CalibrationError, match="a trace of these; show a flat plate"):
        fit_range_calibration([shot.cut(corner)])


def test_a_calibration_of_another_camera_and_numbers_without_sense_are_refused():
    camera = fit_range_calibration(World(5).see_all()).camera
    with pytest.raises(CalibrationError, match="pixels"):
        camera.replace(image_shape=(20, 20))
    with pytest.raises(CalibrationError, match="finite"):
        RangeCalibration(0.0, walk=np.array([np.nan]), walk_covariance=np.eye(1))


def test_returns_of_frames_are_corrected_once():
    """A walk of 2 mm a decade and an offset of 1 mm, off the range and into the deviation."""
    bare = Camera(np.array([8.0]), np.zeros(1), (4, 5), 16, pulse_fwhm=60e-12)
    times = np.arange(100) * 10e-12
    cube = np.zeros((100, 4, 5), np.float32)
    cube[:, 2, 3] = 50 * np.exp(-0.5 * ((times - 400e-12) / 25.5e-12) ** 2)
    offsets = np.zeros((4, 5))
    offsets[2, 3] = 1e-3
    walk = {"walk": np.array([2e-3]), "walk_covariance": np.array([[9e-8]])}
    walk |= {"reference_signal": 10.0, "signal_range": np.array([10.0, 1e5])}
    own = {"offsets": offsets, "offset_sigma": np.full((4, 5), 4e-4)}
    known = RangeCalibration(0.0, **walk, **own, reflectance_scale=0.5)
    frames = Frames(cube, times, bare)
    measured = depth(frames)
    corrected = depth(frames, bare.replace(range_calibration=known))
    signal = measured.intensity[0] / measured.range[0] ** 2
    decades = np.log10(signal / 10)
    excess = measured.range[0] - corrected.range[0]
    assert excess == pytest.approx(1e-3 + 2e-3 * decades, rel=1e-4)
    further = np.sqrt(corrected.confidence[0] ** 2 - measured.confidence[0] ** 2)
    assert further == pytest.approx(np.hypot(4e-4, 3e-4 * decades), rel=1e-3)
    assert corrected.reflectance[0] == pytest.approx(0.5 * signal * corrected.range[0] ** 2)
    # The cloud has it as a column; without a calibration it has none.
    names = [[one.name for one in point_cloud(found).columns] for found in (corrected, measured)]
    assert ["reflectance" in listed for listed in names] == [True, False]


def test_the_deviation_of_a_correction_by_hand():
    """Of 100 ps of time zero, c / 2 of it; of the walk, at two decades; of the pixel's own."""
    known = RangeCalibration(
        time_zero_sigma=100e-12,
        walk=np.array([3e-3]),
        walk_covariance=np.array([[4e-6]]),
        reference_signal=10.0,
        signal_range=np.array([1.0, 1e4]),
        offsets=np.array([[1e-3, -2e-3]]),
        offset_sigma=np.array([[5e-3, 0.0]]),
    )
    excess, sigma = known.compute_excess([1000.0, 10.0], np.array([0, 0]), np.array([0, 1]))
    zero = SPEED_OF_LIGHT / 2 * 100e-12
    np.testing.assert_allclose(excess, [2 * 3e-3 + 1e-3, -2e-3])
    np.testing.assert_allclose(sigma, [np.sqrt(zero**2 + 4e-3**2 + 5e-3**2), zero])
