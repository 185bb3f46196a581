"""CLIP-0D: random codes on a single pixel."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from tofclip.errors import InputError
from tofclip.operators.base import LinearOperator
from tofclip.operators.cameras.base import LightFieldCamera
from tofclip.operators.shear import LinearShear, View
from tofclip.operators.single_pixel import HadamardCodes
from tofclip.operators.stacking import Stack
from tofclip.operators.weighting import MeanWeighting


class SinglePixelCamera(LightFieldCamera):
    """CLIP-0D: as many random 0/1 codes for each view (supplement Note 6)."""

    name: ClassVar[str] = "single-pixel"

    def _assign_measurements(self) -> tuple[int, ...]:
        rows, columns = self.image_shape
        self.codes = round(self.sampling_ratio * rows * columns / len(self.views))
        if self.codes < 1:
            raise InputError(
                f"a sampling ratio of {self.sampling_ratio} gives {len(self.views)} views less than one code each; "
                "take a larger one"
            )
        self.measurements = self.codes * len(self.views)
        return tuple(range(len(self.views)))

    def _build_encoders(self) -> tuple[LinearOperator, ...]:
        # independent codes for every view from one seed
        seeds = np.random.SeedSequence(self.seed).generate_state(len(self.views))
        return tuple(HadamardCodes(self.image_shape, self.codes, int(seed)) for seed in seeds)

    def model(self, shear: float, reference: View = (0.0, 0.0)) -> LinearOperator:
        """Return F(d): every view's codes after its shear, stacked.

        Parameters
        ----------
        shear : float
            Pixels per view step.
        reference : (float, float)
            View (v, u) from which the picture is seen, in view steps.

        Returns
        -------
        Stack
        """
        return Stack(
            [
                encoder @ LinearShear(self.image_shape, shear, self.views[view], reference)
                for view, encoder in zip(self.used_views, self.encoders, strict=True)
            ]
        )

    def weighting(self) -> LinearOperator:
        """Return the weights that keep the mean of each view's codes from swamping the rest."""
        return MeanWeighting([self.codes] * len(self.used_views))
