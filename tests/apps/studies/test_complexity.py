"""The table of costs on a small light field: what is counted, and what must be cheaper than what."""

from __future__ import annotations

import numpy as np
import pytest

from apps.studies.iteration_costs import measure_iteration_costs
from tofclip.light_field import LightField


@pytest.fixture(scope="module")
def costs() -> list:
    views = np.array([(v, u) for v in range(-2, 2) for u in range(-2, 2)], np.float64)
    pictures = np.random.default_rng(0).random((16, 64, 64)).astype(np.float32)
    return measure_iteration_costs(
        LightField(pictures, views), -0.3, exposures=4, sampling_ratio=0.5, repeats=5
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


def test_refocusing_one_picture_is_cheaper_than_recovering_the_light_field(costs):
    """By the prior alone 16 times less work; the bound leaves room for other programs."""
    assert costs[6].seconds < costs[4].seconds
    assert all(0 < cost.model_seconds < 1 and 0 < cost.seconds < 1 for cost in costs)
