"""One simulated shot: the streak image with everything that is known about it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera
from tofclip.errors import InputError
from tofclip.shots import Streak
from tofclip.simulate.ground_truth import GroundTruth
from tofclip.simulate.instrument import Instrument
from tofclip.simulate.render import cast_view_rays, render_streak
from tofclip.simulate.scene import Scene
from tofclip.storage import collect_provenance


@dataclass(frozen=True)
class SimulatedShot:
    """A streak image and the truth behind it.

    Parameters
    ----------
    streak : Streak
        Measurements in photons with noise, background and saturation; carries the true camera.
    camera : Camera
        The true camera, with the gains and the sweep that made the picture.
    truth : GroundTruth
        What the reference view sees.
    signal : (rows, columns) float32 array
        Expected signal of each streak pixel without background, photons.
    exposure : float
        Photons for reflectance 1 at 1 m that fills a picture pixel, in a view of gain 1.
    """

    streak: Streak
    camera: Camera
    truth: GroundTruth
    signal: NDArray[np.float32]
    exposure: float


def simulate_shot(scene: Scene, instrument: Instrument, seed: int) -> SimulatedShot:
    """Take one shot of `scene`.

    Parameters
    ----------
    scene : Scene
    instrument : Instrument
    seed : int
        Of the photon noise; the same seed gives the same shot.

    Returns
    -------
    SimulatedShot
        Streak image, camera, ground truth, and expected photons (rows, columns).

    Raises
    ------
    InputError
        No light of the scene reaches the streak image.
    """
    camera, detector = instrument.camera, instrument.detector
    # In relative units: the exposure below decides what a unit is in photons.
    light = np.zeros((detector.rows, camera.slit_width_px))
    for view, position in enumerate(camera.view_positions):
        light += render_streak(cast_view_rays(scene, instrument, float(position)), view, instrument)
    if not light.any():
        raise InputError(
            "no light of the scene reaches the streak image: check positions, number of rows and time zero"
        )
    # Scaled by the brightest pixel, as one opens the iris of a real camera until it almost
    # saturates.
    exposure = detector.peak_photons / float(light.max())
    counts, saturated = detector.expose(exposure * light, np.random.default_rng(seed))
    streak = Streak(
        counts,
        detector.row_times,
        saturated,
        camera=camera,
        source="simulated streak image",
        provenance=collect_provenance(
            {"seed": seed, "peak_photons": detector.peak_photons, "exposure": exposure}
        ),
    )
    return SimulatedShot(
        streak,
        camera,
        GroundTruth.from_scene(scene, instrument),
        (exposure * light).astype(np.float32),
        exposure,
    )
