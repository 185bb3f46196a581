"""The inactive region, time of flight and shadows of cast rays against geometry that is known;
occluder and target separated by time, and the model of what the one hides of the other.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apps.occlusion.experiment import (
    ILLUMINATIONS,
    OCCLUDER_DISTANCE_M,
    SCENES,
    TARGET_DEPTH_M,
    Experiment,
    ExperimentSettings,
    make_occlusion_scene,
    make_upright_bar,
    probe_target,
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
from tofclip.simulate.bodies import Body, Lambertian, Rectangle, compute_irradiance
from tofclip.simulate.light_fields import (
    CameraArray,
    PulsedScene,
    TimeAxis,
    render_flash,
    render_flash_view,
)
from tofclip.simulate.patterns import make_plain_pattern
from tofclip.units import SPEED_OF_LIGHT


def make_plate(width, height, z, x=0.0):
    return Body(
        Rectangle(width, height), Lambertian(make_plain_pattern(0.5)), np.array([x, 0.0, z])
    )


@given(
    baseline=st.floats(5, 30),
    share=st.floats(0.05, 1.6),
    distance=st.floats(20, 80),
    across=st.floats(-20, 20),
    behind=st.floats(0.5, 300),
)
def test_a_point_is_inside_exactly_if_cast_rays_reach_it_from_no_view_and_no_lamp_beside_one(
    baseline, share, distance, across, behind
):
    region = InactiveRegion(baseline, share * baseline, distance)
    plate = make_plate(region.width, 100.0, distance)
    point = np.array([across, 0.0, distance + behind])
    places = np.linspace(-0.5, 0.5, 7) * baseline
    passed = (across * distance + places * behind) / (distance + behind)
    if np.any(abs(abs(passed) - region.width / 2) < 1e-9):
        return  # a ray along the very edge may go either way
    origins = np.stack([places, 0 * places, 0 * places], axis=-1)
    met = [plate.intersect(origin, (point - origin)[np.newaxis]).distance for origin in origins]
    reached = np.isinf(met)[:, 0]
    np.testing.assert_array_equal(region.sees(places, across, behind), reached)
    assert bool(region.contains(across, behind)) is not reached.any()
    # with a lamp at each view, light gets there and back by the same lines of sight, or not at all
    bodies = make_plate(1e-7, 1e-7, distance + behind, across), plate
    speck = point[np.newaxis], np.array([[0.0, 0.0, -1.0]])
    lit = [compute_irradiance(bodies, origin, *speck)[0] > 0 for origin in origins]
    np.testing.assert_array_equal(lit, reached)


@given(share=st.floats(0.05, 0.95), distance=st.floats(20, 80), place=st.floats(0.01, 3))
def test_on_the_axis_the_region_ends_at_its_length(share, distance, place):
    region = InactiveRegion(15.0, 15.0 * share, distance)
    assert bool(region.contains(0.0, place * region.length)) == (place < 1) or math.isclose(
        place, 1, rel_tol=1e-9
    )


@pytest.mark.parametrize("width", [15.0, 20.0])
def test_behind_a_wide_occluder_nothing_is_promised(width):
    region = InactiveRegion(15.0, width, 50.0)
    assert (region.is_bounded, region.length) == (False, math.inf)
    assert region.contains(0.0, 1e6)


ARRAY = CameraArray(
    (21, 21), 3, focal_length_px=60.0, view_step=5e-3, focus=0.1, samples=1, view_rows=1
)
AT_HOME = np.zeros((1, 3))
CLOCK = TimeAxis.for_ranges(0.02, 0.2, 20e-12, 60e-12)
SMALL_BEFORE_LARGE = (make_plate(0.01, 0.01, 0.05), make_plate(0.4, 0.4, 0.1))


def test_a_row_of_cameras_has_views_to_both_sides():
    np.testing.assert_array_equal(ARRAY.views, [[0, -1], [0, 0], [0, 1]])
    np.testing.assert_allclose(ARRAY.position((0.0, 1.0)), [5e-3, 0, 0])


@pytest.mark.parametrize("z", [0.06, 0.15])
def test_light_from_a_plate_arrives_after_the_way_there_and_back_and_fades_with_distance(z):
    seen = render_flash_view(
        PulsedScene((make_plate(0.4, 0.4, z),), AT_HOME), ARRAY, CLOCK, (0.0, 0.0)
    )
    middle = seen[10, 10]
    # half the field is 1/6 of the distance: its corners lie 2.7 % further, and half a bin at most
    # cut off
    assert middle @ CLOCK.times / middle.sum() == pytest.approx(2 * z / SPEED_OF_LIGHT, abs=1e-13)
    assert middle.sum() == pytest.approx(0.5 * (ARRAY.focus / z) ** 2, rel=1e-5)
    corner = seen[0, 0]
    far = z * np.sqrt(1 + 2 / 36)
    assert corner @ CLOCK.times / corner.sum() == pytest.approx(2 * far / SPEED_OF_LIGHT, abs=1e-13)
    assert corner.sum() == pytest.approx(0.5 * ARRAY.focus**2 * z / far**3, rel=1e-5)


def test_a_lamp_to_the_side_throws_the_shadow_to_the_other_side():
    lamp = np.array([[-0.05, 0.0, 0.0]])
    seen = render_flash_view(PulsedScene(SMALL_BEFORE_LARGE, lamp), ARRAY, CLOCK, (0.0, 0.0))
    total = seen[10].sum(axis=-1)
    # the plate's edges at -5 and 5 mm throw shadows to 40 and 60 mm; a pixel of the wall is 1/600 m
    # wide
    wall = (np.arange(21) - 10) * 0.1 / 60
    assert not total[(wall > 0.041) & (wall < 0.059)].any()
    assert (total[wall < -0.011] > 0).all()


def test_every_view_is_rendered_on_its_own_and_a_lamp_beside_one_shows_it_no_shadow():
    scene = PulsedScene(SMALL_BEFORE_LARGE, AT_HOME)
    all_views = render_flash(scene, ARRAY, CLOCK)
    assert all_views.shape == (3, 21, 21, CLOCK.bins)
    for number in range(3):
        alone = render_flash_view(scene, ARRAY, CLOCK, (0.0, number - 1.0))
        np.testing.assert_array_equal(all_views[number], alone)
    assert all_views[1].sum(axis=-1).min() > 0


SMALL = ExperimentSettings(side_px=48, sampling_ratio=1.0)


@pytest.fixture(scope="module")
def plate():
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
        *(
            lambda lengths=lengths: InactiveRegion(*lengths)
            for lengths in ((0.0, 6.0, 50.0), (15.0, -1.0, 50.0), (15.0, 6.0, math.nan))
        ),
        lambda: PulsedScene((), AT_HOME),
        lambda: PulsedScene(SMALL_BEFORE_LARGE, np.zeros(3)),
        lambda: TimeAxis(0.0, 0.0, 5, 1e-12),
        lambda: TimeAxis(np.nan, 1e-12, 5, 1e-12),
        lambda: CameraArray(view_rows=0),
        lambda: make_occlusion_scene("fog"),
        lambda: ExperimentSettings(illumination="moon"),
        lambda: ExperimentSettings(side_px=8),
        lambda: ExperimentSettings(photons=0.0),
    ],
)
def test_nonsense_is_refused(fault):
    with pytest.raises(InputError):
        fault()


def test_readings_of_another_rig_are_refused(plate):
    with pytest.raises(ShapeError):
        TimedMeasurements(plate.measurements.values[1:], plate.rig, plate.time_axis)
