"""Captures cropped, rebinned, gated, faded and mirrored; and pairs of near lasers and detectors as one
confocal scan at their midpoints.
"""

from dataclasses import replace

import numpy as np
import pytest
from scenes import planar_wall, scaled_error, see

from nlos import Backprojection, Capture, Grid, PlanarRSD, settings_for
from nlos.capture import TimeAxis
from nlos.preparation import (
    MidpointImaging,
    crop_capture,
    fade_record_end,
    flip_capture,
    join_near_lasers,
    rebin_capture,
    remove_first_bounce,
)
from nlos.refinement.photons import PhotonRefinement
from tofclip.errors import InputError
from tofclip.units import SPEED_OF_LIGHT

THREE = np.array([[0.0, 0, 0], [0.3, 0, 0], [np.nan, 0, 0]])
SPACING = 0.01
SIGNAL = np.random.default_rng(3).normal(size=(100, 3))
CAPTURE = Capture(SIGNAL, THREE, [0.0, 0, 0], SPACING / SPEED_OF_LIGHT, 0.2, {"shot": 7})


def test_cropping_keeps_every_bin_at_its_path():
    kept = crop_capture(CAPTURE, 0.395, 0.605)
    assert kept.axis.paths == pytest.approx(np.arange(0.40, 0.606, 0.01))
    assert np.array_equal(kept.signal, CAPTURE.signal[20:41])
    assert kept.provenance == {"shot": 7}
    with pytest.raises(InputError, match=r"record runs from 0\.2 to 1\.19 m"):
        crop_capture(CAPTURE, 2, 3)


def test_bins_put_together_stand_for_their_middle():
    few = rebin_capture(CAPTURE, 8)
    assert few.signal.shape == (12, 3)
    assert few.signal[2] == pytest.approx(CAPTURE.signal[16:24].sum(axis=0), rel=1e-5)
    assert few.bin_width == pytest.approx(8 * CAPTURE.bin_width)
    assert few.axis.paths[2] == pytest.approx(CAPTURE.axis.paths[16:24].mean())
    assert np.array_equal(rebin_capture(CAPTURE, 1).signal, CAPTURE.signal)
    for factor in (0, -2, 51):
        with pytest.raises(InputError, match="put together"):
            rebin_capture(CAPTURE, factor)


def test_the_first_bounce_comes_later_far_from_the_laser():
    gated = remove_first_bounce(CAPTURE, 0.25)
    assert np.all(gated.signal[CAPTURE.axis.paths < 0.2501, 0] == 0)
    assert np.array_equal(gated.signal[6:, 0], CAPTURE.signal[6:, 0])
    assert np.all(gated.signal[:36, 1] == 0)
    assert np.array_equal(gated.signal[36:, 1], CAPTURE.signal[36:, 1])
    # Where the wall point is not known the signal is not used either.
    assert np.array_equal(gated.signal[:, 2], CAPTURE.signal[:, 2])
    with pytest.raises(InputError, match="margin"):
        remove_first_bounce(CAPTURE, -1)


WALL = planar_wall(24, 24) * 0.6
AXIS = TimeAxis(400, 16e-12)


def see_one(wall=WALL, laser=None):
    laser = wall if laser is None else laser
    return see([[0.05, -0.1, 0.8]], wall, laser, AXIS, 40e-12, [400.0])


def test_the_ends_of_the_record_are_soft():
    flat = replace(see_one(), signal=np.ones_like(see_one().signal))
    gated = remove_first_bounce(flat, 0.3, 0.2).signal[:, 3, 3]
    assert gated.min() == 0
    assert np.all(np.diff(gated) >= 0)
    assert np.max(np.diff(gated)) < 0.05
    faded = fade_record_end(flat, 0.2).signal[:, 3, 3]
    assert faded[0] == 1
    assert faded[-1] == 0
    assert np.max(np.abs(np.diff(faded))) < 0.05
    for bad in (-1.0, np.nan):
        with pytest.raises(InputError):
            remove_first_bounce(flat, 0.1, bad)
        with pytest.raises(InputError):
            fade_record_end(flat, bad)


