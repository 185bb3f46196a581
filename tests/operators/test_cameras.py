"""Light-field cameras and the point spreads of their plates: against geometric optics, how many
measurements they take and which views get them, that their two models agree, and their norm.
"""

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
    MarwahCamera,
    MeasuredCamera,
    assign_evenly,
    assign_randomly,
    count_lines,
)
from tofclip.operators.convolution import (
    CodedAperture,
    CubicPhasePlate,
    Diffuser,
    MeasuredPointSpreads,
    shear_point_spreads,
    trace_view_point_spreads,
)
from tofclip.solvers.fista import NORM_MARGIN


def make_views(rows, columns):
    return [(float(v), float(u)) for v in rows for u in columns]


VIEWS = make_views(range(-2, 2), range(-1, 2))
GRID = make_views(range(-4, 4), range(-4, 4))
SHAPE = (48, 56)
PLANE = (64, 72)

every_camera = pytest.mark.parametrize("name", CAMERAS)
every_mask = pytest.mark.parametrize("name", COMPRESSIVE_CAMERAS)


def spread_at(element, shear):
    spreads = trace_view_point_spreads(element, GRID, PLANE)
    return shear_point_spreads(spreads, GRID, shear).sum(axis=0)


@pytest.mark.parametrize("shear", [3.0, -2.0])
def test_a_coded_aperture_s_spread_is_its_code_mirrored_and_scaled_by_the_shear(shear):
    """Supplement Eq. 6; the code's cells are the views, so that at whole s each is one pixel of the
    PSF.
    """
    code = np.random.default_rng(0).integers(0, 2, (8, 8))
    expected = np.zeros(PLANE)
    for v, u in GRID:
        # The aperture's middle lies at view -0.5: its mirror image of view v is -1 - v, cell 3 - v.
        expected[int(32 + shear * v), int(36 + shear * u)] = code[int(3 - v), int(3 - u)] / 64
    np.testing.assert_allclose(spread_at(CodedAperture(code), shear), expected, atol=1e-12)
    in_focus = spread_at(CodedAperture(code), 0.0)
    assert in_focus[32, 36] == pytest.approx(code.mean(), rel=1e-12)
    assert np.count_nonzero(in_focus) == 1


def test_a_cubic_phase_plate_s_spread_hardly_changes_with_depth():
    """Against an open aperture, whose PSF grows with s: the likeness of two depths' PSFs."""

    def similarity(element):
        near, far = (np.abs(np.fft.fft2(spread_at(element, s))) for s in (0.0, 0.7))
        return float(np.vdot(near, far) / np.linalg.norm(near) / np.linalg.norm(far))

    assert similarity(CubicPhasePlate(24.0)) > 0.98
    assert similarity(CodedAperture(np.ones((8, 8)))) < 0.8
    spread = spread_at(CubicPhasePlate(20.0), 0.0)
    assert 20 <= np.ptp(np.flatnonzero(spread.sum(axis=1) > 1e-9)) <= 21
    assert np.unravel_index(spread.argmax(), PLANE) == (22, 26)  # brightest in a corner


def test_a_diffuser_s_spread_is_as_wide_as_asked_and_its_seed_decides_it():
    spread = spread_at(Diffuser(6.0, 0.15, 3), 0.0)
    rows, columns = np.indices(PLANE)
    variance = np.sum(((rows - 32) ** 2 + (columns - 36) ** 2) * spread) / 2
    assert spread.sum() == pytest.approx(1, abs=1e-3)
    # The deflections' variance is the PSF's second moment about zero deflection; the pixels add 1/6
    # of a pixel.
    assert np.sqrt(variance) == pytest.approx(6.0, rel=0.1)
    np.testing.assert_array_equal(spread, spread_at(Diffuser(6.0, 0.15, 3), 0.0))
    assert not np.allclose(spread, spread_at(Diffuser(6.0, 0.15, 4), 0.0))
    with pytest.raises(InputError, match="grain"):
        spread_at(Diffuser(3.0, 0.0, 0), 0.0)


