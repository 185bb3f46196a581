"""The demonstration: one scene with an occluder, and three cameras that look at it.

* Compact light-field photography with time of flight: a row of views, nonlocal measurements in
  every time bin.
* A single view with as many pixels as the other has measurements; it has time of flight too.
* A conventional light-field camera: every pixel of every view, but no time of flight; it can only
  defocus the occluder.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apps.occlusion.scenes import OcclusionScene
from tofclip.errors import InputError
from tofclip.light_field import LightField
from tofclip.light_field.views import CameraSetup
from tofclip.occlusion import (
    InactiveRegion,
    Rig,
    SeparatedImages,
    TimedMeasurements,
    add_poisson_noise,
    measure_views,
    separate_occluder,
)
from tofclip.simulate.bodies import Body
from tofclip.simulate.light_fields import (
    CameraArray,
    PulsedScene,
    TimeAxis,
    render_flash,
    render_flash_view,
)

Array = NDArray[Any]

VIEW_COUNT = 7
MIDDLE_VIEW = (0.0, 0.0)
FIELD_OF_VIEW_RAD = 0.45  # rad across the picture
BIN_WIDTH_S, PULSE_FWHM_S = 20e-12, 60e-12  # the paper's streak camera
RANGE_MARGIN_M = 20e-3  # before the occluder and behind the target, m

OBLIQUE_LAMP_M = (-55e-3, -25e-3, 0.0)
ILLUMINATIONS = ("diodes", "oblique", "co-located")

# of the brightest measurement: one of a single pixel gathers half the picture's light and learns
# little of it
DEFAULT_PHOTONS = {"line": 2e3, "single-pixel": 1e6}


@dataclass(frozen=True)
class ExperimentSettings:
    """How the scene is lit and measured."""

    side_px: int = 128  # rows and columns of the picture
    encoder: str = "line"  # A name of `tofclip.operators.cameras.CAMERAS`
    sampling_ratio: float = 0.5  # measurements over pixels of one picture
    # ``diodes``: one beside each view; ``oblique``: one far to the side; ``co-located``: one beside
    # the middle view, whose light the occluder keeps from everything that view cannot see
    illumination: str = "diodes"
    photons: float = 2000.0  # of the brightest measurement at its brightest instant
    seed: int = 0
    samples: int = 2  # rays on a side of each pixel

    def __post_init__(self) -> None:
        if self.illumination not in ILLUMINATIONS:
            raise InputError(
                f"unknown illumination '{self.illumination}'; take one of {', '.join(ILLUMINATIONS)}"
            )
        if self.side_px < 24:
            raise InputError(f"a picture of {self.side_px} pixels shows nothing; take 24 or more")
        if not (np.isfinite(self.photons) and self.photons > 0):
            raise InputError(f"the number of photons must be positive, got {self.photons}")


def make_rig(
    region: InactiveRegion,
    side_px: int,
    focal_length_px: float,
    focus: float,
    samples: int,
    setup: CameraSetup,
) -> Rig:
    """Return a row of views as long as the baseline, in focus at a distance, m, a lamp beside each."""
    array = CameraArray(
        (side_px, side_px),
        VIEW_COUNT,
        focal_length_px,
        region.baseline / (VIEW_COUNT - 1),
        focus=focus,
        samples=samples,
        view_rows=1,
    )
    return Rig(array, np.stack([array.position((v, u)) for v, u in array.views]), setup)


@dataclass(frozen=True)
class Experiment:
    """A scene, as it is measured."""

    scene: OcclusionScene
    settings: ExperimentSettings

    @cached_property
    def rig(self) -> Rig:
        """Views, lamps and measurements."""
        region, known = self.scene.region, self.settings
        setup = CameraSetup(known.encoder, known.sampling_ratio, known.seed)
        focal_length_px = known.side_px / FIELD_OF_VIEW_RAD
        focus = 2 / (1 / region.distance + 1 / self.scene.distance)
        rig = make_rig(region, known.side_px, focal_length_px, focus, known.samples, setup)
        lamps = {"oblique": np.array([OBLIQUE_LAMP_M]), "co-located": np.zeros((1, 3))}
        return replace(rig, lamps=lamps.get(known.illumination, rig.lamps))

    @cached_property
    def time_axis(self) -> TimeAxis:
        """Instants from before the occluder's return to after the target's."""
        near = self.scene.region.distance - RANGE_MARGIN_M
        far = self.scene.distance + RANGE_MARGIN_M
        lamp = float(np.linalg.norm(self.rig.lamps, axis=1).max())
        return TimeAxis.for_ranges(near, float(np.hypot(far, lamp)), BIN_WIDTH_S, PULSE_FWHM_S)

    @property
    def expected_visible(self) -> bool:
        """Whether the formula promises that the target's middle is seen, and a lamp gets there as
        views do.
        """
        return (
            self.scene.behind > self.scene.region.length
            and self.settings.illumination != "co-located"
        )

    @cached_property
    def pictures(self) -> Array:
        """What every view sees at every instant, without noise, (views, rows, columns, bins)."""
        return render_flash(
            PulsedScene((*self.scene.target, *self.scene.occluder), self.rig.lamps),
            self.rig.array,
            self.time_axis,
        )

    @cached_property
    def truth(self) -> Array:
        """What the middle view would see of the target, were there no occluder, (rows, columns)."""
        picture: Array = self._render_middle_view(self.scene.target, self.rig.array).sum(axis=-1)
        return picture

    def _render_middle_view(self, bodies: tuple[Body, ...], array: CameraArray) -> Any:
        scene = PulsedScene(bodies, self.rig.lamps)
        return render_flash_view(scene, array, self.time_axis, MIDDLE_VIEW)

    @cached_property
    def measurements(self) -> TimedMeasurements:
        """What the nonlocal views read, with photon noise."""
        clean = measure_views(self.pictures, self.rig, self.time_axis)
        return replace(clean, values=self._add_noise(clean.values, 1))

    def _add_noise(self, light: Array, stream: int) -> Array:
        """Light with photon noise, from a stream of random numbers of its own."""
        random = np.random.default_rng([self.settings.seed, stream])
        return add_poisson_noise(light, self.settings.photons / float(light.max()), random)

    @cached_property
    def separated(self) -> SeparatedImages:
        """Occluder and target from the measurements."""
        return separate_occluder(self.measurements)

    @cached_property
    def single_view(self) -> Array:
        """The target by the middle view alone, its pixels as many as the others' measurements;
        occluder gated away.
        """
        seen = self._render_middle_view(
            (*self.scene.target, *self.scene.occluder), self._single_array
        )
        noisy = self._add_noise(seen, 2)
        gates = [one.bins for one in self.measurements.find_returns()]
        picture: Array = noisy[..., gates[1]].sum(axis=-1) if len(gates) > 1 else 0 * noisy[..., 0]
        return picture

    @cached_property
    def single_view_truth(self) -> Array:
        """What the single view would see of the target, were there no occluder."""
        array = self._single_array
        picture: Array = self._render_middle_view(self.scene.target, array).sum(axis=-1)
        return picture

    @property
    def _single_array(self) -> CameraArray:
        """A view with as many pixels as the rig has measurements."""
        side = max(round(np.sqrt(self.rig.camera.measurements)), 1)
        focal_length_px = self.rig.array.focal_length_px * side / self.settings.side_px
        return replace(self.rig.array, image_shape=(side, side), focal_length_px=focal_length_px)

    @cached_property
    def conventional(self) -> Array:
        """All pixels of all views, without time of flight, refocused on the target, (rows,
        columns).
        """
        noisy = self._add_noise(self.pictures.sum(axis=-1), 3)
        shear = float(self.rig.array.shear(self.scene.distance))
        return LightField(noisy, self.rig.array.views).refocus(shear)
