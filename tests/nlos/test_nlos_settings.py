"""Settings found from a capture: the gate, the wavelength, the voxels, the box, the method."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from relay_walls import planar_wall

from nlos import Capture, Grid, PlanarRSD, Settings, Volume, settings_for
from nlos.analysis import choose_wavelength, find_brightest_path, find_first_bounce
from nlos.band import VirtualPulse
from nlos.capture import TimeAxis
from nlos.completion import complete_settings, is_brightest_on_wall
from nlos.io import read_capture
from nlos.preparation import fade_record_end, flip_capture, join_near_lasers, remove_first_bounce
from nlos.simulate import PointScene, add_poisson_noise
from tofclip.errors import InputError

WALL = planar_wall(24, 24) * 0.6
HIDDEN = [[0.05, -0.1, 0.8]]
AXIS = TimeAxis(400, 16e-12)


def clean(confocal: bool = True) -> Capture:
    laser = WALL if confocal else [0.0, 0.0, 0.0]
    return PointScene(HIDDEN, [400.0]).simulate_capture(WALL, laser, AXIS, 40e-12)


def with_glare(capture: Capture, peak: float, fades: float = 0.05) -> Capture:
    """Add the wall's own light, which fades by e over so much path."""
    direct = np.linalg.norm(capture.wall - capture.laser, axis=-1)
    late = capture.axis.paths[:, None, None] - direct
    glare = np.where(late >= 0, np.exp(-np.maximum(late, 0) / fades), 0)
    return replace(capture, signal=capture.signal + peak * capture.signal.max() * glare)


@pytest.mark.parametrize("confocal", [True, False])
@pytest.mark.parametrize("peak", [2.0, 1000.0])
def test_the_walls_own_light_is_recognised_and_gated(confocal: bool, peak: float) -> None:
    bounce = find_first_bounce(with_glare(clean(confocal), peak))
    assert bounce is not None
    settings = settings_for(with_glare(clean(confocal), peak))
    assert settings.gate_found
    assert "wall's own light" in settings.reasons["gate"]
    prepared = settings.prepare(with_glare(clean(confocal), peak))
    volume = settings.make_method().reconstruct(prepared, settings.grid(0.05))
    assert volume.find_brightest() == pytest.approx(HIDDEN[0], abs=0.06)


def lit_late(hidden: float, confocal: bool, peak: float = 0.0, fades: float = 1.0) -> Capture:
    """Every wall point sees light of brightness 1 that much path (m) after the wall's own."""
    axis, laser = TimeAxis(1700, 3e-12), WALL if confocal else np.zeros(3)
    late = axis.paths[:, None, None] - np.linalg.norm(WALL - laser, axis=-1)
    glare = np.where(late >= 0, peak * np.exp(-np.maximum(late, 0) / fades), 0)
    signal = glare + np.exp(-(((late - hidden) / 0.05) ** 2) / 2)
    return Capture(signal, WALL, laser, axis.bin_width)


PROFILE_STEP, ROUNDING = 0.72 / 50, 1e-3
"""m of path by which the mean signal is looked at, of the wall's width; and a bin, to which steps
begin.
"""


@pytest.mark.parametrize("confocal", [True, False])
@pytest.mark.parametrize("peak", [10.0, 1000.0])
def test_the_gate_ends_where_the_walls_light_is_a_tenth_of_what_follows(
    confocal: bool, peak: float
) -> None:
    for fades in np.linspace(0.04, 0.06, 5):
        bounce = find_first_bounce(lit_late(1.2, confocal, peak, fades))
        assert bounce is not None
        faded = fades * np.log(10 * peak)
        # In the middle of the first step of the profile at which it has.
        assert faded - ROUNDING < bounce.end < faded + PROFILE_STEP + ROUNDING


@pytest.mark.parametrize("confocal", [True, False])
def test_the_brightest_path_is_found_to_half_a_step(confocal: bool) -> None:
    for hidden in 1.2 + PROFILE_STEP * np.arange(0, 1, 0.2):
        found = find_brightest_path(lit_late(hidden, confocal))
        assert found == pytest.approx(hidden, abs=PROFILE_STEP / 2 + ROUNDING)


