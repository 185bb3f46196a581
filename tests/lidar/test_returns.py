"""Pulse shapes, and returns found in traces whose arrivals, strengths and noise are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tofclip.camera import Camera
from tofclip.errors import InputError, ShapeError
from tofclip.lidar import Detection, Pulse, Returns, depth
from tofclip.lidar.pulse import PhaseTable
from tofclip.shots import Frames
from tofclip.units import SPEED_OF_LIGHT

BIN = 20e-12
FWHM = 60e-12
START = 10e-9
BIN_M = SPEED_OF_LIGHT * BIN / 2
EVERYTHING = Detection(min_scene_fraction=0, min_time_bin_fraction=0, min_pixel_fraction=0)


def camera(rows=1, columns=1):
    return Camera(np.array([20.0]), np.array([0.1]), (rows, columns), 41, pulse_fwhm=FWHM)


def even_times(bins):
    return START + BIN * np.arange(bins)


def gaussian(times, arrivals, heights):
    """(time, ...) traces of one return each, written out independently of the package's pulse."""
    late = (times.reshape(-1, *[1] * np.ndim(arrivals)) - arrivals) / FWHM
    return heights * np.exp(-4 * np.log(2) * late**2)


def frames_of(values, times):
    """One row of pixels; `values` is (time, pixel)."""
    return Frames(values[:, np.newaxis, :].astype(np.float32), times, camera(1, values.shape[1]))


def range_of(time):
    return SPEED_OF_LIGHT * time / 2


@given(
    position=st.floats(8.0, 51.0),
    height=st.floats(1e-2, 1e6),
    unevenness=st.floats(0.0, 0.1),
    seed=st.integers(0, 1000),
)
def test_a_single_pulse_is_located_far_below_a_bin(position, height, unevenness, seed):
    widths = BIN * (1 + unevenness * np.random.default_rng(seed).uniform(-1, 1, 60))
    times = START + np.cumsum(widths)
    arrival = np.interp(position, np.arange(60), times)
    returns = depth(frames_of(gaussian(times, np.array([arrival]), height), times))
    assert len(returns) == 1
    # float32 traces and the linear pulse table leave 1e-4 bin; 2e-3 bin (6 um) is asked for
    assert returns.range[0] == pytest.approx(range_of(arrival), abs=2e-3 * BIN_M)
    assert returns.time[0] == pytest.approx(arrival, abs=2e-3 * BIN)


def look(arrivals_bins, times, noise=0.0):
    """One return in each pixel, this many bins after the first."""
    values = gaussian(times, times[0] + BIN * arrivals_bins, 100.0) + 3.0
    return frames_of(values + noise * np.random.default_rng(0).normal(0, 1, values.shape), times)


def test_a_return_is_where_it_arrives_whatever_part_of_a_bin_that_is():
    arrivals, times = 30 + np.linspace(-0.5, 0.5, 64), even_times(60)
    found = depth(look(arrivals, times), detection=EVERYTHING)
    assert len(found) == 64
    # (1 / 128)^2 of a bin, and the background's 3 counts in single precision
    np.testing.assert_allclose((found.time - times[0]) / BIN, arrivals, atol=2e-4)


@pytest.mark.parametrize("apart", [4.5, 6.0, 8.0, None])
def test_the_fit_by_a_table_agrees_with_the_exact_one_which_an_uneven_axis_needs(apart):
    """A dim return on the slope of a bright one as well: what that leaves must be right."""
    arrivals, times = np.random.default_rng(2).uniform(20, 30, 64), even_times(60)
    # a last bin that is longer, far from all light: the axis is uneven, and the fit exact
    uneven = np.append(times[:-1], times[-1] + 0.3 * BIN)
    assert PhaseTable.tabulate(Pulse.gaussian(FWHM), uneven).half == 0
    found = []
    for axis in (times, uneven):
        frames = look(arrivals, axis, 1.0)
        if apart is not None:
            dim = np.float32(0.3) * look(arrivals + apart, axis).values
            frames = replace(frames, values=frames.values + dim)
        found.append(depth(frames, detection=EVERYTHING))
    by_table, exact = found
    assert len(by_table) == len(exact) >= (64 if apart is None else 126)
    off = np.abs(by_table.time - exact.time) / BIN
    # where the last step is shorter than 5e-3 bins, one more would be a part of that
    assert np.median(off) < 1 / 128**2 * 10
    assert off.max() < 5e-3
    np.testing.assert_allclose(by_table.intensity, exact.intensity, rtol=5e-3)
    np.testing.assert_allclose(by_table.confidence, exact.confidence, rtol=2e-2)


