from __future__ import annotations

import numpy as np
import pytest

from tofclip.errors import TofclipError
from tofclip.metrics import nmse, nmse_energy

TRUTH = np.array([[0.0, 1.0], [2.0, 3.0]])


def test_values_by_hand():
    estimate = TRUTH + np.array([[1.0, 0.0], [0.0, 0.0]])
    assert nmse(estimate, TRUTH) == pytest.approx(1 / 5)  # variance sum: 2 * (1.5^2 + 0.5^2) = 5
    assert nmse_energy(estimate, TRUTH) == pytest.approx(1 / 14)
    assert nmse(TRUTH, TRUTH) == 0


def test_border_is_left_out():
    truth = np.random.default_rng(0).random((2, 8, 9))
    estimate = truth.copy()
    estimate[:, 0, :] += 5
    estimate[:, :, -1] -= 5
    assert nmse(estimate, truth, border_px=1) == 0
    assert nmse(estimate, truth) > 1


@pytest.mark.parametrize(
    ("estimate", "truth", "border"),
    [
        (np.zeros((2, 2)), np.zeros((2, 3)), 0),
        (TRUTH, np.full((2, 2), 3.0), 0),
        (TRUTH, TRUTH, 1),
        (np.full((2, 2), np.nan), TRUTH, 0),
    ],
)
def test_what_cannot_be_compared_is_refused(estimate, truth, border):
    with pytest.raises(TofclipError):
        nmse(estimate, truth, border)


def test_energy_of_nothing_is_refused():
    with pytest.raises(TofclipError):
        nmse_energy(TRUTH, np.zeros((2, 2)))