def test_a_picture_is_mirrored_along_an_axis():
    grid = Grid.box((-0.3, 0.3), (-0.3, 0.3), (0.7, 0.9), 0.05)
    for axis, expected in (("x", (-0.05, -0.1)), ("y", (0.05, 0.1))):
        found = PlanarRSD(0.2).reconstruct(flip_capture(see_one(), axis), grid).find_brightest()
        assert found[:2] == pytest.approx(expected, abs=0.03)
    with pytest.raises(InputError, match="mirrored along x or y"):
        flip_capture(see_one(), "z")


# --- lasers near their detectors

WAVELENGTH = 0.2
HIDDEN = [[0.1, -0.2, 0.7], [-0.2, 0.1, 0.9]]
GRID = Grid.box((-0.4, 0.4), (-0.4, 0.4), (0.55, 1.0), 0.04)


def see_pairs(apart, points=24):
    """Two points seen from a wall of 1 m x 1 m whose lasers are so far apart, m, or mirrored."""
    wall = planar_wall(points, points) * [1 / 1.2, 1, 1]
    lasers = wall[::-1] if apart is None else wall + np.array([apart, 0, 0])
    return see(HIDDEN, wall, lasers, TimeAxis(320, 32e-12), 40e-12, [400.0, 500.0])


@pytest.mark.parametrize(("apart", "error"), [(1e-7, 0.02), (1e-3, 0.05), (15e-3, 0.1)])
def test_a_laser_near_its_detector_is_confocal(apart, error):
    lasers = WALL + np.array([apart, 0, 0])
    capture = see_one(laser=lasers)
    settings = settings_for(capture)
    assert settings.method == "rsd"
    grid = Grid.box((-0.2, 0.3), (-0.35, 0.15), (0.7, 0.9), 0.05)
    fast = settings.make_method().reconstruct(settings.prepare(capture), grid).values
    # The same record, with the geometry as it is.
    true = replace(settings.prepare(capture), wall=WALL, laser=lasers)
    exact = settings.make_method("backprojection").reconstruct(true, grid)
    assert scaled_error(fast, exact.values) < error


def test_a_small_walls_lasers_may_be_two_centimetres_away():
    small = replace(see_one(), wall=WALL / 2, laser=WALL / 2 + np.array([0.019, 0, 0]))
    joined = join_near_lasers(small)
    assert np.array_equal(joined.laser, joined.wall)
    tiny = replace(see_one(), wall=WALL / 10, laser=WALL / 10 + np.array([0.019, 0, 0]))
    assert join_near_lasers(tiny) is tiny


@pytest.mark.parametrize(("apart", "error"), [(0.05, 0.02), (0.12, 0.05)])
def test_pairs_a_decimetre_apart_are_imaged_at_their_midpoint(apart, error):
    capture = see_pairs(apart)
    joined = join_near_lasers(capture)
    assert np.array_equal(joined.laser, joined.wall)
    exact = Backprojection(WAVELENGTH).reconstruct(capture, GRID).values
    found = MidpointImaging(PlanarRSD(WAVELENGTH)).reconstruct(capture, GRID).values
    assert scaled_error(found, exact) < error
    # Without moveout the path is too long by a part of the offset's square.
    bare = PlanarRSD(WAVELENGTH).reconstruct(replace(joined, signal=capture.signal), GRID).values
    assert scaled_error(bare, exact) > 1.4 * scaled_error(found, exact)
    assert settings_for(capture, wavelength=WAVELENGTH).method == "rsd"


def test_pairs_far_apart_stay_as_they_are():
    mirrored = see_pairs(None, 16)
    assert join_near_lasers(mirrored) is mirrored
    assert settings_for(mirrored, wavelength=WAVELENGTH).method == "backprojection"
    fine = see_pairs(0.25, 40)
    assert join_near_lasers(fine) is fine


def test_counts_of_near_pairs_are_refined_as_they_are():
    counts = np.random.default_rng(0).poisson(see_pairs(0.1, 12).signal * 0.2 + 0.01)
    capture = replace(see_pairs(0.1, 12), signal=counts.astype(np.float32))
    settings = settings_for(capture, wavelength=WAVELENGTH)
    assert np.array_equal(settings.prepare_counts(capture).laser, capture.laser)
    method = PhotonRefinement(MidpointImaging(PlanarRSD(WAVELENGTH)), iterations=3)
    refined = method.reconstruct(capture, GRID)
    assert "refined" not in refined.provenance["imaging"]["stopped_because"]
    nearest = np.linalg.norm(np.array(HIDDEN) - refined.find_brightest(), axis=1).min()
    assert nearest < 0.06
