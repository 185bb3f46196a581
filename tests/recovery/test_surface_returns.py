"""Which points of surfaces are returned, where, and how surely."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from surface_scene import BIN, CAMERA, INSTRUMENT, SCENE, SHAPE, make_model

from tofclip.arrays import FloatArray
from tofclip.camera import Camera
from tofclip.lidar import Detection, depth
from tofclip.recovery.surfaces.amplitudes import AmplitudeSolver
from tofclip.recovery.surfaces.extents import find_usual_brightness
from tofclip.recovery.surfaces.fit import SurfaceFit
from tofclip.recovery.surfaces.points import SurfaceState
from tofclip.recovery.surfaces.ranges import LEFT_ASIDE_PX, Refinement
from tofclip.recovery.surfaces.returns import (
    ROD_RADIUS_PX,
    SHARED_DOUBT,
    estimate_displacement,
    estimate_sweep_error,
    join_unresolved,
    list_returns,
    round_rod,
)
from tofclip.recovery.surfaces.shifts import follow_local_shifts, measure_local_shifts
from tofclip.shots import Frames, Returns
from tofclip.simulate import simulate_shot
from tofclip.units import SPEED_OF_LIGHT


def replace_farther(state: SurfaceState, away: float) -> SurfaceState:
    other = state.copy()
    other.coefficients[0] = state.coefficients[0] * (1 - away * state.coefficients[0][0])
    return other


def test_light_that_arrives_elsewhere_than_its_surface_shows_by_how_much():
    """Of two plates one is rendered 0.6 mm farther, a fifth of a row; a part of that goes into places
    where it lies before or behind the other one's light.
    """
    model = make_model(simulate_shot(SCENE, INSTRUMENT, seed=0).streak)
    amplitude = np.full(model.surface.size, 500, np.float32)
    away, state = 0.6e-3, model.state
    model.place(replace_farther(state, away))
    image = model.render(amplitude)
    model.place(state)
    shifts = measure_local_shifts(model, amplitude, image - model.render(amplitude))
    moved, still = shifts[model.parts[0]], shifts[model.parts[1]]
    assert np.median(moved) == pytest.approx(away, rel=0.2)
    assert np.median(still) < 0.1 * away


def test_ranges_follow_what_no_function_of_the_surface_does():
    """The right half of a plate is rendered a millimetre farther, a third of a row; the surface is a plane. Few
    iterations, which do not follow noise, lead half of the way or more.
    """
    model = make_model(simulate_shot(SCENE, INSTRUMENT, seed=0).streak)
    amplitude, away = np.full(model.surface.size, 500, np.float32), 1e-3
    plate, beside = model.masks
    right = plate & (np.arange(SHAPE[1]) > np.median(model.column[model.parts[0]]))
    farther = replace_farther(model.state, away).coefficients[0]
    shapes = [model.state.coefficients[0], farther, model.state.coefficients[1]]
    bases = [model.bases[number] for number in (0, 0, 1)]
    shading = np.zeros((3, CAMERA.views))
    state = replace(model.state, coefficients=shapes, shading=shading)
    truth = model.lay_out(np.stack([plate & ~right, right, beside]), bases, state)
    model.image = truth.render(amplitude)
    rest, usual = model.image - model.render(amplitude), np.full(amplitude.size, away)
    solver = AmplitudeSolver(model, amplitude, 0.0)
    shifts = follow_local_shifts(solver, rest, solver.estimate_local_variance(), usual)
    moved = right[model.row, model.column] & (model.surface == 0)
    assert 0.5 * away < np.median(shifts[moved]) < 1.1 * away
    assert np.median(np.abs(shifts[~moved])) < 0.01 * away


def test_what_a_pulse_does_not_tell_apart_is_one_return_where_its_light_is():
    """Of two and a third a pulse farther in one pixel, and of one in another."""
    light, distance = np.array([3.0, 1.0, 1.0, 2.0]), np.array([2.0, 2.004, 2.02, 2.002])
    apart = Returns(
        y=np.array([7, 7, 7, 8], np.int32),
        x=np.array([5, 5, 5, 5], np.int32),
        range=distance,
        intensity=(light * distance**2).astype(np.float32),
        confidence=np.array([3e-4, 4e-4, 5e-4, 6e-4], np.float32),
        return_number=np.array([1, 2, 3, 1], np.uint8),
        time=2 * distance / SPEED_OF_LIGHT,
        camera=CAMERA,
        false_alarm=np.array([0.01, 0.3, 0.2, 0.4]),
    )
    found = join_unresolved(apart[[1, 3, 0, 2]], pulse_m=0.009)
    np.testing.assert_array_equal(found.y, [7, 7, 8])
    np.testing.assert_allclose(found.range, [2.001, 2.02, 2.002])
    np.testing.assert_allclose(found.time, 2 * found.range / SPEED_OF_LIGHT)
    np.testing.assert_allclose(found.intensity, [4, 1, 2] * found.range**2, rtol=1e-6)
    np.testing.assert_allclose(found.false_alarm, [0.01, 0.2, 0.4])
    spread = SHARED_DOUBT**2 * (0.75 * 0.001**2 + 0.25 * 0.003**2)
    one = np.sqrt(0.75 * 3e-4**2 + 0.25 * 4e-4**2 + spread)
    np.testing.assert_allclose(found.confidence, [one, 5e-4, 6e-4], rtol=1e-5)
    assert len(join_unresolved(apart[:0], pulse_m=0.009)) == 0


def test_pixels_at_the_side_of_a_rod_see_it_farther_away():
    """Of one of radius R the mean depth that a pixel sees, less the mean over all its light."""
    y, x = np.indices((40, 5)).reshape(2, -1)
    inside = np.linspace(-1, 1, 100_001)[1:-1]  # places across it, radii
    depth = ROD_RADIUS_PX * (1 - np.sqrt(1 - inside**2))
    pixel = np.rint(ROD_RADIUS_PX * inside + 2)
    light = np.sqrt(1 - inside**2)  # of what faces the camera less and less
    seen = np.array([depth[pixel == one].mean() for one in (1, 2, 3)])
    bright = np.array([0, *(light[pixel == one].sum() for one in (1, 2, 3)), 0])
    found = round_rod(y + 7, x + 3, bright[x])
    line = np.average(depth, weights=light)
    np.testing.assert_allclose(
        found.reshape(40, 5)[:, 1:4], np.tile(seen - line, (40, 1)), atol=1e-3
    )
    # what is as wide as pixels shows its own shape
    assert not round_rod(y, x, np.ones(y.size)).any()


def test_a_deviation_is_that_of_the_fit_of_further_steps_and_of_the_centres():
    """Of two planes of which all is known: r = length / (a + b x), so that
    dr = r^2 / length sqrt(var a + x^2 var b); to that what steps leave, and the displaced picture. Where
    the farther plane is seen through the nearer one, each view sees another part of a pixel, and all see
    one part of the nearer one.
    """
    model = make_model(simulate_shot(SCENE, INSTRUMENT, seed=0).streak)
    amplitude = np.full(model.surface.size, 500, np.float32)
    model.image = model.render(
        amplitude
    )  # nothing is left that would show a surface to be elsewhere
    one, along = 4e-4, 3e-4
    covariance = np.diag([one**2, along**2, 0, 0, 0, 0])
    remainder = np.array([0.7e-3, 0.2e-3])[model.surface]
    calibrated = CAMERA.centres_px + 0.1 * np.array([1, -1, 0, 1, 0, -1, 1])
    refinement = Refinement(
        [covariance] * 2, amplitude, np.zeros((6, amplitude.size), np.float32), 1, model.image, None
    )
    solver, nothing = (
        AmplitudeSolver(model, amplitude, 2.0),
        depth(Frames(np.zeros((9, *SHAPE), np.float32), BIN * np.arange(9), CAMERA)),
    )
    fit = SurfaceFit(solver, solver, refinement, remainder, 0.0, nothing, solver, nothing)
    found = list_returns(fit, Detection(), calibrated)
    assert len(found) == model.surface.size
    for surface, (first, slope) in enumerate([(1 / 1.4, 0.02), (1 / 1.7, -0.03)]):
        own = np.abs(found.range - 1 / first) < 0.1
        assert own.sum() == model.masks[surface].sum()
        y, x = found.y[own], found.x[own]
        across = 2 * x / SHAPE[1] - 1
        length = np.sqrt(1 + ((x - 24) ** 2 + (y - 24) ** 2) / CAMERA.focal_length_px**2)

        def reach(x: np.ndarray, y: np.ndarray, first=first, slope=slope) -> np.ndarray:
            ray = np.sqrt(1 + ((x - 24) ** 2 + (y - 24) ** 2) / CAMERA.focal_length_px**2)
            return ray / (first + slope * (2 * x / SHAPE[1] - 1))

        distance = reach(x, y)
        np.testing.assert_allclose(found.range[own], distance, rtol=1e-9)
        stated = distance**2 / length * np.hypot(one, across * along)
        right, down = estimate_displacement(found.camera, calibrated)
        moved = np.hypot(right * (reach(x + 1, y) - distance), down * (reach(x, y + 1) - distance))
        shared = model.masks.all(axis=0)[y, x]
        steep = np.hypot(
            reach(x + 0.5, y) - reach(x - 0.5, y), reach(x, y + 0.5) - reach(x, y - 0.5)
        )
        # each has half of the light
        hidden = shared * 0.5 / np.sqrt(12 * (CAMERA.views if surface else 1)) * steep
        # of pixels at its borders any part may be lit
        mask = np.pad(model.masks[surface], 1)
        aside = LEFT_ASIDE_PX * np.hypot(
            (mask[y + 1, x] != mask[y + 1, x + 2])
            * (reach(x + mask[y + 1, x + 2], y) - reach(x - mask[y + 1, x], y)),
            (mask[y, x + 1] != mask[y + 2, x + 1])
            * (reach(x, y + mask[y + 2, x + 1]) - reach(x, y - mask[y, x + 1])),
        )
        parts = stated, remainder[model.surface == surface], moved, hidden, aside
        expected = np.sqrt(np.sum(np.square(parts), axis=0))
        np.testing.assert_allclose(found.confidence[own], expected, rtol=1e-3)
        # light falls with the square of the range
        np.testing.assert_allclose(found.intensity[own], 500 * distance**2, rtol=1e-5)


def test_what_a_shot_shows_of_centres_says_how_far_the_rest_displaces_the_picture():
    """Of independent errors of seven views all but what looks like a displaced picture shows."""
    looks = np.stack([np.ones(CAMERA.views), -np.tan(CAMERA.angles)], axis=1)
    errors = np.random.default_rng(0).normal(0, 0.5, (2000, CAMERA.views))
    hidden = errors @ np.linalg.pinv(looks).T
    shown = CAMERA.centres_px - (errors - hidden @ looks.T)
    told = [
        estimate_displacement(CAMERA.replace(centres_px=one), CAMERA.centres_px) for one in shown
    ]
    # half of all displacements are smaller than 0.67 of their deviation; 2,000 know a median to 3 %
    ratio = np.median(np.abs(hidden) / told, axis=0)
    np.testing.assert_allclose(ratio, 0.6745, rtol=0.1)
    # of two views no error shows: what the calibration says of itself holds
    pair = Camera([20.0, 60.0], [-0.5, 0.5], (16, 16), 81, centre_uncertainty_px=[0.1, 0.1])
    right, down = estimate_displacement(pair, pair.centres_px)
    assert right == pytest.approx(0.1 / np.sqrt(2))
    assert down == pytest.approx(0.1 / np.sqrt(2) / np.tan(0.5))


def test_usual_brightness_is_that_of_the_surest_points():
    amplitude = np.array([1, 1, 9, 10, 11], np.float32)
    assert find_usual_brightness(amplitude, 3 * amplitude, 5.0) == 10
    # in little light none is twenty deviations out, and half of the upper ones' counts
    assert find_usual_brightness(amplitude, amplitude, 5.0) == 10
    assert find_usual_brightness(amplitude, amplitude / 10, 5.0) == np.inf


def test_a_sweep_is_off_by_the_corners_that_lines_from_view_to_view_cut():
    """A wave of 0.5 rows over five views is off between them by a ninth of that, root mean square, which seven views
    see; what a parabola follows is not off, however late it is.
    """
    model = make_model(simulate_shot(SCENE, INSTRUMENT, seed=0).streak)
    light, centres = np.ones(model.surface.size, np.float32), model.camera.centres_px
    span = centres[1] - centres[0]

    def measure(late: Callable[[FloatArray], FloatArray]) -> float:
        model.place(replace(model.state, delays=late((centres - centres.mean()) / span)))
        return estimate_sweep_error(model, light) / model.row_m

    assert measure(lambda place: 3 * place - 2 * place**2) == pytest.approx(0, abs=1e-9)
    between = np.linspace(-3, 3, 601)

    def wave(place: FloatArray) -> FloatArray:
        return 0.5 * np.sin(2 * np.pi * place / 5 + 1)

    cut = wave(between) - np.interp(between, np.arange(-3, 4), wave(np.arange(-3, 4)))
    # the spline through so few places is nearer to the wave than the lines are by a factor of about five
    shown = float(np.sqrt(np.mean(cut**2) / 7))
    assert measure(wave) == pytest.approx(shown, rel=0.25)
