"""Recovery on the arrays of other libraries: the same pictures as from the compiled loops, in kind,
without waiting.
"""

from functools import partial

import numpy as np
import pytest
from array_places import DEVICE_NAMES, FETCHED, find_device

from tofclip.arrays import ComputeDevice, to_numpy
from tofclip.errors import InputError, ShapeError
from tofclip.operators import Diagonal, LinearShear, LineProjection, Stack, estimate_squared_norm
from tofclip.solvers import (
    Backprojection,
    Fista,
    Huber,
    LeastSquares,
    LinearInverse,
    NonnegativeSparsity,
    NonnegativeTotalVariation,
    PlugAndPlay,
    Poisson,
    Sparse,
    TotalVariation,
    Wavelets,
    methods,
    relative_residual,
)
from tofclip.solvers.fista import LightFieldVariation, choose_weight

METHODS = [Sparse(iterations=40), TotalVariation(iterations=40), LinearInverse(), Backprojection()]
# Of each frame the peak of A'f, by which a weight is relative, and the value for a picture of nothing;
# then the objective before and after each iteration, all frames together. Which readings are dead.
FETCHES = {"l1": [5, 5, 41], "tv": [5, 5, 41], "linear": [90], "adjoint": []}
# What is promised is 1e-4. Float32 sums in another order differ by 1e-6 or so, which the linear
# inverse amplifies by its condition, at most 1 / damping.
ROUNDING = {np.float32: 1e-5, np.float64: 1e-11}

every_method = pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)


@pytest.fixture(params=DEVICE_NAMES)
def device(request):
    return find_device(request.param)


def projection(dtype=np.float32):
    return LineProjection(
        (24, 23), 90, [14.2, 45.0, 74.5], [-0.7, 0.05, 0.6], [1.0, 0.8, 1.1], dtype
    )


def letters(frames, dtype=np.float32):
    """Measurements of bright rectangles with noise, and a mask with a bad reading here and there."""
    rng = np.random.default_rng(7)
    truth = np.zeros((24, 23, frames))
    for frame in range(frames):
        row, column = rng.integers(2, 12, 2)
        truth[row : row + 8, column : column + 5, frame] = 50 + 10 * frame
    measurements = projection(np.float64)(truth)
    measurements += 5 * rng.standard_normal(measurements.shape)
    return measurements.astype(dtype), rng.random(measurements.shape) > 0.03


def difference(found, expected):
    """Norm of what two recoveries differ by, relative."""
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@every_method
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_pictures_are_those_of_the_compiled_loops(device, method, dtype):
    """A few numbers for each frame are fetched, whatever its size, and nothing in an iteration."""
    operator, (measurements, valid) = projection(dtype), letters(5, dtype)
    expected = method.recover(operator, measurements, valid)
    there, done = (device.put(measurements), device.put(valid)), []
    FETCHED.clear()
    found = method.recover(operator, *there, done.append)
    if device.library == "array_api_strict":
        assert FETCHES[method.name] == FETCHED
    residual = relative_residual(operator, expected.frames, measurements, valid)
    assert relative_residual(operator, found.frames, *there) == pytest.approx(residual, rel=1e-5)
    assert ComputeDevice.of(found.frames) == ComputeDevice.of(device.put(measurements))
    frames = to_numpy(found.frames)
    assert (frames.shape, frames.dtype) == ((5, 24, 23), dtype)
    assert difference(frames, expected.frames) < ROUNDING[dtype]
    np.testing.assert_allclose(found.objective, expected.objective, rtol=ROUNDING[dtype])
    assert (found.iterations, found.stop_reason) == (expected.iterations, expected.stop_reason)
    assert sum(done) == method.work(5)
    assert method.portable


@every_method
def test_pieces_make_no_difference(device, method, monkeypatch):
    """Memory for two frames at a time instead of for all five; sums over other numbers of frames
    round otherwise.
    """
    measurements, valid = (device.put(array) for array in letters(5))
    whole = to_numpy(method.recover(projection(), measurements, valid).frames)
    monkeypatch.setattr(methods, "WORKING_BYTES", 2 * methods.WORKING_PICTURES * 24 * 23 * 4)
    assert methods.frames_per_block(projection(), measurements) == 2
    found = to_numpy(method.recover(projection(), measurements, valid).frames)
    assert difference(found, whole) < ROUNDING[np.float32]


