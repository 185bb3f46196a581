"""Arrays of other libraries: recognised, fetched, put back, refused."""

import array_api_strict
import numpy as np
import pytest

from tofclip import arrays
from tofclip.arrays import (
    ComputeDevice,
    PerDevice,
    as_type,
    clip_values,
    empty_aligned,
    is_numpy,
    namespace,
    parse_device,
    require_numpy,
    scalar_like,
    to_numpy,
    zeros,
)
from tofclip.errors import InputError, MissingDependencyError

VALUES = np.arange(6, dtype=np.float32).reshape(2, 3)
STRICT = ComputeDevice("array_api_strict", array_api_strict.Device("CPU_DEVICE"))


def torch_cpu():
    pytest.importorskip("torch", reason="PyTorch is optional")
    return parse_device("torch:cpu")


@pytest.fixture(params=[lambda: STRICT, torch_cpu], ids=["array-api-strict", "torch"])
def device(request):
    return request.param()


def test_lists_and_numbers_are_numpys():
    assert all(is_numpy(values) for values in (VALUES, VALUES[0, 0], [1.0, 2.0], 3))


def test_there_and_back(device):
    there = device.put(VALUES)
    assert not is_numpy(there)
    assert ComputeDevice.of(there) == device
    assert not device.has_compiled_loops
    back = to_numpy(there)
    assert back.dtype == VALUES.dtype
    np.testing.assert_array_equal(back, VALUES)


@pytest.mark.parametrize("values", [VALUES[::-1], VALUES.T, np.broadcast_to(VALUES[0], (4, 3))])
def test_values_that_lie_oddly_in_memory(device, values):
    np.testing.assert_array_equal(to_numpy(device.put(values)), values)


def test_what_is_there_already_is_not_copied(device):
    there = device.put(VALUES)
    assert device.put(there) is there


def test_the_functions_of_the_standard(device):
    there = device.put(VALUES)
    np.testing.assert_allclose(to_numpy(namespace(there).sum(there, axis=0)), VALUES.sum(axis=0))


def test_values_beyond_a_limit_are_replaced_by_it(device):
    values = np.array([-2.0, 0.5, 3.0], np.float32)
    there = device.put(values)
    for limits, expected in (
        ((0.0, 1.0), [0.0, 0.5, 1.0]),
        ((0.0, None), [0.0, 0.5, 3.0]),
        ((None, 1.0), [-2.0, 0.5, 1.0]),
    ):
        found = to_numpy(clip_values(there, *limits))
        np.testing.assert_array_equal(found, expected)
        assert found.dtype == np.float32
    assert type(clip_values(values, 0.0)) is np.ndarray


def test_numpy_is_the_place_of_numpys_arrays(device):
    assert ComputeDevice.of(VALUES) == ComputeDevice() == parse_device("cpu")
    assert ComputeDevice().put(VALUES) is VALUES
    np.testing.assert_array_equal(ComputeDevice().put(device.put(VALUES)), VALUES)
    assert ComputeDevice().has_compiled_loops


def test_libraries_do_not_mix(device):
    with pytest.raises(InputError, match=r"numpy.* do not work together"):
        namespace(device.put(VALUES), VALUES)


def test_compiled_loops_refuse_what_is_not_numpys(device):
    require_numpy("the search", VALUES, [1.0])
    with pytest.raises(InputError, match="the search works on NumPy arrays, not on"):
        require_numpy("the search", VALUES, device.put(VALUES))


def test_types_are_changed_where_the_array_is(device):
    there = device.put(VALUES)
    assert as_type(there, np.float32) is there
    double = as_type(there, np.float64)
    assert ComputeDevice.of(double) == device
    assert to_numpy(double).dtype == np.float64
    np.testing.assert_array_equal(to_numpy(double), VALUES)


def test_numpys_are_made_contiguous_with_their_type():
    changed = as_type(VALUES.T, np.float64)
    assert changed.flags.c_contiguous
    np.testing.assert_array_equal(changed, VALUES.T)


def test_zeros_are_like_what_they_are_for(device):
    for like in (VALUES, device.put(VALUES)):
        nothing = zeros((2, 1), like)
        assert ComputeDevice.of(nothing) == ComputeDevice.of(like)
        assert to_numpy(nothing).dtype == VALUES.dtype
        np.testing.assert_array_equal(to_numpy(nothing), [[0], [0]])


def test_numbers_are_like_what_they_are_for(device):
    for like in (VALUES, device.put(VALUES)):
        there = scalar_like(1.5, like)
        assert ComputeDevice.of(there).library == ComputeDevice.of(like).library
        assert (to_numpy(there).dtype, float(there)) == (VALUES.dtype, 1.5)
        np.testing.assert_array_equal(
            to_numpy(namespace(like).minimum(like, there)), np.minimum(VALUES, 1.5)
        )


def test_what_is_set_up_in_a_place_is_set_up_once(device):
    asked = []
    copies = PerDevice(lambda where: asked.append(where) or where.put(VALUES))
    for array in (device.put(VALUES), VALUES, device.put(VALUES[0])):
        assert ComputeDevice.of(copies.get(array)) == ComputeDevice.of(array)
    assert asked == [device, ComputeDevice()]


def test_a_place_says_where_it_is(device):
    assert str(ComputeDevice()) == "cpu"
    assert str(device).startswith(f"{device.library}:")
    with device.activate():
        assert ComputeDevice.of(device.put(VALUES)) == device


def test_cupy_works_on_its_current_device():
    """No CuPy here: something else that is entered and left, as its devices are, stands in for one."""
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


def test_a_tensor_with_a_gradient():
    torch = pytest.importorskip("torch", reason="PyTorch is optional")
    np.testing.assert_array_equal(to_numpy(torch.ones(3, requires_grad=True) * 2), [2, 2, 2])


@pytest.fixture
def no_graphics(monkeypatch):
    monkeypatch.setattr(arrays, "GRAPHICS_LIBRARIES", ("a_library_that_nobody_has",))


@pytest.mark.usefixtures("no_graphics")
def test_without_a_graphics_processor():
    assert parse_device("auto") == ComputeDevice()
    for name in ("cuda", "cuda:1"):
        with pytest.raises(MissingDependencyError, match='use `device="cpu"`'):
            parse_device(name)


@pytest.mark.parametrize("name", ["gpu", "cuda:", "cuda:one", "torch", "", "numpy:cpu"])
def test_names_that_are_no_device(name):
    with pytest.raises(InputError, match="is not a device"):
        parse_device(name)


def test_a_device_that_pytorch_does_not_have():
    pytest.importorskip("torch", reason="PyTorch is optional")
    for name in ("cuda:99", "nonsense"):
        with pytest.raises(MissingDependencyError, match='use `device="cpu"`'):
            parse_device(f"torch:{name}")


@pytest.mark.parametrize("shape", [(3, 5), (1000, 17), (1,)])
def test_aligned_arrays_begin_a_cache_line(shape):
    for dtype in (np.float32, np.float64):
        made = [empty_aligned(shape, dtype) for _ in range(5)]
        assert all(one.ctypes.data % 64 == 0 for one in made)
        assert all(one.shape == shape and one.dtype == dtype for one in made)
        assert all(one.flags.c_contiguous and one.flags.writeable for one in made)
