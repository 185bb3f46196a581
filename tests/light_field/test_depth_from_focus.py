"""Focal stacks, depth from focus, other viewpoints: rendered scenes whose shears are known exactly."""

from __future__ import annotations

import numpy as np
import pytest

from apps.studies.light_fields import compute_depth_accuracy
from tofclip.errors import InputError, TofclipError
from tofclip.io.light_fields import read_light_field
from tofclip.light_field import (
    FocalStack,
    compute_image_energy,
    compute_modified_laplacian,
    estimate_depth_from_focus,
    find_smooth_labels,
    make_focal_stack,
)
from tofclip.metrics import nmse
from tofclip.simulate.light_fields import CameraArray, render_light_field, render_view
from tofclip.simulate.scenes import make_scene

SHEARS = np.arange(-1.4, 1.01, 0.2)
ARRAY = CameraArray((64, 64), 8, focal_length_px=80.0, view_step=0.025)


@pytest.mark.parametrize("name", ["render_letters", "render_planes"])
def test_textured_pixels_get_the_right_plane(shared_data, name):
    """95 % is what was asked for; 98 and 100 % were measured."""
    path = shared_data / "lightfields" / f"{name}.npz"
    light_field, shears = read_light_field(path), np.load(path)["shear"]
    labels = estimate_depth_from_focus(make_focal_stack(light_field, SHEARS))
    assert compute_depth_accuracy(SHEARS[labels], shears, light_field.pictures[36], 0.2) >= 0.95


@pytest.mark.parametrize("measure", [compute_image_energy, compute_modified_laplacian])
def test_depth_survives_noise_and_focus_is_better_everywhere_than_at_one_depth(measure):
    rendered = render_light_field(make_scene("letters", ARRAY), ARRAY)
    truth = rendered.light_field.pictures[36]
    stack = make_focal_stack(rendered.light_field, SHEARS)
    noise = 0.01 * np.random.default_rng(0).standard_normal(stack.pictures.shape)
    labels = estimate_depth_from_focus(FocalStack(stack.pictures + noise, stack.shears), measure)
    assert compute_depth_accuracy(SHEARS[labels], rendered.shears, truth, 0.2) >= 0.9
    assert nmse(stack.all_in_focus(labels), truth, 6) < 0.5 * min(
        nmse(picture, truth, 6) for picture in stack.pictures
    )


def test_a_fractional_viewpoint_is_what_a_camera_there_sees():
    """Within the views' range; 6 % was measured, and 35 % for the reference view taken for it."""
    scene, viewpoint = make_scene("letters", ARRAY), (-1.5, 2.5)
    light_field = render_light_field(scene, ARRAY).light_field
    truth = render_view(scene, ARRAY, viewpoint)
    stack = make_focal_stack(light_field, SHEARS, viewpoint)
    seen = stack.all_in_focus(estimate_depth_from_focus(stack))
    assert nmse(seen, truth, 6) < 0.1
    assert nmse(light_field.pictures[36], truth, 6) > 0.1


def test_focus_measures_know_a_ramp_an_edge_and_their_shapes():
    ramp = np.tile(np.arange(8.0), (3, 7, 1))
    np.testing.assert_array_equal(compute_modified_laplacian(ramp)[:, :, 1:-1], 0)
    np.testing.assert_array_equal(compute_image_energy(ramp), 1)
    point = np.zeros((5, 5))
    point[2, 2] = 1
    assert compute_modified_laplacian(point)[2, 2] == 4


def test_labels_without_smoothness_are_the_cheapest():
    costs = np.random.default_rng(0).random((4, 6, 7))
    np.testing.assert_array_equal(find_smooth_labels(costs, 0.0), costs.argmin(axis=0))


def test_a_chain_of_pixels_gets_the_labels_of_the_least_total():
    """On a chain belief propagation is exact: compare with every possible labelling."""
    costs = np.random.default_rng(3).random((3, 1, 6)).astype(np.float32)
    every = np.array(np.meshgrid(*[range(3)] * 6, indexing="ij")).reshape(6, -1)
    own = costs[every, 0, np.arange(6)[:, np.newaxis]].sum(axis=0)
    totals = own + 0.2 * np.abs(np.diff(every, axis=0)).sum(axis=0)
    np.testing.assert_array_equal(find_smooth_labels(costs, 0.2)[0], every[:, totals.argmin()])


def test_pixels_without_a_preference_follow_those_with_one():
    costs = np.zeros((3, 12, 12))
    costs[:, 4:8, 4:8] = 1
    costs[2, 4:8, 4:8] = 0
    assert (find_smooth_labels(costs, 0.1) == 2).all()


@pytest.mark.parametrize(
    "fault",
    [
        lambda: FocalStack(np.zeros((3, 4, 4)), np.array([0.0, 1.0])),
        lambda: FocalStack(np.zeros((2, 4, 4)), np.array([1.0, 0.0])),
        lambda: FocalStack(np.full((2, 4, 4), np.nan), np.array([0.0, 1.0])),
        lambda: FocalStack(np.zeros((2, 4, 4)), np.array([0.0, 1.0])).all_in_focus(
            np.zeros((3, 4), int)
        ),
        lambda: find_smooth_labels(np.zeros((4, 4)), 1.0),
        lambda: find_smooth_labels(np.zeros((2, 4, 4)), -1.0),
    ],
)
def test_what_cannot_be_used_is_refused(fault):
    with pytest.raises(TofclipError):
        fault()


def test_even_pictures_have_no_depth():
    with pytest.raises(InputError, match="texture"):
        estimate_depth_from_focus(FocalStack(np.ones((2, 20, 20)), np.array([0.0, 1.0])))
