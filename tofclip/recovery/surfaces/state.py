"""What is solved for beside the amplitudes: the surfaces' shapes, and what is uncertain of the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera

FloatArray = NDArray[np.float64]


@dataclass
class SurfaceState:
    """What is solved for beside the amplitudes."""

    coefficients: list[FloatArray]  # inverse depths of each surface, 1/m, over its basis
    gains: FloatArray  # (views,)
    # (views,), rows by which light at the views' centres is later than the camera's sweep says.
    # Between two centres they are interpolated, as a sweep is a smooth function of the slit column
    delays: FloatArray
    stretches: FloatArray  # (views,), rows by which those delays grow over the streak image
    widths: FloatArray  # (views,), pulse widths, relative to the camera's
    # (surfaces, views), logarithms of how bright each view sees what lies behind another surface,
    # relative to the mean over the views. Through gauze the view beside the lamp sees just what the
    # lamp lights, and the others see a part of it
    shading: FloatArray

    @classmethod
    def start(cls, coefficients: Sequence[FloatArray], camera: Camera) -> SurfaceState:
        """Return the state in which views are as the camera has them."""
        none = np.zeros(camera.views)
        even = np.zeros((len(coefficients), camera.views))
        return cls(list(coefficients), camera.gains.copy(), none, none.copy(), none + 1, even)

    def copy(self) -> SurfaceState:
        """Return a state that can be changed without changing this one."""
        return SurfaceState(
            [one.copy() for one in self.coefficients],
            self.gains.copy(),
            self.delays.copy(),
            self.stretches.copy(),
            self.widths.copy(),
            self.shading.copy(),
        )
