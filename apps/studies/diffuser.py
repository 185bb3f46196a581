"""Area sensors behind a diffuser (Supp. Fig. 4): rendered scenes on sparse pixels, and a recorded hand."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apps.studies.cases import Case, Library, solve_cases
from apps.studies.outcome import CROSS_VALIDATED, Advance, Outcome, Panel, Row, Study
from tofclip.errors import InputError, ShapeError
from tofclip.io.archive import Archive
from tofclip.operators import LinearOperator, PitchedSensor
from tofclip.operators.cameras import MeasuredCamera
from tofclip.operators.point_spreads import MeasuredPointSpreads
from tofclip.solvers import TotalVariation, relative_residual

SPARSITIES = (1, 2, 4, 8, 16)
NOISE_FRACTION = 0.025
POSTER_SCENES = ("blocks", "printed-words", "printed-letters")
POSTER_CASES = [
    Case(
        (scene, str(sparsity)),
        f"{scene}:flat",
        "diffuser",
        # Every n-th pixel on either axis.
        1 / sparsity**2,
        0.0,
        white_noise=NOISE_FRACTION,
    )
    for scene in POSTER_SCENES
    for sparsity in SPARSITIES
]


def run_area_sensors(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Recover scenes of three complexities from every n-th sensor pixel on either axis.

    `library`: light fields and recordings by name; `seeds`: repeats with other random numbers;
    `advance`: called with the number of steps just done. Returns A row of figures for each case,
    and the pictures to show.
    """
    solved = solve_cases(POSTER_CASES, library, seeds, advance)
    panels = []
    for first in range(0, len(solved), len(SPARSITIES)):
        line = solved[first : first + len(SPARSITIES)]
        shown = (one.panel(f"every {one.case.labels[1]}. pixel") for one in line)
        panels.append((Panel(f"{line[0].case.labels[0]}\ntrue", line[0].truth), *shown))
    rows = tuple(one.row() for one in solved)
    return Outcome(("scene", "sparsity"), "NMSE, %", rows, tuple(panels))


POSTER_STUDY = Study(
    "fig4",
    (),
    "Sparse area sensors behind a diffuser, 2.5 % white noise",
    "The paper shows pictures only, of flat scenes; these are posters of our own scenes.",
    CROSS_VALIDATED,
    20,
    len(POSTER_CASES),
    run_area_sensors,
)


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

    # (2 rows, 2 columns), twice as high and wide as the sensor: a PSF as large as the sensor brings
    # light from there
    scene: NDArray[Any]
    pitch_px: int  # every so manieth pixel of either axis was used
    relative_residual: float  # ``|A h - f| / |f|`` over the measurements that were used
    iterations: int
    seconds: float


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
    """Return the map from the scene, twice as high and wide as the sensor, to every n-th pixel's
    measurements.

    `recording`: sensor image and measured point-spread function; `pitch_px`: sensor pixels from one
    used pixel to the next. Returns (2 rows, 2 columns) pictures to (measurements,) vectors.
    """
    rows, columns = recording.measurements.shape
    measured = MeasuredPointSpreads(recording.point_spread[np.newaxis], [0.0])
    sensor = PitchedSensor((rows, columns), (pitch_px, pitch_px))
    # light from beside the sensor's field falls on it too
    return MeasuredCamera((2 * rows, 2 * columns), measured, sensor).model(0.0)


def recover_diffuser_scene(
    recording: DiffuserRecording, pitch_px: int, iterations: int = ITERATIONS
) -> DiffuserRecovery:
    """Recover the scene with nonnegative total variation from every n-th pixel of either axis.

    `pitch_px`: 1 for the full measurement; `iterations`: about 16 ms each for a sensor of 300 x 400
    pixels on one core.
    """
    model = build_diffuser_model(recording, pitch_px)
    every_nth = recording.measurements[::pitch_px, ::pitch_px]
    measurements = (every_nth / recording.measurements.max()).astype(np.float32).reshape(-1, 1)
    started = perf_counter()
    result = TotalVariation(TV_WEIGHT, iterations).recover(model, measurements)
    seconds = perf_counter() - started
    residual = relative_residual(model, result.frames, measurements)
    return DiffuserRecovery(result.frames[0], pitch_px, residual, result.iterations, seconds)


RECORDING = "diffusercam/psf_hand_300x400.npz"
PITCHES_PX = (1, 2, 3)
DISPLAY_THRESHOLD = 0.05  # of the brightest: where the picture is cut off


def run_lensless_hand(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Recover the scene from every pixel, every second and every third on either axis; nothing here
    is random.

    `library`: light fields and recordings by name; `seeds`: repeats with other random numbers;
    `advance`: called with the number of steps just done. Returns A row of figures for each case,
    and the pictures to show.
    """
    recording = read_diffuser_recording(library.recording(RECORDING))
    recoveries = []
    for pitch in PITCHES_PX:
        recoveries.append(recover_diffuser_scene(recording, pitch))
        advance(1)
    window = _find_bright_part(recoveries[0].scene)
    rows = tuple(Row((str(one.pitch_px),), (100 * one.relative_residual,)) for one in recoveries)
    shown = [
        Panel(f"every {pitch}. pixel\n{100 * one.relative_residual:.2f} %", one.scene[window])
        for pitch, one in zip(PITCHES_PX, recoveries, strict=True)
    ]
    return Outcome(("every n-th pixel",), "relative residual, %", rows, (tuple(shown),))


def _find_bright_part(scene: NDArray[np.float32]) -> tuple[slice, slice]:
    """Return the part of a scene that holds what is bright."""
    rows, columns = np.nonzero(scene > DISPLAY_THRESHOLD * scene.max())
    return slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)


HAND_STUDY = Study(
    "fig4d",
    (),
    "A hand behind the diffuser of DiffuserCam, recorded",
    "The paper shows its slanted target, of which no recording is at hand; this is another one from the same camera. "
    "The true scene is not known, so the figure is what the picture leaves unexplained of the measurements.",
    f"fixed at {TV_WEIGHT:g}; ten times less lowers the residual by a tenth",
    10,
    len(PITCHES_PX),
    run_lensless_hand,
    seeded=False,
    recording=RECORDING,
)

STUDIES = (POSTER_STUDY, HAND_STUDY)