def test_background_neither_shifts_nor_brightens_a_return():
    times = even_times(200)
    arrivals = START + BIN * np.array([60.3, 90.7])
    clean = depth(frames_of(gaussian(times, arrivals, 100.0), times))
    lifted = depth(frames_of(gaussian(times, arrivals, 100.0) + np.array([30.0, 400.0]), times))
    # the pulse's tail, below 1 % of its peak, counts as background; float32 keeps 3e-5 of 500
    np.testing.assert_allclose(lifted.range, clean.range, atol=1e-3 * BIN_M)
    np.testing.assert_allclose(lifted.intensity, clean.intensity, rtol=1e-3)


@given(
    widths_apart=st.floats(1.3, 6.0),
    ratio=st.floats(0.7, 1.4),
    position=st.floats(40.0, 41.0),
    number=st.integers(0, 3),
)
def test_two_returns_of_similar_strength_are_told_apart(widths_apart, ratio, position, number):
    times = even_times(120)
    first = START + position * BIN
    arrivals = np.array([first, first + widths_apart * FWHM])
    trace = gaussian(times, arrivals, np.array([100.0, 100.0 * ratio])).sum(axis=1)
    values = np.zeros((120, 4))
    values[:, number] = trace
    returns = depth(frames_of(values, times))
    assert returns.x.tolist() == [number, number]
    assert returns.return_number.tolist() == [1, 2]
    # eight rounds of taking turns leave 2 % of a bin at the closest distance
    np.testing.assert_allclose(returns.time, arrivals, atol=0.03 * BIN)
    strength = returns.intensity / returns.range**2
    assert strength[1] / strength[0] == pytest.approx(ratio, rel=0.03)


def test_two_returns_within_a_pulse_width_are_one():
    times = even_times(120)
    arrivals = START + BIN * np.array([40.0, 42.0])
    returns = depth(frames_of(gaussian(times, arrivals, 100.0).sum(axis=1, keepdims=True), times))
    assert len(returns) == 1
    assert returns.time[0] == pytest.approx(arrivals.mean(), abs=0.1 * BIN)


@pytest.mark.parametrize(
    ("bins", "first", "returns", "counted", "all_found"),
    [
        # (pixel, bin, height)
        pytest.param(
            700, 0, [(0, 100.0, 1000.0), (0, 605.0, 20.0)], [0], [0, 1], id="an echo 505 rows later"
        ),
        pytest.param(
            200,
            0,
            [(0, 80.0, 1000.0), (1, 80.5, 80.0), (2, 150.0, 80.0)],
            [0, 2],
            [0, 1, 2],
            id="faint light beside something bright of the same instant",
        ),
        pytest.param(
            200,
            0,
            [(0, 80.0, 1000.0), (1, 150.0, 20.0)],
            [0],
            [0, 1],
            id="far weaker than the scene",
        ),
        pytest.param(100, 0, [(2, 50.0, 10.0), (4, 50.0, 0.0)], [0], [0], id="darkness"),
        pytest.param(100, 0, [(2, 50.0, 0.0)], [], [], id="nothing but darkness"),
        pytest.param(60, 0, [(0, -1.5, 100.0), (1, 61.0, 100.0)], [], [], id="cut off"),
        pytest.param(
            60, -530, [(0, 20.0, 100.0), (1, 40.0, 100.0)], [1], [1], id="before time zero"
        ),
    ],
)
def test_which_returns_count(bins, first, returns, counted, all_found):
    times = START + BIN * (first + np.arange(bins))
    values = np.zeros((bins, 5))
    for pixel, place, height in returns:
        values[:, pixel] += gaussian(times, np.array(times[0] + place * BIN), height)
    for detection, expected in ((None, counted), (EVERYTHING, all_found)):
        found = depth(frames_of(values, times), detection=detection)
        assert found.x.tolist() == [returns[number][0] for number in expected]
        arrivals = [times[0] + returns[number][1] * BIN for number in expected]
        np.testing.assert_allclose(found.time, arrivals, atol=0.01 * BIN)
        # range is half the way
        np.testing.assert_allclose(found.range, 299_792_458.0 * found.time / 2)


