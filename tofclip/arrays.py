"""Arrays of other libraries and on other devices: what they are, where they live, and how values
get there and back.

The compiled loops of this package work on NumPy arrays. Whatever is written with the functions of
the array API standard (https://data-apis.org/array-api) works on the arrays of any library that
follows it: CuPy and PyTorch on a GPU, PyTorch and array-api-strict on this one. What
accepts such arrays answers in the library and on the device of the one that came in; what has only
compiled loops refuses them (`require_numpy`).
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from tofclip.errors import InputError, MissingDependencyError, explain_import

T = TypeVar("T")

AnyArray = NDArray[Any]
BoolArray = NDArray[np.bool_]
ComplexArray = NDArray[np.complex64]
FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IndexArray = NDArray[np.intp]
IntArray = NDArray[np.int64]

Array = Any  # of any library that follows the array API standard

GRAPHICS_LIBRARIES = ("cupy", "torch")  # those that can use a GPU, the preferred one first

CACHE_LINE_BYTES = 64

_NAMESPACES: dict[type, Any] = {}


def is_numpy(array: Array) -> bool:
    """Return whether `array` is NumPy's, or something that NumPy makes an array of, such as a list of
    numbers.
    """
    return isinstance(array, np.ndarray | np.generic) or not hasattr(array, "__dlpack__")


def empty_aligned(shape: tuple[int, ...], dtype: DTypeLike) -> AnyArray:
    """Return an array whose first element begins a cache line: NumPy's begin anywhere, and then
    every vector of 512 bits lies in two lines. Returns contiguous; its elements are not set.
    """
    kind = np.dtype(dtype)
    size = math.prod(shape) * kind.itemsize
    room = np.empty(size + CACHE_LINE_BYTES, np.uint8)
    skipped = -room.ctypes.data % CACHE_LINE_BYTES
    return room[skipped : skipped + size].view(kind).reshape(shape)


def namespace(*arrays: Array) -> Any:
    """Return the functions of the array API standard for the library that all `arrays` are of."""
    kinds = {type(array) for array in arrays}
    if len(kinds) == 1:  # asked in every step of a solver: a dictionary answers ten times as fast
        (kind,) = kinds
        if kind not in _NAMESPACES:
            _NAMESPACES[kind] = _resolve_namespace(arrays)
        return _NAMESPACES[kind]
    return _resolve_namespace(arrays)


def _resolve_namespace(arrays: tuple[Array, ...]) -> Any:
    from array_api_compat import array_namespace

    try:
        return array_namespace(*arrays)
    except TypeError as problem:
        kinds = " and ".join(sorted({_library_name(array) for array in arrays}))
        raise InputError(
            f"arrays of {kinds} do not work together; put all into one library"
        ) from problem


def clip_values(values: Array, lowest: float | None = None, highest: float | None = None) -> Array:
    """Return an array's values with those below or above a limit replaced by it."""
    if not is_numpy(values):
        return namespace(values).clip(values, min=lowest, max=highest)
    # the standard's function looks at dtypes and shapes for longer than a few numbers take
    if lowest is not None:
        values = np.maximum(values, lowest)
    return values if highest is None else np.minimum(values, highest)


def to_numpy(array: Array) -> AnyArray:
    """Return the values as a NumPy array, fetched from wherever they are; NumPy's as it is."""
    if hasattr(array, "detach"):  # PyTorch: a gradient is carried along
        array = array.detach().cpu()
    elif hasattr(array, "get") and not is_numpy(array):  # CuPy copies nothing unless asked to
        array = array.get()
    return np.asarray(array)


def is_complex(array: Array) -> bool:
    """Return whether `array` is of a complex type."""
    if is_numpy(array):
        return bool(array.dtype.kind == "c")
    return bool(namespace(array).isdtype(array.dtype, "complex floating"))


def as_type(array: Array, dtype: DTypeLike) -> Array:
    """Return `array` in a NumPy type, in the library and on the device where it is; as it is if it
    has that type. NumPy's come back contiguous, as compiled loops need them.
    """
    if is_numpy(array):
        return np.ascontiguousarray(array, dtype)
    xp = namespace(array)
    return xp.astype(array, getattr(xp, np.dtype(dtype).name), copy=False)


def native_device(array: Array) -> Any:
    """Return the device that `array` is on, as its library has it."""
    from array_api_compat import device

    return device(array)


def zeros(shape: tuple[int, ...], like: Array) -> Array:
    """Return zeros of the type of `like`, where `like` is."""
    if is_numpy(like):
        return np.zeros(shape, like.dtype)
    return namespace(like).zeros(shape, dtype=like.dtype, device=native_device(like))


def scalar_like(value: float, like: Array) -> Array:
    """Return a number of the type of `like`, and where it is: not every function takes Python's."""
    return like.dtype.type(value) if is_numpy(like) else zeros((), like) + value


