from __future__ import annotations

import pytest
from relay_walls import AXIS, HIDDEN, JITTER, planar_wall

from nlos import Capture
from nlos.simulate import PointScene


@pytest.fixture
def capture() -> Capture:
    """One hidden point before a planar wall, one laser spot."""
    return PointScene([HIDDEN]).seen_from(planar_wall(), [0.12, 0.05, 0.0], AXIS, JITTER)
