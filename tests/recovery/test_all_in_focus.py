"""All-in-focus pictures from one shot, on a scene of two depths whose nearer surface hides a part of
the farther one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofclip.errors import InputError, ShapeError
from tofclip.light_field import LightField
from tofclip.light_field.measurement import CameraSetup, ClipMeasurement, measure
from tofclip.light_field.views import find_view_labels, make_view_warp
from tofclip.metrics import nmse
from tofclip.recovery.all_in_focus import (
    count_recoveries,
    make_shear_range,
    recover_all_in_focus,
    recover_on_depth_map,
)
from tofclip.recovery.light_field import ClipRecovery

SIDE = 48
NEAR, FAR = -1.0, 0.5
VIEWS = np.array([(v, u) for v in range(-2, 2) for u in range(-2, 2)], float)


def draw_view(v: float, u: float) -> tuple[np.ndarray, np.ndarray]:
    """A near frame before far stripes, and where the frame is."""
    y, x = np.mgrid[:SIDE, :SIDE].astype(float)
    right, down = np.abs(x - NEAR * u - 22), np.abs(y - NEAR * v - 25)
    frame = (np.maximum(right, down) < 14) & (np.maximum(right, down) >= 8)
    far = 0.2 + 0.5 * (np.floor((x - FAR * u) / 6) % 2) * (np.abs(y - FAR * v - 24) < 20)
    return np.where(frame, 1.0, far), frame


@pytest.fixture(scope="module")
def scene() -> LightField:
    pictures = [draw_view(v, u)[0] for v, u in VIEWS]
    return LightField(np.stack(pictures).astype(np.float32), VIEWS)


@pytest.fixture(scope="module")
def measurement(scene) -> ClipMeasurement:
    return measure(scene, CameraSetup("line-even", 1.0, 0))


REFERENCE, FRAME = draw_view(0.0, 0.0)
LABELS = np.where(FRAME, 0, 1)
SHEARS = np.array([NEAR, FAR])


def test_views_of_a_known_picture_are_those_of_the_scene(scene):
    warp = make_view_warp(LABELS, SHEARS, [(v, u) for v, u in VIEWS.tolist()])
    views = warp(REFERENCE.astype(np.float32))
    np.testing.assert_allclose(views[10], REFERENCE, atol=1e-6)  # the reference view itself
    inner = np.s_[:, 4:-4, 4:-4]
    # what is left are edges between pixels, and what only one view sees
    still = np.broadcast_to(REFERENCE, scene.pictures.shape)
    assert nmse(views[inner], scene.pictures[inner]) < 0.25 * nmse(
        still[inner], scene.pictures[inner]
    )


def test_nearer_surfaces_hide_farther_ones():
    seen = find_view_labels(LABELS, SHEARS, (0.0, -2.0))
    frame = draw_view(0.0, -2.0)[1]
    assert np.mean((seen == 0) == frame) > 0.99


def test_a_matrix_of_views_matches_its_adjoint():
    warp = make_view_warp(LABELS, SHEARS, [(0.0, 1.0), (-2.0, 0.5)])
    random = np.random.default_rng(0)
    x = random.random((SIDE, SIDE)).astype(np.float32)
    y = random.random((2, SIDE, SIDE)).astype(np.float32)
    assert np.vdot(warp(x), y) == pytest.approx(np.vdot(x, warp.H(y)), rel=1e-4)


def test_one_picture_for_all_depths_is_better_than_any_refocused_one(measurement, scene):
    found = recover_on_depth_map(measurement, SHEARS[LABELS], weight=3e-4)
    plain = ClipRecovery(weight=1e-2)
    refocused = [plain.recover(measurement, shear).picture for shear in SHEARS]
    assert nmse(found.picture, REFERENCE, 4) < 0.5 * min(
        nmse(picture, REFERENCE, 4) for picture in refocused
    )
    assert found.refocused is None
    # what is out of focus is rendered too, and does not have to be guessed
    views = found.render_views(VIEWS)
    for shear, picture in zip(SHEARS, refocused, strict=True):
        true = scene.refocus(shear)
        assert nmse(views.refocus(shear), true, 4) < 0.85 * nmse(picture, true, 4)  # 0.47, 0.72


def test_a_weight_that_is_not_given_predicts_what_was_left_out(measurement):
    """Cross-validation, as for one depth; noise asks for more of the prior."""
    random = np.random.default_rng(0)
    noise = 0.3 * measurement.values.std() * random.standard_normal(measurement.values.size)
    noisy = replace(measurement, values=measurement.values + noise.astype(np.float32))
    found = [recover_on_depth_map(one, SHEARS[LABELS]).weight for one in (measurement, noisy)]
    assert found[1] > 2 * found[0]  # 5.4


def test_depths_are_found_and_the_picture_beats_depth_from_focus(measurement):
    shears, steps = np.arange(-1.5, 1.01, 0.5), []
    found = recover_all_in_focus(measurement, shears, progress=steps.append)
    assert sum(steps) == count_recoveries(shears)
    assert found.refocused is not None
    error, other = (nmse(one, REFERENCE, 4) for one in (found.picture, found.refocused))
    assert error < other
    assert np.median(found.shears[FRAME]) == pytest.approx(NEAR, abs=0.25)


def test_depths_are_tried_as_close_as_the_outermost_view_tells_them_apart():
    shears = make_shear_range(-1.0, 0.5, VIEWS)
    assert (shears[0], shears[-1]) == (-1.0, 0.5)
    assert np.diff(shears).max() * 2 <= 0.6 + 1e-9
    with pytest.raises(InputError, match="smaller"):
        make_shear_range(0.5, -1.0, VIEWS)


def test_maps_that_make_no_sense_are_refused(measurement):
    with pytest.raises(ShapeError, match="map of shears"):
        recover_on_depth_map(measurement, np.zeros((3, 3)))
    with pytest.raises(InputError, match="nowhere finite"):
        recover_on_depth_map(measurement, np.full((SIDE, SIDE), np.inf))
    with pytest.raises(InputError, match="ascending"):
        recover_all_in_focus(measurement, [0.5])
    with pytest.raises(InputError, match="ascending"):
        make_view_warp(LABELS, SHEARS[::-1], [(0.0, 1.0)])
