"""Arrays of other libraries: recognised, fetched, put back, refused."""

from dataclasses import replace

import numpy as np
import pytest
from array_places import find_device

from tofclip import arrays
from tofclip.arrays import (
    ComputeDevice,
    is_numpy,
    namespace,
    parse_device,
    require_numpy,
    to_numpy,
)
from tofclip.camera import Camera
from tofclip.errors import InputError, MissingDependencyError, ShapeError
from tofclip.lidar import Detection, depth
from tofclip.shots import Frames

strict = pytest.importorskip("array_api_strict")
VALUES = np.arange(6, dtype=np.float32).reshape(2, 3)


@pytest.fixture(params=["array_api_strict", "torch"])
def device(request):
    return find_device(request.param)


class TestDevice:
    def test_there_and_back(self, device):
        there = device.put(VALUES)
        assert not is_numpy(there)
        assert device.put(there) is there  # what is there already is not copied
        assert ComputeDevice.of(there) == device
        assert device.library != "numpy"
        back = to_numpy(there)
        assert back.dtype == VALUES.dtype
        np.testing.assert_array_equal(back, VALUES)
        for odd in (VALUES[::-1], VALUES.T, np.broadcast_to(VALUES[0], (4, 3))):
            np.testing.assert_array_equal(to_numpy(device.put(odd)), odd)
        sums = to_numpy(namespace(there).sum(there, axis=0))
        np.testing.assert_allclose(sums, VALUES.sum(axis=0))

    def test_numpy_is_the_place_of_numpys_arrays_lists_and_numbers(self, device):
        assert all(is_numpy(values) for values in (VALUES, VALUES[0, 0], [1.0, 2.0], 3))
        assert ComputeDevice.of(VALUES) == ComputeDevice() == parse_device("cpu")
        assert ComputeDevice().put(VALUES) is VALUES
        np.testing.assert_array_equal(ComputeDevice().put(device.put(VALUES)), VALUES)
        assert ComputeDevice().library == "numpy"

    def test_libraries_do_not_mix_and_compiled_loops_refuse_what_is_not_numpys(self, device):
        with pytest.raises(InputError, match=r"numpy.* do not work together"):
            namespace(device.put(VALUES), VALUES)
        require_numpy("the search", VALUES, [1.0])
        with pytest.raises(InputError, match="the search works on NumPy arrays, not on"):
            require_numpy("the search", VALUES, device.put(VALUES))

    def test_a_place_says_where_it_is(self, device):
        assert str(ComputeDevice()) == "cpu"
        assert str(device).startswith(f"{device.library}:")
        with device.activate():
            assert ComputeDevice.of(device.put(VALUES)) == device

    def test_cupy_works_on_its_current_device(self):
        """No CuPy here: something else that is entered and left, as its devices are, stands in for
        one.
        """
        entered = []

        class Device:
            id = 1

            def __enter__(self):
                entered.append(self.id)

            def __exit__(self, *_):
                entered.append(-self.id)

        device = ComputeDevice("cupy", Device())
        assert str(device) == "cupy:1"
        with device.activate():
            assert entered == [1]
        assert entered == [1, -1]

    def test_a_tensor_with_a_gradient(self):
        torch = pytest.importorskip("torch", reason="PyTorch is optional")
        np.testing.assert_array_equal(to_numpy(torch.ones(3, requires_grad=True) * 2), [2, 2, 2])

    def test_names_of_devices(self, monkeypatch):
        monkeypatch.setattr(arrays, "GRAPHICS_LIBRARIES", ("a_library_that_nobody_has",))
        assert parse_device("auto") == ComputeDevice()
        for name in ("gpu", "cuda:", "cuda:one", "torch", "", "numpy:cpu"):
            with pytest.raises(InputError, match="is not a device"):
                parse_device(name)
        pytest.importorskip("torch", reason="PyTorch is optional")
        for name in ("cuda", "cuda:1", "torch:cuda:99", "torch:nonsense"):
            with pytest.raises(MissingDependencyError, match='use `device="cpu"`'):
                parse_device(name)


def test_frames_of_other_libraries_are_checked_and_saved(device, tmp_path):
    camera = Camera([20.0], [0.1], (4, 5), 41, pulse_fwhm=60e-12)
    values = np.random.default_rng(0).normal(10, 2, (10, 4, 5)).astype(np.float32)
    there = Frames(device.put(values), 20e-12 * np.arange(10), camera)
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


def test_what_the_device_of_other_tests_gives_is_fetched_on_purpose_only():
    there = find_device("array_api_strict").put(VALUES)
    with pytest.raises(ValueError, match="different devices"):
        _ = there + strict.ones(3, dtype=strict.float32)
    with pytest.raises(RuntimeError, match="convert array on the 'array_api_strict"):
        np.asarray(there)


def test_the_search_for_returns(device):
    random = np.random.default_rng(2)
    times = 10e-9 + 20e-12 * np.arange(90)
    arrival = random.uniform(times[5], times[-5], (2, 12, 9))
    pulses = np.exp(-4 * np.log(2) * ((times[:, None, None, None] - arrival) / 60e-12) ** 2)
    values = (300 * pulses).sum(axis=1) + random.normal(5, 2, (90, 12, 9))
    camera = Camera([20.0], [0.1], (12, 9), 41, pulse_fwhm=60e-12)
    frames = Frames(values.astype(np.float32), times, camera)
    detection = Detection(min_scene_fraction=0, min_time_bin_fraction=0)
    expected = depth(frames, detection=detection)
    assert len(expected) > 108
    found = depth(replace(frames, values=device.put(frames.values)), detection=detection)
    np.testing.assert_array_equal([found.y, found.x], [expected.y, expected.x])
    np.testing.assert_array_equal(found.time, expected.time)
