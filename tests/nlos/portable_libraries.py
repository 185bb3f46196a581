"""Libraries other than NumPy that the tests of portable imaging put captures into."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tofclip.arrays import Place, place_named, to_numpy

LIBRARIES = ("torch", "array_api_strict")


def place_of(library: str) -> Place:
    """Return the library's processor; skip the test where the library is not installed."""
    module = pytest.importorskip(library)
    if library == "array_api_strict":
        return Place.of(module.asarray([0.0]))
    module.set_num_threads(1)  # waking others up takes longer than what there is to do
    return place_named("torch:cpu")


def relative_error(found: Any, expected: np.ndarray) -> float:
    return float(np.linalg.norm(to_numpy(found) - expected) / np.linalg.norm(expected))
