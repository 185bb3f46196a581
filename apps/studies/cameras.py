"""Cameras beside each other: coded lines for 1D sensors (supplement Note 4, Supp. Fig. 5), of which one
slice is not enough, and what rotating them gains; a recorded hand behind a diffuser, from all and from
few pixels of the sensor (Supp. Fig. 4); what one iteration costs (Table 1).
"""

from __future__ import annotations

import math
import timeit
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from apps.studies.cases import Advance, Library, Outcome, Panel, Row, study
from tofclip.arrays import AnyArray, FloatArray
from tofclip.errors import InputError, ShapeError
from tofclip.io.archive import Archive
from tofclip.light_field import LightField
from tofclip.operators import (
    LinearOperator,
    LinearShear,
    PitchedSensor,
    Reshape,
    SliceConvolution,
    SparseMatrix,
    estimate_squared_norm,
)
from tofclip.operators.cameras import CAMERAS, COMPRESSIVE_CAMERAS, LightFieldCamera, MeasuredCamera
from tofclip.operators.convolution import MeasuredPointSpreads, make_coded_line
from tofclip.solvers import (
    Fista,
    LeastSquares,
    NonnegativeTotalVariation,
    TotalVariation,
    relative_residual,
)
from tofclip.solvers.fista import choose_weight
from tofclip.threads import limit_blas_threads, map_parallel

MAX_ANGLE_RAD = np.pi / 4
ITERATIONS, RELATIVE_CHANGE = 800, 1e-5  # of coded lines
SEARCH_ITERATIONS = 60  # of the trials that choose the prior's weight
ROUNDING = 1e-5  # of the largest entry of a model: what the transforms of float32 leave of zeros
HELD_OUT_RUN = 4  # neighbouring measurements left out together by the cross-validation


def make_coded_line_sensors(
    image_shape: tuple[int, int], lines: int, width_px: int, steepest: float, seed: int
) -> list[SliceConvolution]:
    """Build 1D sensors behind m coded lines, each with a code of its own, whose angles run evenly from
    minus `steepest` to this, rad; all are long enough for 45 degrees from all of the picture.
    """
    random = np.random.default_rng(seed)
    spreads = [
        make_coded_line(image_shape, width_px, angle, random)
        for angle in np.linspace(-steepest, steepest, lines)
    ]
    sensor_px = image_shape[0] + image_shape[1]
    return [SliceConvolution(image_shape, spread[np.newaxis], sensor_px) for spread in spreads]


def recover_from_lines(
    light_field: LightField,
    shear: float,
    sensors: Sequence[SliceConvolution],
    weight: float | None = None,
) -> tuple[AnyArray, float]:
    """Measure each view's own picture by a sensor of its own, as an instrument would, and recover the
    picture that is in focus at one depth (supplement Eq. 21). `weight`: of total variation, relative to
    the largest value of A'f, by default from cross-validation; the one that was used is returned too.
    """
    measured = [
        one(picture).ravel() for one, picture in zip(sensors, light_field.pictures, strict=True)
    ]
    measurements = np.concatenate(measured).astype(np.float32)
    model = _tabulate_model(sensors, light_field.views, shear)
    if weight is None:
        trial = TotalVariation(1.0, SEARCH_ITERATIONS, RELATIVE_CHANGE)
        weight = choose_weight(trial, model, measurements, HELD_OUT_RUN).weight
    method = TotalVariation(weight, ITERATIONS, RELATIVE_CHANGE)
    return method.recover(model, measurements[:, np.newaxis]).frames[0], weight


