"""Cameras of compact light-field photography: which nonlocal readings each view of a light field gets."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError
from tofclip.operators.base import BlockDiagonal, LinearOperator, Stack
from tofclip.operators.radon import RadonProjection
from tofclip.operators.shear import LinearShear, View
from tofclip.operators.single_pixel import HadamardCodes
from tofclip.operators.weighting import MeanWeighting


class LightFieldCamera(ABC):
    """An encoder A_k for each view, and the two models that follow from them.

    Parameters
    ----------
    image_shape : (int, int)
        Rows and columns of every view's picture.
    views : sequence of (float, float)
        (v, u) of every view.
    sampling_ratio : float
        Readings over pixels of one picture.
    seed : int
        Of everything random.

    Attributes
    ----------
    used : tuple of int
        Numbers of the views that get readings, in the order of the readings.
    encoders : tuple of LinearOperator
        A_k of these views.

    Raises
    ------
    InputError
        So few readings are asked for that there would be none.
    """

    name: str

    def __init__(self, image_shape: tuple[int, int], views: Sequence[View], sampling_ratio: float, seed: int) -> None:
        if not (np.isfinite(sampling_ratio) and sampling_ratio > 0):
            raise InputError(f"the sampling ratio must be positive, got {sampling_ratio}")
        self.image_shape, self.views = image_shape, tuple(views)
        self.sampling_ratio, self.seed = sampling_ratio, seed
        self.used, self.encoders = self._deal()

    @abstractmethod
    def _deal(self) -> tuple[tuple[int, ...], tuple[LinearOperator, ...]]:
        """Give readings to views."""

    @abstractmethod
    def model(self, shear: float, reference: View = (0.0, 0.0)) -> LinearOperator:
        """Return F(d): from the picture refocused at `shear`, seen from `reference`, to the readings (Eq. 21)."""

    @abstractmethod
    def weighting(self) -> LinearOperator:
        """Return the weights W that readings and model get in a recovery."""

    def light_field_model(self) -> LinearOperator:
        """Return the map from the used views' pictures, (views, rows, columns), to the readings (Eq. 20)."""
        return BlockDiagonal(self.encoders)


class LineCamera(LightFieldCamera):
    """CLIP-1D: line projections, their angles dealt to the views at random (supplement Note 6).

    ``sampling_ratio * rows * columns / detector`` angles, evenly in [0, pi), are permuted and dealt one by one to the
    views in random order; if there are fewer angles than views, some views get none. A detector has as many pixels
    as the picture's longer side.
    """

    name = "line"

    def _deal(self) -> tuple[tuple[int, ...], tuple[LinearOperator, ...]]:
        rows, columns = self.image_shape
        self.detector_px = max(rows, columns)
        count = round(self.sampling_ratio * rows * columns / self.detector_px)
        if count < 1:
            raise InputError(f"a sampling ratio of {self.sampling_ratio} gives no view a projection; take a larger one")
        random = np.random.default_rng(self.seed)
        angles = random.permutation(np.arange(count) * np.pi / count)
        owners = np.resize(random.permutation(len(self.views)), count)
        used = tuple(int(view) for view in np.unique(owners))
        self._angles = [angles[owners == view] for view in used]
        return used, tuple(self._projection(own, np.zeros(own.size)) for own in self._angles)

    def _projection(self, angles: NDArray[np.float64], offsets_px: NDArray[np.float64]) -> RadonProjection:
        return RadonProjection(self.image_shape, self.detector_px, angles, offsets_px)

    def model(self, shear: float, reference: View = (0.0, 0.0)) -> LinearOperator:
        """Return F(d) as one sparse matrix: a sheared view is one whose detector is offset."""
        offsets = []
        for view, angles in zip(self.used, self._angles, strict=True):
            down, right = (shear * (a - b) for a, b in zip(self.views[view], reference, strict=True))
            if not max(abs(down), abs(right)) < self.detector_px:
                raise InputError(f"shear {shear} moves view {self.views[view]} out of the field; take a smaller one")
            offsets.append(right * np.cos(angles) + down * np.sin(angles))
        return self._projection(np.concatenate(self._angles), np.concatenate(offsets))

    def weighting(self) -> LinearOperator:
        """Return weights of 1: what projections have in common is no nuisance."""
        readings = sum(encoder.shape_out[0] for encoder in self.encoders)
        return MeanWeighting([readings], 1.0)


class SinglePixelCamera(LightFieldCamera):
    """CLIP-0D: as many random 0/1 codes for each view (supplement Note 6)."""

    name = "single-pixel"

    def _deal(self) -> tuple[tuple[int, ...], tuple[LinearOperator, ...]]:
        rows, columns = self.image_shape
        codes = round(self.sampling_ratio * rows * columns / len(self.views))
        if codes < 1:
            raise InputError(
                f"a sampling ratio of {self.sampling_ratio} gives {len(self.views)} views less than one code each; "
                "take a larger one"
            )
        seeds = np.random.SeedSequence(self.seed).generate_state(len(self.views))
        encoders = tuple(HadamardCodes(self.image_shape, codes, int(seed)) for seed in seeds)
        return tuple(range(len(self.views))), encoders

    def model(self, shear: float, reference: View = (0.0, 0.0)) -> LinearOperator:
        """Return F(d): every view's codes after its shear, stacked."""
        return Stack(
            [
                encoder @ LinearShear(self.image_shape, shear, self.views[view], reference)
                for view, encoder in zip(self.used, self.encoders, strict=True)
            ]
        )

    def weighting(self) -> LinearOperator:
        """Return the weights that keep the mean of each view's codes from swamping the rest."""
        return MeanWeighting([encoder.shape_out[0] for encoder in self.encoders])


CAMERAS: dict[str, type[LightFieldCamera]] = {kind.name: kind for kind in (LineCamera, SinglePixelCamera)}
