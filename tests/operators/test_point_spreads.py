"""Point-spread functions of apertures against geometric optics, and measured ones against what was
measured.
"""

from __future__ import annotations

import numpy as np
import pytest

from tofclip.errors import InputError
from tofclip.operators import LinearShear, PointSpreadConvolution
from tofclip.operators.point_spreads import (
    CodedAperture,
    CubicPhasePlate,
    Diffuser,
    MeasuredPointSpreads,
    shear_point_spreads,
    trace_view_point_spreads,
)

VIEWS = [(float(v), float(u)) for v in range(-4, 4) for u in range(-4, 4)]
SHAPE = (64, 72)


def spread_at(element, shear: float) -> np.ndarray:
    return shear_point_spreads(trace_view_point_spreads(element, VIEWS, SHAPE), VIEWS, shear).sum(
        axis=0
    )


@pytest.mark.parametrize("shear", [3.0, -2.0])
def test_a_coded_aperture_s_spread_is_its_code_mirrored_and_scaled_by_the_shear(shear):
    """Supplement Eq. 6; the code's cells are the views, so that at whole s each is one pixel of the
    PSF.
    """
    code = np.random.default_rng(0).integers(0, 2, (8, 8))
    spread = spread_at(CodedAperture(code), shear)
    expected = np.zeros(SHAPE)
    for v, u in VIEWS:
        # The aperture's middle lies at view -0.5: its mirror image of view v is -1 - v, cell 3 - v.
        expected[int(32 + shear * v), int(36 + shear * u)] = code[int(3 - v), int(3 - u)] / 64
    np.testing.assert_allclose(spread, expected, atol=1e-12)


def test_in_focus_a_coded_aperture_s_spread_is_a_point():
    code = np.random.default_rng(1).random((8, 8))
    spread = spread_at(CodedAperture(code), 0.0)
    assert spread[32, 36] == pytest.approx(code.mean(), rel=1e-12)
    assert np.count_nonzero(spread) == 1


def test_a_cubic_phase_plate_s_spread_hardly_changes_with_depth():
    """Against an open aperture, whose PSF grows with s: the likeness of two depths' PSFs."""

    def similarity(element) -> float:
        near, far = (np.abs(np.fft.fft2(spread_at(element, s))) for s in (0.0, 0.7))
        return float(np.vdot(near, far) / np.linalg.norm(near) / np.linalg.norm(far))

    assert similarity(CubicPhasePlate(24.0)) > 0.98
    assert similarity(CodedAperture(np.ones((8, 8)))) < 0.8


def test_a_cubic_phase_plate_s_spread_is_as_large_as_asked_and_brightest_in_a_corner():
    spread = spread_at(CubicPhasePlate(20.0), 0.0)
    rows = np.flatnonzero(spread.sum(axis=1) > 1e-9)
    assert 20 <= np.ptp(rows) <= 21
    assert np.unravel_index(spread.argmax(), SHAPE) == (22, 26)


def test_a_diffuser_s_spread_is_as_wide_as_asked_and_its_seed_decides_it():
    spread = spread_at(Diffuser(6.0, 0.15, 3), 0.0)
    rows, columns = np.indices(SHAPE)
    variance = np.sum(((rows - 32) ** 2 + (columns - 36) ** 2) * spread) / 2
    assert spread.sum() == pytest.approx(1, abs=1e-3)
    # The deflections' variance is the PSF's second moment about zero deflection; the pixels add 1/6
    # of a pixel.
    assert np.sqrt(variance) == pytest.approx(6.0, rel=0.1)
    np.testing.assert_array_equal(spread, spread_at(Diffuser(6.0, 0.15, 3), 0.0))
    assert not np.allclose(spread, spread_at(Diffuser(6.0, 0.15, 4), 0.0))


def test_a_diffuser_s_spread_grows_and_moves_with_depth_as_the_rays_do():
    """The mean of s (u + deflection) over the aperture: u's mean is -0.5 views on this grid."""
    rows, columns = np.indices(SHAPE)
    shift = []
    for shear in (0.0, -2.0):
        spread = spread_at(Diffuser(5.0, 0.2, 0), shear)
        shift.append([np.sum(rows * spread), np.sum(columns * spread)])
    np.testing.assert_allclose(np.subtract(shift[1], shift[0]), [1.0, 1.0], atol=1e-2)


def test_shearing_the_spread_is_shearing_the_picture():
    """A_k B_k h, for a picture and a PSF that stay off every border."""
    spreads = trace_view_point_spreads(Diffuser(2.0, 0.3, 0), [(0.0, 0.0), (1.0, 2.0)], (24, 25))
    picture = np.zeros((64, 65))
    picture[25:40, 25:40] = np.random.default_rng(4).random((15, 15))
    view, reference = (1.0, 2.0), (0.3, -0.4)
    moved = shear_point_spreads(spreads, [(0.0, 0.0), view], -0.7, reference)[1]
    together = PointSpreadConvolution((64, 65), moved, dtype=np.float64)(picture)
    sheared = LinearShear((64, 65), -0.7, view, reference, np.float64)(picture)
    np.testing.assert_allclose(
        together,
        PointSpreadConvolution((64, 65), spreads[1], dtype=np.float64)(sheared),
        atol=1e-12,
    )


def test_measured_spreads_are_returned_where_measured_and_mixed_between():
    stack = np.random.default_rng(5).random((3, 6, 7)) * np.array([1.0, 5.0, 2.0])[:, None, None]
    measured = MeasuredPointSpreads(stack, [0.5, -1.0, 0.0])
    unit = stack / stack.sum(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(measured.interpolate(-1.0), unit[1], rtol=1e-12)
    np.testing.assert_allclose(measured.interpolate(0.5), unit[0], rtol=1e-12)
    np.testing.assert_allclose(
        measured.interpolate(-0.25), 0.25 * unit[1] + 0.75 * unit[2], rtol=1e-12
    )
    np.testing.assert_allclose(
        MeasuredPointSpreads(stack[:1], [2.0]).interpolate(2.0), unit[0], rtol=1e-12
    )


@pytest.mark.parametrize(
    ("stack", "shears", "message"),
    [
        (np.ones((2, 3, 3)), [0.0], "must have shape"),
        (np.ones((2, 3, 3)), [0.0, 0.0], "same shear"),
        (np.zeros((1, 3, 3)), [0.0], "hold light"),
        (np.full((1, 3, 3), np.nan), [0.0], "hold light"),
        (np.ones((1, 3, 3)), [np.inf], "hold light"),
    ],
)
def test_measurements_that_cannot_be_used_are_refused(stack, shears, message):
    with pytest.raises(InputError, match=message):
        MeasuredPointSpreads(stack, shears)


def test_a_depth_that_was_not_measured_is_refused():
    with pytest.raises(InputError, match=r"beyond the measured 0 \.\.\. 1"):
        MeasuredPointSpreads(np.ones((2, 3, 3)), [0.0, 1.0]).interpolate(1.2)


def test_a_diffuser_without_grain_is_refused():
    with pytest.raises(InputError, match="grain"):
        trace_view_point_spreads(Diffuser(3.0, 0.0, 0), VIEWS, (8, 8))