@pytest.mark.parametrize("depth", [0.5, 0.8, 1.3])
def test_the_wavelength_is_the_shortest_that_the_wall_samples_at_the_hidden_depth(
    depth: float,
) -> None:
    """A flash, of all waves alike: 20 % of the pulse's may be finer than the wall samples."""
    wall = planar_wall(32, 32) * 0.6
    # 0.6 mm of path, and light of 1 mm, that all waves of centimetres are alike in.
    axis = TimeAxis(900, 2e-12, 2 * depth - 0.05)
    flash = PointScene([[0.0, 0.0, depth]]).simulate_capture(wall, wall, axis, 3.5e-12)
    counts = add_poisson_noise(flash, 1000.0, 1.0, seed=1)
    sine = 0.72 / np.hypot(0.72, depth)
    sampled = 4 * flash.spacing * sine
    # The pulse's waves are normally distributed; the wavenumber above which a fifth of them lies:
    pulse = VirtualPulse(1.0, 3.0)
    expected = sampled * (1 + 0.8416 / (np.sqrt(2) * pulse.sigma * pulse.wavenumber))
    found, reason = choose_wavelength(counts, 3.0)
    assert "wall points" in reason
    # Steps of 5 %, rounded up to a millimetre; the brightest wall points lie aside of the depth.
    assert 0.95 * expected < found < 1.05 * expected + 1e-3


def test_nothing_is_gated_where_the_wall_is_dark() -> None:
    assert find_first_bounce(clean()) is None
    settings = settings_for(clean())
    assert (settings.gate, settings.gate_found) == (None, False)
    assert settings.method == "rsd"
    assert settings_for(clean(), gate=0.2).gate == 0.2
    assert settings_for(clean(), wavelength=0.3).wavelength == 0.3


def test_background_is_not_the_walls_own_light() -> None:
    """Few counts before anything else, of which some are the first: nothing fades after them."""
    capture = clean(confocal=False)
    for seed in range(5):
        counts = add_poisson_noise(capture, 60, 0.02, seed)
        assert settings_for(counts).gate is None


def test_noise_makes_the_wave_longer() -> None:
    quiet, random = complete_settings(clean(), Settings()).wavelength, np.random.default_rng(1)
    many = clean().signal * (100 / clean().signal.max())
    noisy = replace(clean(), signal=random.poisson(many + 0.5).astype(np.float32))
    found = complete_settings(noisy, Settings())
    assert quiet is not None
    assert found.wavelength is not None
    fewer = replace(clean(), signal=random.poisson(many / 10 + 0.5).astype(np.float32))
    longer = complete_settings(fewer, Settings()).wavelength
    assert longer is not None
    assert longer > found.wavelength


def test_transforms_see_the_lattice_whatever_the_wavelength() -> None:
    by_wave, by_lattice = (
        complete_settings(clean(), Settings()),
        complete_settings(clean(), Settings(method="fk")),
    )
    assert by_wave.voxel == pytest.approx((by_wave.wavelength or 0) / 8)
    bins = by_lattice.bins_together or 0
    assert bins * AXIS.spacing <= clean().spacing < (bins + 1) * AXIS.spacing
    assert by_lattice.voxel == pytest.approx(bins * AXIS.spacing / 3)


def test_the_ends_of_the_record_are_soft() -> None:
    flat = replace(clean(), signal=np.ones_like(clean().signal))
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


def test_a_picture_is_mirrored_along_an_axis() -> None:
    grid = Grid.box((-0.3, 0.3), (-0.3, 0.3), (0.7, 0.9), 0.05)
    for axis, expected in (("x", (-0.05, -0.1)), ("y", (0.05, 0.1))):
        found = PlanarRSD(0.2).reconstruct(flip_capture(clean(), axis), grid).find_brightest()
        assert found[:2] == pytest.approx(expected, abs=0.03)
    with pytest.raises(InputError, match="mirrored along x or y"):
        flip_capture(clean(), "z")


