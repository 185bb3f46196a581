"""Returns in frames of other libraries: those that the compiled search finds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from array_places import DEVICE_NAMES, find_device

from tofclip.arrays import ComputeDevice, to_numpy
from tofclip.camera import Camera
from tofclip.errors import InputError, ShapeError
from tofclip.lidar import Detection, Pulse, Returns, depth
from tofclip.lidar import search_array as search
from tofclip.shots import Frames
from tofclip.solvers import LinearInverse
from tofclip.units import SPEED_OF_LIGHT

BIN = 20e-12
FWHM = 60e-12
START = 10e-9
EVERYTHING = Detection(min_scene_fraction=0, min_time_bin_fraction=0, min_pixel_fraction=0)
MANY = replace(EVERYTHING, max_returns=7, signal_to_noise=3.5)

# The fits stop where the next step would be far below 5e-3 bins, and which of two rounds is the last
# may differ: by rounding, or by the table of phases on an even axis. Weak returns converge slowly; for
# them it stays a small part of what noise does.
ARRIVAL_BINS, ARRIVAL_DEVIATIONS = 5e-3, 0.1
# Near the end a step is a fifth of the one before it.
USUAL_BINS = 1e-3


@pytest.fixture(params=DEVICE_NAMES)
def device(request):
    return find_device(request.param)


def scene(bins: int = 150, side: int = 14, unevenness: float = 0.0, seed: int = 0) -> Frames:
    """Up to four returns in a pixel, some overlapping, some at the ends of the axis, on noise and a
    background.
    """
    rng = np.random.default_rng(seed)
    times = START + np.cumsum(BIN * (1 + unevenness * rng.uniform(-1, 1, bins)))
    shape = (side, side)
    values = rng.normal(rng.uniform(0, 30, shape), 2, (bins, *shape))
    arrival = rng.uniform(times[0], times[-1], shape)
    number = rng.integers(0, 5, shape)
    for k in range(4):
        height = 10 ** rng.uniform(1, 3, shape) * (number > k)
        values += height * np.exp(
            -4 * np.log(2) * ((times[:, np.newaxis, np.newaxis] - arrival) / FWHM) ** 2
        )
        near = np.clip(arrival + rng.uniform(0.8, 3, shape) * FWHM, times[0], times[-1])
        arrival = np.where(rng.random(shape) < 0.3, near, rng.uniform(times[0], times[-1], shape))
    camera = Camera(np.array([20.0]), np.array([0.1]), shape, 41, pulse_fwhm=FWHM)
    return Frames(values.astype(np.float32), times, camera)


def move_frames(frames: Frames, device: ComputeDevice) -> Frames:
    return replace(frames, values=device.put(frames.values))


def assert_alike(found: Returns, expected: Returns) -> None:
    assert len(expected) > 0
    for name in ("y", "x", "return_number"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    apart = np.abs(found.time - expected.time) / BIN
    deviation = 2 * expected.confidence / SPEED_OF_LIGHT / BIN
    assert np.all(apart < np.maximum(ARRIVAL_BINS, ARRIVAL_DEVIATIONS * deviation))
    assert np.median(apart) < USUAL_BINS
    np.testing.assert_allclose(found.range, SPEED_OF_LIGHT / 2 * found.time)
    np.testing.assert_allclose(found.intensity, expected.intensity, rtol=5e-3)
    np.testing.assert_allclose(found.confidence, expected.confidence, rtol=2e-2)
    assert np.median(np.abs(found.intensity / expected.intensity - 1)) < 1e-5
    assert np.median(np.abs(found.confidence / expected.confidence - 1)) < 5e-4
    assert {type(getattr(found, name)) for name in ("range", "intensity", "confidence")} == {
        np.ndarray
    }


@pytest.mark.parametrize(
    "detection", [Detection(), EVERYTHING, MANY], ids=["usual", "everything", "many"]
)
@pytest.mark.parametrize("unevenness", [0.0, 0.1])
def test_the_same_returns_as_by_the_compiled_search(device, detection, unevenness):
    frames = scene(unevenness=unevenness)
    expected = depth(frames, detection=detection)
    assert expected.return_number.max() >= 3
    assert_alike(depth(move_frames(frames, device), detection=detection), expected)


def test_a_measured_pulse_that_is_not_symmetric(device):
    frames, pulse = scene(seed=1), Pulse.exponentially_modified(FWHM, 30e-12)
    assert_alike(depth(move_frames(frames, device), pulse=pulse), depth(frames, pulse=pulse))


def test_pieces_make_no_difference(device, monkeypatch):
    frames = move_frames(scene(), device)
    whole = depth(frames, detection=EVERYTHING)
    monkeypatch.setattr(search, "WORKING_BYTES", 50 * 150 * 4 * search.WORKING_ARRAYS)
    pieces = depth(frames, detection=EVERYTHING)
    for name in ("y", "x", "time", "intensity", "confidence"):
        np.testing.assert_allclose(getattr(pieces, name), getattr(whole, name), rtol=1e-6)


def test_nothing_in_darkness_nor_in_light_that_never_changes(device):
    frames = scene()
    for level in (0.0, 20.0):
        assert (
            len(
                depth(
                    move_frames(replace(frames, values=np.full_like(frames.values, level)), device)
                )
            )
            == 0
        )


def test_three_frames_are_enough_and_two_are_not(device):
    values = np.array([0.0, 10.0, 0.0], np.float32)[:, np.newaxis, np.newaxis]
    camera = Camera(np.array([20.0]), np.array([0.1]), (1, 1), 41, pulse_fwhm=FWHM)
    frames = Frames(values, START + BIN * np.arange(3), camera)
    expected, found = (
        depth(frames, detection=EVERYTHING),
        depth(move_frames(frames, device), detection=EVERYTHING),
    )
    np.testing.assert_allclose(found.time, expected.time)
    two = Frames(device.put(values[:2]), frames.times[:2], camera)
    with pytest.raises(InputError, match="at least three frames"):
        depth(two)


def test_from_readings_to_returns_without_leaving_the_device(device):
    """A wall at one range in the measurements of five views, recovered and ranged where the measurements
    are.
    """
    camera = Camera(
        np.linspace(20.0, 100.0, 5),
        np.deg2rad([-38.0, -20.0, 2.0, 21.0, 40.0]),
        (16, 16),
        120,
        pulse_fwhm=FWHM,
    )
    times = START + BIN * np.arange(60)
    operator = camera.operator()
    wall = np.zeros((16, 16))
    wall[4:12, 5:11] = 100
    pulse = np.exp(-4 * np.log(2) * ((times - times[31] - 0.3 * BIN) / FWHM) ** 2)
    measurements = operator(wall)[:, np.newaxis] * pulse + np.random.default_rng(2).normal(
        0, 1, (120, 60)
    )
    measurements = measurements.astype(np.float32)
    recovered = LinearInverse().recover(operator, device.put(measurements))
    found = depth(Frames(recovered.frames, times, camera))
    expected = depth(Frames(LinearInverse().recover(operator, measurements).frames, times, camera))
    np.testing.assert_array_equal([found.y, found.x], [expected.y, expected.x])
    # Recovery differs by 1e-6 of the brightest pixel.
    np.testing.assert_allclose(found.time, expected.time, atol=1e-3 * BIN)
    assert np.median(found.time) == pytest.approx(times[31] + 0.3 * BIN, abs=0.1 * BIN)


def test_frames_of_other_libraries_are_checked_and_saved(device, tmp_path):
    frames = scene(bins=10)
    there = move_frames(frames, device)
    there.save(tmp_path / "frames.h5")
    np.testing.assert_array_equal(Frames.load(tmp_path / "frames.h5").values, frames.values)
    assert ComputeDevice.of(there.values).library == device.library
    np.testing.assert_array_equal(to_numpy(there.values), frames.values)
    with pytest.raises(ShapeError):
        replace(there, values=device.put(frames.values[1:]))
    with pytest.raises(InputError, match="NaN"):
        replace(there, values=device.put(np.full_like(frames.values, np.nan)))
