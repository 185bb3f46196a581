"""Cameras of compressive light-field photography (supplement Note 5), and the single pixel."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError
from tofclip.operators.base import Diagonal, LinearOperator
from tofclip.operators.cameras.base import LightFieldCamera
from tofclip.operators.coded_views import (
    MaskedViews,
    ShearedViews,
    WeightedViews,
    make_sheared_mask,
)
from tofclip.operators.composition import MeanWeighting, Stack
from tofclip.operators.sensors import DenseSensor
from tofclip.operators.shear import LinearShear, View
from tofclip.operators.single_pixel import HadamardCodes

MASK_SHEAR_PX = 1.0
"""Pixels from view to view by which Marwah's mask appears moved: no two views see a pixel through
the same cell.
"""


class CompressiveCamera(LightFieldCamera):
    """Masks that weigh the views' pixels before they add up on a dense area sensor.

    The sampling ratio is the number of exposures, a whole number.
    """

    def _assign_measurements(self) -> tuple[int, ...]:
        self.exposures = round(self.sampling_ratio)
        if self.exposures < 1 or self.exposures != self.sampling_ratio:
            raise InputError(
                "every exposure of this camera reads all pixels: its sampling ratio is their number, a whole one, "
                f"not {self.sampling_ratio}"
            )
        self.measurements = self.exposures * self.image_shape[0] * self.image_shape[1]
        return tuple(range(len(self.views)))

    @abstractmethod
    def light_field_model(self) -> LinearOperator:
        """Return the map from the views' pictures, (views, rows, columns), to the measurements."""

    def model(self, shear: float, reference: View = (0.0, 0.0)) -> LinearOperator:
        """Return F(d): the light field's model after the shears.

        `shear`: pixels per view step; `reference`: view (v, u) from which the picture is seen, in
        view steps. Returns (rows, columns) pictures to (measurements,) vectors.
        """
        return self.light_field_model() @ ShearedViews(
            self.image_shape, self.views, shear, reference
        )


class ApertureMaskCamera(CompressiveCamera):
    """A mask in the aperture, another one for each exposure (Eq. 17)."""

    @abstractmethod
    def weights(self) -> NDArray[np.float64]:
        """Return the fraction of each view's light that each mask lets pass, (exposures, views)."""

    def _build_encoders(self) -> tuple[LinearOperator, ...]:
        sensor, even = DenseSensor(self.image_shape), np.ones(self.image_shape)
        return tuple(
            Stack([sensor @ Diagonal(share * even) for share in own]) for own in self.weights().T
        )

    def light_field_model(self) -> LinearOperator:
        """Return Eq. 17 for all exposures."""
        return WeightedViews(self.image_shape, self.weights())


class AshokCamera(ApertureMaskCamera):
    """Masks of open and closed cells from a Hadamard matrix (A. Ashok, M. A. Neifeld, Proc. SPIE
    7690, 76900Q (2010)).

    The first exposure is an ordinary photograph, all cells open; the others are drawn from the
    matrix.
    """

    name: ClassVar[str] = "ashok"

    def _assign_measurements(self) -> tuple[int, ...]:
        used = super()._assign_measurements()
        self._order = 1 << (len(self.views) - 1).bit_length()
        if self.exposures > self._order:
            raise InputError(
                f"{len(used)} views have at most {self._order} different masks, not {self.exposures}"
            )
        return used

    def weights(self) -> NDArray[np.float64]:
        """Return the masks."""
        from scipy.linalg import hadamard

        others = (
            1 + np.random.default_rng(self.seed).permutation(self._order - 1)[: self.exposures - 1]
        )
        # row 0 of the Hadamard matrix opens all cells; +-1 become open and closed
        open_cells: NDArray[np.float64] = (
            1 + hadamard(self._order)[np.append(0, others), : len(self.views)]
        ) / 2
        return open_cells


class BabacanCamera(ApertureMaskCamera):
    """Masks of random grey cells (S. D. Babacan et al., IEEE Trans. Image Process. 21, 4746
    (2012)).
    """

    name: ClassVar[str] = "babacan"

    def weights(self) -> NDArray[np.float64]:
        """Return the masks, their transmissions evenly from 0 to 1."""
        return np.random.default_rng(self.seed).random((self.exposures, len(self.views)))


class MarwahCamera(CompressiveCamera):
    """One exposure through a random mask just in front of the sensor.

    Each view sees the mask moved by `MASK_SHEAR_PX` pixels against its neighbour (Eq. 18; K. Marwah
    et al., ACM Trans. Graph. 32, 46 (2013)).
    """

    name: ClassVar[str] = "marwah"

    def _assign_measurements(self) -> tuple[int, ...]:
        used = super()._assign_measurements()
        if self.exposures != 1:
            raise InputError(
                f"this camera takes one exposure, not {self.exposures}; set the sampling ratio to 1"
            )
        return used

    def codes(self) -> NDArray[np.float64]:
        """Return the mask as each view sees it, (views, rows, columns)."""
        return make_sheared_mask(
            self.image_shape, self.views, MASK_SHEAR_PX, np.random.default_rng(self.seed)
        )

    def _build_encoders(self) -> tuple[LinearOperator, ...]:
        sensor = DenseSensor(self.image_shape)
        return tuple(sensor @ Diagonal(code) for code in self.codes())

    def light_field_model(self) -> LinearOperator:
        """Return Eq. 18."""
        return MaskedViews(self.codes())


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

        `shear`: pixels per view step; `reference`: view (v, u) from which the picture is seen, in
        view steps.
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
