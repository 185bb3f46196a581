"""Returns in frames of other libraries: those of the same frames in NumPy's arrays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from array_places import DEVICE_NAMES, find_device

from tofclip.arrays import ComputeDevice, to_numpy
from tofclip.camera import Camera
from tofclip.errors import InputError, ShapeError
from tofclip.lidar import depth
from tofclip.shots import Frames
from tofclip.solvers import LinearInverse

BIN, FWHM, START = 20e-12, 60e-12, 10e-9


@pytest.fixture(params=DEVICE_NAMES)
def device(request):
    return find_device(request.param)


def test_from_readings_to_returns(device):
    """A wall at one range in the measurements of five views, recovered where the measurements are."""
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
    same = depth(Frames(to_numpy(recovered.frames), times, camera))
    np.testing.assert_array_equal(found.range, same.range)


def test_frames_of_other_libraries_are_checked_and_saved(device, tmp_path):
    camera = Camera(np.array([20.0]), np.array([0.1]), (4, 5), 41, pulse_fwhm=FWHM)
    values = np.random.default_rng(0).normal(10, 2, (10, 4, 5)).astype(np.float32)
    there = Frames(device.put(values), START + BIN * np.arange(10), camera)
    there.save(tmp_path / "frames.h5")
    np.testing.assert_array_equal(Frames.load(tmp_path / "frames.h5").values, values)
    assert ComputeDevice.of(there.values).library == device.library
    np.testing.assert_array_equal(to_numpy(there.values), values)
    with pytest.raises(ShapeError):
        replace(there, values=device.put(values[1:]))
    with pytest.raises(InputError, match="NaN"):
        replace(there, values=device.put(np.full_like(values, np.nan)))
    with pytest.raises(InputError, match="at least three frames"):
        depth(Frames(device.put(values[:2]), there.times[:2], camera))
