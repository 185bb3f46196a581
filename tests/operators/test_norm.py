"""The step of a solver: the norm of every camera's model is not underestimated by more than the
margin.
"""

from __future__ import annotations

import numpy as np
import pytest

from tofclip.operators.cameras import CAMERAS
from tofclip.solvers.fista import NORM_MARGIN

VIEWS = [(v, u) for v in range(-1, 2) for u in range(-1, 2)]
SIDE = 16


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("ratio", [0.5, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_the_margin_covers_what_the_estimate_of_the_norm_lacks(name, ratio, seed):
    camera = CAMERAS[name]((SIDE, SIDE), VIEWS, ratio, seed)
    model = camera.weighting() @ camera.model(0.3)
    pictures = np.eye(SIDE * SIDE, dtype=model.dtype).reshape(SIDE, SIDE, -1)
    matrix = model(pictures).reshape(-1, SIDE * SIDE).astype(np.float64)
    norm = np.linalg.norm(matrix, 2) ** 2
    assert norm / NORM_MARGIN <= model.squared_norm <= norm * 1.0001
