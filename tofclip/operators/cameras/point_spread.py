"""Cameras with a mask or a phase plate in the aperture and one area sensor (supplement Note 3)."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import numpy as np

from tofclip.errors import InputError
from tofclip.operators.base import LinearOperator
from tofclip.operators.cameras.base import LightFieldCamera
from tofclip.operators.composition import Integration
from tofclip.operators.convolution import PointSpreadConvolution
from tofclip.operators.point_spreads import (
    ApertureElement,
    CodedAperture,
    CubicPhasePlate,
    Diffuser,
    MeasuredPointSpreads,
    shear_point_spreads,
    trace_view_point_spreads,
)
from tofclip.operators.sensors import DenseSensor, PitchedSensor
from tofclip.operators.shear import View


class PointSpreadCamera(LightFieldCamera):
    """Every view goes through its own part of the aperture; their light adds up on one sparse
    sensor (Eq. 4, 5).

    The sensor's pixels are spread evenly over the picture, as many as the sampling ratio asks for.
    """

    @abstractmethod
    def make_element(self) -> ApertureElement:
        """Return what stands in the aperture."""

    def _assign_measurements(self) -> tuple[int, ...]:
        self.sensor = make_sparse_sensor(self.image_shape, self.sampling_ratio)
        (self.measurements,) = self.sensor.shape_out
        spreads = trace_view_point_spreads(self.make_element(), self.views, self.image_shape)
        # Views behind closed cells are seen by no measurement; they are left out of the model.
        used = np.flatnonzero(spreads.any(axis=(1, 2)))
        if used.size == 0:
            raise InputError("the aperture lets no light through; take another seed")
        self._spreads = spreads[used]
        return tuple(int(view) for view in used)

    def _build_encoders(self) -> tuple[LinearOperator, ...]:
        return tuple(self.sensor @ self._make_convolution(spread) for spread in self._spreads)

    def _make_convolution(self, spread: np.ndarray) -> PointSpreadConvolution:
        return PointSpreadConvolution(self.image_shape, spread)

    def model(self, shear: float, reference: View = (0.0, 0.0)) -> LinearOperator:
        """Return F(d): one convolution with the depth's PSF, read by the sensor.

        `shear`: pixels per view step; `reference`: view (v, u) from which the picture is seen, in
        view steps. Returns (rows, columns) pictures to (measurements,) vectors.
        """
        views = [self.views[view] for view in self.used_views]
        # views are moved by the shear and add up on the sensor: one convolution (Eq. 5)
        return self.sensor @ self._make_convolution(
            shear_point_spreads(self._spreads, views, shear, reference).sum(axis=0)
        )

    def light_field_model(self) -> LinearOperator:
        """Return the map from the used views' pictures to the measurements: the sum of what each
        puts on the sensor.
        """
        return self.sensor @ Integration(
            [self._make_convolution(spread) for spread in self._spreads]
        )


class CodedApertureCamera(PointSpreadCamera):
    """A random mask of open and closed cells, one for each view. In focus (s = 0) nothing is
    encoded.
    """

    name: ClassVar[str] = "coded-aperture"

    def make_element(self) -> CodedAperture:
        """Return the mask; at least one of its cells is open."""
        random = np.random.default_rng(self.seed)
        cells = tuple(len({view[axis] for view in self.views}) for axis in (0, 1))
        code = random.integers(0, 2, cells)
        # At least one open cell, or a small aperture might let no light through.
        code.flat[random.integers(code.size)] = 1
        return CodedAperture(code)


class CubicPhaseCamera(PointSpreadCamera):
    """A cubic phase plate, whose PSF spans a fifth of the picture at every depth."""

    name: ClassVar[str] = "cubic-phase"

    def make_element(self) -> CubicPhasePlate:
        """Return the phase plate."""
        return CubicPhasePlate(min(self.image_shape) / 5)


class DiffuserCamera(PointSpreadCamera):
    """A diffuser, whose caustics cover about half of the picture at every depth."""

    name: ClassVar[str] = "diffuser"

    def make_element(self) -> Diffuser:
        """Return the diffuser."""
        return Diffuser(min(self.image_shape) / 9, 0.25, self.seed)


class MeasuredCamera:
    """A camera known by its PSFs only, measured with a point source at several depths (supplement
    Note 4).

    `sensor`: from the light on the sensor's plane to the measurements, any of
    `tofclip.operators.sensors`; its plane may be smaller than the picture.
    """

    def __init__(
        self,
        image_shape: tuple[int, int],
        point_spreads: MeasuredPointSpreads,
        sensor: LinearOperator | None = None,
    ) -> None:
        self.image_shape, self.point_spreads = image_shape, point_spreads
        self.sensor = DenseSensor(image_shape) if sensor is None else sensor

    def model(self, shear: float) -> LinearOperator:
        """Return F(d): from the picture at `shear` to the measurements."""
        plane = (self.sensor.shape_in[0], self.sensor.shape_in[1])
        spread = self.point_spreads.interpolate(shear)
        return self.sensor @ PointSpreadConvolution(
            self.image_shape, spread, plane, self.sensor.dtype
        )


def make_sparse_sensor(image_shape: tuple[int, int], sampling_ratio: float) -> PitchedSensor:
    """Spread as many pixels evenly over the picture as the sampling ratio asks for.

    `image_shape`: rows and columns of a view's picture; `sampling_ratio`: sensor pixels over
    picture pixels, above 0 up to 1.
    """
    rows, columns = image_shape
    if not 0 < sampling_ratio <= 1:
        raise InputError(
            f"one area sensor gives sampling ratios above 0 up to 1, not {sampling_ratio}"
        )
    # the same pitch on both axes, as far as whole numbers of pixels allow
    kept_rows = min(max(round(rows * np.sqrt(sampling_ratio)), 1), rows)
    kept_columns = min(round(sampling_ratio * rows * columns / kept_rows), columns)
    if kept_columns < 1:
        raise InputError(
            f"a sampling ratio of {sampling_ratio} gives no sensor pixel; take a larger one"
        )
    return PitchedSensor(image_shape, (rows / kept_rows, columns / kept_columns))
