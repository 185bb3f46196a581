from __future__ import annotations

import numpy as np
import pytest
from portable_libraries import LIBRARIES, find_device

from nlos import Capture
from nlos.capture import remove_device_legs
from nlos.compressed import CompressedCapture
from nlos.preparation import crop_capture, rebin_capture, remove_first_bounce
from nlos.simulate import add_poisson_noise
from tofclip.arrays import to_numpy
from tofclip.errors import InputError
from tofclip.units import SPEED_OF_LIGHT

WALL = np.array([[0.0, 0, 0], [0.3, 0, 0], [np.nan, 0, 0]])
SPACING = 0.01
SIGNAL = np.random.default_rng(3).normal(size=(100, 3))
CAPTURE = Capture(SIGNAL, WALL, [0.0, 0, 0], SPACING / SPEED_OF_LIGHT, 0.2, {"shot": 7})


def test_cropping_keeps_every_bin_at_its_path() -> None:
    kept = crop_capture(CAPTURE, 0.395, 0.605)
    assert kept.axis.paths == pytest.approx(np.arange(0.40, 0.606, 0.01))
    assert np.array_equal(kept.signal, CAPTURE.signal[20:41])
    assert kept.provenance == {"shot": 7}
    with pytest.raises(InputError, match=r"record runs from 0\.2 to 1\.19 m"):
        crop_capture(CAPTURE, 2, 3)


def test_bins_put_together_stand_for_their_middle() -> None:
    few = rebin_capture(CAPTURE, 8)
    assert few.signal.shape == (12, 3)
    assert few.signal[2] == pytest.approx(CAPTURE.signal[16:24].sum(axis=0), rel=1e-5)
    assert few.bin_width == pytest.approx(8 * CAPTURE.bin_width)
    assert few.axis.paths[2] == pytest.approx(CAPTURE.axis.paths[16:24].mean())
    assert np.array_equal(rebin_capture(CAPTURE, 1).signal, CAPTURE.signal)
    for factor in (0, -2, 51):
        with pytest.raises(InputError, match="put together"):
            rebin_capture(CAPTURE, factor)


def test_the_first_bounce_comes_later_far_from_the_laser() -> None:
    gated = remove_first_bounce(CAPTURE, 0.25)
    assert np.all(gated.signal[CAPTURE.axis.paths < 0.2501, 0] == 0)
    assert np.array_equal(gated.signal[6:, 0], CAPTURE.signal[6:, 0])
    assert np.all(gated.signal[:36, 1] == 0)
    assert np.array_equal(gated.signal[36:, 1], CAPTURE.signal[36:, 1])
    # Where the wall point is not known the signal is not used either.
    assert np.array_equal(gated.signal[:, 2], CAPTURE.signal[:, 2])
    with pytest.raises(InputError, match="margin"):
        remove_first_bounce(CAPTURE, -1)


@pytest.mark.parametrize("library", LIBRARIES)
def test_a_capture_is_prepared_where_it_lives(library: str) -> None:
    moved = CAPTURE.on(find_device(library))
    for prepared in (
        lambda one: crop_capture(one, 0.395, 0.605),
        lambda one: rebin_capture(one, 8),
        lambda one: remove_first_bounce(one, 0.25),
    ):
        found, expected = prepared(moved), prepared(CAPTURE)
        assert found.device == moved.device
        assert found.axis == expected.axis
        np.testing.assert_allclose(to_numpy(found.signal), expected.signal, rtol=1e-6, atol=1e-6)


def test_what_has_compiled_loops_refuses_other_arrays() -> None:
    moved = CAPTURE.on(find_device("torch"))
    with pytest.raises(InputError, match="unwarping works on NumPy arrays"):
        remove_device_legs(moved, np.zeros(3), np.zeros(3))
    with pytest.raises(InputError, match="drawing photons works on NumPy arrays"):
        add_poisson_noise(moved, 10)
    with pytest.raises(InputError, match="compressed measurements works on NumPy arrays"):
        CompressedCapture(moved.signal, None, WALL, np.zeros(3), 1e-11)  # type: ignore[arg-type]
