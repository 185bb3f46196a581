"""Light-field cameras: how many measurements they take and which views get them, that their two models
agree, and what solvers take for their norm.
"""

from __future__ import annotations

import numpy as np
import pytest

from tofclip.errors import InputError
from tofclip.operators import (
    Composition,
    DenseSensor,
    Integration,
    LinearShear,
    PointSpreadConvolution,
    SparseMatrix,
)
from tofclip.operators.cameras import (
    CAMERAS,
    COMPRESSIVE_CAMERAS,
    AshokCamera,
    BabacanCamera,
    CodedApertureCamera,
    EvenAngleLineCamera,
    LineCamera,
    MarwahCamera,
    MeasuredCamera,
    assign_evenly,
    assign_randomly,
    count_lines,
)
from tofclip.operators.codes import make_sheared_mask
from tofclip.operators.point_spreads import MeasuredPointSpreads
from tofclip.solvers.fista import NORM_MARGIN

VIEWS = [(float(v), float(u)) for v in range(-2, 2) for u in range(-1, 2)]
SHAPE = (48, 56)
AREA = ("coded-aperture", "cubic-phase", "diffuser")

every_camera = pytest.mark.parametrize("name", CAMERAS)


def blob(y: float = 24.0, x: float = 29.0) -> np.ndarray:
    """A spot that no shear or PSF of these cameras brings near a border, and smooth enough for
    interpolation.
    """
    rows, columns = np.indices(SHAPE)
    return np.exp(-((rows - y) ** 2 + (columns - x) ** 2) / 12).astype(np.float32)


@every_camera
@pytest.mark.parametrize("ratio", [1.0, 0.5, 0.13])
def test_the_sampling_ratio_holds(name, ratio):
    camera = CAMERAS[name](SHAPE, VIEWS, ratio, 0)
    expected = ratio * SHAPE[0] * SHAPE[1]
    assert (
        camera.light_field_model().shape_out
        == camera.model(0.0).shape_out
        == (camera.measurements,)
    )
    # A line detector, a row of the area sensor or a code for each view is the least that can be
    # added or left out.
    step = len(VIEWS) if name == "single-pixel" else max(SHAPE)
    assert abs(camera.measurements - expected) <= step
    assert camera.weighting().shape_in == (camera.measurements,)


@every_camera
@pytest.mark.parametrize("reference", [(0.0, 0.0), (0.5, -0.7)])
def test_a_flat_scene_is_seen_alike_by_both_models(name, reference):
    """Eq. 20 on the sheared views is Eq. 21 on the picture; linear interpolation in another order
    differs by 3 %.
    """
    camera = CAMERAS[name](SHAPE, VIEWS, 0.6, 1)
    pictures = [
        LinearShear(SHAPE, -0.8, camera.views[k], reference)(blob()) for k in camera.used_views
    ]
    true = camera.light_field_model()(np.stack(pictures))
    seen = camera.model(-0.8, reference)(blob())
    assert np.linalg.norm(seen - true) < 0.03 * np.linalg.norm(true)
    assert np.linalg.norm(camera.model(0.4, reference)(blob()) - true) > 0.04 * np.linalg.norm(true)


@every_camera
def test_the_seed_decides_the_camera(name):
    measurements = [CAMERAS[name](SHAPE, VIEWS, 0.5, seed).model(0.7)(blob()) for seed in (3, 3, 4)]
    np.testing.assert_array_equal(measurements[0], measurements[1])
    assert name == "cubic-phase" or not np.allclose(measurements[0], measurements[2], rtol=1e-3)


@every_camera
@pytest.mark.parametrize("ratio", [0.0, -1.0, np.nan, 1e-6])
def test_a_ratio_that_leaves_no_reading_is_refused(name, ratio):
    with pytest.raises(InputError, match="sampling ratio"):
        CAMERAS[name](SHAPE, VIEWS, ratio, 0)