def test_shearing_the_spread_is_shearing_the_picture():
    """A_k B_k h, for a picture and a PSF that stay off every border."""
    view, reference, shape = (1.0, 2.0), (0.3, -0.4), (64, 65)
    spreads = trace_view_point_spreads(Diffuser(2.0, 0.3, 0), [(0.0, 0.0), view], (24, 25))
    picture = np.zeros(shape)
    picture[25:40, 25:40] = np.random.default_rng(4).random((15, 15))
    moved = shear_point_spreads(spreads, [(0.0, 0.0), view], -0.7, reference)[1]
    sheared = LinearShear(shape, -0.7, view, reference, np.float64)(picture)
    np.testing.assert_allclose(
        PointSpreadConvolution(shape, moved, dtype=np.float64)(picture),
        PointSpreadConvolution(shape, spreads[1], dtype=np.float64)(sheared),
        atol=1e-12,
    )


def test_measured_spreads_are_returned_where_measured_and_mixed_between():
    stack = np.random.default_rng(5).random((3, 6, 7)) * np.array([1.0, 5.0, 2.0])[:, None, None]
    measured = MeasuredPointSpreads(stack, [0.5, -1.0, 0.0])
    unit = stack / stack.sum(axis=(1, 2), keepdims=True)
    for shear, parts in ((-1.0, (0, 1, 0)), (0.5, (1, 0, 0)), (-0.25, (0, 0.25, 0.75))):
        expected = np.tensordot(parts, unit, 1)
        np.testing.assert_allclose(measured.interpolate(shear), expected, rtol=1e-12)
    alone = MeasuredPointSpreads(stack[:1], [2.0]).interpolate(2.0)
    np.testing.assert_allclose(alone, unit[0], rtol=1e-12)
    with pytest.raises(InputError, match=r"beyond the measured -1 \.\.\. 0.5"):
        measured.interpolate(1.2)


@pytest.mark.parametrize(
    ("stack", "shears", "message"),
    [
        (np.ones((2, 3, 3)), [0.0], "must have shape"),
        (np.ones((2, 3, 3)), [0.0, 0.0], "same shear"),
        (np.zeros((1, 3, 3)), [0.0], "hold light"),
        (np.full((1, 3, 3), np.nan), [0.0], "hold light"),
        (np.ones((1, 3, 3)), [np.inf], "hold light"),
    ],
)
def test_measurements_that_cannot_be_used_are_refused(stack, shears, message):
    with pytest.raises(InputError, match=message):
        MeasuredPointSpreads(stack, shears)


def blob(y=24.0, x=29.0):
    """A spot that no shear or PSF of these cameras brings near a border, and smooth enough for
    interpolation.
    """
    rows, columns = np.indices(SHAPE)
    return np.exp(-((rows - y) ** 2 + (columns - x) ** 2) / 12).astype(np.float32)


@every_camera
@pytest.mark.parametrize("ratio", [1.0, 0.5, 0.13])
def test_the_sampling_ratio_holds(name, ratio):
    camera = CAMERAS[name](SHAPE, VIEWS, ratio, 0)
    shape = (camera.measurements,)
    assert camera.light_field_model().shape_out == camera.model(0.0).shape_out == shape
    assert camera.weighting().shape_in == shape
    # A line detector, a row of the area sensor or a code for each view is the least that can be
    # added or left out.
    step = len(VIEWS) if name == "single-pixel" else max(SHAPE)
    assert abs(camera.measurements - ratio * SHAPE[0] * SHAPE[1]) <= step


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
    seen, elsewhere = (camera.model(shear, reference)(blob()) for shear in (-0.8, 0.4))
    assert np.linalg.norm(seen - true) < 0.03 * np.linalg.norm(true)
    assert np.linalg.norm(elsewhere - true) > 0.04 * np.linalg.norm(true)


