"""Nothing hides on the processor: a device of array-api-strict that mixes with no other, and gives
NumPy nothing.

So would a graphics processor: whatever stays behind on the processor, or is fetched in passing,
ends in an error. What is fetched on purpose is counted.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from tofclip.arrays import ComputeDevice, to_numpy
from tofclip.camera import Camera
from tofclip.lidar import Detection, depth, pulse_tables
from tofclip.operators import (
    BlockDiagonal,
    Diagonal,
    Integration,
    LinearOperator,
    LineProjection,
    Reshape,
    Stack,
)
from tofclip.shots import Frames
from tofclip.solvers import (
    Backprojection,
    Huber,
    LinearInverse,
    Method,
    Poisson,
    Sparse,
    TotalVariation,
    relative_residual,
)

strict = pytest.importorskip("array_api_strict")
OTHER_DEVICE = ComputeDevice("array_api_strict", strict.Device("device1"))
HERE = strict.Device("CPU_DEVICE")

ANGLES = np.deg2rad([-38.0, -20.0, 2.0, 21.0, 40.0])
CENTRES = np.linspace(20.0, 100.0, 5)


def brought_here(array: Any) -> np.ndarray:
    return np.asarray(array.to_device(HERE))


@pytest.fixture(autouse=True)
def fetched(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Sizes of what is fetched on purpose."""
    sizes: list[int] = []

    def fetch(array: Any) -> np.ndarray:
        if isinstance(array, np.ndarray):
            return array
        sizes.append(array.size)
        return brought_here(array)

    for name, module in list(sys.modules.items()):
        if name.startswith("tofclip.") and getattr(module, "to_numpy", None) is to_numpy:
            monkeypatch.setattr(module, "to_numpy", fetch)
    return sizes


def projection() -> LineProjection:
    return LineProjection((16, 15), 120, CENTRES, ANGLES, np.ones(5))


def measured(frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Measurements of a bright square with noise, and which of them are good."""
    random = np.random.default_rng(5)
    picture = np.zeros((16, 15, 1))
    picture[4:11, 5:10] = 100
    measurements = projection()(picture * random.uniform(0.5, 1, frames)) + random.normal(
        0, 2, (120, frames)
    )
    return np.maximum(measurements, 0).astype(np.float32), random.random((120, frames)) > 0.03


def test_the_device_is_as_strict_as_it_is_meant_to_be() -> None:
    there = OTHER_DEVICE.put(np.ones(3, np.float32))
    with pytest.raises(ValueError, match="different devices"):
        _ = there + strict.ones(3, dtype=strict.float32)
    with pytest.raises(RuntimeError, match="convert array on the 'array_api_strict"):
        np.asarray(there)


@pytest.mark.parametrize(
    "operator",
    [
        projection(),
        Diagonal(np.linspace(0, 2, 120)) @ projection(),
        Stack([projection(), projection()]),
        BlockDiagonal([projection(), projection()]),
        Integration([projection(), projection()]),
        Reshape((120,), (10, 12)) @ projection(),
        projection().H,
    ],
    ids=lambda operator: type(operator).__name__,
)
def test_operators(operator: LinearOperator, fetched: list[int]) -> None:
    random = np.random.default_rng(1)
    for apply, shape in ((operator, operator.shape_in), (operator.adjoint, operator.shape_out)):
        operand = random.random((*shape, 3), np.float32)
        there = apply(OTHER_DEVICE.put(operand))
        np.testing.assert_allclose(brought_here(there), apply(operand), rtol=1e-4)
    assert fetched == []


FRAMES, ITERATIONS = 4, 20
PEAKS, PULLS, VALUES = FRAMES, FRAMES, FRAMES
HISTORY = ITERATIONS + 1
"""Numbers that a solver fetches, of each frame: the peak of A'f, by which a weight is relative; the
peak of the data term's gradient, where that is not least squares, by which dark frames are known;
and the term's value for a picture of nothing. Then the objective before and after each iteration,
all frames together.
"""


@pytest.mark.parametrize(
    ("method", "fetches"),
    [
        (Sparse(iterations=ITERATIONS), [PEAKS, VALUES, HISTORY]),
        (TotalVariation(iterations=ITERATIONS, tolerance=1e-9), [PEAKS, VALUES, HISTORY]),
        (
            Sparse(iterations=ITERATIONS, data_term=partial(Huber, threshold=5.0)),
            [PEAKS, PULLS, VALUES, HISTORY],
        ),
        (
            TotalVariation(
                iterations=ITERATIONS, data_term=partial(Poisson, deviation=np.full(120, 1.0))
            ),
            [PEAKS, PULLS, VALUES, HISTORY],
        ),
        (LinearInverse(), [120]),  # which measurements are dead, before it is prepared
        (Backprojection(), []),
    ],
)
def test_recovery(method: Method, fetches: list[int], fetched: list[int]) -> None:
    """A few numbers for each frame are fetched, whatever its size, and nothing in an iteration."""
    measurements, valid = measured(FRAMES)
    expected = method.recover(projection(), measurements, valid).frames
    there = OTHER_DEVICE.put(measurements), OTHER_DEVICE.put(valid)
    frames = method.recover(projection(), *there).frames
    assert fetched == fetches
    assert np.linalg.norm(brought_here(frames) - expected) < 1e-4 * np.linalg.norm(expected)
    residual = relative_residual(projection(), expected, measurements, valid)
    assert relative_residual(projection(), frames, *there) == pytest.approx(residual, rel=1e-4)


def test_the_search_for_returns(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames are fetched on purpose, and the same returns found."""
    random = np.random.default_rng(2)
    times = 10e-9 + 20e-12 * np.arange(90)
    arrival = random.uniform(times[5], times[-5], (2, 12, 9))
    pulses = np.exp(-4 * np.log(2) * ((times[:, None, None, None] - arrival) / 60e-12) ** 2)
    values = (300 * pulses).sum(axis=1) + random.normal(5, 2, (90, 12, 9))
    frames = Frames(
        values.astype(np.float32), times, Camera(CENTRES, ANGLES, (12, 9), 120, pulse_fwhm=60e-12)
    )
    detection = Detection(min_scene_fraction=0, min_time_bin_fraction=0)
    expected = depth(frames, detection=detection)
    assert len(expected) > 108
    monkeypatch.setattr(pulse_tables, "to_numpy", brought_here)
    found = depth(replace(frames, values=OTHER_DEVICE.put(frames.values)), detection=detection)
    np.testing.assert_array_equal([found.y, found.x], [expected.y, expected.x])
    np.testing.assert_array_equal(found.time, expected.time)
