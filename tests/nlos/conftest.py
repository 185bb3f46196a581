import warnings

import pytest
from scenes import AXIS, HIDDEN, JITTER, planar_wall

from nlos.illumination import AliasingWarning
from nlos.simulate import PointScene
from tofclip.threads import limit_blas_threads


@pytest.fixture(autouse=True)
def _small_scenes():
    """Small matrices gain nothing from threads, which on a busy machine wait for each other; and
    small walls are coarse ones, of which `test_capture.py` holds what is said.
    """
    warnings.filterwarnings("ignore", category=AliasingWarning)
    with limit_blas_threads():
        yield


@pytest.fixture
def capture():
    """One hidden point before a planar wall, one laser spot."""
    return PointScene([HIDDEN]).simulate_capture(planar_wall(), [0.12, 0.05, 0.0], AXIS, JITTER)
