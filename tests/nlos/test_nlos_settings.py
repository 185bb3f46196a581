"""Settings found from a capture: the gate, the wavelength, the voxels, the box, the method."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.linalg import norm
from scenes import planar_wall, reorder, see

from nlos import Capture, Grid, Settings, Volume, reconstruct, settings_for
from nlos.analysis import choose_wavelength, find_first_bounce
from nlos.band import VirtualPulse
from nlos.capture import TimeAxis
from nlos.imaging import MIN_EVIDENCE, complete_settings, is_brightest_on_wall, prepare_imaging
from nlos.resolution import measure_point_spread
from nlos.simulate import add_poisson_noise
from tofclip.errors import InputError

WALL = planar_wall(24, 24) * 0.6
HIDDEN = [[0.05, -0.1, 0.8]]
AXIS = TimeAxis(400, 16e-12)


def clean(confocal=True):
    laser = WALL if confocal else [0.0, 0.0, 0.0]
    return see(HIDDEN, WALL, laser, AXIS, 40e-12, [400.0])


def with_glare(capture, peak, fades=0.05):
    """Add the wall's own light, which fades by e over so much path."""
    direct = norm(capture.wall - capture.laser, axis=-1)
    late = capture.axis.paths[:, None, None] - direct
    glare = np.where(late >= 0, np.exp(-np.maximum(late, 0) / fades), 0)
    return replace(capture, signal=capture.signal + peak * capture.signal.max() * glare)


@pytest.mark.parametrize("confocal", [True, False])
@pytest.mark.parametrize("peak", [2.0, 1000.0])
def test_the_walls_own_light_is_recognised_and_gated(confocal, peak):
    bounce = find_first_bounce(with_glare(clean(confocal), peak))
    assert bounce is not None
    settings = settings_for(with_glare(clean(confocal), peak))
    assert settings.gate_found
    assert "wall's own light" in settings.reasons["gate"]
    prepared = settings.prepare(with_glare(clean(confocal), peak))
    volume = settings.make_method().reconstruct(prepared, settings.grid(0.05))
    assert volume.find_brightest() == pytest.approx(HIDDEN[0], abs=0.06)


def lit_late(hidden, confocal, peak=0.0, fades=1.0):
    """Every wall point sees light of brightness 1 that much path (m) after the wall's own."""
    axis, laser = TimeAxis(1700, 3e-12), WALL if confocal else np.zeros(3)
    late = axis.paths[:, None, None] - norm(WALL - laser, axis=-1)
    glare = np.where(late >= 0, peak * np.exp(-np.maximum(late, 0) / fades), 0)
    signal = glare + np.exp(-(((late - hidden) / 0.05) ** 2) / 2)
    return Capture(signal, WALL, laser, axis.bin_width)


PROFILE_STEP, ROUNDING = 0.72 / 50, 1e-3
"""m of path by which the mean signal is looked at, of the wall's width; and a bin, to which steps
begin.
"""


@pytest.mark.parametrize("confocal", [True, False])
@pytest.mark.parametrize("peak", [10.0, 1000.0])
def test_the_gate_ends_where_the_walls_light_is_a_tenth_of_what_follows(confocal, peak):
    for fades in np.linspace(0.04, 0.06, 5):
        bounce = find_first_bounce(lit_late(1.2, confocal, peak, fades))
        assert bounce is not None
        faded = fades * np.log(10 * peak)
        # In the middle of the first step of the profile at which it has.
        assert faded - ROUNDING < bounce.end < faded + PROFILE_STEP + ROUNDING