def test_a_bright_wall_is_noticed() -> None:
    """Nearer than half a wavelength to a wall point."""
    x, y, _ = clean().points[100]
    grid = Grid([x, x + 0.2], [y], [0.01, 0.045, 0.055, 0.07, 0.09, 0.5])
    for index, on_wall in enumerate((True, True, False, False, False, False)):
        values = np.zeros(grid.shape)
        values[index, 0, 0] = 1
        assert is_brightest_on_wall(Volume(values, grid), clean(), 0.1) == on_wall


def test_the_box_before_a_wall_with_relief_begins_by_its_middle() -> None:
    """Of 30 cm of relief, the hindmost points see things that the foremost ones' gate blanks."""
    wall = WALL.copy()
    wall[..., 2] = 0.3 * (wall[..., 0] > 0)
    hidden = [-0.15, -0.05, 0.5]
    capture = PointScene([hidden], [400.0]).simulate_capture(wall, wall, AXIS, 40e-12)
    settings = complete_settings(with_glare(capture, 1000.0, 0.045), Settings())
    assert settings.gate_found
    gate, near = settings.gate or 0.0, settings.near or 0.0
    # Two fifths of the gate from the middle of the relief.
    assert near == pytest.approx(0.15 + 0.4 * gate, abs=settings.voxel)


@pytest.mark.parametrize(("apart", "error"), [(1e-7, 0.02), (1e-3, 0.05), (15e-3, 0.1)])
def test_a_laser_near_its_detector_is_confocal(apart: float, error: float) -> None:
    lasers = WALL + np.array([apart, 0, 0])
    capture = PointScene(HIDDEN, [400.0]).simulate_capture(WALL, lasers, AXIS, 40e-12)
    settings = settings_for(capture)
    assert settings.method == "rsd"
    grid = Grid.box((-0.2, 0.3), (-0.35, 0.15), (0.7, 0.9), 0.05)
    fast = settings.make_method().reconstruct(settings.prepare(capture), grid).values
    # The same record, with the geometry as it is.
    true = replace(settings.prepare(capture), wall=WALL, laser=lasers)
    exact = settings.make_method("backprojection").reconstruct(true, grid)
    scale = np.vdot(exact.values, fast) / np.vdot(exact.values, exact.values)
    assert np.linalg.norm(fast / scale - exact.values) < error * np.linalg.norm(exact.values)


def test_a_small_walls_lasers_may_be_two_centimetres_away() -> None:
    small = replace(clean(), wall=WALL / 2, laser=WALL / 2 + np.array([0.019, 0, 0]))
    joined = join_near_lasers(small)
    assert np.array_equal(joined.laser, joined.wall)
    tiny = replace(clean(), wall=WALL / 10, laser=WALL / 10 + np.array([0.019, 0, 0]))
    assert join_near_lasers(tiny) is tiny


def test_transforms_show_no_stripes_at_their_own_voxels(shared_data: Path) -> None:
    """Front views at default voxels and at voxels of 2.5 mm are the same picture."""
    recorded = read_capture(shared_data / "nlos_native" / "otoole2018_outdoor_s.mat")
    box = {"x": (-0.2, 0.2), "y": (-0.2, 0.2), "near": 1.0, "far": 1.35}
    for method in ("lct", "fk"):
        settings = settings_for(recorded, method=method, everywhere=True, gate=0.73, **box)
        capture, imaging = settings.prepare(recorded), settings.make_method()
        found, fine = (
            imaging.reconstruct(capture, settings.grid(voxel)).maximum_projection().brightness
            for voxel in (None, 2.5e-3)
        )
        coarse_grid, fine_grid = settings.grid(), settings.grid(2.5e-3)
        nearest = [
            np.abs(getattr(fine_grid, axis)[:, None] - getattr(coarse_grid, axis)).argmin(axis=0)
            for axis in "yx"
        ]
        same = fine[np.ix_(*nearest)]
        on_object = same > 0.2 * same.max()
        assert np.corrcoef(found[on_object], same[on_object])[0, 1] > 0.98