def require_numpy(what: str, *arrays: Array) -> None:
    """Refuse arrays of other libraries; `what` works on NumPy arrays only."""
    for array in arrays:
        if not is_numpy(array):
            raise InputError(
                f"{what} works on NumPy arrays, not on {_library_name(array)}'s; use tofclip.arrays.to_numpy"
            )


@dataclass(frozen=True)
class ComputeDevice:
    """Where arrays live: a `library` (``numpy``, ``cupy``, ``torch`` or another that follows the
    standard, by the name it is imported by) and one of its devices, as the library has it; by
    default its own choice.
    """

    library: str = "numpy"
    device: Any = None

    @classmethod
    def of(cls, array: Array) -> ComputeDevice:
        """Return where `array` lives."""
        if is_numpy(array):
            return cls()
        return cls(_library_name(array), native_device(array))

    def put(self, values: Array) -> Array:
        """Return `values`, of any library, as an array that lives here, with the type they have."""
        if self.library == "numpy":
            return to_numpy(values)
        if not is_numpy(values) and ComputeDevice.of(values) == self:
            return values
        library = importlib.import_module(self.library)
        # PyTorch warns of memory that it may not write to, and refuses steps backwards.
        contiguous = np.require(to_numpy(values), requirements=["C", "W"])
        return namespace(library.asarray([0.0])).asarray(contiguous, device=self.device)

    def activate(self) -> AbstractContextManager[Any]:
        """Return a context in which what is made is made here: CuPy works on its current device."""
        return self.device if self.library == "cupy" and self.device else nullcontext()

    def __str__(self) -> str:
        if self.library == "numpy":
            return "cpu"
        number = getattr(self.device, "id", self.device)
        return self.library if self.device is None else f"{self.library}:{number}"


CPU = ComputeDevice()  # NumPy's arrays, where the compiled loops work


class PerDevice(Generic[T]):
    """What `make` sets up once on each device where it is needed, such as the copy of an array."""

    def __init__(self, make: Callable[[ComputeDevice], T]) -> None:
        self._make = make
        self._made: dict[str, T] = {}

    def get(self, array: Array) -> T:
        """Return what belongs where `array` lives."""
        device = ComputeDevice.of(array)
        name = str(device)  # not every library's devices can be looked up in a dictionary
        if name not in self._made:
            self._made[name] = self._make(device)
        return self._made[name]


def parse_device(name: str) -> ComputeDevice:
    """Return the place that a user asks for: ``cpu`` for NumPy and the compiled loops; ``cuda`` or
    ``cuda:1`` for a GPU, through CuPy or else PyTorch; ``auto`` for a GPU where there is one, else
    ``cpu``; or PyTorch with its own name of a device, such as ``torch:xpu``.
    """
    if name == "cpu":
        return ComputeDevice()
    kind, _, which = name.partition(":")
    if name == "auto" or (kind == "cuda" and (which.isdecimal() or name == "cuda")):
        number = int(which or 0)
        found = filter(None, (_find_gpu(library, number) for library in GRAPHICS_LIBRARIES))
        if device := next(found, ComputeDevice() if name == "auto" else None):
            return device
        raise MissingDependencyError(
            f'no CUDA device {number} was found through CuPy or PyTorch; install tofclip[cuda], or use `device="cpu"`'
        )
    if kind == "torch" and which:
        return _find_torch_device(which)
    raise InputError(f"'{name}' is not a device; use cpu, cuda, cuda:1, auto or torch:DEVICE")


def _library_name(array: Array) -> str:
    return type(array).__module__.partition(".")[0]


def _find_gpu(library: str, number: int) -> ComputeDevice | None:
    """CUDA device `number` through `library`, or None where that cannot be had."""
    try:
        module = importlib.import_module(library)
        if library == "torch":
            found = module.cuda.is_available() and number < module.cuda.device_count()
            return ComputeDevice(library, module.device("cuda", number)) if found else None
        found = number < module.cuda.runtime.getDeviceCount()
        return ComputeDevice(library, module.cuda.Device(number)) if found else None
    except Exception:
        return None


def _find_torch_device(name: str) -> ComputeDevice:
    with explain_import('PyTorch is not installed; pip install torch, or use `device="cpu"`'):
        import torch
    try:
        # Sums are taken in double precision, which some devices do not have. The array knows its
        # device's number.
        device = torch.zeros(1, dtype=torch.float64, device=name).device
    except (RuntimeError, AssertionError, NotImplementedError, TypeError) as problem:
        raise MissingDependencyError(
            f"PyTorch finds no device '{name}' with float64 here; use `device=\"cpu\"`"
        ) from problem
    return ComputeDevice("torch", device)
