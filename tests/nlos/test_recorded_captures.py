"""Recordings of other labs: letters that read the right way round, by every method."""

import numpy as np
import pytest

from nlos import (
    Backprojection,
    FKMigration,
    Grid,
    LightCone,
    settings_for,
)
from nlos.io import read_capture
from nlos.preparation import rebin_capture, remove_first_bounce

FIRST_BOUNCE_BINS = 600
OUTDOOR = "nlos_native/otoole2018_outdoor_s.mat"
DIFFUSE = "nlos/otoole2018_diffuse_s.npz"
MANNEQUIN = "nlos_native/cmu_mannequin_transient.mat"


@pytest.fixture(scope="module")
def letter(shared_data):
    """A confocal scan of a diffuse S, half a metre from the wall."""
    raw = read_capture(shared_data / DIFFUSE)
    return rebin_capture(remove_first_bounce(raw, FIRST_BOUNCE_BINS * raw.axis.spacing), 8)


def require_s(volume, half, gain, bars):
    """Bars of the S at y = -0.15, 0.05 and 0.25, joined on the right above the middle and on the
    left below it (an S seen in a mirror, because y points down here and up in that recording).
    `half`: of a row, m; `gain`: of the bars over the gaps.
    """
    picture, x, y = volume.maximum_projection().brightness, volume.grid.x, volume.grid.y
    places = (-0.15, -0.06, 0.05, 0.15, 0.25)
    rows = {at: picture[np.abs(y - at) <= half].mean(axis=0) for at in places}
    left, right = (x > -0.2) & (x < -0.1), (x > 0.06) & (x < 0.16)
    assert rows[-0.06][right].mean() > 1.3 * rows[-0.06][left].mean()
    assert rows[0.15][left].mean() > 1.3 * rows[0.15][right].mean()
    for bar, gap in bars:
        middle = np.abs(x) < 0.05
        assert rows[bar][middle].mean() > gain * rows[gap][middle].mean()


BARS = (-0.15, -0.06), (0.05, -0.06), (0.05, 0.15), (0.25, 0.15)


def test_the_confocal_letter_s_stands_half_a_metre_from_the_wall(letter):
    grid = Grid.box((-0.3, 0.3), (-0.3, 0.35), (0.4, 0.62), 0.01)
    volume = Backprojection(0.04).reconstruct(letter, grid)
    assert 0.48 <= volume.find_brightest()[2] <= 0.52
    require_s(volume, 0.0051, 1.2, BARS)


@pytest.mark.parametrize("method", [LightCone(), FKMigration()], ids=["lightcone", "fk"])
def test_transforms_show_the_same_letter(method, letter):
    axis = np.linspace(-0.35, 0.35, 64)
    volume = method.reconstruct(letter, Grid(axis, axis, np.arange(0.36, 0.64, 0.005)))
    assert 0.49 <= volume.find_brightest()[2] <= 0.52
    assert 0.49 <= volume.grid.z[volume.values.sum(axis=(1, 2)).argmax()] <= 0.52
    require_s(volume, 0.02, 1.15, BARS[:3])


@pytest.mark.parametrize(
    ("name", "gated", "shortest", "longest"),
    [
        (OUTDOOR, True, 0.08, 0.15),
        (DIFFUSE, True, 0.05, 0.09),
        (MANNEQUIN, False, 0.025, 0.06),
    ],
)
def test_settings_of_recorded_captures(name, gated, shortest, longest, shared_data):
    """The wavelengths that look best by hand, and the gate of the authors: 0.72 m."""
    settings = settings_for(read_capture(shared_data / name))
    assert settings.gate_found == gated
    assert settings.method == "rsd"
    assert shortest <= (settings.wavelength or 0) <= longest
    if gated:
        assert settings.gate == pytest.approx(0.72, abs=0.1)


def test_the_outdoor_letter_reads_as_an_s(shared_data):
    """O'Toole's outdoor letter with no setting at all: an S, not its mirror image."""
    recorded = read_capture(shared_data / OUTDOOR)
    settings = settings_for(recorded, near=1.0, far=1.4)
    volume = settings.make_method().reconstruct(settings.prepare(recorded), settings.grid(0.02))
    picture, grid = volume.maximum_projection().brightness, volume.grid
    left, right = grid.x < -0.1, grid.x > 0.1
    upper, lower = (np.abs(grid.y - middle) < 0.08 for middle in (-0.15, 0.15))
    assert picture[upper][:, left].max() > 1.5 * picture[upper][:, right].max()
    assert picture[lower][:, right].max() > 1.3 * picture[lower][:, left].max()
    assert 1.1 < volume.find_brightest()[2] < 1.25


@pytest.mark.parametrize("method", ["lct", "fk"])
def test_transforms_show_no_stripes_at_their_own_voxels(method, shared_data):
    """Front views at default voxels and at voxels of 2.5 mm are the same picture."""
    recorded = read_capture(shared_data / OUTDOOR)
    box = {"x": (-0.2, 0.2), "y": (-0.2, 0.2), "near": 1.0, "far": 1.35}
    settings = settings_for(recorded, method=method, everywhere=True, gate=0.73, **box)
    capture, imaging = settings.prepare(recorded), settings.make_method()
    coarse, fine = settings.grid(), settings.grid(2.5e-3)
    found, same = (
        imaging.reconstruct(capture, grid).maximum_projection().brightness
        for grid in (coarse, fine)
    )
    nearest = [
        np.abs(getattr(fine, axis)[:, None] - getattr(coarse, axis)).argmin(axis=0) for axis in "yx"
    ]
    same = same[np.ix_(*nearest)]
    on_object = same > 0.2 * same.max()
    assert np.corrcoef(found[on_object], same[on_object])[0, 1] > 0.98