def _tabulate_model(
    sensors: Sequence[SliceConvolution], views: FloatArray, shear: float
) -> SparseMatrix:
    """F(d) as a sparse matrix: the choice of a weight takes thousands of products."""
    import scipy.sparse

    shape = (sensors[0].shape_in[0], sensors[0].shape_in[1])
    pixels = shape[0] * shape[1]
    # The columns of a matrix are the responses to the unit vectors: a point in each pixel.
    points = np.eye(pixels, dtype=np.float32).reshape(*shape, pixels)
    parts = []
    for sensor, (v, u) in zip(sensors, views, strict=True):
        part = sensor(LinearShear(shape, shear, (float(v), float(u)))(points)).reshape(-1, pixels)
        part[abs(part) < ROUNDING * part.max()] = 0
        parts.append(scipy.sparse.csr_array(part))
    matrix = scipy.sparse.csr_array(scipy.sparse.vstack(parts))
    return SparseMatrix(matrix, shape, (matrix.shape[0],))


def measure_lines(
    light_field: LightField, shear: float, seeds: int, lines: tuple[int, float]
) -> tuple[tuple[float, ...], AnyArray]:
    """Recover a light field's picture through ten lines, a view for each, once for each seed of
    their codes: PSNR of each seed, dB, against shift-and-add, and the first seed's picture. `lines`:
    their width, n_p, and the angle up to which they turn to either side, rad.
    """
    from skimage.metrics import peak_signal_noise_ratio

    truth = light_field.refocus(shear)
    shape = (truth.shape[0], truth.shape[1])
    weight, pictures = None, []  # the weight chosen with the first seed is kept
    for seed in range(seeds):
        sensors = make_coded_line_sensors(shape, LINES, *lines, seed)
        picture, weight = recover_from_lines(light_field, shear, sensors, weight)
        pictures.append(picture)
    score = partial(peak_signal_noise_ratio, truth, data_range=float(truth.max()))
    return tuple(float(score(one)) for one in pictures), pictures[0]


WIDTHS_PX = (1, 2, 4, 8, 16, 32, 64)
LINES = 10
LINE_SCENE, LINE_SHEAR = "printed-letters", -0.3
MAX_ANGLES_RAD = {"upright": 0.0, "rotated": MAX_ANGLE_RAD}