@pytest.mark.parametrize(
    ("changes", "given", "reason"),
    [
        ({"signal": np.zeros((400, 24, 24))}, {}, "every signal is 0"),
        ({"signal": np.full((400, 24, 24), 255.0)}, {}, "constant or saturated"),
        ({"signal": np.full((400, 24, 24), 1e35)}, {}, "overflow"),
        ({"laser": np.array([50.0, 0, 0])}, {}, "from the wall, which is"),
        ({"laser": np.array([0, 0, 20.0])}, {}, "from the wall, which is"),
        ({"laser": np.array([0, 0, -0.1])}, {}, "0.1 m behind the wall"),
        ({"laser": np.array([0.1, 0, 0.3])}, {}, "0.3 m in front of the wall"),
        ({}, {"wavelength": 0.9}, "shows nothing of this capture"),
        ({}, {"wavelength": 0.7, "cycles": 4.0}, "use at most 0.2"),
        ({"laser": np.subtract(WALL, [0, 0, 0.1])}, {}, "0.1 m behind the wall"),
        ({"laser": np.add(WALL, [0, 0, 0.1])}, {}, "0.1 m in front of the wall"),
        (
            {"signal": np.where(np.arange(400) < 150, 9, 255)[:, None, None] * np.ones((24, 24))},
            {},
            "62 % of the samples are 255, saturated",
        ),
        ({"start": 5.0}, {}, "begins at a path of 5 m, but none by way of the box"),
        ({"start": 1e6}, {}, "take the ways to and from the devices off"),
        ({}, {"gate": 100.0}, "blanks the whole record"),
        ({}, {"near": 50.0, "far": 51.0}, "beyond the record"),
        ({"wall": np.zeros((24, 24, 3)), "laser": np.zeros(3)}, {}, "stand in one place"),
    ],
)
def test_what_no_picture_can_come_of_is_refused_in_one_line(
    changes: dict[str, object], given: dict[str, float], reason: str
) -> None:
    with pytest.raises(InputError, match=reason) as refused:
        settings_for(replace(clean(confocal=False), **changes), **given)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("name", "gated", "shortest", "longest"),
    [
        ("nlos_native/otoole2018_outdoor_s.mat", True, 0.08, 0.15),
        ("nlos/otoole2018_diffuse_s.npz", True, 0.05, 0.09),
        ("nlos_native/cmu_mannequin_transient.mat", False, 0.025, 0.06),
    ],
)
def test_recorded_captures(
    name: str, gated: bool, shortest: float, longest: float, shared_data: Path
) -> None:
    """The wavelengths that look best by hand, and the gate of the authors: 0.72 m."""
    settings = settings_for(read_capture(shared_data / name))
    assert settings.gate_found == gated
    assert settings.method == "rsd"
    assert shortest <= (settings.wavelength or 0) <= longest
    if gated:
        assert settings.gate == pytest.approx(0.72, abs=0.1)


def test_the_letter_reads_as_an_s(shared_data: Path) -> None:
    """O'Toole's outdoor letter with no setting at all: an S, not its mirror image."""
    recorded = read_capture(shared_data / "nlos_native" / "otoole2018_outdoor_s.mat")
    settings = settings_for(recorded, near=1.0, far=1.4)
    volume = settings.make_method().reconstruct(settings.prepare(recorded), settings.grid(0.02))
    picture, grid = volume.maximum_projection().brightness, volume.grid
    left, right = grid.x < -0.1, grid.x > 0.1
    upper, lower = (np.abs(grid.y - middle) < 0.08 for middle in (-0.15, 0.15))
    assert picture[upper][:, left].max() > 1.5 * picture[upper][:, right].max()
    assert picture[lower][:, right].max() > 1.3 * picture[lower][:, left].max()
    assert 1.1 < volume.find_brightest()[2] < 1.25
