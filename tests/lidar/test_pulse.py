"""Pulse shapes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tofclip.errors import InputError
from tofclip.lidar import Pulse


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
    # one that never falls ends with its samples
    assert Pulse([1.0, 1.0, 1.0], 1e-12, origin=0.0).fwhm == pytest.approx(2e-12)


def test_a_binned_pulse_sums_up_the_light():
    pulse = Pulse.gaussian(60e-12)
    shape = pulse.integrate_bins(60e-12)
    middles = np.arange(-8, 9) * 60e-12 + 6e-12
    assert np.sum(shape(middles)) * 60e-12 == pytest.approx(shape.area, rel=1e-4)
    assert shape.area / shape(0.0) > pulse.area
    assert shape.slope_at(0.0) == pytest.approx(0, abs=1e-6 / 20e-12)


@pytest.mark.parametrize("times", [1e300, 1e-300, 1e6, 1e-6])
def test_widths_of_different_units_are_refused_before_memory_is_taken(times):
    """A slip in a unit asked for terabytes: the finer of the two decides how many samples there are."""
    pulse = Pulse.gaussian(60e-12)
    with pytest.raises(InputError, match="check their units"):
        pulse.integrate_bins(60e-12 * times)
    if times > 1:
        with pytest.raises(InputError, match="check their units"):
            Pulse.exponentially_modified(60e-12, 60e-12 * times)


USUAL = ([0.0, 1.0, 0.0], 1e-12, 0.0)


@pytest.mark.parametrize(
    ("make", "settings"),
    [
        *((Pulse, (samples, 1e-12, 0.0)) for samples in ([1.0, 2.0], [0.0] * 3, [[1.0, 2.0, 1.0]])),
        (Pulse, ([0.0, np.nan, 0.0], 1e-12, 0.0)),
        *((Pulse, (USUAL[0], spacing, 0.0)) for spacing in (0.0, np.nan)),
        *((Pulse, (*USUAL[:2], origin)) for origin in (3.0, np.nan)),
        *((Pulse.gaussian, (fwhm,)) for fwhm in (0.0, -1e-12, np.nan, np.inf)),
        (Pulse.exponentially_modified, (0, 1e-12)),
        (Pulse.exponentially_modified, (1e-12, np.inf)),
        (Pulse.gaussian(1e-12).integrate_bins, (0.0,)),
    ],
)
def test_unusable_shapes_and_widths_are_refused(make, settings):
    with pytest.raises(InputError):
        make(*settings)
