"""`--refine photons`: albedo by the statistics of counts and the time of flight."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.linalg import norm
from scenes import FIVE_POINTS, distance_to_nearest, energy_fraction, planar_wall

from nlos import Capture, Grid, Hybrid
from nlos.capture import TimeAxis
from nlos.refinement.photons import (
    HELD_OUT_FRACTION,
    LINEAR_SHOWN,
    CountedPhotons,
    PhotonFit,
    PhotonRefinement,
    TimeOfFlight,
    build_response,
    compute_beam,
    judge,
)
from nlos.simulate import HiddenScene, PointScene, Surface, add_poisson_noise, build_relay_wall
from tofclip.errors import InputError

SIDE = np.linspace(-0.75, 0.75, 64)
FINE = Grid(SIDE, SIDE, np.linspace(0.5, 1.25, 64))
COARSE = Grid(SIDE[::2], SIDE[::2], FINE.z[::2])
SMALL = Grid(COARSE.x[::2], COARSE.y[::2], COARSE.z[::2])
AXIS = TimeAxis(512, 32e-12)
LINEAR = Hybrid(0.125, 4.243)
BACKGROUND = 0.02


@cache
def expected(wall, scene, points):
    """Light of five points, or of two letters, before noise; one laser spot."""
    hidden = PointScene(FIVE_POINTS) if scene == "points" else letters()
    return hidden.simulate_capture(build_relay_wall(wall, points), np.zeros(3), AXIS, 20e-12)


@cache
def letters():
    height = 0.6
    left = Surface.letters("L", (-0.3, 0.0, 0.8), height, 0.02)
    return HiddenScene([left, Surface.letters("N", (0.3, 0.0, 1.0), height, 0.02)])


def count(wall, scene, photons, points, seed):
    """Draw counts: so many photons of hidden things per wall point of 64 x 64, and background."""
    light = expected(wall, scene, points)
    peak = photons * 64**2 * float(light.signal.max()) / float(light.signal.sum(dtype=float))
    return add_poisson_noise(light, peak, BACKGROUND, seed)


def mask_of(scene, grid):
    """Voxels within 4 cm of a point, or that hold a piece of a letter."""
    if scene == "points":
        return distance_to_nearest(grid, FIVE_POINTS) <= 0.04
    mask = np.zeros(grid.shape, bool)
    for surface in letters().surfaces:
        for position in surface.positions:
            mask[grid.find_nearest(position)] = True
    return mask


def score_brightest(volume, occupied):
    """Of the K brightest voxels, the fraction that is occupied, where K voxels are."""
    brightest = np.argsort(-volume.magnitude, axis=None, kind="stable")
    return float(np.mean(occupied.ravel()[brightest[: np.count_nonzero(occupied)]]))


@pytest.mark.parametrize("obliquity", [0, 2])
@pytest.mark.parametrize("laser", ["spot", "confocal"])
def test_light_and_backprojection_are_adjoint(obliquity, laser):
    wall, random = build_relay_wall("wavy", 6), np.random.default_rng(1)
    spot = wall if laser == "confocal" else np.array([0.1, 0.0, -0.1])
    capture = Capture(np.zeros((200, 6, 6)), wall, spot, 40e-12, 1.2)
    grid = Grid(np.linspace(-0.4, 0.4, 9), np.linspace(-0.4, 0.4, 8), np.linspace(0.5, 1.4, 7))
    model = TimeOfFlight(capture, grid, np.array([0.1, 0.3, 0.6]), obliquity)
    voxels, points = np.arange(3, grid.size, 2), np.arange(1, 36)
    albedo, values = random.random(voxels.size), random.random((points.size, 200))
    light = model.compute_light(albedo, voxels, points)
    assert light.min() > -1e-6
    back = model.backproject(values, voxels, points)
    assert np.sum(light * values) == pytest.approx(np.sum(albedo * back), rel=1e-5)


@pytest.mark.parametrize("wall", ["planar", "cylinder"])
def test_few_photons_show_points(wall):
    """1.15 photons per wall point of 64 x 64, on 16 x 16 points: as many in all."""
    near = mask_of("points", COARSE)
    capture = count(wall, "points", 1.15, 16, seed=0)
    refined = PhotonRefinement(LINEAR, iterations=4).reconstruct(capture, COARSE)
    linear = LINEAR.reconstruct(capture, COARSE)
    assert refined.values.min() >= 0
    assert energy_fraction(refined.values, near) >= 0.75  # the linear image has 0.23
    assert score_brightest(refined, near) >= score_brightest(linear, near)
    history = refined.provenance["imaging"]
    assert history["obliquity"] == 0
    assert history["background_per_bin"] == pytest.approx(BACKGROUND, rel=0.1)
    # of 4,700 that there are, and some of the background's
    assert history["photons_of_hidden_things"] == pytest.approx(1.15 * 64**2, rel=0.2)


def test_few_photons_show_letters():
    mask = mask_of("letters", COARSE)
    capture = count("planar", "letters", 5.7, 16, seed=1)
    refined = PhotonRefinement(LINEAR, iterations=4).reconstruct(capture, COARSE)
    linear = LINEAR.reconstruct(capture, COARSE)
    assert score_brightest(refined, mask) >= score_brightest(linear, mask) + 0.1
    # flat letters that face a matte wall: the cosines of both legs, squared
    assert refined.provenance["imaging"]["obliquity"] == 2


@pytest.mark.nightly
@pytest.mark.parametrize("wall", ["planar", "cylinder"])
@pytest.mark.parametrize(("photons", "least"), [(1147, 0.63), (5.7, 0.5), (1.15, 0.2)])
def test_points_at_all_levels(wall, photons, least):
    near = mask_of("points", FINE)
    for seed in range(2):
        capture = count(wall, "points", photons, 64, seed)
        refined = PhotonRefinement(LINEAR).reconstruct(capture, FINE)
        assert energy_fraction(refined.values, near) >= least
        linear = score_brightest(LINEAR.reconstruct(capture, FINE), near)
        assert score_brightest(refined, near) >= linear


def test_background_alone_shows_the_linear_image():
    """Noise is explained best by no scene at all: photons that were set aside tell."""
    light = expected("planar", "points", 16)
    for seed in range(2):
        counts = np.random.default_rng(seed).poisson(BACKGROUND, light.signal.shape)
        capture = Capture(counts, light.wall, light.laser, light.bin_width)
        refined = PhotonRefinement(LINEAR, iterations=2).reconstruct(capture, SMALL)
        assert refined.provenance["imaging"]["stopped_because"] == LINEAR_SHOWN
        assert np.array_equal(refined.values, LINEAR.reconstruct(capture, SMALL).values)


def test_the_walls_own_light_is_left_out_of_account():
    """Glare in the first 0.2 m after the direct path changes nothing but what it blanks."""
    capture = count("planar", "points", 20, 16, seed=2)
    direct = norm(capture.wall - capture.laser, axis=-1)
    glare = 1000 * (np.abs(AXIS.paths[:, None, None] - direct - 0.1) < 0.05)
    method = PhotonRefinement(LINEAR, iterations=2, blank=0.2)
    bright = Capture(capture.signal + glare, capture.wall, capture.laser, AXIS.bin_width)
    plain, blanked = (method.reconstruct(one, SMALL).values for one in (capture, bright))
    assert np.allclose(plain, blanked, atol=1e-6 * plain.max())


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda signal: signal - 1, "negative signals"),
        (lambda signal: signal * np.pi + (signal > 1), "multiples of one step"),
        (lambda signal: 0 * signal, "every signal is 0"),
    ],
)
def test_what_is_not_counted_is_refused(change, reason):
    capture = count("planar", "points", 20, 8, seed=0)
    with pytest.raises(InputError, match=reason) as refused:
        CountedPhotons.of(replace(capture, signal=change(capture.signal)))
    assert "\n" not in str(refused.value)
    # counts on another scale are counts
    tenfold = replace(capture, signal=capture.signal * 10)
    assert np.array_equal(CountedPhotons.of(tenfold).counts, CountedPhotons.of(capture).counts)


# --- a fit of known light: brightness, sharpness, and a judge that is fair

SHORT, WALL = TimeAxis(256, 32e-12), planar_wall(8, 8)


GRID = Grid(np.linspace(-0.4, 0.4, 9), np.linspace(-0.4, 0.4, 9), np.linspace(0.5, 1.0, 6))


def make_fit(wall, grid, albedo, sigma=0.0):
    """A fit that explains the photons of this albedo, without noise, and of a background."""
    capture = Capture(np.ones((SHORT.bins, *wall.shape[:2])), wall, wall, SHORT.bin_width)
    model = TimeOfFlight(capture, grid, build_response(sigma))
    voxels, everyone = np.arange(grid.size), np.arange(len(capture.points))
    light = model.compute_light(albedo, voxels, everyone)
    counts = (1000 * light / light.sum(axis=1).mean() + 0.5).astype(np.float32)
    photons = CountedPhotons(capture, counts, np.ones(counts.shape, bool))
    return PhotonFit(photons, model, voxels, np.maximum(albedo, 1e-3), 0.0)


def point_albedo(grid, *places):
    albedo = np.zeros(grid.shape)
    for place in places:
        albedo[grid.find_nearest(place)] = 1
    return albedo.ravel()


def test_photons_set_aside_prefer_the_fit_that_is_as_bright_as_the_scene():
    fit = make_fit(WALL, GRID, point_albedo(GRID, (0.1, 0.0, 0.7), (-0.2, 0.2, 0.9)))
    fit.improve(1)
    # What the kept photons are of is what this fit expects; of all photons a tenth was set aside.
    fit.photons = replace(fit.photons, counts=fit.expect())
    held = fit.photons.counts * HELD_OUT_FRACTION / (1 - HELD_OUT_FRACTION)
    light = fit.model.compute_light(np.ones(GRID.size), fit.voxels, np.arange(64))
    albedo, background, gains = fit.albedo, fit.background, {}
    for scale in (0.8, 0.9, 0.95, 1.0, 1.05, 1.1, 1.2):
        fit.albedo, fit.background = albedo * np.float32(scale), background * np.float32(scale)
        gains[scale] = judge(fit, light, held)[0]
    assert max(gains, key=lambda scale: gains[scale]) == 1.0


@pytest.mark.parametrize("sigma", [0.0, 2.0])
def test_a_point_is_as_sharp_as_response_bin_and_wall_make_it(sigma):
    """Two rings of wall points about a point's foot, each lit where it is seen: paths of 2 *
    hypot(radius, depth), whose light falls with the fourth power of the distance.
    """
    depth, radii = 0.5, np.array([0.1, 1.0])
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(24)], axis=-1)
    wall = radii[:, np.newaxis, np.newaxis] * circle
    step = np.array([-1e-3, 0.0, 1e-3])
    grid = Grid(step, step, depth + step)
    fit = make_fit(wall, grid, point_albedo(grid, (0, 0, depth)))
    fit.albedo = point_albedo(grid, (0, 0, depth)).astype(np.float32)
    fit.response_sigma = sigma
    distance = np.hypot(radii, depth)
    weights = distance**-4 / np.sum(distance**-4)
    along = np.sqrt(np.sum(weights * (2 * depth / distance) ** 2))
    across = np.sqrt(np.sum(weights * (2 * radii / distance) ** 2) / 2)
    # An even spread over a bin has the standard deviation 1 / sqrt(12).
    path = SHORT.spacing * np.sqrt(sigma**2 + 1 / 12)
    assert compute_beam(fit) == pytest.approx(
        [path / along, path / across, path / across], rel=1e-3
    )
