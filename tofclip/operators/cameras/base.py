"""What every light-field camera has in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import ClassVar

import numpy as np

from tofclip.errors import InputError
from tofclip.operators.base import Identity, LinearOperator
from tofclip.operators.composition import BlockDiagonal
from tofclip.operators.shear import View


class LightFieldCamera(ABC):
    """An encoder A_k for each view, and the two models that follow from them.

    `image_shape`: rows and columns of every view's picture; `views`: (v, u) of every view;
    `sampling_ratio`: measurements over pixels of one picture; `seed`: of everything random.
    `used_views`: numbers of the views that get measurements, in the order of the measurements.
    """

    name: ClassVar[str]
    measurements: int  # how many measurements there are
    # consecutive measurements on a detector whose errors are alike; 1 where each stands for itself
    correlation_length: int = 1

    def __init__(
        self, image_shape: tuple[int, int], views: Sequence[View], sampling_ratio: float, seed: int
    ) -> None:
        if not (np.isfinite(sampling_ratio) and sampling_ratio > 0):
            raise InputError(f"the sampling ratio must be positive, got {sampling_ratio}")
        self.image_shape, self.views = image_shape, tuple(views)
        self.sampling_ratio, self.seed = sampling_ratio, seed
        self.used_views = self._assign_measurements()

    @abstractmethod
    def _assign_measurements(self) -> tuple[int, ...]:
        """Give measurements to views and set `measurements`; return the numbers of the views that
        get any.
        """

    @cached_property
    def encoders(self) -> tuple[LinearOperator, ...]:
        """A_k of the used views."""
        return self._build_encoders()

    @abstractmethod
    def _build_encoders(self) -> tuple[LinearOperator, ...]:
        """Build A_k of the used views."""

    @abstractmethod
    def model(self, shear: float, reference: View = (0.0, 0.0)) -> LinearOperator:
        """Return F(d): from the picture refocused at `shear`, seen from `reference`, to the
        measurements (Eq. 21).

        `shear`: pixels by which a point moves from one view to the next; stands for a depth;
        `reference`: view (v, u) from which the picture is seen, in view steps. Returns (rows,
        columns) pictures to (measurements,) vectors.
        """

    def weighting(self) -> LinearOperator:
        """Return the weights W that measurements and model get in a recovery; 1 unless the camera
        has a reason.
        """
        # by default every measurement counts alike
        return Identity((self.measurements,))

    def light_field_model(self) -> LinearOperator:
        """Return the map from the used views' pictures, (views, rows, columns), to the measurements
        (Eq. 20).
        """
        return BlockDiagonal(self.encoders)