def test_the_strongest_returns_are_kept_in_raster_order_nearest_first_and_make_pictures():
    times = even_times(400)
    values = np.zeros((400, 2, 3))
    values[:, 0, 2] = gaussian(times, np.array(START + 40 * BIN), 100.0)
    for place, height in ((50.0, 100.0), (120.0, 40.0), (200.0, 300.0), (300.0, 200.0)):
        values[:, 1, 0] += gaussian(times, np.array(START + place * BIN), height)
    frames = Frames(values.astype(np.float32), times, camera(2, 3))
    returns = depth(frames, detection=replace(EVERYTHING, max_returns=3))
    assert list(zip(returns.y, returns.x, returns.return_number, strict=True)) == [
        (0, 2, 1),
        *((1, 0, rank) for rank in (1, 2, 3)),
    ]
    expected = START + BIN * np.array([40.0, 50.0, 200.0, 300.0])
    np.testing.assert_allclose(returns.time, expected, atol=0.01 * BIN)
    picture = returns.image("time")
    assert np.isnan(picture).sum() == 4
    # the most intense of the three, with the fall-off with range undone
    assert picture[1, 0] == pytest.approx(START + 200 * BIN, abs=0.01 * BIN)
    assert picture[0, 2] == pytest.approx(START + 40 * BIN, abs=0.01 * BIN)


def test_noise_alone_hardly_ever_makes_a_return():
    noise = np.random.default_rng(0).normal(20.0, 3.0, (500, 400))
    returns = depth(frames_of(noise, even_times(500)), detection=EVERYTHING)
    # the best of about 170 independent bins exceeds 5 sigma once in 20 000 pixels; the noise level
    # itself is uncertain by a few percent, so 1 % is asked for
    assert len(returns) <= 4


def test_intensity_undoes_the_falloff_with_range():
    times = START + BIN * np.arange(900)
    arrivals = np.array([START + 100.2 * BIN, START + 800.6 * BIN])
    heights = 500.0 / range_of(arrivals) ** 2
    returns = depth(frames_of(gaussian(times, arrivals, heights), times))
    pulse_bins = FWHM / BIN * np.sqrt(np.pi / (4 * np.log(2)))
    # the tails beyond 1 % of the peak, 0.2 % of the energy, are not counted
    np.testing.assert_allclose(returns.intensity, 500.0 * pulse_bins, rtol=4e-3)


def test_another_pulse_shape_finds_its_own_arrivals():
    spacing = 1e-12
    late = np.arange(400) * spacing
    shape = (1 - np.exp(-late / 15e-12)) * np.exp(-late / 60e-12)  # arrives at once, decays slowly
    pulse = Pulse(shape, spacing, origin=0.0)
    times = even_times(200)
    arrival = START + 80.37 * BIN
    returns = depth(frames_of(50 * pulse(times - arrival)[:, np.newaxis], times), pulse=pulse)
    assert len(returns) == 1
    # the kink at its start is 1 ps wide
    assert returns.time[0] == pytest.approx(arrival, abs=0.05 * BIN)


def test_a_pulse_shorter_than_a_bin_still_gives_a_range():
    times = even_times(50)
    values = np.zeros((50, 1))
    values[20, 0] = 100.0
    short = camera().replace(pulse_fwhm=1e-12)
    returns = depth(frames_of(values, times), short)
    assert returns.time[0] == pytest.approx(times[20], abs=1e-3 * BIN)


@pytest.mark.parametrize(("photons", "background"), [(20, 0.02), (200, 2.0)])
def test_a_cube_of_counts_has_the_deviations_of_photons(photons, background):
    """Those of least squares are four times too large; the bound is 3 sigma of 576 pixels' spread. Times
    are of flight, whatever the camera's time zero; strengths are those of photons from 1 m, and false
    alarms those of a pixel in a hundred.
    """
    width, times = 400e-12, 2e-9 + 80e-12 * np.arange(200)
    y, x = np.mgrid[:24, :24]
    ranges = 1 + 0.01 * x + 0.003 * y
    off = times - 2 * ranges[..., np.newaxis] / SPEED_OF_LIGHT
    light = np.exp(-4 * np.log(2) * (off / width) ** 2)
    light *= photons / light.sum(axis=-1, keepdims=True)
    cube = np.random.default_rng(3).poisson(np.moveaxis(light + background, -1, 0))
    seen_by = Camera.pinhole((24, 24), 60.0, width).replace(time_zero=5e-9)
    found = depth(Frames(cube.astype(np.float32), times, seen_by))
    strongest = found.select("strongest")
    assert len(strongest) > 0.98 * ranges.size
    true = ranges[strongest.y, strongest.x]
    z = (strongest.range - true) / strongest.range_sigma
    assert np.median(np.abs(z)) / 0.6745 == pytest.approx(1, abs=0.15)
    # 576 pixels know the mean of so many photons to a hundredth, and a background beside them
    assert np.mean(strongest.intensity / true**2) == pytest.approx(photons, rel=0.03)
    assert strongest.false_alarm == pytest.approx(0.01 * ranges.size / len(strongest), rel=0.01)