@study(
    "fig5",
    title="Ten coded lines, upright and rotated over -45 to 45 degrees",
    note="The paper has a plot: there rotation gains more than 4 dB at every width; here up to 8 px, less at 16 and "
    "32, and it loses at 64, where a line is as wide as the picture. Pictures here are halved to 64 x 64. Each "
    "line measures a view of its own, one of the ten in the middle of the aperture; the truth is shift-and-add of "
    "these views.",
    seconds=60,
    steps=2 * len(WIDTHS_PX),
)
def run_line_rotation(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Recover letters through ten coded lines of several widths, with and without rotation."""
    light_field = halve_pictures(select_views(library.light_field(LINE_SCENE), LINES))
    shear = LINE_SHEAR / 2  # a pixel is twice as wide
    arms = [(name, (width, angle)) for name, angle in MAX_ANGLES_RAD.items() for width in WIDTHS_PX]
    truth = light_field.refocus(shear)
    rows, panels = [], {name: [Panel(f"true; right: {name}", truth)] for name in MAX_ANGLES_RAD}
    measure = partial(measure_lines, light_field, shear, seeds)
    results = map_parallel(measure, [lines for _, lines in arms])
    for (name, (width, _)), (psnr_db, picture) in zip(arms, results, strict=True):
        rows.append(Row((name, str(width)), psnr_db))
        panels[name].append(Panel(f"{width} px wide\n{psnr_db[0]:.1f} dB", picture))
        advance(seeds)
    return Outcome(("lines", "N_p, px"), "PSNR, dB", rows, list(panels.values()))


def select_views(light_field: LightField, count: int) -> LightField:
    """Return the `count` views nearest to the middle of the aperture."""
    nearest = np.argsort((light_field.views**2).sum(axis=1), kind="stable")[:count]
    return LightField(light_field.pictures[nearest], light_field.views[nearest])


def halve_pictures(light_field: LightField) -> LightField:
    """Return the light field with pixels twice as wide, the brightest of them 1."""
    from skimage.transform import downscale_local_mean

    halved = downscale_local_mean(light_field.pictures, (1, 2, 2))
    return LightField((halved / halved.max()).astype(np.float32), light_field.views)


HAND_WEIGHT = 1e-4  # relative to the largest A'f; ten times less lowers the residual by a tenth
HAND_ITERATIONS = 200


@dataclass(frozen=True)
class DiffuserRecording:
    """What a diffuser put on an area sensor, and what it does to a point source."""

    point_spread: FloatArray  # (rows, columns), background taken off
    measurements: FloatArray  # (rows, columns), background taken off; any scale

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


def read_diffuser_recording(path: str | Path) -> DiffuserRecording:
    """Read an ``.npz`` of `psf` and `raw`, (rows, columns) in counts, and a number `background`."""
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
    recording: DiffuserRecording, pitch_px: int, iterations: int = HAND_ITERATIONS
) -> tuple[AnyArray, float]:
    """Recover the scene with nonnegative total variation from every n-th pixel of either axis; an
    iteration takes 16 ms for a sensor of 300 x 400 pixels on one core. Returns the scene (2 rows,
    2 columns), since a PSF as large as the sensor brings light from there, and ``|A h - f| / |f|``
    over the measurements that were used.
    """
    model = build_diffuser_model(recording, pitch_px)
    every_nth = recording.measurements[::pitch_px, ::pitch_px]
    measurements = (every_nth / recording.measurements.max()).astype(np.float32).reshape(-1, 1)
    frames = TotalVariation(HAND_WEIGHT, iterations).recover(model, measurements).frames
    return frames[0], relative_residual(model, frames, measurements)


RECORDING = "diffusercam/psf_hand_300x400.npz"
PITCHES_PX = (1, 2, 3)
DISPLAY_THRESHOLD = 0.05  # of the brightest: where the picture is cut off


@study(
    "fig4d",
    title="A hand behind the diffuser of DiffuserCam, recorded",
    note="The paper shows its slanted target, of which no recording is at hand; this is another one from the same "
    "camera. The true scene is not known, so the figure is what the picture leaves unexplained of the measurements.",
    weight=f"fixed at {HAND_WEIGHT:g}; ten times less lowers the residual by a tenth",
    seconds=10,
    steps=len(PITCHES_PX),
    seeded=False,
    recording=RECORDING,
)
def run_lensless_hand(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Recover the scene from every, every second and every third pixel; nothing is random."""
    recording = read_diffuser_recording(library.recording(RECORDING))
    recoveries = []
    for pitch in PITCHES_PX:
        recoveries.append(recover_diffuser_scene(recording, pitch))
        advance(1)
    whole = recoveries[0][0]
    bright = np.nonzero(whole > DISPLAY_THRESHOLD * whole.max())
    window = tuple(slice(axis.min(), axis.max() + 1) for axis in bright)
    rows, line = [], []
    for pitch, (scene, residual) in zip(PITCHES_PX, recoveries, strict=True):
        rows.append(Row((str(pitch),), (100 * residual,)))
        line.append(Panel(f"pitch {pitch} px\n{100 * residual:.2f} %", scene[window]))
    return Outcome(("every n-th pixel",), "relative residual, %", rows, [line])


TV_WEIGHT = 1e-2  # relative to the largest A'f; what an iteration costs does not depend on it
NORM_ITERATIONS = 10
WHOLE, PICTURE = "light field", "refocused picture"


class IterationCost(NamedTuple):
    """One row of Table 1, with what was measured."""

    method: str
    recovers: str  # `WHOLE` or `PICTURE`
    measurements: int
    unknowns: int
    # of one iteration as the paper has it: N pixels on a side, n_a views on a side, m measurements,
    # r exposures, k operations of the prior for each unknown
    complexity: str
    # of one whole iteration: model, prior and bookkeeping; the median of the repeats
    seconds: float


def measure_iteration_costs(
    light_field: LightField,
    shear: float,
    exposures: int = 8,
    sampling_ratio: float = 0.5,
    repeats: int = 5,
) -> list[IterationCost]:
    """Time one iteration of every method of Table 1: FISTA with total variation for all of them
    alike. `shear`, `sampling_ratio`: of CLIP; `exposures`: r, of Ashok's and Babacan's methods.
    """
    views = [(v, u) for v, u in light_field.views.tolist()]
    shape = (light_field.pictures.shape[1], light_field.pictures.shape[2])
    line, pixel = (
        CAMERAS[name](shape, views, sampling_ratio, 0) for name in ("line", "single-pixel")
    )
    masks = {
        name: kind(shape, views, 1 if name == "marwah" else exposures, 0)
        for name, kind in COMPRESSIVE_CAMERAS.items()
    }
    diffuser = CAMERAS["diffuser"](shape, views, 1.0, 0)
    methods: list[tuple[str, LightFieldCamera, str, str]] = [
        ("Ashok", masks["ashok"], WHOLE, "(2r + k) n_a^2 N^2"),
        ("Babacan", masks["babacan"], WHOLE, "(2r + k) n_a^2 N^2"),
        ("Marwah", masks["marwah"], WHOLE, "(2 + k) n_a^2 N^2"),
        ("Cai, Antipa", diffuser, WHOLE, "(4 log N + k n_a^2) N^2"),
        ("CLIP-1D", line, WHOLE, "(2m + k n_a^2) N^2"),
        ("CLIP-0D", pixel, WHOLE, "(2m + k n_a^2) N^2"),
        ("CLIP-1D", line, PICTURE, "(2m + 2n_a^2 + k) N^2"),
        ("CLIP-0D", pixel, PICTURE, "(2m + 2n_a^2 + k) N^2"),
    ]
    costs = []
    with limit_blas_threads():  # all methods on one core
        for name, camera, recovers, complexity in methods:
            seen = light_field.pictures[list(camera.used_views)]
            whole, model = camera.light_field_model(), camera.model(shear)
            measurements = whole(seen)[:, np.newaxis]
            if recovers == WHOLE:  # its views one below the other: priors take one picture
                count, rows, columns = whole.shape_in
                model = whole @ Reshape((count * rows, columns), whole.shape_in)
            weight = TV_WEIGHT * float(model.adjoint(measurements).max())
            # The power iteration approaches the norm from below, hence the margin.
            step = 1 / (1.02 * estimate_squared_norm(model, NORM_ITERATIONS))
            prior = NonnegativeTotalVariation(weight)
            solver = Fista(model, LeastSquares(measurements), prior, step, 1)
            numbers = (measurements.size, math.prod(model.shape_in))
            # The first run fills caches and compiles; it does not count.
            seconds = np.median(timeit.repeat(solver.step, number=1, repeat=repeats + 1)[1:])
            costs.append(IterationCost(name, recovers, *numbers, complexity, seconds))
    return costs


SCENE, SHEAR = "letters", -0.4


@study(
    "table1",
    title="What an iteration costs",
    note="The paper gives the operations; seconds are measured here, on one core, and depend on the machine.",
    weight=f"fixed at {TV_WEIGHT:g}; the cost of an iteration does not depend on it",
    seconds=5,
    steps=1,
    seeded=False,
)
def run_iteration_table(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Time every method; the repeats stand in for seeds."""
    costs = measure_iteration_costs(library.light_field(SCENE), SHEAR, repeats=2 * seeds)
    advance(1)
    columns = ("method", "recovers", "measurements", "unknowns", "operations")
    rows = [Row(tuple(map(str, cost[:5])), (1e3 * cost.seconds,)) for cost in costs]
    panel = Panel(f"{SCENE}, s = {SHEAR:g}", library.light_field(SCENE).refocus(SHEAR))
    return Outcome(columns, "ms per iteration", rows, [[panel]])
