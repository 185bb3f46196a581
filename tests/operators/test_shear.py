"""The shear against shifts that can be written down."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofclip.operators import FourierShear, LinearShear

both = pytest.mark.parametrize("kind", [LinearShear, FourierShear])


@both
def test_near_objects_move_against_the_view(kind):
    """Negative shear: a view to the right and below sees the object further left and up, by whole
    pixels.
    """
    picture = np.zeros((9, 12))
    picture[6, 8] = 1
    seen = kind((9, 12), -2.0, (1, 3), (0, 1), np.float64)(picture)
    expected = np.zeros((9, 12))
    expected[4, 4] = 1
    np.testing.assert_allclose(seen, expected, atol=1e-14)


def test_light_leaves_over_the_border_with_linear_and_returns_with_fourier():
    picture = np.zeros((5, 6))
    picture[2, 5] = 1
    assert LinearShear((5, 6), 1.0, (0, 1), dtype=np.float64)(picture).sum() == 0
    assert FourierShear((5, 6), 1.0, (0, 1), dtype=np.float64)(picture)[2, 0] == pytest.approx(1)


@settings(max_examples=40, deadline=None)
@given(s=st.floats(-0.9, 0.9), v=st.integers(-4, 3), u=st.integers(-4, 3), r=st.floats(-1.0, 1.0))
def test_the_centroid_moves_by_the_shear_times_the_distance_from_the_reference(s, v, u, r):
    picture = np.zeros((21, 23))
    picture[10, 11] = 1
    seen = LinearShear((21, 23), s, (v, u), (r, -r), np.float64)(picture)
    rows, columns = np.indices(picture.shape)
    assert np.sum(rows * seen) == pytest.approx(10 + s * (v - r), abs=1e-9)
    assert np.sum(columns * seen) == pytest.approx(11 + s * (u + r), abs=1e-9)


@both
def test_a_band_limited_picture_is_shifted(kind):
    x = 2 * np.pi * np.arange(32) / 32
    seen = kind((7, 32), 0.3, (0, 1), dtype=np.float64)(np.tile(np.cos(x), (7, 1)))
    # Linear interpolation of a sine with 32 pixels a period is off by at most (2 pi / 32)^2 / 8 =
    # 0.5 %.
    bound = 5e-3 if kind is LinearShear else 1e-12
    assert np.abs(seen - np.cos(x - 0.3 * 2 * np.pi / 32))[:, 1:].max() < bound


@pytest.mark.parametrize("shift", [0.3, 0.5, -1.2])
def test_the_finest_pattern_fades_with_a_fractional_shift_and_moves_no_other_way(shift):
    """A pattern at the Nyquist frequency has no phase: shifted, only its cosine is left."""
    rows, columns = np.indices((8, 16))
    finest, wave = (-1.0) ** rows, np.cos(2 * np.pi * 3 * columns / 16)
    seen = FourierShear((8, 16), shift, (1, 0), dtype=np.float64)(finest * wave)
    np.testing.assert_allclose(seen, np.cos(np.pi * shift) * finest * wave, atol=1e-12)
    finest, wave = (-1.0) ** columns, np.cos(2 * np.pi * 3 * rows / 8)
    seen = FourierShear((8, 16), shift, (0, 1), dtype=np.float64)(finest * wave)
    np.testing.assert_allclose(seen, np.cos(np.pi * shift) * finest * wave, atol=1e-12)
