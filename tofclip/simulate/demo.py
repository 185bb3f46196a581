"""The scene and the instrument of the demonstration.

The instrument is modelled on the seed paper's: seven lenslets whose lines lie between -43 and 48
degrees on a slit of 1344 pixels, 20 ps rows, a 60 ps response, and a sweep that is skewed between
the views by up to 16 rows. Its exposure gives the brightest streak pixel 2000 photons.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tofclip.camera import Camera, SkewSweep
from tofclip.simulate.bodies import Body, Vector
from tofclip.simulate.patterns import (
    Pattern,
    make_checkerboard,
    make_letter,
    make_rings,
    make_stripes,
)
from tofclip.simulate.streak import Instrument, Scene, StreakDetector, make_plate

CENTRES_PX = (147.7, 320.0, 490.2, 664.1, 835.5, 1011.5, 1192.3)
ANGLES_DEG = (-43.3, -25.7, -12.7, 0.6, 22.9, 37.5, 48.0)
GAINS = (0.92, 1.08, 1.02, 0.90, 1.02, 0.96, 1.10)
OFFSETS_BINS = (-16.3, -10.4, -4.8, 0.0, 3.9, 8.2, 12.0)
STRETCHES = (0.009, 0.008, 0.004, 0.0, -0.001, -0.006, -0.006)
TIME_ZERO_S = -10.784e-9
CENTRE_ERROR_PX = 0.4  # the calibration's, by which a recovery starts off
FOCAL_LENGTH_PX = 560.0
LENSLET_PITCH_M = 2.3e-3
FOCUS_DISTANCE_M = 2.3


def make_default_camera() -> Camera:
    """Return the demonstration's camera, with its true gains and sweep."""
    return Camera(
        centres_px=np.array(CENTRES_PX),
        angles=np.radians(ANGLES_DEG),
        image_shape=(128, 128),
        slit_width_px=1344,
        gains=np.array(GAINS),
        sweep=SkewSweep(np.array(CENTRES_PX), np.array(OFFSETS_BINS), np.array(STRETCHES)),
        time_zero=TIME_ZERO_S,
        pulse_fwhm=60e-12,
        focal_length_px=FOCAL_LENGTH_PX,
        lenslet_pitch=LENSLET_PITCH_M,
        focus_distance=FOCUS_DISTANCE_M,
    )


def make_nominal_camera(camera: Camera) -> Camera:
    """Return a camera as focus pictures would give it.

    They cannot know sweep and gains, and know the slit centres to half a pixel only: these have to
    be found from the shot.
    """
    errors_px = CENTRE_ERROR_PX * np.cos(np.pi * np.arange(camera.views))
    return camera.replace(
        sweep=None, gains=np.ones(camera.views), centres_px=camera.centres_px + errors_px
    )


def make_default_instrument() -> Instrument:
    """Return the demonstration's camera with its detector."""
    return Instrument(make_default_camera(), StreakDetector(full_scale_photons=1900.0))


def make_default_scene() -> Scene:
    """Return four cut-out letters and three textured plates between 1.7 and 3.2 m."""
    # pattern, middle and side in pixels, depth in m, yaw and pitch in rad
    plates: tuple[tuple[Pattern, Any, float, float, float, float], ...] = (
        (make_letter("U", 0.8), (-25, -24), 34, 1.75, 0.0, 0.0),
        (make_letter("C", 0.8), (23, -27), 34, 2.05, 0.15, 0.0),
        (make_letter("L", 0.8), (-24, 22), 32, 2.35, 0.0, 0.0),
        (make_letter("A", 0.8), (22, 20), 36, 2.62, 0.0, -0.15),
        (make_checkerboard(4, 0.3, 0.9), (2, -2), 36, 2.85, -0.3, 0.0),
        (make_rings(3, 0.3, 0.9), (-2, 36), 36, 3.0, 0.0, 0.0),
        (make_stripes(4, 0.3, 0.9), (0, 0), 96, 3.18, 0.0, 0.0),
    )
    return Scene(tuple(place_plate(*plate) for plate in plates))


def place_plate(
    pattern: Pattern,
    middle_px: tuple[float, float],
    side_px: float,
    depth: float,
    yaw: float = 0.0,
    pitch: float = 0.0,
    focal_length_px: float = FOCAL_LENGTH_PX,
) -> Body:
    """Square plate that appears around pixel offset `middle_px` (x, y) from the optical axis,
    `side_px` wide.
    """
    pixel = depth / focal_length_px
    centre: Vector = (middle_px[0] * pixel, middle_px[1] * pixel, depth)
    return make_plate(centre, (side_px * pixel, side_px * pixel), pattern, yaw, pitch)