@every_camera
def test_the_seed_decides_the_camera(name):
    first, again, other = (
        CAMERAS[name](SHAPE, VIEWS, 0.5, seed).model(0.7)(blob()) for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(first, again)
    assert name == "cubic-phase" or not np.allclose(first, other, rtol=1e-3)


@every_camera
def test_ratios_and_shears_that_cannot_be_are_refused(name):
    for ratio in (0.0, -1.0, np.nan, 1e-6):
        with pytest.raises(InputError, match="sampling ratio"):
            CAMERAS[name](SHAPE, VIEWS, ratio, 0)
    if name in ("coded-aperture", "cubic-phase", "diffuser"):
        with pytest.raises(InputError, match="up to 1, not 2"):
            CAMERAS[name](SHAPE, VIEWS, 2.0, 0)
    with pytest.raises(InputError, match="shear"):
        CAMERAS[name](SHAPE, VIEWS, 0.5, 0).model(60.0)


def test_few_lines_leave_views_without_any():
    camera = CAMERAS["line"](SHAPE, VIEWS, 0.1, 0)
    assert len(camera.used_views) == camera.measurements // max(SHAPE) == 5
    assert isinstance(camera.weighting() @ camera.model(0.3), SparseMatrix)
    with pytest.raises(InputError, match="gives no view a projection"):
        count_lines((32, 32), 32, 0.01)


def test_a_closed_cell_blinds_its_view():
    camera = CodedApertureCamera(SHAPE, VIEWS, 1.0, 0)
    assert 0 < len(camera.used_views) == camera.make_element().code.sum() < len(VIEWS)


def test_a_measured_camera_is_one_convolution_with_the_depth_s_spread():
    stack = np.random.default_rng(0).random((2, 20, 24))
    measured = MeasuredPointSpreads(stack, [-1.0, 0.0])
    expected = PointSpreadConvolution(SHAPE, measured.interpolate(-0.3))(blob())
    seen = MeasuredCamera(SHAPE, measured).model(-0.3)(blob())
    np.testing.assert_allclose(seen, expected.ravel(), rtol=1e-6)
    # without a lens it sees beyond its sensor
    model = MeasuredCamera(SHAPE, measured, DenseSensor((24, 28))).model(0.0)
    assert isinstance(model, Composition)
    assert model.shape_in == SHAPE
    assert model(blob(24, 6)).sum() > 0


def assign(even, angles, seed, cycle=4):
    """The views that have angles, and each angle's view."""
    random = np.random.default_rng(seed)
    used, dealt = (
        assign_evenly(angles, GRID, cycle, random)
        if even
        else assign_randomly(angles, len(GRID), random)
    )
    assert list(used) == sorted(set(used))
    order = np.argsort(np.concatenate(dealt))
    np.testing.assert_array_equal(np.concatenate(dealt)[order], angles)  # each is dealt once
    return used, np.repeat(used, [len(own) for own in dealt])[order]


@pytest.mark.parametrize("even", [False, True])
@pytest.mark.parametrize("count", [5, 64, 100, 256])
def test_every_angle_is_dealt_once_and_no_view_gets_two_more_than_another(even, count):
    _, owner = assign(even, np.arange(count) * np.pi / count, 0)
    own = np.bincount(owner, minlength=len(GRID))
    assert own.max() == -(-count // len(GRID))
    assert even or own.max() - own.min() <= 1


@pytest.mark.parametrize(("count", "cycle"), [(32, 2), (64, 2), (128, 4), (256, 8)])
def test_neighbouring_angles_stand_for_the_whole_aperture(count, cycle):
    """Their mean place ``t = u cos + v sin`` is the aperture's middle, many times more nearly than at
    random; so for every seed.
    """
    angles = np.arange(count) * np.pi / count

    def unevenness(even, seed):
        v, u = np.array(GRID)[assign(even, angles, seed, cycle)[1]].T
        offset = (u + 0.5) * np.cos(angles) + (v + 0.5) * np.sin(angles)
        return float(np.sqrt(np.mean(np.convolve(offset, np.ones(cycle) / cycle, "valid") ** 2)))

    evenly, randomly = ([unevenness(even, seed) for seed in range(3)] for even in (True, False))
    assert max(evenly) < 0.25 * min(randomly)


MASKED_VIEWS = make_views(range(-1, 2), range(-2, 2))
SMALL = (9, 11)
LIGHT_FIELD = np.random.default_rng(0).random((len(MASKED_VIEWS), *SMALL)).astype(np.float32)


@every_mask
def test_the_whole_model_is_the_sum_of_the_views_encoders(name):
    camera = COMPRESSIVE_CAMERAS[name](SMALL, MASKED_VIEWS, 1, 3)
    assert camera.measurements == 99
    assert camera.used_views == tuple(range(12))
    model = camera.light_field_model()
    summed = Integration(camera.encoders)(LIGHT_FIELD)
    np.testing.assert_allclose(model(LIGHT_FIELD), summed, rtol=1e-5)
    np.testing.assert_array_equal(camera.weighting()(summed), summed)
    # a picture is seen as its sheared views
    shears = (LinearShear(SMALL, 0.6, view, (0.5, 0.0)) for view in MASKED_VIEWS)
    views = np.stack([one(LIGHT_FIELD[0]) for one in shears])
    seen = camera.model(0.6, (0.5, 0.0))(LIGHT_FIELD[0])
    np.testing.assert_allclose(seen, model(views), rtol=1e-6)
    for ratio in (0.5, 1.3):
        with pytest.raises(InputError, match="a whole one"):
            COMPRESSIVE_CAMERAS[name](SMALL, MASKED_VIEWS, ratio, 0)


@pytest.mark.parametrize("kind", [AshokCamera, BabacanCamera])
def test_each_exposure_weighs_whole_views(kind):
    camera = kind(SMALL, MASKED_VIEWS, 5, 1)
    weights = camera.weights()
    assert weights.shape == (5, 12)
    assert 0 <= weights.min() < weights.max() <= 1
    exposures = camera.light_field_model()(LIGHT_FIELD).reshape(5, *SMALL)
    np.testing.assert_allclose(exposures, np.tensordot(weights, LIGHT_FIELD, 1), rtol=1e-5)
    assert np.linalg.matrix_rank(weights) == 5


def test_ashok_s_first_mask_is_open_and_half_of_the_others_cells_are():
    weights = AshokCamera(SMALL, make_views(range(1), range(16)), 16, 0).weights()
    assert weights[0].all()
    np.testing.assert_array_equal(weights[1:].sum(axis=1), 8)
    with pytest.raises(InputError, match="at most 16"):
        AshokCamera(SMALL, MASKED_VIEWS, 17, 0)


def test_marwah_s_mask_is_the_same_for_all_views_but_moved():
    """Each view of shear 1 sees the mask of the view above it one row further down."""
    codes = MarwahCamera(SMALL, MASKED_VIEWS, 1, 0).codes().reshape(3, 4, *SMALL)
    np.testing.assert_allclose(codes[1, :, 1:], codes[0, :, :-1])
    np.testing.assert_allclose(codes[:, 1, :, 1:], codes[:, 0, :, :-1])
    assert 0 <= codes.min() < codes.max() <= 1
    with pytest.raises(InputError, match="one exposure, not 2"):
        MarwahCamera(SMALL, MASKED_VIEWS, 2, 0)


@every_camera
@pytest.mark.parametrize("ratio", [0.5, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_the_margin_covers_what_the_estimate_of_the_norm_lacks(name, ratio, seed):
    camera = CAMERAS[name]((16, 16), make_views(range(-1, 2), range(-1, 2)), ratio, seed)
    model = camera.weighting() @ camera.model(0.3)
    pictures = np.eye(256, dtype=model.dtype).reshape(16, 16, -1)
    norm = np.linalg.norm(model(pictures).reshape(-1, 256).astype(np.float64), 2) ** 2
    assert norm / NORM_MARGIN <= model.squared_norm <= norm * 1.0001
