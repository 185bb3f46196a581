"""What emulated instruments look at: scenes of `tofclip.simulate.simulate_shot`, so that the truth
behind their photons is known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import Float32Array, FloatArray, IndexArray
from tofclip.camera import Camera, SkewSweep
from tofclip.simulate import (
    GroundTruth,
    Instrument,
    Scene,
    StreakDetector,
    make_default_instrument,
    make_default_scene,
    simulate_shot,
)
from tofclip.simulate.patterns import (
    make_letter,
    make_plain_pattern,
    make_stripes,
)
from tofclip.simulate.streak import place_plate
from tofclip.units import SPEED_OF_LIGHT

SENSOR_PIXELS = 256
LENSLET_COUNT = 7
IMAGE_SIZE_PX = 32


@dataclass(frozen=True)
class LineLight:
    """What falls on a line of pixels after each pulse of the laser, in one exposure."""

    # (rows, columns), expected photons, background included; row = instant, column = pixel
    photons: FloatArray
    row_times: FloatArray  # (rows,), middle of each row, s after the pulse
    camera: Camera  # what a calibration would know of the camera
    truth: GroundTruth  # what stands in front of it


@dataclass(frozen=True)
class EmulatedLight:
    """What falls on the screen, and how it is swept."""

    photons: FloatArray  # (rows, columns), expected photons of each pixel in one exposure
    row_times: FloatArray  # (rows,), s
    full_scale: int = 65535  # reading at which a pixel saturates
    seed: int = 0

    def draw_frame(self, number: int) -> NDArray[np.uint16]:
        """Draw picture `number`; the same number gives the same picture."""
        drawn = np.random.default_rng([self.seed, number]).poisson(self.photons)
        return np.minimum(drawn, self.full_scale).astype("<u2")

    @classmethod
    def of(cls, light: LineLight, seed: int) -> EmulatedLight:
        return cls(light.photons, light.row_times, seed=seed)


def make_line_instrument() -> Instrument:
    """Return seven lenslets before a line of 256 pixels; nothing sweeps, nothing is skewed."""
    half = IMAGE_SIZE_PX / 2
    centres = np.linspace(half, SENSOR_PIXELS - half, LENSLET_COUNT)
    still = SkewSweep(centres, np.zeros(LENSLET_COUNT), np.zeros(LENSLET_COUNT))
    demonstration = make_default_instrument()
    camera = Camera(
        centres_px=centres,
        angles=np.radians(np.linspace(-42, 46, LENSLET_COUNT)),
        image_shape=(IMAGE_SIZE_PX, IMAGE_SIZE_PX),
        slit_width_px=SENSOR_PIXELS,
        sweep=still,
        time_zero=demonstration.camera.time_zero,
        pulse_fwhm=demonstration.camera.pulse_fwhm,
        focal_length_px=demonstration.camera.focal_length_px
        * IMAGE_SIZE_PX
        / demonstration.camera.image_shape[0],
    )
    return Instrument(camera, StreakDetector())


def make_line_scene() -> Scene:
    """Return a letter and four plates between 1.7 and 3.2 m, coarse enough for 32 pixels; places and
    sizes are pixels of the demonstration's camera, whose field the line's is.
    """
    bright = make_plain_pattern(0.8)
    return Scene(
        (
            place_plate(make_letter("U", 0.8), (-26, -22), 44, 1.75),
            place_plate(bright, (24, -24), 36, 2.1, yaw=0.15),
            place_plate(make_plain_pattern(0.7), (-24, 26), 34, 2.5),
            place_plate(bright, (24, 24), 40, 2.8, pitch=-0.15),
            place_plate(make_stripes(3, 0.3, 0.9), (0, 0), 100, 3.18),
        )
    )


@lru_cache(maxsize=2)
def simulate_light(scene: str) -> LineLight:
    """Return, always the same object, the light of a scene as addresses call it: ``small``,
    `make_line_scene` on the pixels of `make_line_instrument`; or ``demo``, the demonstration's, whose
    camera lacks sweep and gains.
    """
    if scene == "small":
        seen, instrument = make_line_scene(), make_line_instrument()
    else:
        # Rays at half of its density: nobody has to wait for an instrument that is not there.
        instrument = replace(make_default_instrument(), rays_per_pixel_side=2)
        seen = make_default_scene()
    shot = simulate_shot(seen, instrument, seed=0)  # of which no noise is taken
    photons = shot.signal.astype(np.float64) + instrument.detector.background_photons
    photons.flags.writeable = False  # it is shared by all who look at this scene
    camera = shot.camera
    if scene != "small":
        camera = replace(camera, sweep=None, gains=np.ones(camera.views))
    return LineLight(photons, instrument.detector.row_times, camera, shot.truth)


def render_array_light() -> FloatArray:
    """Return the demonstration's reference view as an array of 512 x 512 pixels sees it, 0..1."""
    return _enlarge(np.nan_to_num(_render_truth().reflectance))


def render_array_delays() -> FloatArray:
    """Return when light comes back to the array's pixels, s; NaN where none does."""
    return _enlarge(_render_truth().range) * 2 / SPEED_OF_LIGHT


def draw_cells(
    random: np.random.Generator, cumulative: FloatArray, total: int, columns: int
) -> tuple[IndexArray, IndexArray]:
    """Draw row and column of so many photons from light added up in raster order."""
    return np.divmod(
        np.searchsorted(cumulative, random.uniform(0, cumulative[-1], total), "right"), columns
    )


@lru_cache(maxsize=1)
def _render_truth() -> GroundTruth:
    """Return what the demonstration's reference view shows."""
    return GroundTruth.from_scene(make_default_scene(), make_default_instrument())


def _enlarge(picture: Float32Array) -> FloatArray:
    """Let 4 x 4 pixels of an array of 512 x 512 see each pixel of the reference view."""
    return np.asarray(np.kron(picture, np.ones((4, 4))), np.float64)
