"""CLIP-1D: line projections."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError
from tofclip.operators.base import LinearOperator
from tofclip.operators.cameras.angle_assignment import (
    CORRELATION_LENGTH_PX,
    AngleAssignment,
    assign_evenly,
    assign_randomly,
    count_lines,
)
from tofclip.operators.cameras.base import LightFieldCamera
from tofclip.operators.radon import RadonProjection
from tofclip.operators.shear import View


class LineCamera(LightFieldCamera):
    """CLIP-1D: line projections, their angles assigned to the views at random (supplement Note 6).

    ``sampling_ratio * rows * columns / detector`` angles, evenly in [0, pi). A detector has as many
    pixels as the picture's longer side.
    """

    name: ClassVar[str] = "line"

    def _assign_measurements(self) -> tuple[int, ...]:
        self.detector_px = max(self.image_shape)
        count = count_lines(self.image_shape, self.detector_px, self.sampling_ratio)
        self.measurements, self.correlation_length = (
            count * self.detector_px,
            min(CORRELATION_LENGTH_PX, self.detector_px),
        )
        # half a turn is all: a line turned by 180 degrees measures the same, mirrored
        used, self.angles = self._assign_angles(np.arange(count) * np.pi / count)
        return used

    def _assign_angles(self, angles: NDArray[np.float64]) -> AngleAssignment:
        """Give angles to views."""
        return assign_randomly(angles, len(self.views), np.random.default_rng(self.seed))

    def _build_encoders(self) -> tuple[LinearOperator, ...]:
        return tuple(self._make_projection(own, np.zeros(own.size)) for own in self.angles)

    def _make_projection(
        self, angles: NDArray[np.float64], offsets_px: NDArray[np.float64]
    ) -> RadonProjection:
        return RadonProjection(self.image_shape, self.detector_px, angles, offsets_px)

    def model(self, shear: float, reference: View = (0.0, 0.0)) -> LinearOperator:
        """Return F(d) as one sparse matrix: a sheared view is one whose detector is offset.

        Parameters
        ----------
        shear : float
            Pixels per view step.
        reference : (float, float)
            View (v, u) from which the picture is seen, in view steps.

        Returns
        -------
        LinearOperator
            (rows, columns) pictures to (measurements,) vectors.

        Raises
        ------
        InputError
            The shear moves a view by more than the detector's length.
        """
        offsets = []
        for view, angles in zip(self.used_views, self.angles, strict=True):
            down, right = (
                shear * (a - b) for a, b in zip(self.views[view], reference, strict=True)
            )
            if not max(abs(down), abs(right)) < self.detector_px:
                raise InputError(
                    f"shear {shear} moves view {self.views[view]} out of the field; take a smaller one"
                )
            # the shift's component along the line's direction (cos, sin); the other one moves along
            # the integral
            offsets.append(right * np.cos(angles) + down * np.sin(angles))
        return self._make_projection(np.concatenate(self.angles), np.concatenate(offsets))


class EvenAngleLineCamera(LineCamera):
    """CLIP-1D with angles assigned so that neighbouring ones look from places spread evenly over the
    aperture.

    What is out of focus is then blurred rather than torn into streaks, and which seed was drawn
    hardly matters (`apps.studies.refocused_pictures` shows how much better it is than dealing at
    random).
    """

    name: ClassVar[str] = "line-even"

    def _assign_angles(self, angles: NDArray[np.float64]) -> AngleAssignment:
        """Deal evenly; directions that differ by 6 px at the picture's border stand for the
        aperture together.
        """
        neighbours = 4 * angles.size / max(self.image_shape)
        cycle = max(2, 1 << max(round(np.log2(neighbours)), 0))
        return assign_evenly(angles, self.views, cycle, np.random.default_rng(self.seed))