def test_the_result_does_not_depend_on_the_number_of_threads(monkeypatch):
    random = np.random.default_rng(5)
    times = even_times(80)
    frames = frames_of(
        random.poisson(gaussian(times, START + BIN * random.uniform(20, 60, 700), 50.0) + 1.0),
        times,
    )
    found: list[Returns] = []
    for threads in ("1", "2"):
        monkeypatch.setenv("TOFCLIP_THREADS", threads)
        found.append(depth(frames))
    np.testing.assert_array_equal(found[0].range, found[1].range)
    np.testing.assert_array_equal(found[0].confidence, found[1].confidence)


def test_unusable_input_is_refused():
    times = even_times(10)
    frames = frames_of(np.ones((10, 2)), times)
    with pytest.raises(ShapeError, match="frames must have shape"):
        depth(frames, camera(3, 3))
    with pytest.raises(InputError, match="at least three frames"):
        depth(frames_of(np.ones((2, 1)), even_times(2)))
    with pytest.raises(InputError, match="no property 'colour'"):
        depth(frames).image("colour")
    with pytest.raises(ShapeError, match="time of the returns"):
        replace(depth(frames), time=np.zeros(3))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"signal_to_noise": -1.0}, "must not be negative"),
        ({"signal_to_noise": float("nan")}, "must not be negative"),
        ({"min_scene_fraction": 1.5}, "between 0 and 1"),
        ({"min_time_bin_fraction": -0.1}, "between 0 and 1"),
        ({"min_pixel_fraction": float("nan")}, "between 0 and 1"),
        ({"max_returns": 0}, "1 to 255"),
    ],
)
def test_unusable_limits_are_refused(wrong, words):
    with pytest.raises(InputError, match=words):
        Detection(**wrong)


def test_the_confidence_is_the_scatter_of_ranges_where_noise_does_not_grow_with_light():
    """With read-out noise alone, the same for every bin."""
    random, pixels = np.random.default_rng(5), 2000
    times = even_times(64)
    arrivals = START + BIN * random.uniform(30, 34, pixels)
    noise = random.normal(0, 1.0, (times.size, pixels))
    found = depth(frames_of(gaussian(times, arrivals, 40.0) + noise, times), detection=EVERYTHING)
    strongest = found.intensity > 0.5 * np.median(found.intensity)
    error = found.range[strongest] - range_of(arrivals)[found.x[strongest]]
    assert np.count_nonzero(strongest) == pixels
    assert np.median(found.confidence[strongest]) == pytest.approx(np.std(error), rel=0.15)


def test_an_echo_weaker_than_the_limit_of_its_pixel_is_left_out():
    times = even_times(200)
    strong = gaussian(times, np.full(50, START + 40 * BIN), 1000.0)
    weak = gaussian(times, np.full(50, START + 140 * BIN), 100.0)
    noise = np.random.default_rng(0).normal(0, 0.5, (200, 50))
    frames = frames_of(strong + weak + noise, times)
    # Its intensity is a tenth of the other's, times 1.4 for its range.
    for limit, returns in ((0.02, 2), (0.13, 2), (0.165, 1), (0.5, 1)):
        found = depth(frames, detection=replace(EVERYTHING, min_pixel_fraction=limit))
        assert np.count_nonzero(found.return_number == returns) == 50
        assert found.return_number.max() == returns


def test_the_brightest_at_an_instant_is_looked_for_within_a_pulse_width_to_either_side():
    """To a quarter of a width: what comes 0.8 widths after something bright is its streak, what comes
    1.4 widths after it is not.
    """
    width, pixel = 100e-12, np.array([0, 1, 2, 3])
    time = width * np.array([10.0, 10.8, 8.6, 9.2])
    intensity = np.array([100.0, 5.0, 5.0, 5.0])
    detection = Detection(min_scene_fraction=0, min_time_bin_fraction=0.12, min_pixel_fraction=0)
    found = detection.find_significant(pixel, time, intensity, width)
    np.testing.assert_array_equal(found, [True, False, True, False])


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
