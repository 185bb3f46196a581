import numpy as np
import pytest

from tofclip.errors import TofclipError
from tofclip.metrics import correlation_coefficient, nmse, nmse_energy

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


def test_correlation_knows_no_scale_and_a_dark_picture_shows_nothing():
    truth = np.random.default_rng(0).random((8, 8))
    assert correlation_coefficient(3 * truth + 1, truth) == pytest.approx(1)
    assert correlation_coefficient(-truth, truth) == pytest.approx(-1)
    assert correlation_coefficient(np.zeros((8, 8)), truth) == 0


@pytest.mark.parametrize(
    "compare",
    [
        lambda: nmse(np.zeros((2, 2)), np.zeros((2, 3))),
        lambda: nmse(TRUTH, np.full((2, 2), 3.0)),
        lambda: nmse(TRUTH, TRUTH, 1),
        lambda: nmse(np.full((2, 2), np.nan), TRUTH),
        lambda: nmse_energy(TRUTH, np.zeros((2, 2))),
        lambda: correlation_coefficient(TRUTH, np.ones((2, 2))),
    ],
)
def test_what_cannot_be_compared_is_refused(compare):
    with pytest.raises(TofclipError):
        compare()