@pytest.mark.parametrize("prior", [Sparse, TotalVariation])
@pytest.mark.parametrize(
    "data_term",
    [partial(Huber, threshold=8.0), partial(Poisson, deviation=np.full(90, 12.0))],
    ids=["huber", "poisson"],
)
def test_every_data_term(device, prior, data_term):
    operator = projection()
    measurements, valid = letters(3)
    measurements = np.maximum(measurements, 0)
    if data_term.func is Poisson:
        operator, measurements = (
            Diagonal(np.full(90, 1 / 12)) @ operator,
            measurements / np.float32(12),
        )
    method = prior(iterations=30, data_term=data_term)
    expected = method.recover(operator, measurements, valid).frames
    FETCHED.clear()
    found = method.recover(operator, device.put(measurements), device.put(valid)).frames
    if device.library == "array_api_strict":
        # the peak of the term's gradient as well, by which dark frames are known
        assert FETCHED == [3, 3, 3, 31]
    assert difference(to_numpy(found), expected) < 1e-5


def test_a_tolerance_stops_at_the_same_iteration(device):
    measurements, _ = letters(3, np.float64)
    method = TotalVariation(iterations=200, tolerance=1e-4)
    expected = method.recover(projection(np.float64), measurements)
    found = method.recover(projection(np.float64), device.put(measurements))
    assert found.stop_reason == expected.stop_reason == "converged"
    assert found.iterations == expected.iterations < 200


def begin(measurements, prior):
    step = 1 / estimate_squared_norm(projection())
    return Fista(projection(), LeastSquares(measurements), prior, step, measurements.shape[1])


@pytest.mark.parametrize("prior", [NonnegativeSparsity, NonnegativeTotalVariation])
def test_no_step_waits_for_the_device(prior, monkeypatch):
    """Whatever asks an array for a number has to wait until the device has it."""
    strict = pytest.importorskip("array_api_strict")
    measurements = ComputeDevice("array_api_strict").put(letters(6)[0])
    solver = begin(measurements, prior(0.5))
    solver.step()

    def asked(array):
        raise AssertionError("the array was asked for its value")

    for question in ("__bool__", "__float__", "__int__", "__index__", "__array__", "__complex__"):
        monkeypatch.setattr(type(measurements), question, asked)
    with pytest.raises(AssertionError, match="asked for its value"):
        float(strict.sum(solver.objective))
    for _ in range(3):
        solver.step()


def test_what_has_only_compiled_loops_says_so(device):
    measurements = device.put(letters(2)[0])
    shear = LinearShear((24, 23), 0.5, (1, 1))
    stack, picture = Stack([projection() @ shear, projection()]), np.zeros((24, 23), np.float32)
    for what, attempt in (
        ("the prior Wavelets", lambda: Wavelets().recover(projection(), measurements)),
        ("LightFieldVariation", lambda: LightFieldVariation().recover(projection(), measurements)),
        ("a denoiser", lambda: PlugAndPlay(Sparse()).recover(projection(), measurements)),
        ("weight", lambda: choose_weight(Sparse(), projection(), measurements[:, 0], 5)),
        ("LinearShear", lambda: stack.H.H(device.put(picture))),
        ("LinearShear", lambda: Sparse().recover(projection() @ shear, measurements)),
    ):
        with pytest.raises(InputError, match=f"{what} works on NumPy arrays"):
            attempt()
    assert not any(
        one.portable for one in (Wavelets(), LightFieldVariation(), PlugAndPlay(Sparse()))
    )


@every_method
@pytest.mark.parametrize("library", ["numpy", *DEVICE_NAMES])
def test_unusable_readings_are_refused(library, method):
    device, (measurements, valid) = find_device(library), letters(2)
    there, recover = device.put(measurements), partial(method.recover, projection())
    with pytest.raises(ShapeError, match="measurements"):
        recover(there[1:, :])
    with pytest.raises(ShapeError, match="mask"):
        recover(there, device.put(valid[:, :1]))
    with pytest.raises(InputError, match="NaN"):
        recover(device.put(np.where(valid, measurements, np.nan)))
    if library != "numpy":
        with pytest.raises(InputError, match="do not work together"):
            recover(there, valid)
    if method.has_prior:
        for dark in (0 * there, -abs(there)):
            with pytest.raises(InputError, match="no view sees anything"):
                recover(dark)