@pytest.mark.parametrize("depth", [0.5, 0.8, 1.3])
def test_the_wavelength_is_the_shortest_that_the_wall_samples_at_the_hidden_depth(
    depth,
):
    """A flash, of all waves alike: 20 % of the pulse's may be finer than the wall samples."""
    wall = planar_wall(32, 32) * 0.6
    # 0.6 mm of path, and light of 1 mm, that all waves of centimetres are alike in.
    axis = TimeAxis(900, 2e-12, 2 * depth - 0.05)
    flash = see([[0.0, 0.0, depth]], wall, wall, axis, 3.5e-12)
    counts = add_poisson_noise(flash, 1000.0, 1.0, seed=1)
    sine = 0.72 / np.hypot(0.72, depth)
    sampled = 4 * flash.spacing * sine
    # The pulse's waves are normally distributed; the wavenumber above which a fifth of them lies:
    pulse = VirtualPulse(1.0, 3.0)
    expected = sampled * (1 + 0.8416 / (np.sqrt(2) * pulse.sigma * pulse.wavenumber))
    found, reason = choose_wavelength(counts, 3.0)
    assert "wall points" in reason
    # Steps of 2 %, rounded up by a thirtieth; the brightest wall points lie aside of the depth.
    assert 0.95 * expected < found < 1.06 * expected


def test_nothing_is_gated_where_the_wall_is_dark():
    assert find_first_bounce(clean()) is None
    settings = settings_for(clean())
    assert (settings.gate, settings.gate_found) == (None, False)
    assert settings.method == "rsd"
    assert settings_for(clean(), gate=0.2).gate == 0.2
    assert settings_for(clean(), wavelength=0.3).wavelength == 0.3