@pytest.mark.parametrize("name", AREA)
def test_one_area_sensor_cannot_read_more_than_its_pixels(name):
    with pytest.raises(InputError, match="up to 1, not 2"):
        CAMERAS[name](SHAPE, VIEWS, 2.0, 0)


@every_camera
def test_a_shear_that_leaves_the_field_is_refused(name):
    with pytest.raises(InputError, match="shear"):
        CAMERAS[name](SHAPE, VIEWS, 0.5, 0).model(60.0)


def test_few_lines_leave_views_without_any():
    camera = CAMERAS["line"](SHAPE, VIEWS, 0.1, 0)
    assert len(camera.used_views) == camera.measurements // max(SHAPE) == 5
    assert isinstance(camera.weighting() @ camera.model(0.3), SparseMatrix)


def test_a_closed_cell_blinds_its_view():
    camera = CodedApertureCamera(SHAPE, VIEWS, 1.0, 0)
    code = camera.make_element().code
    assert 0 < len(camera.used_views) == code.sum() < len(VIEWS)


def test_a_measured_camera_is_one_convolution_with_the_depth_s_spread():
    stack = np.random.default_rng(0).random((2, 20, 24))
    measured = MeasuredPointSpreads(stack, [-1.0, 0.0])
    expected = PointSpreadConvolution(SHAPE, measured.interpolate(-0.3))(blob())
    np.testing.assert_allclose(
        MeasuredCamera(SHAPE, measured).model(-0.3)(blob()), expected.ravel(), rtol=1e-6
    )


def test_a_measured_camera_without_a_lens_sees_beyond_its_sensor():
    measured = MeasuredPointSpreads(np.ones((1, 20, 24)), [0.0])
    model = MeasuredCamera(SHAPE, measured, DenseSensor((24, 28))).model(0.0)
    assert isinstance(model, Composition)
    assert model.shape_in == SHAPE
    assert model(blob(24, 6)).sum() > 0


@pytest.mark.parametrize(
    ("name", "weight", "worst"),
    [
        ("line", 1.5e-2, 0.10),
        ("line-even", 2.5e-2, 0.045),
        ("single-pixel", 7e-2, 0.045),
        ("coded-line", 1e-2, 0.18),
        ("coded-aperture", 1e-2, 0.13),
        ("cubic-phase", 1e-2, 0.13),
        ("diffuser", 2e-3, 0.22),
    ],
)
def test_every_camera_refocuses_the_letters(name, weight, worst, shared_data):
    """Measurements from the true views; bounds with a little room above what was seen. Mixed up depths
    give twice that.
    """
    from tofclip.io.light_fields import read_light_field
    from tofclip.metrics import nmse
    from tofclip.solvers import TotalVariation

    letters = read_light_field(shared_data / "lightfields" / "render_letters.npz")
    camera = CAMERAS[name]((128, 128), [(v, u) for v, u in letters.views.tolist()], 0.5, 0)
    measurements = camera.light_field_model()(letters.pictures[list(camera.used_views)])
    weighting = camera.weighting()
    method = TotalVariation(weight, 300, 1e-4)
    errors = {}
    for shear in (-0.3, 1.2):
        found = method.recover(
            weighting @ camera.model(shear), weighting(measurements)[:, None]
        ).frames[0]
        errors[shear] = nmse(found, letters.refocus(-0.3), 12)
    assert errors[-0.3] < worst
    assert errors[1.2] > 2 * errors[-0.3]


GRID = [(float(v), float(u)) for v in range(-4, 4) for u in range(-4, 4)]


def random_deal(angles: np.ndarray, seed: int):
    return assign_randomly(angles, len(GRID), np.random.default_rng(seed))


def even_deal(angles: np.ndarray, seed: int, cycle: int = 4):
    return assign_evenly(angles, GRID, cycle, np.random.default_rng(seed))


