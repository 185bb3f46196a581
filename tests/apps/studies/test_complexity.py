"""The table of costs on a small light field: what is counted, and what must be cheaper than what."""

from __future__ import annotations

import numpy as np
import pytest

from apps.studies.iteration_costs import measure_iteration_costs
from tofclip.light_field import LightField
from tofclip.operators import LinearOperator
from tofclip.solvers import NonnegativeTotalVariation


def make_light_field() -> LightField:
    views = np.array([(v, u) for v in range(-2, 2) for u in range(-2, 2)], np.float64)
    pictures = np.random.default_rng(0).random((16, 64, 64)).astype(np.float32)
    return LightField(pictures, views)


@pytest.fixture(scope="module")
def costs() -> list:
    return measure_iteration_costs(
        make_light_field(), -0.3, exposures=4, sampling_ratio=0.5, repeats=5
    )


def test_every_method_of_the_table_is_there(costs):
    assert [cost.method for cost in costs[:4]] == ["Ashok", "Babacan", "Marwah", "Cai, Antipa"]
    assert [cost.recovers for cost in costs] == ["light field"] * 6 + ["refocused picture"] * 2


def test_readings_and_unknowns_are_those_of_the_paper(costs):
    """r N^2, N^2 and m measurements; n_a^2 N^2 unknowns of a light field, N^2 of a picture."""
    assert [cost.measurements for cost in costs] == [
        4 * 4096,
        4 * 4096,
        4096,
        4096,
        2048,
        2048,
        2048,
        2048,
    ]
    assert [cost.unknowns for cost in costs] == [16 * 4096] * 6 + [4096] * 2


def test_all_of_them_are_timed(costs):
    assert all(0 < cost.model_seconds < 1 and 0 < cost.seconds < 1 for cost in costs)


def test_refocusing_one_picture_takes_a_sixteenth_of_the_priors_work(monkeypatch):
    """What is counted is the numbers that an iteration's prior and products handle, not seconds:
    k n_a^2 N^2 against k N^2 by the prior, and one product each way of m measurements for both.
    """
    handled: list[tuple[int, int]] = []

    def count_numbers(action, _: int) -> float:
        numbers = {"prior": 0, "measurements": 0}
        sweep, adjoint = NonnegativeTotalVariation.proximal_step, LinearOperator.adjoint

        def counted_sweep(self, current, *rest):
            numbers["prior"] += current.size
            return sweep(self, current, *rest)

        def counted_adjoint(self, measurements):
            numbers["measurements"] += measurements.size
            return adjoint(self, measurements)

        with pytest.MonkeyPatch.context() as counting:
            counting.setattr(NonnegativeTotalVariation, "proximal_step", counted_sweep)
            counting.setattr(LinearOperator, "adjoint", counted_adjoint)
            action()
        handled.append((numbers["prior"], numbers["measurements"]))
        return 1.0

    monkeypatch.setattr("apps.studies.iteration_costs._measure_median_seconds", count_numbers)
    measure_iteration_costs(make_light_field(), -0.3, exposures=4, sampling_ratio=0.5)
    steps, products = handled[::2], handled[1::2]
    pixels, views, readings = 64 * 64, 16, [4 * 4096] * 2 + [4096] * 2 + [2048] * 4
    assert [prior for prior, _ in steps] == [views * pixels] * 6 + [pixels] * 2
    assert [prior for prior, _ in products] == [0] * 8
    assert [measured for _, measured in steps] == readings
    assert [measured for _, measured in products] == readings
