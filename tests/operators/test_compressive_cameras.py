"""Cameras of compressive light-field photography against the sums that they stand for (supplement
Eq. 17 and 18).
"""

from __future__ import annotations

import numpy as np
import pytest

from tofclip.errors import InputError
from tofclip.operators import Integration
from tofclip.operators.cameras import (
    COMPRESSIVE_CAMERAS,
    AshokCamera,
    BabacanCamera,
    MarwahCamera,
)
from tofclip.operators.codes import make_sheared_mask

VIEWS = [(float(v), float(u)) for v in range(-1, 2) for u in range(-2, 2)]
SHAPE = (9, 11)

every_camera = pytest.mark.parametrize("name", COMPRESSIVE_CAMERAS)


def light_field() -> np.ndarray:
    return np.random.default_rng(0).random((len(VIEWS), *SHAPE)).astype(np.float32)


@every_camera
def test_the_whole_model_is_the_sum_of_the_views_encoders(name):
    camera = COMPRESSIVE_CAMERAS[name](SHAPE, VIEWS, 1, 3)
    assert camera.measurements == 99
    assert camera.used_views == tuple(range(12))
    summed = Integration(camera.encoders)(light_field())
    np.testing.assert_allclose(camera.light_field_model()(light_field()), summed, rtol=1e-5)
    np.testing.assert_array_equal(camera.weighting()(summed), summed)


@pytest.mark.parametrize("kind", [AshokCamera, BabacanCamera])
def test_each_exposure_weighs_whole_views(kind):
    camera = kind(SHAPE, VIEWS, 5, 1)
    weights = camera.weights()
    assert weights.shape == (5, 12)
    assert 0 <= weights.min() < weights.max() <= 1
    exposures = camera.light_field_model()(light_field()).reshape(5, *SHAPE)
    np.testing.assert_allclose(
        exposures, np.einsum("jk,kyx->jyx", weights, light_field()), rtol=1e-5
    )
    assert np.linalg.matrix_rank(weights) == 5


def test_ashok_s_first_mask_is_open_and_half_of_the_others_cells_are():
    weights = AshokCamera(SHAPE, [(0.0, float(u)) for u in range(16)], 16, 0).weights()
    assert weights[0].all()
    np.testing.assert_array_equal(weights[1:].sum(axis=1), 8)


def test_marwah_s_mask_is_the_same_for_all_views_but_moved():
    """Each view of shear 1 sees the mask of the view above it one row further down."""
    codes = MarwahCamera(SHAPE, VIEWS, 1, 0).codes().reshape(3, 4, *SHAPE)
    np.testing.assert_allclose(codes[1, :, 1:], codes[0, :, :-1])
    np.testing.assert_allclose(codes[:, 1, :, 1:], codes[:, 0, :, :-1])
    assert 0 <= codes.min() < codes.max() <= 1


def test_no_view_looks_past_the_edge_of_the_mask():
    """Beyond it all would be dark, and random transmissions never are; far views look furthest."""
    views = [(float(v), float(u)) for v in (-4, 4) for u in (-4, 4)]
    codes = make_sheared_mask((9, 11), views, 1.6, np.random.default_rng(0))
    assert codes.shape == (4, 9, 11)
    assert codes.min() > 0


@every_camera
def test_a_picture_is_seen_as_its_sheared_views(name):
    from tofclip.operators import ShearedViews

    camera = COMPRESSIVE_CAMERAS[name](SHAPE, VIEWS, 1, 3)
    picture = light_field()[0]
    views = ShearedViews(SHAPE, VIEWS, 0.6, (0.5, 0.0))(picture)
    np.testing.assert_allclose(
        camera.model(0.6, (0.5, 0.0))(picture), camera.light_field_model()(views), rtol=1e-6
    )


@every_camera
@pytest.mark.parametrize("ratio", [0.5, 1.3])
def test_exposures_are_whole(name, ratio):
    with pytest.raises(InputError, match="a whole one"):
        COMPRESSIVE_CAMERAS[name](SHAPE, VIEWS, ratio, 0)


def test_more_exposures_than_a_camera_has_are_refused():
    with pytest.raises(InputError, match="one exposure, not 2"):
        MarwahCamera(SHAPE, VIEWS, 2, 0)
    with pytest.raises(InputError, match="at most 16"):
        AshokCamera(SHAPE, VIEWS, 17, 0)