@pytest.mark.parametrize("deal", [random_deal, even_deal])
@pytest.mark.parametrize("count", [5, 64, 100, 256])
def test_every_angle_is_dealt_once_and_no_view_gets_two_more_than_another(deal, count):
    angles = np.arange(count) * np.pi / count
    used, dealt = deal(angles, 0)
    assert list(used) == sorted(set(used))
    np.testing.assert_array_equal(np.sort(np.concatenate(dealt)), angles)
    own = np.zeros(len(GRID), int)
    own[list(used)] = [len(angles) for angles in dealt]
    assert own.max() == -(-count // len(GRID))
    if deal is random_deal:
        assert own.max() - own.min() <= 1


def unevenness(used: tuple[int, ...], dealt: list[np.ndarray], window: int) -> float:
    """How far the mean of ``t = u cos + v sin`` over neighbouring angles is from the aperture's,
    rms, in views.
    """
    angles = np.concatenate(dealt)
    v, u = np.repeat(np.array(GRID)[list(used)], [len(own) for own in dealt], axis=0).T
    order = np.argsort(angles)
    offset = ((u + 0.5) * np.cos(angles) + (v + 0.5) * np.sin(angles))[order]
    return float(np.sqrt(np.mean(np.convolve(offset, np.ones(window) / window, "valid") ** 2)))


@pytest.mark.parametrize(("count", "cycle"), [(32, 2), (64, 2), (128, 4), (256, 8)])
def test_neighbouring_angles_stand_for_the_whole_aperture(count, cycle):
    """Their mean place is the aperture's middle, many times more nearly than at random; so for
    every seed.
    """
    angles = np.arange(count) * np.pi / count
    even = [unevenness(*even_deal(angles, seed, cycle), cycle) for seed in range(3)]
    at_random = [unevenness(*random_deal(angles, seed), cycle) for seed in range(3)]
    assert max(even) < 0.25 * min(at_random)


def test_the_places_of_a_cycle_are_all_different():
    """With cycle 8 each eighth of the ranked views is taken once in every eight angles."""
    angles = np.arange(64) * np.pi / 64
    used, dealt = even_deal(angles, 0, 8)
    owner = np.empty(64, int)
    owner[np.searchsorted(angles, np.concatenate(dealt))] = np.repeat(
        used, [len(own) for own in dealt]
    )
    v, u = np.array(GRID).T[:, :, None]
    rank = np.argsort(
        np.argsort(u * np.cos(angles) + v * np.sin(angles), axis=0, kind="stable"),
        axis=0,
        kind="stable",
    )
    eighth = rank[owner, np.arange(64)] * 8 // 64
    # Each view is taken once only, so that a few must make do with a neighbouring eighth.
    assert np.mean([len(set(eighth[k : k + 8])) for k in range(0, 64, 8)]) > 6.5


def test_the_even_camera_measures_as_much_as_the_random_one():
    for ratio in (0.25, 1.0, 2.0):
        cameras = [kind((32, 32), GRID, ratio, 0) for kind in (LineCamera, EvenAngleLineCamera)]
        assert cameras[0].measurements == cameras[1].measurements
        np.testing.assert_array_equal(
            *(np.sort(np.concatenate(camera.angles)) for camera in cameras)
        )


def test_no_lines_at_all_are_refused():
    with pytest.raises(InputError, match="gives no view a projection"):
        count_lines((32, 32), 32, 0.01)


MASKED_VIEWS = [(float(v), float(u)) for v in range(-1, 2) for u in range(-2, 2)]
SMALL = (9, 11)

every_mask = pytest.mark.parametrize("name", COMPRESSIVE_CAMERAS)


def light_field() -> np.ndarray:
    return np.random.default_rng(0).random((len(MASKED_VIEWS), *SMALL)).astype(np.float32)


@every_mask
def test_the_whole_model_is_the_sum_of_the_views_encoders(name):
    camera = COMPRESSIVE_CAMERAS[name](SMALL, MASKED_VIEWS, 1, 3)
    assert camera.measurements == 99
    assert camera.used_views == tuple(range(12))
    summed = Integration(camera.encoders)(light_field())
    np.testing.assert_allclose(camera.light_field_model()(light_field()), summed, rtol=1e-5)
    np.testing.assert_array_equal(camera.weighting()(summed), summed)


@pytest.mark.parametrize("kind", [AshokCamera, BabacanCamera])
def test_each_exposure_weighs_whole_views(kind):
    camera = kind(SMALL, MASKED_VIEWS, 5, 1)
    weights = camera.weights()
    assert weights.shape == (5, 12)
    assert 0 <= weights.min() < weights.max() <= 1
    exposures = camera.light_field_model()(light_field()).reshape(5, *SMALL)
    np.testing.assert_allclose(
        exposures, np.einsum("jk,kyx->jyx", weights, light_field()), rtol=1e-5
    )
    assert np.linalg.matrix_rank(weights) == 5


def test_ashok_s_first_mask_is_open_and_half_of_the_others_cells_are():
    weights = AshokCamera(SMALL, [(0.0, float(u)) for u in range(16)], 16, 0).weights()
    assert weights[0].all()
    np.testing.assert_array_equal(weights[1:].sum(axis=1), 8)


def test_marwah_s_mask_is_the_same_for_all_views_but_moved():
    """Each view of shear 1 sees the mask of the view above it one row further down."""
    codes = MarwahCamera(SMALL, MASKED_VIEWS, 1, 0).codes().reshape(3, 4, *SMALL)
    np.testing.assert_allclose(codes[1, :, 1:], codes[0, :, :-1])
    np.testing.assert_allclose(codes[:, 1, :, 1:], codes[:, 0, :, :-1])
    assert 0 <= codes.min() < codes.max() <= 1


def test_no_view_looks_past_the_edge_of_the_mask():
    """Beyond it all would be dark, and random transmissions never are; far views look furthest."""
    views = [(float(v), float(u)) for v in (-4, 4) for u in (-4, 4)]
    codes = make_sheared_mask((9, 11), views, 1.6, np.random.default_rng(0))
    assert codes.shape == (4, 9, 11)
    assert codes.min() > 0


@every_mask
def test_a_picture_is_seen_as_its_sheared_views(name):
    from tofclip.operators import ShearedViews

    camera = COMPRESSIVE_CAMERAS[name](SMALL, MASKED_VIEWS, 1, 3)
    picture = light_field()[0]
    views = ShearedViews(SMALL, MASKED_VIEWS, 0.6, (0.5, 0.0))(picture)
    np.testing.assert_allclose(
        camera.model(0.6, (0.5, 0.0))(picture), camera.light_field_model()(views), rtol=1e-6
    )


@every_mask
@pytest.mark.parametrize("ratio", [0.5, 1.3])
def test_exposures_are_whole(name, ratio):
    with pytest.raises(InputError, match="a whole one"):
        COMPRESSIVE_CAMERAS[name](SMALL, MASKED_VIEWS, ratio, 0)


def test_more_exposures_than_a_camera_has_are_refused():
    with pytest.raises(InputError, match="one exposure, not 2"):
        MarwahCamera(SMALL, MASKED_VIEWS, 2, 0)
    with pytest.raises(InputError, match="at most 16"):
        AshokCamera(SMALL, MASKED_VIEWS, 17, 0)


NINE_VIEWS = [(v, u) for v in range(-1, 2) for u in range(-1, 2)]
SIDE = 16


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("ratio", [0.5, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_the_margin_covers_what_the_estimate_of_the_norm_lacks(name, ratio, seed):
    camera = CAMERAS[name]((SIDE, SIDE), NINE_VIEWS, ratio, seed)
    model = camera.weighting() @ camera.model(0.3)
    pictures = np.eye(SIDE * SIDE, dtype=model.dtype).reshape(SIDE, SIDE, -1)
    matrix = model(pictures).reshape(-1, SIDE * SIDE).astype(np.float64)
    norm = np.linalg.norm(matrix, 2) ** 2
    assert norm / NORM_MARGIN <= model.squared_norm <= norm * 1.0001