def test_a_record_that_begins_amid_the_walls_own_light_is_gated_alike():
    capture = with_glare(clean(), 2.0)
    late = replace(capture, signal=capture.signal[20:], start=20 * AXIS.spacing)
    whole, cut = find_first_bounce(capture), find_first_bounce(late)
    assert whole is not None
    assert cut is not None
    assert cut.end == pytest.approx(whole.end, rel=0.1)
    # Of hidden light alone, its fall is not that of the wall's.
    hidden = replace(clean(), signal=clean().signal[400 * 3 // 4 :], start=300 * AXIS.spacing)
    assert find_first_bounce(hidden) is None


def test_background_is_not_the_walls_own_light():
    """Few counts before anything else, of which some are the first: nothing fades after them."""
    capture = clean(confocal=False)
    for seed in range(5):
        counts = add_poisson_noise(capture, 60, 0.02, seed)
        assert settings_for(counts).gate is None


@pytest.mark.nightly
def test_noise_makes_the_wave_longer_and_nothing_makes_it_jump():
    """From photons whose spectrum tells the wave to so few that pictures have to."""
    random, light = np.random.default_rng(1), clean().signal / clean().signal.max()
    found = []
    for peak in (30, 20, 10, 5, 2):
        counts = random.poisson(peak * light + 0.5).astype(np.float32)
        found.append(complete_settings(replace(clean(), signal=counts), Settings()))
    waves = [one.wavelength or 0.0 for one in found]
    assert waves[0] < waves[-1]
    assert max(abs(np.diff(np.log(waves)))) < np.log(1.1)
    assert "picture" in found[-1].reasons["wavelength"]


def test_transforms_see_the_lattice_whatever_the_wavelength():
    by_wave, by_lattice = (
        complete_settings(clean(), Settings()),
        complete_settings(clean(), Settings(method="fk")),
    )
    assert by_wave.voxel == pytest.approx((by_wave.wavelength or 0) / 8)
    bins = by_lattice.bins_together or 0
    assert bins * AXIS.spacing <= clean().spacing < (bins + 1) * AXIS.spacing
    assert by_lattice.voxel == pytest.approx(bins * AXIS.spacing / 3)


def test_a_bright_wall_is_noticed():
    """Nearer than half a wavelength to a wall point."""
    x, y, _ = clean().points[100]
    grid = Grid([x, x + 0.2], [y], [0.01, 0.045, 0.055, 0.07, 0.09, 0.5])
    for index, on_wall in enumerate((True, True, False, False, False, False)):
        values = np.zeros(grid.shape)
        values[index, 0, 0] = 1
        assert is_brightest_on_wall(Volume(values, grid), clean(), 0.1) == on_wall


@pytest.mark.parametrize(("confocal", "seed"), [(True, 1), (False, 2)])
def test_evidence_separates_a_scene_from_noise_and_from_a_shuffled_record(confocal, seed):
    counts = add_poisson_noise(clean(confocal), 300, 0.5, seed)
    random, signal = np.random.default_rng(seed), counts.signal
    shuffled = random.permutation(signal.reshape(400, -1), axis=1).reshape(signal.shape)
    noise = random.poisson(0.5, signal.shape)

    def judge(capture):
        return prepare_imaging(capture, Settings()).measure_evidence()

    assert judge(counts) > 2 * MIN_EVIDENCE
    assert judge(replace(counts, signal=shuffled)) < MIN_EVIDENCE
    assert judge(replace(counts, signal=noise)) < MIN_EVIDENCE


def test_settings_do_not_hang_on_the_order_of_points_or_the_seed():
    random, found = np.random.default_rng(3), []
    everyone = np.arange(clean().valid.size)
    shuffled, fewer = random.permutation(everyone), everyone[everyone % 100 > 0]
    for seed in range(2):
        counts = add_poisson_noise(clean(), 100, 0.5, seed)
        variants = [reorder(counts, one) for one in (everyone, shuffled, everyone[24:], fewer)]
        variants.append(reorder(counts, everyone, 0.3))
        found += [complete_settings(one, Settings()).wavelength or 0.0 for one in variants]
    assert max(found) < 1.1 * min(found)


def test_pictures_choose_where_noise_is_coloured_in_any_order_of_points():
    """Noise that neighbouring bins share, as of recovered frames."""
    counts = add_poisson_noise(clean(), 100, 0.5, 0)
    counts = replace(counts, signal=counts.signal + 0.25 * np.roll(counts.signal, 1, axis=0))
    everyone = np.arange(counts.valid.size)
    shuffled = np.random.default_rng(3).permutation(everyone)
    one, two = (
        complete_settings(reorder(counts, kept), Settings()) for kept in (everyone, shuffled)
    )
    assert "picture" in one.reasons["wavelength"]
    assert one.wavelength == two.wavelength


def test_reconstructing_says_what_was_found_and_why():
    volume = reconstruct(add_poisson_noise(clean(), 300, 0.5, seed=1))
    assert volume.find_brightest() == pytest.approx(HIDDEN[0], abs=0.03)
    imaging = volume.provenance["imaging"]
    settings, widths = imaging["settings"], imaging["resolution_m"]
    assert settings["reasons"].keys() >= {"wavelength", "method", "voxel"}
    assert imaging["evidence"] > MIN_EVIDENCE
    assert measure_point_spread(volume).x == pytest.approx(widths["x"], rel=0.2)


def test_the_box_before_a_wall_with_relief_begins_by_its_middle():
    """Of 30 cm of relief, the hindmost points see things that the foremost ones' gate blanks."""
    wall = WALL.copy()
    wall[..., 2] = 0.3 * (wall[..., 0] > 0)
    hidden = [-0.15, -0.05, 0.5]
    capture = see([hidden], wall, wall, AXIS, 40e-12, [400.0])
    settings = complete_settings(with_glare(capture, 1000.0, 0.045), Settings())
    assert settings.gate_found
    gate, near = settings.gate or 0.0, settings.near or 0.0
    # Two fifths of the gate from the middle of the relief.
    assert near == pytest.approx(0.15 + 0.4 * gate, abs=settings.voxel)


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
def test_what_no_picture_can_come_of_is_refused_in_one_line(changes, given, reason):
    with pytest.raises(InputError, match=reason) as refused:
        settings_for(replace(clean(confocal=False), **changes), **given)
    assert "\n" not in str(refused.value)
