"""Pulse shapes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofclip.errors import InputError
from tofclip.lidar import Pulse


@settings(max_examples=50, deadline=None)
@given(fwhm=st.floats(1e-12, 1e-8), widths=st.floats(-3, 3))
def test_a_gaussian_has_its_width_and_is_even(fwhm, widths):
    pulse = Pulse.gaussian(fwhm)
    assert pulse(0.0) == 1.0
    assert pulse.fwhm == pytest.approx(fwhm, rel=1e-4)
    assert pulse(widths * fwhm) == pytest.approx(pulse(-widths * fwhm), abs=1e-12)
    expected = np.exp(-4 * np.log(2) * widths**2) if abs(widths) < 2 else 0.0
    # linear interpolation between 128 samples a width, and the cut at two widths
    assert pulse(widths * fwhm) == pytest.approx(expected, abs=5e-5)


def test_support_is_where_a_gaussian_exceeds_one_percent():
    first, last = Pulse.gaussian(1.0).support
    half = np.sqrt(np.log(100) / (4 * np.log(2)))
    assert (first, last) == (pytest.approx(-half, abs=1e-3), pytest.approx(half, abs=1e-3))


def test_samples_are_scaled_and_the_origin_shifts_them():
    pulse = Pulse([0.0, 4.0, 2.0, 0.0], 1e-12, origin=1.0)
    assert pulse([0.0, 0.5e-12, 1e-12, -1e-12, 5e-12]) == pytest.approx([1.0, 0.75, 0.5, 0.0, 0.0])
    # half maximum at 0.5 samples on the way up and at sample 2 on the way down
    assert pulse.fwhm == pytest.approx(1.5e-12)


def test_a_pulse_that_never_falls_ends_with_its_samples():
    assert Pulse([1.0, 1.0, 1.0], 1e-12, origin=0.0).fwhm == pytest.approx(2e-12)


@pytest.mark.parametrize(
    ("samples", "spacing", "origin"),
    [
        ([1.0, 2.0], 1e-12, 0.0),
        ([0.0, 0.0, 0.0], 1e-12, 0.0),
        ([0.0, np.nan, 0.0], 1e-12, 0.0),
        ([[1.0, 2.0, 1.0]], 1e-12, 0.0),
        ([0.0, 1.0, 0.0], 0.0, 0.0),
        ([0.0, 1.0, 0.0], np.nan, 0.0),
        ([0.0, 1.0, 0.0], 1e-12, 3.0),
        ([0.0, 1.0, 0.0], 1e-12, np.nan),
    ],
)
def test_unusable_shapes_are_refused(samples, spacing, origin):
    with pytest.raises(InputError):
        Pulse(samples, spacing, origin)


@pytest.mark.parametrize("times", [1e300, 1e-300, 1e6, 1e-6])
def test_widths_of_different_units_are_refused_before_memory_is_taken(times):
    """A slip in a unit asked for terabytes: the finer of the two decides how many samples there are."""
    pulse = Pulse.gaussian(60e-12)
    with pytest.raises(InputError, match="check their units"):
        pulse.integrate_bins(60e-12 * times)
    if times > 1:
        with pytest.raises(InputError, match="check their units"):
            Pulse.exponentially_modified(60e-12, 60e-12 * times)


@pytest.mark.parametrize("fwhm", [0.0, -1e-12, np.nan, np.inf])
def test_unusable_widths_are_refused(fwhm):
    with pytest.raises(InputError, match="positive time"):
        Pulse.gaussian(fwhm)
