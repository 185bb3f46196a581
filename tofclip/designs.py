"""A CLIP instrument on paper: what its views see, what they leave undetermined, and how well it will
measure brightness and range.

Every figure is that of the regularised linear inverse, ``h = A' (A A' + mu I)^-1 f`` (method
"linear"), of which all is known beforehand: with R for the matrix before f, a picture errs by the
bias ``(R A - 1) h`` and by noise of covariance ``R C R'``, C that of the photons. That is the
Cramer-Rao bound of all estimates with this bias. Methods with a prior on pictures do better, by an
amount that only the scene can tell. `predict_accuracy` computes this from the operator; `try_out`
draws shots with the ray caster, which shares no code with the operator, and recovers them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from tofclip.arrays import BoolArray, Float32Array, FloatArray, IndexArray
from tofclip.camera import measure
from tofclip.design_description import SCENES, Design, make_scene
from tofclip.errors import InputError, require
from tofclip.lidar import Pulse, depth
from tofclip.light_field.views import CameraSetup, ClipMeasurement
from tofclip.notebook import plot_picture
from tofclip.occlusion import InactiveRegion
from tofclip.operators import LineProjection
from tofclip.shots import Frames, Streak
from tofclip.simulate import GroundTruth, Scene, render_true_frames, simulate_shot
from tofclip.simulate.streak import MIN_REFLECTANCE
from tofclip.storage import collect_provenance
from tofclip.threads import limit_blas_threads
from tofclip.units import MAD_TO_SIGMA, MILLIMETRE, PICOSECOND, SPEED_OF_LIGHT

__all__ = ["Accuracy", "Design", "DesignReport", "Sight", "design"]

MAX_SAMPLED_PIXELS = 1500  # of which ranges are predicted: each costs a row of the inverse
BYTES_PER_READING = 2
FIT_STEPS = 6  # of Gauss and Newton, after which a fit stands still


@dataclass(frozen=True)
class Sight:
    """What the views determine of a picture at one shear; maps are (rows, columns)."""

    singular_values: FloatArray  #: (readings,), of W A, falling
    least: float  #: the one of which the linear inverse returns half, sqrt(mu)
    undetermined: float  #: share of the picture's dimensions of which less is returned
    by_pixel: FloatArray  #: part of a point's energy there that is undetermined
    #: the same of waves, frequency 0 in the middle: what is undetermined there shows as rays
    by_frequency: FloatArray
    points: FloatArray  #: what the linear inverse makes of points


def analyse_sight(design: Design, shear: float = 0.0) -> Sight:
    """Decompose a design's operator; see `Sight`."""
    matrix, shape = design.matrix(shear).astype(np.float64), design.camera.image_shape
    if design.encoder is not None:
        matrix = design.weights @ matrix
    gram = matrix @ matrix.T
    eigenvalues, vectors = np.linalg.eigh(gram.toarray() if scipy.sparse.issparse(gram) else gram)
    eigenvalues = np.maximum(eigenvalues, 0)
    mu = design.damping * eigenvalues[-1]
    known = eigenvalues > mu
    basis = (matrix.T @ vectors[:, known] / np.sqrt(eigenvalues[known])).reshape(*shape, -1)
    waves = np.zeros(shape)
    for part in np.array_split(np.arange(basis.shape[-1]), 1 + basis.shape[-1] // 64):
        spectra = np.fft.fft2(basis[..., part], axes=(0, 1), norm="ortho")
        waves += np.sum(np.abs(spectra) ** 2, axis=-1)
    points = np.zeros(shape)
    points[shape[0] // 4 :: shape[0] // 2, shape[1] // 4 :: shape[1] // 2] = 1
    seen = vectors.T @ (matrix @ points.ravel())
    answer = matrix.T @ (vectors @ (seen / (eigenvalues + mu)))
    return Sight(
        np.sqrt(eigenvalues[::-1]),
        float(np.sqrt(mu)),
        1 - float(known.sum()) / points.size,
        1 - np.sum(basis**2, axis=-1),
        np.fft.fftshift(1 - waves),
        answer.reshape(shape),
    )


@dataclass(frozen=True)
class Accuracy:
    """How well a scene is measured, predicted or found in simulated shots; maps are (rows, columns).
    Errors of the picture of all light are squared, over the variance of the truth.
    """

    picture_bias: float  #: what noiseless shots err by
    picture_noise: float  #: what the noise adds
    range_deviation: FloatArray  #: from shot to shot, m; NaN where no surface is asked for
    range_offset: FloatArray  #: mean error, m: the rays of other pixels
    picture: FloatArray  #: the mean, photons
    seconds: float = float("nan")  #: of one shot on this machine, from readings to ranges

    @property
    def picture_error(self) -> float:
        """Of one shot (NMSE)."""
        return self.picture_bias + self.picture_noise

    @property
    def median_deviation(self) -> float:
        """Of the pixels that have one, m."""
        return float(np.nanmedian(self.range_deviation))

    @property
    def median_offset(self) -> float:
        """Of the sizes of the mean errors, m."""
        return float(np.nanmedian(np.abs(self.range_offset)))


def predict_accuracy(design: Design, scene: Scene) -> Accuracy:
    """Compute bias and noise of picture and ranges from the operator alone; no chance is involved."""
    frames = render_true_frames(scene, design.instrument)
    target, pixels = _choose_pixels(design, scene)
    times = 2 * target.ravel()[pixels] / SPEED_OF_LIGHT
    width = design.bin_width_ps * PICOSECOND
    reach = 2 * np.hypot(design.pulse_ps * PICOSECOND, width)
    flat = frames.values.reshape(len(frames.values), -1).T
    segments = design.plan_segments(frames)
    matrices = [design.matrix(one.shear) for one in segments]
    # the brightest reading at an exposure of 1
    pairs = list(zip(segments, matrices, strict=True))
    peak = max(float((matrix @ flat[:, one.frames]).max()) for one, matrix in pairs)
    scale = design.photons / peak
    mean, noise = np.zeros(flat.shape[0]), np.zeros(flat.shape[0])
    expected = np.zeros((pixels.size, flat.shape[1]), np.float32)
    variance = np.zeros_like(expected)
    for segment, matrix in pairs:
        weighted = matrix if design.encoder is None else design.weights @ matrix
        linear = weighted.T @ (design.prepare(segment.shear).inverse_gram @ design.weights)
        light = scale * (matrix @ flat[:, segment.frames])
        counts = light + design.background_photons
        mean += linear @ light.sum(axis=1)
        noise += linear**2 @ counts.sum(axis=1)
        at = frames.times[segment.frames]
        near = np.flatnonzero((times > at[0] - reach) & (times < at[-1] + reach))
        rows = linear[pixels[near]]
        expected[near, segment.frames] = rows @ light
        variance[near, segment.frames] = rows**2 @ counts
    truth = scale * flat.sum(axis=1)
    spread = np.sum((truth - truth.mean()) ** 2)
    fitted = _fit_pulses(frames.times, times, expected, variance, design)
    bias, chance = np.sum((mean - truth) ** 2) / spread, noise.sum() / spread
    deviation, offset = (_map(SPEED_OF_LIGHT / 2 * part, pixels, target.shape) for part in fitted)
    picture = mean.reshape(target.shape)
    return Accuracy(float(bias), float(chance), deviation, offset, picture)


def _map(values: FloatArray, pixels: IndexArray, shape: tuple[int, ...]) -> FloatArray:
    """A picture of the values of some pixels, NaN elsewhere."""
    picture = np.full(shape, np.nan)
    picture.ravel()[pixels] = values
    return picture


def _choose_pixels(design: Design, scene: Scene) -> tuple[FloatArray, IndexArray]:
    """True ranges, and the pixels whose ranges are asked for, spread evenly."""
    truth = GroundTruth.from_scene(scene, design.instrument)
    # in a small picture no pixel has neighbours on its own surface all around
    asked = truth.target if truth.target.any() else truth.reflectance >= MIN_REFLECTANCE
    pixels = np.flatnonzero(asked & np.isfinite(truth.range))
    step = -(-pixels.size // MAX_SAMPLED_PIXELS)
    return truth.range.astype(np.float64), pixels[::step]


def _fit_pulses(
    at: FloatArray, times: FloatArray, expected: Any, variance: Any, design: Design
) -> tuple[FloatArray, FloatArray]:
    """Deviation and mean error of arrivals that least squares find in traces (pixels, time), s."""
    width = design.bin_width_ps * PICOSECOND
    pulse = Pulse.gaussian(max(design.pulse_ps * PICOSECOND, 2 * width))
    arrival = times.copy()
    for _ in range(FIT_STEPS):
        shape = pulse(at - arrival[:, np.newaxis])
        slope = -pulse.slope_at(at - arrival[:, np.newaxis])
        height = np.maximum(np.sum(shape * expected, axis=1) / np.sum(shape**2, axis=1), 1e-9)
        left = expected - height[:, np.newaxis] * shape
        information = height * np.sum(slope**2, axis=1)
        step = np.sum(slope * left, axis=1) / information
        arrival += np.clip(step, -pulse.fwhm / 4, pulse.fwhm / 4)
    deviation = np.sqrt(np.sum(slope**2 * variance, axis=1)) / information
    return deviation, arrival - times


def draw_shots(
    design: Design, scene: Scene, shots: int, seed: int
) -> tuple[float, Iterator[tuple[Float32Array, BoolArray]]]:
    """Return the exposure and, shot by shot, noisy readings (bins, readings) and the saturated."""
    detector, noise = design.instrument.detector, np.random.default_rng(seed)
    if design.encoder is None:
        shot = simulate_shot(scene, design.instrument, seed)
        exposure, signal = shot.exposure, shot.signal.astype(np.float64)
    else:
        views = [
            render_true_frames(scene, design.instrument, 1.0, float(u)).values
            for u in design.camera.view_positions[list(design.encoder.used_views)]
        ]
        light = design.encoder.light_field_model()(np.moveaxis(np.stack(views), 1, -1)).T
        exposure = float(design.photons / light.max())
        signal = exposure * np.maximum(light, 0).astype(np.float64)
    return exposure, (detector.expose(signal, noise) for _ in range(shots))


def take_shots(
    design: Design, scene: Scene, shots: int, seed: int
) -> tuple[float, Iterator[Streak | ClipMeasurement]]:
    """Return the exposure and shots as files hold them: streak images, or of 2d and 0d sensors readings
    summed over all instants.
    """
    exposure, drawn = draw_shots(design, scene, shots, seed)
    camera, past = design.camera, collect_provenance({**asdict(design), "seed": seed})

    def pack(counts: Any, saturated: Any) -> Streak | ClipMeasurement:
        if design.encoder is None:
            at = design.instrument.detector.row_times
            source = "simulated streak image"
            return Streak(counts, at, saturated, camera=camera, source=source, provenance=past)
        setup = CameraSetup(design.encoder.name, design.sampling_ratio, 0)
        views = np.array(design.encoder.views)
        values = (counts - np.float32(design.background_photons)).sum(axis=0)
        return ClipMeasurement(values, views, camera.image_shape, setup, 1.0, past)

    return exposure, (pack(*one) for one in drawn)


def try_out(design: Design, scene: Scene, shots: int = 20, seed: int = 0) -> Accuracy:
    """Simulate shots, recover each by the linear inverse at the shear of its range, find the returns,
    and compare with the truth.
    """
    exposure, drawn = draw_shots(design, scene, shots, seed)
    frames = render_true_frames(scene, design.instrument, exposure)
    true_ranges, pixels = _choose_pixels(design, scene)
    truth = frames.values.sum(axis=0, dtype=np.float64)
    segments = design.plan_segments(frames)
    inverses = [design.prepare(one.shear) for one in segments]
    shears = np.repeat([one.shear for one in segments], [one.size for one in segments])
    pictures, ranges, seconds = [], [], []
    for counts, saturated in drawn:
        started = time.perf_counter()
        if design.encoder is None:
            values = measure(counts, saturated, design.camera).values
        else:
            values = design.weights @ (counts.T - np.float32(design.background_photons))
        cube = np.empty_like(frames.values)
        for segment, inverse in zip(segments, inverses, strict=True):
            cube[segment.frames] = inverse.recover(values[:, segment.frames]).frames
        found = depth(Frames(cube, frames.times, design.camera, shears=shears))
        ranges.append(found.image("range").ravel()[pixels])
        seconds.append(time.perf_counter() - started)
        pictures.append(cube.sum(axis=0, dtype=np.float64))
    mean = np.mean(pictures, axis=0)
    spread = np.sum((truth - truth.mean()) ** 2)
    # the mean of a few shots has a share of their noise, which is taken off its error
    scatter = np.sum(np.var(pictures, axis=0, ddof=min(1, shots - 1))) / spread
    bias = float(np.sum((mean - truth) ** 2) / spread - scatter / shots)
    middle = np.nanmedian(ranges, axis=0)
    # robust: a shot in which another return is the stronger one does not count
    away = np.nanmedian(np.abs(np.array(ranges) - middle), axis=0)
    deviation = _map(MAD_TO_SIGMA * shots / (shots - 0.8) * away, pixels, truth.shape)
    offset = _map(middle - true_ranges.ravel()[pixels], pixels, truth.shape)
    return Accuracy(bias, float(scatter), deviation, offset, mean, float(np.median(seconds)))


@dataclass(frozen=True)
class DesignReport:
    """What is known of an instrument before it is built; `design` makes it."""

    design: Design
    sight: Sight  #: at the middle of its range
    #: By name, with units at the end: ``field_of_view_deg`` (down, across); ``overlap_near`` and
    #: ``overlap_far``, share of the picture's width that all views have in common;
    #: ``sensor_overlap``, share of the slit that several views use; ``undetermined``;
    #: ``refocus_nearest_m``, from where on the outermost views have half of their field in common;
    #: ``refocus_planes``, distances that the views' parallax tells apart between near and far;
    #: ``inactive_m`` behind the occluder; ``bytes_per_second``
    figures: Mapping[str, Any]
    predicted: Mapping[str, Accuracy]  #: by the names of scenes
    simulated: Mapping[str, Accuracy]  #: the same

    def __repr__(self) -> str:
        known = self.design
        errors = ", ".join(
            f"{name} {one.picture_error:.3g}" for name, one in self.predicted.items()
        )
        return (
            f"DesignReport({known.sensor}, {known.views} views, {100 * self.sight.undetermined:.1f} % of the picture "
            f"undetermined, picture errors: {errors})"
        )

    def plot(self, ax: Any = None) -> Any:
        """Draw what the views leave undetermined of waves: rays run across the dark sectors."""
        title = f"undetermined: {100 * self.sight.undetermined:.1f} %"
        return plot_picture(self.sight.by_frequency, title, ax, unit="share")


def design(
    settings: str | Path | Mapping[str, Any] | Design, shots: int = 0, seed: int = 0
) -> DesignReport:
    """Tell what an instrument will see, before it is built.

    Parameters
    ----------
    settings : path-like, mapping or Design
        A TOML file or its keys; see `Design`.
    shots : int
        Simulated ones of each scene beside the prediction; 0 or at least 2.
    seed : int
        Of their photons.

    Raises
    ------
    InputError, FileFormatError
        A description of no instrument.

    Examples
    --------
    >>> import tofclip
    >>> report = tofclip.design({"rows_px": 32, "columns_px": 32, "focal_length_px": 140.0})
    >>> 0.5 < report.sight.undetermined < 0.9
    True
    """
    if isinstance(settings, Design):
        known = settings
    else:
        known = Design.of(settings) if isinstance(settings, Mapping) else Design.load(settings)
    require(
        shots != 1 and shots >= 0,
        f"a deviation takes two shots or more, or 0 for none; got {shots}",
    )
    scenes = {name: make_scene(name, known) for name in SCENES}
    sight = analyse_sight(known, float(known.camera.shear_at((known.near_m + known.far_m) / 2)))
    return DesignReport(
        known,
        sight,
        _list_figures(known) | {"undetermined": sight.undetermined},
        {name: predict_accuracy(known, scene) for name, scene in scenes.items()},
        {name: try_out(known, scene, shots, seed) for name, scene in scenes.items() if shots},
    )


def _list_figures(known: Design) -> dict[str, Any]:
    camera, columns = known.camera, known.columns_px
    positions = camera.view_positions
    near, far = camera.shear_at([known.near_m, known.far_m])
    fields_deg = 2 * np.degrees(np.arctan(np.array(camera.image_shape) / 2 / known.focal_length_px))
    figures: dict[str, Any] = {"field_of_view_deg": fields_deg.tolist()}
    for name, shear in (("near", near), ("far", far)):
        figures[f"overlap_{name}"] = float(max(0, 1 - abs(shear) * np.ptp(positions) / columns))
    readings = camera.slit_width_px if known.encoder is None else known.encoder.measurements
    # what of u is no translation of the picture
    down, across = camera.displacement_per_shear
    rest = positions - across + down * np.tan(camera.angles)
    if known.encoder is None:
        lit = np.stack([one > 0 for one in list_footprints(known)])
        figures["sensor_overlap"] = float(np.mean(lit.sum(axis=0) > 1))
    else:
        rest = positions
    # pixels between the outermost views, for each 1/m of nearness
    parallax = known.focal_length_px * camera.lenslet_pitch * np.ptp(positions)
    if parallax:
        nearness = 1 / known.focus_distance_m + columns / 2 / parallax
        figures["refocus_nearest_m"] = float(1 / nearness)
    figures["refocus_planes"] = float(1 + abs(far - near) * np.ptp(rest)) if parallax else 1.0
    if known.occluder_mm and known.occluder_distance_m and parallax:
        figures["inactive_m"] = find_inactive_region(known).length
    figures["readings"] = readings
    rate = readings * known.bins * known.shots_per_second * BYTES_PER_READING
    figures["bytes_per_second"] = float(rate)
    return figures


def find_inactive_region(known: Design) -> InactiveRegion:
    """Return what the design's occluder hides from all of its views."""
    baseline = float(np.ptp(known.camera.view_positions)) * known.camera.lenslet_pitch
    return InactiveRegion(baseline, known.occluder_mm * MILLIMETRE, known.occluder_distance_m)


def list_footprints(known: Design) -> list[FloatArray]:
    """Return the light of an even picture on the slit, view by view, (readings,) each."""
    camera, even = known.camera, np.ones(known.camera.image_shape)
    parts = zip(camera.centres_px, camera.angles, strict=True)
    views = (
        LineProjection(camera.image_shape, camera.slit_width_px, [centre], [angle], [1.0])
        for centre, angle in parts
    )
    return [np.asarray(view(even), np.float64) for view in views]


SMALL_SIDE_PX = 24  # angles do not depend on the scale: pictures are scaled down to try them
CANDIDATE_ANGLES = 13
CORRELATION_LENGTH = 0.15  # of random pictures, in parts of the picture
USUAL_CONTRAST = 0.5  # their deviation, relative to their mean
MAX_ROUNDS = 4


@limit_blas_threads()
def optimise_angles(known: Design) -> Design:
    """Return a design whose angles, up to `max_angle_deg`, leave the least error that a random
    picture is expected to have, at the near and the far end of the range: bias and noise of the
    linear inverse, for pictures of exponential correlation. Scenes take no part; `InputError` for a
    sensor without lines.
    """
    if known.encoder is not None:
        raise InputError(f"a {known.sensor} sensor has no lines whose angles could be better")
    scale = SMALL_SIDE_PX / max(known.rows_px, known.columns_px)
    rows, columns = (max(1, round(side * scale)) for side in known.camera.image_shape)
    small = replace(
        known,
        rows_px=rows,
        columns_px=columns,
        focal_length_px=known.focal_length_px * scale,
        sensor_px=round(known.camera.slit_width_px * scale),
        centres_px=tuple((known.camera.centres_px * scale).tolist()),
    )
    y, x = np.indices(small.camera.image_shape).reshape(2, -1)
    down, across = abs(y[:, np.newaxis] - y), abs(x[:, np.newaxis] - x)
    length = CORRELATION_LENGTH * SMALL_SIDE_PX
    # half of the light has edges in all directions, half upright and level ones, as what people make
    mixed = np.exp(-np.hypot(down, across) / length) + np.exp(-(down + across) / length)
    covariance = USUAL_CONTRAST**2 / 2 * mixed
    shears = small.camera.shear_at([small.near_m, small.far_m])
    tried: dict[tuple[float, ...], float] = {}

    def expect_error(angles: tuple[float, ...]) -> float:
        if angles not in tried:
            camera = small.camera.replace(angles=np.radians(angles))
            tried[angles] = sum(
                _expect_error(camera.operator(shear, np.float64).matrix, covariance, small)
                for shear in map(float, shears)
            )
        return tried[angles]

    candidates = np.linspace(-known.max_angle_deg, known.max_angle_deg, CANDIDATE_ANGLES).tolist()
    own = tuple(np.degrees(known.camera.angles).tolist())
    even = tuple(np.linspace(candidates[0], candidates[-1], known.views).tolist())
    found = [_descend(expect_error, start, candidates) for start in (own, even)]
    best = min(found, key=expect_error)
    return replace(known, angles_deg=tuple(round(angle, 2) for angle in best))


def _descend(
    expect_error: Callable[[tuple[float, ...]], float],
    angles: tuple[float, ...],
    candidates: list[float],
) -> tuple[float, ...]:
    """Change one angle after the other for the best candidate, until none is better."""
    for _ in range(MAX_ROUNDS):
        before = angles
        for view in range(len(angles)):
            choices = (
                (*angles[:view], angle, *angles[view + 1 :])
                for angle in (angles[view], *candidates)
            )
            angles = min(choices, key=expect_error)
        if angles == before:
            break
    return angles


def _expect_error(matrix: Any, covariance: FloatArray, known: Design) -> float:
    """Expected squared error of a pixel of random pictures with mean 1."""
    gram = (matrix @ matrix.T).toarray()
    mu = known.damping * float(np.linalg.eigvalsh(gram)[-1])
    inverse = np.linalg.inv(gram + mu * np.eye(len(gram)))
    seen = matrix @ covariance  # (readings, pixels)
    spread = np.asarray((matrix @ seen.T).T)
    linear = inverse @ gram
    light = np.asarray(matrix.sum(axis=1)).ravel()
    # half of the brightest reading is what an even picture is expected to bring
    noise = 2 * light.max() * light / known.photons
    bias = (
        np.trace(covariance) - 2 * np.sum(inverse * spread) + np.sum((inverse @ spread) * linear.T)
    )
    variance = np.sum(np.sum(linear * inverse.T, axis=1) * noise)
    return float(bias + variance) / len(covariance)
