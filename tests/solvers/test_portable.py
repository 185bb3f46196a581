"""Recovery on the arrays of other libraries: the same pictures as from the compiled loops, in kind, without waiting."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from array_places import PLACES, place_called

from tofclip.arrays import Place, to_numpy
from tofclip.errors import InputError, ShapeError
from tofclip.operators import Diagonal, FourierShear, LineProjection, Stack, squared_norm
from tofclip.solvers import (
    Adjoint,
    Fista,
    Huber,
    LeastSquares,
    LinearInverse,
    NonnegativeSparsity,
    NonnegativeTotalVariation,
    PlugAndPlay,
    Poisson,
    Sparse,
    Stopping,
    TotalVariation,
    Wavelets,
    batches,
    iterate,
    relative_residual,
    silent,
)
from tofclip.solvers.compiled import CompiledLoops
from tofclip.solvers.hold_out import choose_weight
from tofclip.solvers.light_field_variation import LightFieldVariation
from tofclip.solvers.portable import PortableLoops

METHODS = [Sparse(iterations=40), TotalVariation(iterations=40), LinearInverse(), Adjoint()]
# What is promised is 1e-4. Float32 sums in another order differ by 1e-6 or so, which the linear inverse amplifies by
# its condition, at most 1 / damping.
ROUNDING = {np.float32: 1e-5, np.float64: 1e-11}

every_method = pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)


@pytest.fixture(params=PLACES)
def place(request):
    return place_called(request.param)


def projection(dtype: type = np.float32) -> LineProjection:
    return LineProjection((24, 23), 90, [14.2, 45.0, 74.5], [-0.7, 0.05, 0.6], [1.0, 0.8, 1.1], dtype)


def letters(frames: int, dtype: type = np.float32) -> tuple[np.ndarray, np.ndarray]:
    """Readings of bright rectangles with noise, and a mask with a bad reading here and there."""
    rng = np.random.default_rng(7)
    truth = np.zeros((24, 23, frames))
    for frame in range(frames):
        row, column = rng.integers(2, 12, 2)
        truth[row : row + 8, column : column + 5, frame] = 50 + 10 * frame
    readings = projection(np.float64)(truth)
    readings += 5 * rng.standard_normal(readings.shape)
    return readings.astype(dtype), rng.random(readings.shape) > 0.03


def difference(found: np.ndarray, expected: np.ndarray) -> float:
    """Norm of what two recoveries differ by, relative."""
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@every_method
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_pictures_are_those_of_the_compiled_loops(place, method, dtype):
    operator, (readings, good) = projection(dtype), letters(5, dtype)
    expected = method.recover(operator, readings, good)
    done = []
    found = method.recover(operator, place.put(readings), place.put(good), done.append)
    assert Place.of(found.frames) == Place.of(place.put(readings))
    frames = to_numpy(found.frames)
    assert (frames.shape, frames.dtype) == ((5, 24, 23), dtype)
    assert difference(frames, expected.frames) < ROUNDING[dtype]
    np.testing.assert_allclose(found.objective, expected.objective, rtol=ROUNDING[dtype])
    assert (found.iterations, found.stopped_because) == (expected.iterations, expected.stopped_because)
    assert sum(done) == method.work(5)
    assert method.portable


@every_method
def test_without_a_mask_and_a_lone_frame(place, method):
    readings, _ = letters(1)
    expected = method.recover(projection(), readings)
    assert difference(to_numpy(method.recover(projection(), place.put(readings)).frames), expected.frames) < 1e-5


@every_method
def test_pieces_make_no_difference(place, method, monkeypatch):
    """Memory for two frames at a time instead of for all five; sums over other numbers of frames round otherwise."""
    readings, good = (place.put(array) for array in letters(5))
    whole = to_numpy(method.recover(projection(), readings, good).frames)
    monkeypatch.setattr(batches, "WORKING_BYTES", 2 * batches.WORKING_PICTURES * 24 * 23 * 4)
    assert batches.frames_at_once(projection(), readings) == 2
    assert difference(to_numpy(method.recover(projection(), readings, good).frames), whole) < 1e-6


def test_an_inverse_is_prepared_once_for_all_arrays(place):
    readings, _ = letters(40)
    prepared = LinearInverse().prepare(projection())
    assert difference(to_numpy(prepared.recover(place.put(readings)).frames), prepared.recover(readings).frames) < 1e-5


@pytest.mark.parametrize("prior", [Sparse, TotalVariation])
@pytest.mark.parametrize(
    "data_term",
    [partial(Huber, threshold=8.0), partial(Poisson, deviation=np.full(90, 12.0))],
    ids=["huber", "poisson"],
)
def test_every_data_term(place, prior, data_term):
    operator = projection()
    readings, good = letters(3)
    readings = np.maximum(readings, 0)
    if data_term.func is Poisson:
        operator, readings = Diagonal(np.full(90, 1 / 12)) @ operator, readings / np.float32(12)
    method = prior(iterations=30, data_term=data_term)
    expected = method.recover(operator, readings, good).frames
    found = method.recover(operator, place.put(readings), place.put(good)).frames
    assert difference(to_numpy(found), expected) < 1e-5


def test_a_tolerance_stops_at_the_same_iteration(place):
    readings, _ = letters(3, np.float64)
    method = TotalVariation(iterations=200, tolerance=1e-4)
    expected = method.recover(projection(np.float64), readings)
    found = method.recover(projection(np.float64), place.put(readings))
    assert found.stopped_because == expected.stopped_because == "converged"
    assert found.iterations == expected.iterations < 200


def test_the_residual_is_measured_where_the_frames_are(place):
    readings, good = letters(4)
    frames = Sparse(iterations=5).recover(projection(), readings, good).frames
    there = (place.put(array) for array in (frames, readings, good))
    expected = relative_residual(projection(), frames, readings, good)
    assert relative_residual(projection(), *there) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("prior", [NonnegativeSparsity, NonnegativeTotalVariation])
def test_no_step_waits_for_the_device(prior, monkeypatch):
    """Whatever asks an array for a number has to wait until the device has it."""
    strict = pytest.importorskip("array_api_strict")
    readings = Place("array_api_strict").put(letters(6)[0])
    step = 1 / squared_norm(projection())
    solver = Fista(projection(), LeastSquares(readings), prior(0.5), step, 6)
    solver.step()

    def asked(array: object) -> None:
        raise AssertionError("the array was asked for its value")

    for question in ("__bool__", "__float__", "__int__", "__index__", "__array__", "__complex__"):
        monkeypatch.setattr(type(readings), question, asked)
    with pytest.raises(AssertionError, match="asked for its value"):
        float(strict.sum(solver.objective))
    for _ in range(3):
        solver.step()


def test_a_tolerance_waits_for_the_device_once_in_an_iteration(monkeypatch):
    pytest.importorskip("array_api_strict")
    readings = Place("array_api_strict").put(letters(3)[0])
    solver = Fista(projection(), LeastSquares(readings), NonnegativeSparsity(0.5), 1 / squared_norm(projection()), 3)
    kind, asked = type(readings), []
    truth = kind.__bool__
    monkeypatch.setattr(kind, "__bool__", lambda array: bool(asked.append(array)) or truth(array))
    history = iterate(solver, Stopping(7, 1e-9), silent, 3)
    assert len(asked) == history.iterations == 7


@pytest.mark.parametrize("shape", [(7, 6, 3), (1, 9, 2), (8, 1, 1)], ids=str)
@pytest.mark.parametrize("weight", [0.0, 0.3])
def test_total_variation_sweep_by_sweep(place, shape, weight):
    noisy = np.random.default_rng(3).standard_normal(shape)
    here, there = None, None
    for _ in range(3):
        result, total, here = CompiledLoops().variation_shrunk(noisy, here, weight, 4, np.empty(shape))
        found, variation, there = PortableLoops().variation_shrunk(
            place.put(noisy), there, weight, 4, place.put(np.empty(shape))
        )
        np.testing.assert_allclose(to_numpy(found), result, atol=1e-13)
        np.testing.assert_allclose(to_numpy(variation), total, rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(to_numpy(there), here, atol=1e-13)


def test_refused_frames_are_put_back(place):
    rng = np.random.default_rng(4)
    values, before = rng.random((4, 5, 3)), rng.random((4, 5, 3))
    refused = np.array([False, True, False])
    found = PortableLoops().put_back(place.put(values), place.put(before), place.put(refused))
    expected = CompiledLoops().put_back(values.copy(), before, refused)
    np.testing.assert_allclose(to_numpy(found), expected, rtol=1e-14)
    np.testing.assert_array_equal(to_numpy(found)[..., 1], before[..., 1])
    np.testing.assert_array_equal(to_numpy(found)[..., ::2], values[..., ::2])


@pytest.mark.parametrize(
    ("method", "what"),
    [
        (Wavelets(), "the prior Wavelets"),
        (LightFieldVariation(), "the prior LightFieldVariation"),
        (PlugAndPlay(Sparse()), "a denoiser"),
    ],
    ids=["wavelets", "light field", "denoiser"],
)
def test_what_has_only_compiled_loops_says_so(place, method, what):
    assert not method.portable
    with pytest.raises(InputError, match=f"{what} works on NumPy arrays, not on {place.library}'s"):
        method.recover(projection(), place.put(letters(2)[0]))


def test_the_choice_of_a_weight_says_so_too(place):
    with pytest.raises(InputError, match="works on NumPy arrays"):
        choose_weight(Sparse(), projection(), place.put(letters(1)[0][:, 0]), 5)


def test_operators_with_compiled_loops_only_say_so(place):
    operator = projection() @ FourierShear((24, 23), 0.5, (1, 1))
    for whole in (operator, Stack([operator, projection()]).H.H):
        with pytest.raises(InputError, match="the operator FourierShear works on NumPy arrays"):
            whole(place.put(np.zeros((24, 23), np.float32)))
    with pytest.raises(InputError, match="the operator FourierShear works on NumPy arrays"):
        Sparse().recover(operator, place.put(letters(2)[0]))


@every_method
def test_unusable_readings_are_refused(place, method):
    readings, good = letters(2)
    for wrong, mask, why in (
        (np.where(good, readings, np.nan), None, "NaN"),
        (readings[:-1], None, "must have shape"),
        (readings, good[:, :1], "must have shape"),
    ):
        with pytest.raises(InputError, match=why):
            method.recover(projection(), place.put(wrong), None if mask is None else place.put(mask))
    with pytest.raises(InputError, match="do not work together"):
        method.recover(projection(), place.put(readings), good)
    with pytest.raises(ShapeError):
        LeastSquares(place.put(readings), place.put(good[:, :1]))


def test_darkness_is_refused(place):
    with pytest.raises(InputError, match="no view sees anything"):
        Sparse().recover(projection(), place.put(np.zeros((90, 3), np.float32)))
