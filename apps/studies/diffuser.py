"""A recorded hand behind a diffuser, from all and from few pixels of the sensor (Supp. Fig. 4)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apps.studies.cases import Advance, Library, Outcome, Panel, Row, study
from tofclip.errors import InputError, ShapeError
from tofclip.io.archive import Archive
from tofclip.operators import LinearOperator, PitchedSensor
from tofclip.operators.cameras import MeasuredCamera
from tofclip.operators.convolution import MeasuredPointSpreads
from tofclip.solvers import TotalVariation, relative_residual

TV_WEIGHT = 1e-4  # relative to the largest A'f; ten times less lowers the residual by a tenth
ITERATIONS = 200


@dataclass(frozen=True)
class DiffuserRecording:
    """What a diffuser put on an area sensor, and what it does to a point source."""

    point_spread: NDArray[np.float64]  # (rows, columns), background taken off
    measurements: NDArray[np.float64]  # (rows, columns), background taken off; any scale

    def __post_init__(self) -> None:
        if self.point_spread.ndim != 2 or self.measurements.shape != self.point_spread.shape:
            raise ShapeError(
                "the measurements",
                f"{self.point_spread.shape} like the PSF",
                self.measurements.shape,
            )
        if not (np.all(np.isfinite(self.measurements)) and self.measurements.max() > 0):
            raise InputError(
                "the measurements must be finite and show something; check the background"
            )


@dataclass(frozen=True)
class DiffuserRecovery:
    """The scene behind a recording."""

    scene: NDArray[Any]  # (2 rows, 2 columns): a PSF as large as the sensor brings light from there
    pitch_px: int  # every so manieth pixel of either axis was used
    relative_residual: float  # ``|A h - f| / |f|`` over the measurements that were used


def read_diffuser_recording(path: str | Path) -> DiffuserRecording:
    """Read an ``.npz`` with `psf` and `raw`, both (rows, columns) in counts, and one number
    `background`.
    """
    archive = Archive(path)
    background = float(archive.finite_array("background"))
    spread, measurements = (
        # Counts below the background are noise; light is not negative.
        np.clip(archive.finite_array(name, None, None) - background, 0, None)
        for name in ("psf", "raw")
    )
    return DiffuserRecording(spread, measurements)


def build_diffuser_model(recording: DiffuserRecording, pitch_px: int) -> LinearOperator:
    """Return the map from the scene, twice as high and wide as the sensor, to every n-th pixel."""
    rows, columns = recording.measurements.shape
    measured = MeasuredPointSpreads(recording.point_spread[np.newaxis], [0.0])
    sensor = PitchedSensor((rows, columns), (pitch_px, pitch_px))
    # light from beside the sensor's field falls on it too
    return MeasuredCamera((2 * rows, 2 * columns), measured, sensor).model(0.0)


def recover_diffuser_scene(
    recording: DiffuserRecording, pitch_px: int, iterations: int = ITERATIONS
) -> DiffuserRecovery:
    """Recover the scene with nonnegative total variation from every n-th pixel of either axis; an
    iteration takes 16 ms for a sensor of 300 x 400 pixels on one core.
    """
    model = build_diffuser_model(recording, pitch_px)
    every_nth = recording.measurements[::pitch_px, ::pitch_px]
    measurements = (every_nth / recording.measurements.max()).astype(np.float32).reshape(-1, 1)
    frames = TotalVariation(TV_WEIGHT, iterations).recover(model, measurements).frames
    return DiffuserRecovery(frames[0], pitch_px, relative_residual(model, frames, measurements))


RECORDING = "diffusercam/psf_hand_300x400.npz"
PITCHES_PX = (1, 2, 3)
DISPLAY_THRESHOLD = 0.05  # of the brightest: where the picture is cut off


@study(
    "fig4d",
    title="A hand behind the diffuser of DiffuserCam, recorded",
    note="The paper shows its slanted target, of which no recording is at hand; this is another one from the same "
    "camera. The true scene is not known, so the figure is what the picture leaves unexplained of the measurements.",
    weight=f"fixed at {TV_WEIGHT:g}; ten times less lowers the residual by a tenth",
    seconds=10,
    steps=len(PITCHES_PX),
    seeded=False,
    recording=RECORDING,
)
def run_lensless_hand(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Recover the scene from every pixel, every second and every third on either axis; nothing here
    is random.
    """
    recording = read_diffuser_recording(library.recording(RECORDING))
    recoveries = []
    for pitch in PITCHES_PX:
        recoveries.append(recover_diffuser_scene(recording, pitch))
        advance(1)
    bright = np.nonzero(recoveries[0].scene > DISPLAY_THRESHOLD * recoveries[0].scene.max())
    window = tuple(slice(axis.min(), axis.max() + 1) for axis in bright)
    rows, line = [], []
    for one in recoveries:
        percent = 100 * one.relative_residual
        rows.append(Row((str(one.pitch_px),), (percent,)))
        line.append(Panel(f"every {one.pitch_px}. pixel\n{percent:.2f} %", one.scene[window]))
    return Outcome(("every n-th pixel",), "relative residual, %", rows, [line])
