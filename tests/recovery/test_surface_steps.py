"""Steps on ranges and on what is uncertain of the instrument, and which shapes a shot shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from surface_scene import BIN_M, CAMERA, INSTRUMENT, SCENE, SHAPE, make_model

from tofclip.recovery.surfaces.amplitudes import AmplitudeSolver
from tofclip.recovery.surfaces.fit import extrapolate_step
from tofclip.recovery.surfaces.model import SurfaceModel
from tofclip.recovery.surfaces.points import SurfaceState
from tofclip.recovery.surfaces.ranges import (
    CLUSTER_COLUMNS,
    CLUSTER_ROWS,
    Derivatives,
    NormalEquations,
    compute_objective,
    iterate_derivatives,
    refine_state,
)
from tofclip.recovery.surfaces.shapes import SmoothBasis
from tofclip.recovery.surfaces.straighten import straighten_surfaces
from tofclip.simulate import simulate_shot


@pytest.fixture(scope="module")
def shot():
    return simulate_shot(SCENE, INSTRUMENT, seed=0)


@pytest.mark.parametrize("blur_px", [0.0, 1.5])
def test_derivatives_are_those_of_the_image(shot, blur_px: float):
    """Central differences in every direction. What is used is the derivative of the smooth pulse;
    that of light between rows differs by (f / (1 - f))^2 at f cycles a row, 4 to 9 % where a pulse
    of 1.3 rows changes most, to and fro with the place between rows.
    """
    model = make_model(shot.streak).blur(blur_px)
    amplitude = np.random.default_rng(1).random(model.surface.size).astype(np.float32)
    state, found = model.state, {}
    for group in iterate_derivatives(model, amplitude):
        for name, image in zip(group.names, group.images, strict=True):
            found.setdefault(name, np.zeros_like(model.image))[group.area] += image
    # time zero is the reference view's
    assert ("delays", 0, 3) not in found
    assert ("stretches", 0, 3) not in found
    assert not any(name == "shading" for name, _, _ in found)
    for name, step in (
        (("coefficients", 0, 0), 2e-4), (("coefficients", 1, 2), 2e-4), (("gains", 0, 2), 1e-2),
        (("delays", 0, 4), 2e-2), (("stretches", 0, 1), 5e-2), (("widths", 0, 5), 2e-2),
    ):  # fmt: skip
        images = []
        for sign in (1, -1):
            moved = state.copy()
            field, surface, number = name
            values = (
                moved.coefficients[surface] if field == "coefficients" else getattr(moved, field)
            )
            values[number] += sign * step * (values[number] if field in ("gains", "widths") else 1)
            model.place(moved)
            images.append(model.render(amplitude))
        model.place(state)
        difference = (images[0] - images[1]) / (2 * step)
        assert np.linalg.norm(found[name] - difference) < 0.1 * np.linalg.norm(difference), name


def compute_misfit(model: SurfaceModel, amplitude: np.ndarray) -> float:
    return float(np.sum(model.weights * (model.render(amplitude) - model.image) ** 2))


def test_a_refused_or_taken_step_never_raises_the_misfit(shot):
    model = make_model(shot.streak)
    amplitude = np.full(model.surface.size, 50, np.float32)
    before = compute_misfit(model, amplitude)
    refined = refine_state(model, amplitude)
    assert compute_misfit(model, refined.amplitude) <= before
    assert model.state.gains.mean() == pytest.approx(CAMERA.gains.mean())
    assert model.state.delays[3] == model.state.stretches[3] == 0


def test_views_that_are_all_late_do_not_pass_for_nearer_surfaces(shot):
    """Amplitudes explain much of both. Where that is left out for the views, the second step leaves
    36 and 20 um of it; the state is the true one but for them, and there is no noise.
    """
    model = make_model(shot.streak)
    y, x = np.divmod(model.pixel, SHAPE[1])
    amplitude = np.where((x // 6 + y // 6) % 2 == 0, 60, 30).astype(np.float32)
    model.fill_partly(amplitude)
    model.image = model.render(amplitude)
    model.weights = 1 / (model.image + 5)
    true = model.distance
    late = model.state.copy()
    late.delays[:] = 0.1
    late.delays[model.reference] = 0
    for coefficients in late.coefficients:
        coefficients[0] *= 1 + 0.1 * BIN_M / 1.5
    model.place(late)
    assert abs(np.mean(model.distance - true)) > 300e-6
    found = None
    for _ in range(2):
        found = refine_state(model, amplitude, found)
        amplitude = found.amplitude
    assert found.steps == 2
    for part in model.parts:
        assert abs(np.mean((model.distance - true)[part])) < 10e-6


def test_each_view_sees_its_own_part_of_what_shines_through(shot):
    """As through gauze: the view beside the lamp sees all that the lamp lights behind it."""
    model = make_model(shot.streak, overlap=True)
    amplitude = np.full(model.surface.size, 50, np.float32)
    model.find_behind(amplitude)
    hidden = model.masks[0].ravel()[model.pixel] & (model.surface == 1)
    np.testing.assert_array_equal(model.behind, hidden)
    even, shaded = model.state, model.state.copy()
    shaded.shading[1] = [-0.25, -0.1, 0.1, 0.4, 0.15, -0.1, -0.2]
    model.place(shaded)
    y = np.random.default_rng(0).standard_normal(model.image.shape).astype(np.float32)
    there, back = model.render(amplitude).astype(np.float64), model.gather(y).astype(np.float64)
    assert np.vdot(there, y) == pytest.approx(float(np.vdot(amplitude, back)), rel=1e-4)
    model.image = model.render(amplitude)
    model.weights = 1 / (model.image + 5)
    model.place(even)
    for _ in range(2):
        amplitude = refine_state(model, amplitude).amplitude
    # what amplitudes take of it in two steps is a few hundredths of the largest
    np.testing.assert_allclose(model.state.shading[1], shaded.shading[1], atol=0.03)
    assert not model.state.shading[0].any()


def test_what_all_views_see_alike_is_not_shaded(shot):
    model = make_model(shot.streak, overlap=True)
    amplitude = np.full(model.surface.size, 50, np.float32)
    model.find_behind(amplitude)
    clean = model.render(amplitude)
    model.image = np.random.default_rng(0).poisson(clean + 1).astype(np.float32) - 1
    model.weights = 1 / (clean + 1)
    refine_state(model, amplitude)
    assert not model.state.shading.any()
    assert not model.behind.any()


@pytest.mark.parametrize("bent", [False, True])
def test_splines_are_left_where_a_quadratic_explains_the_shot(shot, bent: bool):
    """Frames displace returns here and there, and splines follow them; the shot knows better."""
    masks = np.zeros((1, *SHAPE), bool)
    masks[0, 4:44, 4:44] = True
    pixels = np.flatnonzero(masks)
    y, x = np.divmod(pixels, SHAPE[1])
    bump = 3e-3 * np.exp(-((x - 18) ** 2 + (y - 20) ** 2) / 50)
    basis = SmoothBasis(SHAPE, (4, 4, 44, 44), (4, 4))
    design = basis.evaluate(pixels)
    flat = 1 / 1.5 + 1e-4 * x
    found, true = (
        np.linalg.lstsq(design, flat + part, rcond=None)[0] for part in (bump, bent * bump)
    )
    basis = replace(basis, bending=1e-3 * np.eye(design.shape[1]))
    state = SurfaceState.start([true], CAMERA)
    model = SurfaceModel(shot.streak, CAMERA, masks, [basis], state)
    board = np.where((x // 6 + y // 6) % 2 == 0, 60, 30).astype(np.float32)
    model.image = model.render(board)
    model.weights = 1 / (model.image + 5)
    model.place(SurfaceState.start([found], CAMERA))
    amplitude = refine_state(model, board).amplitude
    solver = AmplitudeSolver(model, amplitude, 2.0)
    straight, _ = straighten_surfaces(solver)
    assert straight.model.bases[0].is_quadratic != bent
    if not bent:
        error = straight.model.distance - straight.model.ray_length / flat
        assert np.median(np.abs(error)) < 0.1e-3  # 2.9 mm at the bump before


def test_where_the_shot_says_nothing_what_is_known_beforehand_decides(shot):
    """Of a bend of which nothing is seen: its variance is the inverse of what is known of it, and a
    step takes it back, as the least of ``c' bending c / 2``.
    """
    known, bend = np.array([2.5e5, 1e6, 4e5]), np.array([3e-3, -2e-3, 1e-3])
    model = make_model(shot.streak)
    bending = np.diag([0, 0, 0, *known])
    model.bases = [replace(basis, bending=bending) for basis in model.bases]
    bent = model.state.copy()
    for coefficients in bent.coefficients:
        coefficients[3:] = bend
    model.place(bent)
    model.weights = model.weights * np.float32(1e-9)
    found = refine_state(model, np.full(model.surface.size, 50, np.float32))
    for covariance, coefficients in zip(found.covariances, model.state.coefficients, strict=True):
        np.testing.assert_allclose(covariance[3:, 3:] * known, np.eye(3), atol=1e-3)
        np.testing.assert_allclose(coefficients[3:], 0, atol=1e-3 * np.abs(bend).max())
    assert compute_objective(model, found.rest) < 1e-3 * np.sum(
        known * bend**2
    )  # of both surfaces, half of each


def test_of_a_surface_that_is_dark_no_range_is_known(shot):
    """Its deviation was stated as 0 m."""
    model = make_model(shot.streak)
    dark = model.surface == 1
    found = refine_state(model, np.where(dark, 0, 50).astype(np.float32), robust=True)
    deviation = model.estimate_deviation(found.covariances)
    assert np.all(deviation[dark] > 1e3)
    assert np.all(deviation[~dark] < 10 * BIN_M)


def test_the_objective_holds_what_is_known_of_surfaces_beforehand(shot):
    """Bent surfaces that a shot without noise shows to be so: nothing but the bending is left."""
    model = make_model(shot.streak)
    bent = model.state.copy()
    for coefficients in bent.coefficients:
        coefficients[3:] = 3e-3, -2e-3, 1e-3
    model.place(bent)
    known = np.diag([0, 0, 0, 3e3, 1e3, 2e3])  # far less than the shot says
    model.bases = [replace(basis, bending=known) for basis in model.bases]
    amplitude = np.full(model.surface.size, 50, np.float32)
    model.image = model.render(amplitude)
    model.weights = 1 / (model.image + 5)
    expected = sum(float(one @ known @ one) / 2 for one in bent.coefficients)
    rest = refine_state(model, amplitude).rest
    assert compute_objective(model, rest) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(
    ("moved", "earlier", "left"),
    [
        ([2, -2], [4, -4], 2.0),  # 1 + 1/2 + 1/4 ...
        ([-2, 2], [4, -4], 0.0),  # back again: about its end
        ([2, 2], [4, -4], 0.0),  # anywhere
        ([2, -2], [2, -2], 6.0),  # hardly shorter: three quarters
        ([2, -2], [0, 0], 0.0),
    ],
)
def test_what_steps_leave_is_a_geometric_series(moved, earlier, left):
    light = np.ones(2, np.float32)
    found = extrapolate_step(np.array(moved, float), np.array(earlier, float), light)
    np.testing.assert_allclose(found, left)


def test_what_steps_take_from_the_misfit_is_given_back():
    """Seven unknowns and sixteen clusters: their scores after the step say too little."""
    draw = np.random.default_rng(0)
    rows, columns = 4 * CLUSTER_ROWS, 4 * CLUSTER_COLUMNS
    images = draw.standard_normal((7, rows, columns)).astype(np.float32)
    images *= np.repeat(np.repeat(draw.uniform(0, 1, (7, 4, 4)) ** 2, 12, 1), 48, 2)
    group = Derivatives(0, 0, images, [("coefficients", 0, number) for number in range(7)])
    weights = np.ones((rows, columns), np.float32)
    flat = images.reshape(7, -1).astype(np.float64)
    inverse = np.linalg.inv(flat @ flat.T)
    stated, plain = np.zeros((2, 7))
    draws = 60
    for _ in range(draws):
        noise = draw.standard_normal((rows, columns)).astype(np.float32)
        change = inverse @ (flat @ noise.ravel())
        left = noise - np.tensordot(change.astype(np.float32), images, 1)
        found = NormalEquations.multiply([group], weights, left, left)
        np.testing.assert_allclose(found.normal, flat @ flat.T, rtol=1e-4, atol=0.1)
        np.testing.assert_allclose(found.slope, 0, atol=0.1)
        stated += np.diag(found.estimate_covariances(inverse, np.zeros((7, 7)))) / draws
        scores = np.array(
            [
                images[:, top : top + CLUSTER_ROWS, side : side + CLUSTER_COLUMNS].reshape(7, -1)
                @ left[top : top + CLUSTER_ROWS, side : side + CLUSTER_COLUMNS].ravel()
                for top in range(0, rows, CLUSTER_ROWS)
                for side in range(0, columns, CLUSTER_COLUMNS)
            ]
        )
        plain += np.diag(inverse @ (scores.T @ scores) @ inverse) / draws
    assert np.mean(stated / np.diag(inverse)) == pytest.approx(1, abs=0.08)
    assert np.mean(plain / np.diag(inverse)) < 0.9
