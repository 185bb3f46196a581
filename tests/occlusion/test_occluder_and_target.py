"""Occluder and target separated by time, and the model of what the one hides of the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from apps.occlusion.experiment import ILLUMINATIONS, Experiment, ExperimentSettings
from apps.occlusion.probe import probe_target
from apps.occlusion.scenes import (
    OCCLUDER_DISTANCE_M,
    SCENES,
    TARGET_DEPTH_M,
    make_occlusion_scene,
    make_upright_bar,
)
from tofclip.errors import InputError, ShapeError
from tofclip.metrics import correlation_coefficient, nmse
from tofclip.occlusion import (
    InactiveRegion,
    TimedMeasurements,
    add_poisson_noise,
    build_occluded_model,
    find_occlusion_mask,
    measure_views,
    separate_occluder,
)
from tofclip.units import SPEED_OF_LIGHT

SMALL = ExperimentSettings(side_px=48, sampling_ratio=1.0)


@pytest.fixture(scope="module")
def plate() -> Experiment:
    return Experiment(make_occlusion_scene("plate"), SMALL)


def test_returns_are_found_where_they_are(plate):
    occluder, target = plate.measurements.find_returns()
    # The picture's corners are up to 5 % further away than its middle, and the word is wide.
    assert occluder.distance == pytest.approx(OCCLUDER_DISTANCE_M, rel=0.02)
    assert target.distance == pytest.approx(OCCLUDER_DISTANCE_M + TARGET_DEPTH_M, rel=0.02)
    assert occluder.bins.stop == target.bins.start


def test_the_mean_time_of_flight_on_the_axis(plate):
    places = np.linspace(-7.5e-3, 7.5e-3, 7)
    expected = 2 * np.hypot(0.1, places).mean() / SPEED_OF_LIGHT
    assert plate.rig.compute_flight_time(np.array([0.1]))[0] == pytest.approx(expected, rel=1e-12)


def test_a_single_return_is_not_split(plate):
    alone = replace(
        plate.measurements, values=plate.measurements.values * (plate.time_axis.times < 0.55e-9)
    )
    assert len(alone.find_returns()) == 1
    assert not separate_occluder(alone).target.any()
    assert alone.find_returns()[0].distance == pytest.approx(OCCLUDER_DISTANCE_M, rel=0.02)
    dark = replace(alone, values=0 * alone.values)
    assert dark.find_returns() == ()
    with pytest.raises(InputError, match="no light"):
        separate_occluder(dark)


@pytest.mark.parametrize("photons", [300, 1e6])
def test_a_dim_target_behind_a_retroreflector_is_found_and_noise_is_not(plate, photons):
    """The occluder 300 times as bright: the target has 0.012 % of its peak, and its photons."""
    clean, early = plate.measurements, plate.time_axis.times < 0.55e-9
    per_unit = photons / (clean.values * ~early).sum()
    random = np.random.default_rng(0)
    dazzled = add_poisson_noise(clean.values * (1 + 299 * early), per_unit, random)
    measured = replace(clean, values=dazzled)
    _, target = measured.find_returns()
    assert target.distance == pytest.approx(OCCLUDER_DISTANCE_M + TARGET_DEPTH_M, rel=0.02)
    assert len(measured.split_returns(OCCLUDER_DISTANCE_M + TARGET_DEPTH_M / 2)) == 2
    # A background of a photon in a hundred measurements, whose noise is 1 % of the peak where it is dim.
    light = clean.values * early + 0.01 * clean.values.mean()
    for _ in range(5):
        counts = add_poisson_noise(light, 0.1 * per_unit, random)
        assert len(replace(clean, values=counts).find_returns()) == 1


def test_the_model_of_hidden_pixels_and_shadows_agrees_with_cast_rays(plate):
    """The true target through the model, with the true cover, is what the true views read."""
    array = plate.rig.array
    bare = plate._render_middle_view(plate.scene.occluder, array).sum(axis=-1)
    cover = (bare > 0.5 * bare.max()).astype(np.float32)
    shears = tuple(
        float(array.shear(z)) for z in (OCCLUDER_DISTANCE_M, OCCLUDER_DISTANCE_M + TARGET_DEPTH_M)
    )
    clean = measure_views(plate.pictures, plate.rig, plate.time_axis).sum_gate(
        plate.measurements.find_returns()[1].bins
    )
    # The reference picture at its own shear is the target's; borders of the bar fall between
    # pixels.
    predicted = build_occluded_model(plate.rig, cover, shears)(plate.truth)
    plain = plate.rig.camera.model(shears[1])(plate.truth)
    error, before = (
        np.linalg.norm(one - clean) / np.linalg.norm(clean) for one in (predicted, plain)
    )
    assert error < 0.15 < before


def test_the_adjoint_of_the_model_matches(plate):
    random = np.random.default_rng(0)
    model = build_occluded_model(
        plate.rig, (random.random((48, 48)) < 0.3).astype(np.float32), (-1.5, 1.5)
    )
    x, y = random.random(model.shape_in), random.random(model.shape_out)
    assert float(np.vdot(model(x), y)) == pytest.approx(
        float(np.vdot(x, model.adjoint(y))), rel=1e-5
    )


def test_a_cover_is_what_is_as_bright_as_the_occluder_whatever_piles_up_at_the_border():
    picture = np.zeros((40, 40), np.float32)
    picture[10:30, 15:20] = 0.5 + 0.05 * np.random.default_rng(1).standard_normal((20, 5))
    picture[0, :5] = 9.0
    expected = np.zeros((40, 40), bool)
    expected[10:30, 15:20] = expected[0, :5] = True
    np.testing.assert_array_equal(find_occlusion_mask(picture), expected)


def test_what_one_view_cannot_see_all_views_recover(plate):
    found = plate.separated
    assert found.sees_target
    ours, plainly = (
        correlation_coefficient(one, plate.truth) for one in (found.target, found.plain)
    )
    assert ours > 0.9 > plainly
    assert ours > correlation_coefficient(plate.single_view, plate.single_view_truth)
    assert ours > correlation_coefficient(plate.conventional, plate.truth)
    assert nmse(found.target, plate.truth) < 0.2
    assert found.occluder[24, 24] > 0
    assert plate.single_view.size == pytest.approx(plate.rig.camera.measurements, rel=0.05)


def test_behind_a_board_nothing_is_found_and_nothing_invented():
    board = Experiment(make_occlusion_scene("board"), SMALL)
    assert not board.scene.region.is_bounded
    assert not board.separated.sees_target
    assert not board.separated.target.any()
    assert board.separated.occluder.any()
    assert not board.single_view.any()


def test_a_lone_lamp_at_the_middle_leaves_in_the_dark_what_the_middle_view_cannot_see():
    scene = make_occlusion_scene("plate")
    light = {}
    for illumination in ILLUMINATIONS:
        lit = Experiment(scene, replace(SMALL, illumination=illumination))
        target = lit.measurements.find_returns()[1].bins
        light[illumination] = lit.pictures[..., target].sum(axis=-1)[:, 24, 20:28].sum()
    assert light["co-located"] < 0.2 * min(light["diodes"], light["oblique"])


@pytest.mark.parametrize(("factor", "recovered"), [(0.8, False), (1.2, True), (2.0, True)])
def test_targets_are_recovered_beyond_the_inactive_region_and_not_inside(factor, recovered):
    region = InactiveRegion(15e-3, 6e-3, 50e-3)
    found = probe_target((make_upright_bar(region.width, region.distance),), region, factor)
    assert (found.is_recovered, found.expected_visible) == (recovered, recovered)
    assert (found.views > 0) == recovered
    assert found.truth.max() > 0


@pytest.mark.parametrize("name", [name for name in SCENES if name != "board"])
def test_the_solid_part_on_every_scenes_axis_is_as_wide_as_its_region_says(name):
    scene = make_occlusion_scene(name)
    x = np.linspace(-1.5, 1.5, 1201) * scene.region.width
    rays = np.stack([x, 0 * x, np.full_like(x, scene.region.distance)], axis=-1)
    met = np.any(
        [np.isfinite(body.intersect(np.zeros(3), rays).distance) for body in scene.occluder], axis=0
    )
    edges = np.flatnonzero(np.diff(met.astype(int)))
    left, right = edges[edges < 600].max(), edges[edges > 600].min()
    # patterns have texels
    assert x[right] - x[left] == pytest.approx(scene.region.width, rel=0.05)
    assert met[600]


@pytest.mark.parametrize(
    "fault",
    [
        lambda: make_occlusion_scene("fog"),
        lambda: ExperimentSettings(illumination="moon"),
        lambda: ExperimentSettings(side_px=8),
        lambda: ExperimentSettings(photons=0.0),
    ],
)
def test_bad_settings_are_refused(fault):
    with pytest.raises(InputError):
        fault()


def test_readings_of_another_rig_are_refused(plate):
    with pytest.raises(ShapeError):
        TimedMeasurements(plate.measurements.values[1:], plate.rig, plate.time_axis)


def test_correlation_knows_no_scale_and_a_dark_picture_shows_nothing():
    truth = np.random.default_rng(0).random((8, 8))
    assert correlation_coefficient(3 * truth + 1, truth) == pytest.approx(1)
    assert correlation_coefficient(-truth, truth) == pytest.approx(-1)
    assert correlation_coefficient(np.zeros((8, 8)), truth) == 0
    with pytest.raises(InputError):
        correlation_coefficient(truth, np.ones((8, 8)))
