"""Light-field cameras: how many measurements they take, and that their two models agree where they
must.
"""

from __future__ import annotations

import numpy as np
import pytest

from tofclip.errors import InputError
from tofclip.operators import (
    Composition,
    DenseSensor,
    LinearShear,
    PointSpreadConvolution,
    SparseMatrix,
)
from tofclip.operators.cameras import CAMERAS, CodedApertureCamera, MeasuredCamera
from tofclip.operators.point_spreads import MeasuredPointSpreads

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
