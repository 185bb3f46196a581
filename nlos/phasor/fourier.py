"""Fourier transforms between fixed buffers, unscaled in both directions: FFTW's plans, or scipy.fft
where pyfftw is absent.

pyfftw's wheel carries FFTW, which is under the GPL: a bundle that must not hold it can leave pyfftw
out.
"""

from __future__ import annotations

import importlib
import sys
import threading
from typing import Any

import numpy as np
from scipy import fft

from tofclip.arrays import ComplexArray


def _import_fftw() -> Any:
    """Import pyfftw without its interface for dask, which takes longer than an image."""
    hidden = "dask" not in sys.modules
    if hidden:
        sys.modules["dask"] = None  # type: ignore[assignment]
    try:
        return importlib.import_module("pyfftw")
    except ImportError:
        return None
    finally:
        if hidden:
            del sys.modules["dask"]


pyfftw: Any = _import_fftw()


# FFTW plans one transform at a time.
PLANNING_LOCK = threading.Lock()
# Plans that are measured are no faster here, and differ from run to run in the last bits.
FFTW_FLAGS = ("FFTW_ESTIMATE",)


class FourierPlan:
    """A transform along one axis between two buffers by scipy.fft, unscaled, as FFTW's plans."""

    def __init__(
        self, source: ComplexArray, target: ComplexArray, axis: int, inverse: bool
    ) -> None:
        self._source, self._target, self._axis, self._inverse = source, target, axis, inverse

    def execute(self) -> None:
        """Transform."""
        if self._inverse:
            self._target[...] = fft.ifft(self._source, axis=self._axis, norm="forward")
        else:
            self._target[...] = fft.fft(self._source, axis=self._axis)

    def update_arrays(self, source: ComplexArray, target: ComplexArray) -> None:
        """Go on with other buffers of the same shapes and strides."""
        self._source, self._target = source, target


def allocate_zeros(shape: tuple[int, ...]) -> ComplexArray:
    """Return zeros, complex64, aligned for vector instructions where FFTW is there."""
    zeros: Any = np.zeros if pyfftw is None else pyfftw.zeros_aligned
    return zeros(shape, np.complex64)


def plan_transform(
    source: ComplexArray, target: ComplexArray, axis: int, inverse: bool = False
) -> FourierPlan:
    """Plan a transform along one axis on one thread; see `FourierPlan`."""
    if pyfftw is None:
        return FourierPlan(source, target, axis, inverse)
    direction = "FFTW_BACKWARD" if inverse else "FFTW_FORWARD"
    with PLANNING_LOCK:
        made: FourierPlan = pyfftw.FFTW(source, target, (axis,), direction, FFTW_FLAGS)
    return made
