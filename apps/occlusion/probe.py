"""Small targets on the axis at set distances behind an occluder, to see where its inactive region ends.

A target is so small that inside, at 0.8 of the region's length, all of it lies in the umbra, and beyond, at 1.2 and
more, the outermost views see all of it. The camera looks closely at it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.light_field.measurement import Setup
from tofclip.metrics import correlation
from tofclip.occlusion.readings import Rig, counted, encoded
from tofclip.occlusion.recovery import WEIGHT
from tofclip.occlusion.region import InactiveRegion
from tofclip.recovery.light_field import ITERATIONS, RELATIVE_CHANGE
from tofclip.simulate.light_fields import Body, CameraArray, Clock, Lambertian, PulsedScene, Rectangle, flash
from tofclip.simulate.shapes import cut_out, letter, plain
from tofclip.solvers import TotalVariation

Array = NDArray[Any]

FACTORS = (0.8, 1.2, 2.0)
"""Distances behind the occluder, in lengths of the inactive region."""

TARGET_WIDTH = 0.15
"""Of the occluder's; the umbra is 0.2 of it wide at 0.8 of its length."""

RECOVERED = 0.8
"""Correlation with the unoccluded truth from which on a target counts as recovered."""

VIEWS = 7
PICTURE_PX = 48
TARGET_PX = 20
PULSE = 10e-12  # the nearest target of all trials answers 25 ps after its occluder
LONGEST_GATE = 80e-12
PHOTONS = 2000.0  # of the brightest reading, were there no occluder
BACKGROUND = 20.0  # photons of every reading that come at any time
SIGNIFICANT = 5.0  # standard deviations of the background
DIMMED = 0.5  # a view with less light than this share of the brightest view's is blocked


@dataclass(frozen=True)
class Probe:
    """One target and what became of it.

    Parameters
    ----------
    distance : float
        From the views, m.
    factor : float
        Distance from the occluder in lengths of the inactive region.
    correlation : float
        Of the recovered picture with what the reference view would see without an occluder.
    views : int
        How many views got light from it.
    picture, truth : (rows, columns) float32 arrays
    """

    distance: float
    factor: float
    correlation: float
    views: int
    picture: Array
    truth: Array

    @property
    def expected_visible(self) -> bool:
        """Whether the formula promises it."""
        return self.factor > 1

    @property
    def recovered(self) -> bool:
        """Whether it was."""
        return self.correlation >= RECOVERED


def probe(occluder: tuple[Body, ...], region: InactiveRegion, factor: float, seed: int = 0) -> Probe:
    """Put a target behind an occluder and try to recover it.

    Parameters
    ----------
    occluder : tuple of Body
    region : InactiveRegion
        Of the occluder's solid part on the axis; it must have an end.
    factor : float
        Where the target stands, in lengths of the region behind the occluder.
    seed : int
        Of the line angles and the photons.
    """
    distance = region.distance + factor * region.length
    width = TARGET_WIDTH * region.width
    rig = _rig(region, distance, width, seed)
    target = Body(Rectangle(width, width), Lambertian(cut_out(letter("L"), plain(0.9))), np.array([0.0, 0.0, distance]))
    gate = _gate(rig, region.distance, distance)
    hidden, free = (
        flash(PulsedScene(bodies, rig.lamps), rig.array, gate) for bodies in ((target, *occluder), (target,))
    )
    picture, views = _recovered(rig, encoded(hidden, rig, gate).values, encoded(free, rig, gate).values.max(), seed)
    truth = free[VIEWS // 2, :, :, 0]
    return Probe(distance, factor, correlation(picture, truth), views, picture, truth)


def _rig(region: InactiveRegion, distance: float, width: float, seed: int) -> Rig:
    """A row of views as long as the baseline, aimed at the target, a lamp beside each."""
    step = region.baseline / (VIEWS - 1)
    shape = (PICTURE_PX, PICTURE_PX)
    array = CameraArray(shape, VIEWS, distance * TARGET_PX / width, step, focus=distance, view_rows=1)
    return Rig(array, np.stack([array.place((v, u)) for v, u in array.views]), Setup("line", 1.0, seed))


def _gate(rig: Rig, occluder: float, target: float) -> Clock:
    """One bin about the target's return that opens halfway from the occluder's."""
    near, far = rig.flight_time(np.array([occluder, target]))
    return Clock(float(far), float(min(far - near, LONGEST_GATE)), 1, PULSE)


def _recovered(rig: Rig, light: Array, brightest: float, seed: int) -> tuple[Array, int]:
    """Recover from noisy readings, blocked views left out; nothing where no view got significant light."""
    camera, per_unit = rig.camera, PHOTONS / brightest
    dark = BACKGROUND / per_unit
    readings = counted(light + dark, per_unit, np.random.default_rng([seed, 3])) - np.float32(dark)
    sizes = [encoder.shape_out[0] for encoder in camera.encoders]
    parts = np.split(readings[:, 0], np.cumsum(sizes)[:-1])
    lights = np.array([part.mean() for part in parts])
    doubt = np.sqrt(BACKGROUND / np.array(sizes)) / per_unit
    seeing = (lights > SIGNIFICANT * doubt) & (lights > DIMMED * lights.max())
    if not seeing.any():
        return np.zeros(rig.array.image_shape, np.float32), 0
    good = np.repeat(seeing, sizes)[:, np.newaxis]
    method = TotalVariation(WEIGHT, ITERATIONS, RELATIVE_CHANGE)
    return method.recover(camera.model(0.0), readings, good).frames[0], int(seeing.sum())
