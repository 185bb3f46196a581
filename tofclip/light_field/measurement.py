"""Measurements of a light-field camera: how they were made, how they are kept, and the problem that
they pose.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError, ShapeError
from tofclip.light_field import LightField
from tofclip.operators.cameras import CAMERAS, EvenAngleLineCamera, LightFieldCamera
from tofclip.storage import (
    Storable,
    stored_array,
    stored_part,
    stored_provenance,
    stored_value,
)


@dataclass(frozen=True)
class CameraSetup:
    """Which camera measures."""

    # A name in `tofclip.operators.cameras.CAMERAS`
    encoder: str = field(metadata=stored_value(dtype=str))
    # measurements over pixels of one picture
    sampling_ratio: float = field(metadata=stored_value())
    seed: int = field(metadata=stored_value(dtype=int))

    def __post_init__(self) -> None:
        # The name in commands and files of version 0.1.0; to go with the next version.
        if self.encoder == "line-spread":
            object.__setattr__(self, "encoder", EvenAngleLineCamera.name)

    def camera(self, image_shape: tuple[int, int], views: NDArray[np.float64]) -> LightFieldCamera:
        """Build the camera of views (v, u), (views, 2); the same setup builds the same one again."""
        if self.encoder not in CAMERAS:
            raise InputError(f"unknown encoder '{self.encoder}'; take one of {', '.join(CAMERAS)}")
        return CAMERAS[self.encoder](
            image_shape, [(v, u) for v, u in views.tolist()], self.sampling_ratio, self.seed
        )


@dataclass(frozen=True)
class ClipMeasurement(Storable):
    """Measurements and the camera that made them."""

    RECORD_KIND = "clip_measurement"

    values: NDArray[Any] = field(
        metadata=stored_array("", "reading", dtype=np.float32, name="readings")
    )  # (measurements,)
    # (views, 2), (v, u) of every view
    views: NDArray[np.float64] = field(metadata=stored_array("", "view", "vu"))
    image_shape: tuple[int, int] = field(metadata=stored_value("rows", "columns", dtype=int))
    setup: CameraSetup = field(metadata=stored_part(CameraSetup))
    # what a measurement of 1 means in counted photons; 0: not known
    photons_per_unit: float = field(default=0.0, metadata=stored_value())
    # how they came about
    provenance: Mapping[str, Any] = field(default_factory=dict, metadata=stored_provenance())

    def __post_init__(self) -> None:
        if not np.all(np.isfinite(self.values)):
            raise InputError("the measurements hold NaN or infinity")
        if not self.values.any():
            raise InputError("every reading is zero; there is nothing to recover")

    def camera(self) -> LightFieldCamera:
        """Build the camera that made the measurements."""
        camera = self.setup.camera(self.image_shape, self.views)
        if self.values.shape != (camera.measurements,):
            raise ShapeError(
                "the measurements of this camera", (camera.measurements,), self.values.shape
            )
        return camera

    def counts(self) -> NDArray[Any]:
        """Return the measurements in photons, (measurements,) float32."""
        if self.photons_per_unit <= 0:
            raise InputError(
                "these measurements do not say how many photons they stand for; take squares or huber"
            )
        counted: NDArray[Any] = self.values * np.float32(self.photons_per_unit)
        return counted


def measure(light_field: LightField, setup: CameraSetup) -> ClipMeasurement:
    """Encode the true views, each by its own A_k and without noise: no model of refocusing takes part."""
    shape = (light_field.pictures.shape[1], light_field.pictures.shape[2])
    camera = setup.camera(shape, light_field.views)
    measurements = camera.light_field_model()(light_field.pictures[list(camera.used_views)])
    return ClipMeasurement(measurements, light_field.views, shape, setup)


def corrupt_measurement(
    measurement: ClipMeasurement, photons: float | None, bad_fraction: float
) -> ClipMeasurement:
    """Add the noise of so many photons of the largest measurement, None: no noise; then set a fraction
    of all measurements to 0 or to the largest, at random.
    """
    if not 0 <= bad_fraction <= 1:
        raise InputError(
            f"the share of bad measurements must lie between 0 and 1, got {bad_fraction}"
        )
    if photons is not None and not (np.isfinite(photons) and photons > 0):
        raise InputError(f"the number of photons must be positive, got {photons}")
    random = np.random.default_rng([measurement.setup.seed, 1])
    measurements = measurement.values.copy()
    largest = measurements.max()
    per_unit = 0.0 if photons is None else float(photons / largest)
    if photons is not None:
        counted = random.poisson(np.maximum(measurements, 0) * per_unit)
        measurements = (counted / per_unit).astype(np.float32)
    bad = random.permutation(measurements.size)[: round(bad_fraction * measurements.size)]
    measurements[bad] = random.choice(np.array([0, largest], np.float32), bad.size)
    return replace(measurement, values=measurements, photons_per_unit=per_unit)
