"""The demonstration: one scene with an occluder, and three cameras that look at it.

* Compact light-field photography with time of flight: a row of views, nonlocal readings at every instant.
* A single view with as many pixels as the other has readings; it has time of flight too.
* A conventional light-field camera: every pixel of every view, but no time of flight; it can only defocus the occluder.
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
from tofclip.light_field.measurement import Setup
from tofclip.occlusion.readings import Rig, TimedReadings, counted, encoded
from tofclip.occlusion.recovery import Separated, separate
from tofclip.simulate.light_fields import Body, CameraArray, Clock, PulsedScene, flash, flash_view

Array = NDArray[Any]

VIEWS = 7
MIDDLE = (0.0, 0.0)
FIELD = 0.45  # rad across the picture
BIN_WIDTH, PULSE = 20e-12, 60e-12  # the paper's streak camera
MARGIN = 20e-3  # before the occluder and behind the target, m

OBLIQUE_LAMP = (-55e-3, -25e-3, 0.0)
ILLUMINATIONS = ("diodes", "oblique", "co-located")

USUAL_PHOTONS = {"line": 2e3, "single-pixel": 1e6}
"""Of the brightest reading: one of a single pixel gathers half the picture's light and tells little of it."""


@dataclass(frozen=True)
class Settings:
    """How the scene is lit and measured.

    Parameters
    ----------
    side_px : int
        Rows and columns of the picture.
    encoder : str
        A name of `tofclip.operators.light_field_camera.CAMERAS`.
    sampling_ratio : float
        Readings over pixels of one picture.
    illumination : str
        ``diodes``: one beside each view; ``oblique``: one far to the side; ``co-located``: one beside the middle view,
        whose light the occluder keeps from everything that view cannot see.
    photons : float
        Of the brightest reading at its brightest instant.
    seed : int

    Raises
    ------
    InputError
        An unknown illumination, a picture too small to show anything, or no photons.
    """

    side_px: int = 128
    encoder: str = "line"
    sampling_ratio: float = 0.5
    illumination: str = "diodes"
    photons: float = 2000.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.illumination not in ILLUMINATIONS:
            raise InputError(f"unknown illumination '{self.illumination}'; take one of {', '.join(ILLUMINATIONS)}")
        if self.side_px < 24:
            raise InputError(f"a picture of {self.side_px} pixels shows nothing; take 24 or more")
        if not (np.isfinite(self.photons) and self.photons > 0):
            raise InputError(f"the number of photons must be positive, got {self.photons}")


@dataclass(frozen=True)
class Experiment:
    """A scene, as it is measured.

    Parameters
    ----------
    scene : OcclusionScene
    settings : Settings
    """

    scene: OcclusionScene
    settings: Settings

    @cached_property
    def rig(self) -> Rig:
        """Views, lamps and readings."""
        near, far = self.scene.region.distance, self.scene.distance
        side = self.settings.side_px
        array = CameraArray(
            (side, side),
            VIEWS,
            focal_length_px=side / FIELD,
            view_step=self.scene.region.baseline / (VIEWS - 1),
            focus=2 / (1 / near + 1 / far),
            view_rows=1,
        )
        setup = Setup(self.settings.encoder, self.settings.sampling_ratio, self.settings.seed)
        return Rig(array, self._lamps(array), setup)

    def _lamps(self, array: CameraArray) -> NDArray[np.float64]:
        if self.settings.illumination == "oblique":
            return np.array([OBLIQUE_LAMP])
        if self.settings.illumination == "co-located":
            return np.zeros((1, 3))
        return np.stack([array.place((v, u)) for v, u in array.views])

    @cached_property
    def clock(self) -> Clock:
        """Instants from before the occluder's return to after the target's."""
        near, far = self.scene.region.distance - MARGIN, self.scene.distance + MARGIN
        lamp = float(np.linalg.norm(self.rig.lamps, axis=1).max())
        return Clock.covering(near, float(np.hypot(far, lamp)), BIN_WIDTH, PULSE)

    @property
    def promised(self) -> bool:
        """Whether the formula promises that the target's middle is seen, and a lamp gets there as views do."""
        return self.scene.behind > self.scene.region.length and self.settings.illumination != "co-located"

    @cached_property
    def pictures(self) -> Array:
        """What every view sees at every instant, without noise, (views, rows, columns, bins)."""
        return flash(
            PulsedScene((*self.scene.target, *self.scene.occluder), self.rig.lamps), self.rig.array, self.clock
        )

    @cached_property
    def truth(self) -> Array:
        """What the middle view would see of the target, were there no occluder, (rows, columns)."""
        picture: Array = self._middle_view(self.scene.target, self.rig.array).sum(axis=-1)
        return picture

    def _middle_view(self, bodies: tuple[Body, ...], array: CameraArray) -> Array:
        return flash_view(PulsedScene(bodies, self.rig.lamps), array, self.clock, MIDDLE)

    @cached_property
    def readings(self) -> TimedReadings:
        """What the nonlocal views read, with photon noise."""
        clean = encoded(self.pictures, self.rig, self.clock)
        random = np.random.default_rng([self.settings.seed, 1])
        return replace(clean, values=counted(clean.values, self._photons_per_unit(clean.values), random))

    def _photons_per_unit(self, light: Array) -> float:
        return self.settings.photons / float(light.max())

    @cached_property
    def separated(self) -> Separated:
        """Occluder and target from the readings."""
        return separate(self.readings)

    @cached_property
    def single_view(self) -> Array:
        """The target by the middle view alone, its pixels as many as the others' readings; occluder gated away."""
        seen = self._middle_view((*self.scene.target, *self.scene.occluder), self._single_array)
        random = np.random.default_rng([self.settings.seed, 2])
        noisy = counted(seen, self._photons_per_unit(seen), random)
        gates = [one.bins for one in self.readings.returns()]
        picture: Array = noisy[..., gates[1]].sum(axis=-1) if len(gates) > 1 else 0 * noisy[..., 0]
        return picture

    @cached_property
    def single_view_truth(self) -> Array:
        """What the single view would see of the target, were there no occluder."""
        picture: Array = self._middle_view(self.scene.target, self._single_array).sum(axis=-1)
        return picture

    @property
    def _single_array(self) -> CameraArray:
        """A view with as many pixels as the rig has readings."""
        side = max(round(np.sqrt(self.rig.camera.readings)), 1)
        focal_length_px = self.rig.array.focal_length_px * side / self.settings.side_px
        return replace(self.rig.array, image_shape=(side, side), focal_length_px=focal_length_px)

    @cached_property
    def conventional(self) -> Array:
        """All pixels of all views, without time of flight, refocused on the target, (rows, columns)."""
        pictures = self.pictures.sum(axis=-1)
        random = np.random.default_rng([self.settings.seed, 3])
        noisy = counted(pictures, self._photons_per_unit(pictures), random)
        shear = float(self.rig.array.shear(self.scene.distance))
        return LightField(noisy, self.rig.array.views).refocus(shear)
