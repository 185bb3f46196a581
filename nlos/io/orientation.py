"""Turning a capture so that the hidden scene lies at larger z."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from tofclip.errors import InputError

MIN_Z_COSINE = 1 - 1e-6
"""Cosine beyond which a direction counts as z."""


def rotate_to_scene(capture: Capture, towards_scene: NDArray[np.float64]) -> Capture:
    """Turn all coordinates so that a direction becomes +z.

    A direction of +z leaves them as they are; of -z, they turn half around y. Otherwise the old z,
    upright in most programs, becomes -y, because y points down here.

    `towards_scene` (3,): from the wall into the hidden scene; of any length but 0.
    """
    turn = _build_rotation(towards_scene)
    laser, wall = capture.laser @ turn.T, capture.wall @ turn.T
    return Capture(
        capture.signal, wall, laser, capture.bin_width, capture.start, capture.provenance
    )


def _build_rotation(towards_scene: NDArray[np.float64]) -> NDArray[np.float64]:
    length = float(np.linalg.norm(towards_scene))
    if not (np.isfinite(length) and length > 0):
        raise InputError(f"the direction towards the scene must not be 0, got {towards_scene}")
    forward = np.asarray(towards_scene, dtype=np.float64) / length
    if abs(forward[2]) > MIN_Z_COSINE:
        return np.diag([np.sign(forward[2]), 1.0, np.sign(forward[2])])
    down = forward * forward[2] - [0.0, 0.0, 1.0]
    down /= np.linalg.norm(down)
    return np.stack([np.cross(down, forward), down, forward])
