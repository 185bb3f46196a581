from __future__ import annotations

from collections.abc import Iterator

import pytest
from relay_walls import AXIS, HIDDEN, JITTER, planar_wall

from nlos import Capture
from nlos.simulate import PointScene
from tofclip.threads import limit_blas_threads


@pytest.fixture(autouse=True)
def _one_thread_for_products() -> Iterator[None]:
    """Small matrices gain nothing from threads, which on a busy machine wait for each other."""
    with limit_blas_threads():
        yield


@pytest.fixture
def capture() -> Capture:
    """One hidden point before a planar wall, one laser spot."""
    return PointScene([HIDDEN]).simulate_capture(planar_wall(), [0.12, 0.05, 0.0], AXIS, JITTER)
