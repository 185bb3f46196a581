"""1D sensors behind randomly coded line-shaped point-spread functions (supplement Note 4)."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tofclip.operators.base import LinearOperator
from tofclip.operators.cameras.angle_assignment import (
    CORRELATION_LENGTH_PX,
    assign_randomly,
    count_lines,
)
from tofclip.operators.cameras.base import LightFieldCamera
from tofclip.operators.coded_lines import SliceConvolution, make_coded_line
from tofclip.operators.point_spreads import shear_point_spreads
from tofclip.operators.shear import View

MAX_LINE_ANGLE_RAD = np.pi / 4


class CodedLineCamera(LightFieldCamera):
    """Coded lines one pixel wide, their angles evenly from -45 to 45 degrees, assigned to the views at
    random.

    Each line has a code and a 1D sensor of its own, as long as the picture is wide.
    """

    name: ClassVar[str] = "coded-line"
    width_px: ClassVar[int] = 1

    def _assign_measurements(self) -> tuple[int, ...]:
        count = count_lines(self.image_shape, self.image_shape[1], self.sampling_ratio)
        self.measurements, self.correlation_length = (
            count * self.image_shape[1],
            min(CORRELATION_LENGTH_PX, self.image_shape[1]),
        )
        random = np.random.default_rng(self.seed)
        angles = MAX_LINE_ANGLE_RAD * (2 * np.arange(count) + 1 - count) / count
        used, dealt = assign_randomly(angles, len(self.views), random)
        self._spreads = [
            np.stack(
                [make_coded_line(self.image_shape, self.width_px, angle, random) for angle in own]
            )
            for own in dealt
        ]
        return used

    def _build_encoders(self) -> tuple[LinearOperator, ...]:
        return tuple(SliceConvolution(self.image_shape, spreads) for spreads in self._spreads)

    def model(self, shear: float, reference: View = (0.0, 0.0)) -> LinearOperator:
        """Return F(d): the lines of each view moved as its picture would be.

        Parameters
        ----------
        shear : float
            Pixels per view step.
        reference : (float, float)
            View (v, u) from which the picture is seen, in view steps.

        Returns
        -------
        SliceConvolution
        """
        moved: list[NDArray[np.float64]] = []
        for view, spreads in zip(self.used_views, self._spreads, strict=True):
            moved.append(
                shear_point_spreads(spreads, [self.views[view]] * len(spreads), shear, reference)
            )
        return SliceConvolution(self.image_shape, np.concatenate(moved))
