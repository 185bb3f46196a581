"""The surface that a picture of few photons shows: neighbours lend each other theirs.

1. Semi-global matching over eight directions finds the instant of each pixel's surface on a coarse
   time axis: the most likely piecewise smooth one (Hirschmueller, IEEE Trans. Pattern Anal. 30,
   328, 2008), with log-matched filter responses as scores.
2. Planes through the neighbours on the same surface, fitted to the likelihood of their photons
   (Fisher scoring), give the instant below a bin and its deviation.

How much neighbours have to agree, how far they reach, the response and the probability of an
outlier come from the data: a part of the photons is held back, and what explains it best counts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from tofclip.camera import Camera
from tofclip.lidar.photons.detector import PhotonDetector
from tofclip.lidar.photons.photon_image import FloatArray, PhotonImage
from tofclip.lidar.photons.response import BinnedResponse, learn_response, measure_pulse_width
from tofclip.lidar.pulse import Pulse
from tofclip.shots import Returns
from tofclip.threads import run_blocks, split_blocks
from tofclip.units import SPEED_OF_LIGHT

HELD_OUT_FRACTION = 0.25
LABELS_PER_WIDTH = 2
"""Coarse bins in the full width of the response."""

MAX_VOLUME_BYTES = 1 << 31
"""Memory of the two volumes (pixels, labels) of float32; a longer axis gets coarser labels."""

SLOPE_COSTS = (1.5, 4.0, 10.0)
"""Log-likelihood that a change of the surface by one label has to bring."""

JUMP_COST_RATIO = 7.0
"""Any larger change costs this many times as much."""

REACHES_PX = (1, 2, 3, 4, 6, 8)
PLANE_ROUNDS = 5
TRIAL_ROUNDS = 3
"""Of a reach that is tried, from the fit of the reach before."""

NESTED_BIAS_RATIO = 4 / 3
"""A curved surface pulls a plane by the square of its reach: what a plane of half the reach differs
by is three quarters of what both miss."""

RESPONSE_ROUNDS = 3
RESPONSE_REACH_PX = 3
MIN_LEARNT_GAIN, MIN_LEARNT_SIGNIFICANCE = 500.0, 5.0
"""Log-likelihood, and its standard deviations, by which a learnt response has to beat a given one;
its free shape alone gains some hundred."""

GATE_WIDTHS = 1.0
"""A neighbour whose surface is further off than this many widths of the response is another's."""

MIN_EXPLAINED_DENSITY = 0.003
"""Of the response's peak: photons where it is brighter belong to the surface."""

MAX_OWN_CHANCE, MAX_POOLED_CHANCE = 0.02, 1e-4
"""That the background alone shows as many photons at a further surface, in the pixel and in the
nine pixels around it."""

TILE_PX = 16
MIN_TILE_SIGNIFICANCE = 5.0
"""Standard deviations above the background at which a tile of the picture says that some surface
lies at an instant."""

SAMPLED_PIXELS = 8192
"""That say what the pixels' background has in common."""

PIXELS_PER_BLOCK, ROWS_PER_BLOCK, DETECTED_PIXELS_PER_BLOCK = 1 << 14, 16, 1 << 10
SIGNAL_POOL_PX = 5
MIN_SIGNAL_PHOTONS = 0.05
BACKGROUND_QUANTILE, BACKGROUND_GROUPS = 0.2, 64
MIN_BACKGROUND_PHOTONS = 1.0
"""Of the whole picture: no background is exactly zero."""

LEARNT_RESPONSE_SIGMA_WIDTHS = 1 / 8
"""Standard deviation of where the surface lies in a response that was learnt from the scene.

Its shape varies from surface to surface with tilt, material and brightness; a response that is
given is taken as exact."""


@dataclass(frozen=True)
class SurfaceImage:
    """A range for every pixel.

    Parameters
    ----------
    range : (rows, columns) float64 array
        Distance for a co-located source, m; the middle of the first bin is range 0. NaN where there
        is none.
    range_sigma : (rows, columns) float64 array
        One standard deviation of the range, m.
    intensity : (rows, columns) float64 array
        Expected photons of the return.
    outlier_probability : (rows, columns) float64 array
        That the return is not of this pixel's surface.
    pulse : Pulse
        The response that was used, as bins show it.
    settings : mapping
        What was chosen from the data, by name.
    further : tuple of SurfaceImage
        Weaker returns of the same pixels, the strongest first; NaN where there is none.
    """

    range: FloatArray
    range_sigma: FloatArray
    intensity: FloatArray
    outlier_probability: FloatArray
    pulse: Pulse
    settings: dict[str, float | str]
    further: tuple[SurfaceImage, ...] = ()

    def to_returns(
        self, focal_length_px: float, provenance: Mapping[str, Any] | None = None
    ) -> Returns:
        """List the pixels with a range, as seen by a pinhole camera.

        Parameters
        ----------
        focal_length_px : float
            Distance of the pinhole from the picture, in pixels; the optical axis meets pixel
            ``(rows // 2, columns // 2)``.
        provenance : mapping, optional
            How they came about.

        Returns
        -------
        tofclip.lidar.Returns
        """
        rows, columns = self.range.shape
        pinhole = Camera(
            np.array([columns / 2]),
            np.zeros(1),
            (rows, columns),
            columns,
            pulse_fwhm=self.pulse.fwhm,
            focal_length_px=focal_length_px,
        )
        layers = [self, *self.further]
        distance = np.stack([layer.range for layer in layers], axis=2).reshape(-1, len(layers))
        order = np.argsort(distance, axis=1)
        pixel, nearness = np.nonzero(np.isfinite(np.take_along_axis(distance, order, axis=1)))
        layer = order[pixel, nearness]
        sigma, signal = (
            np.stack([getattr(one, name) for one in layers], axis=2).reshape(distance.shape)
            for name in ("range_sigma", "intensity")
        )
        found = distance[pixel, layer]
        y, x = np.divmod(pixel, columns)
        return Returns(
            y=y.astype(np.int32),
            x=x.astype(np.int32),
            range=found,
            intensity=(signal[pixel, layer] * found**2).astype(np.float32),
            confidence=sigma[pixel, layer].astype(np.float32),
            return_number=(nearness + 1).astype(np.uint8),
            time=2 * found / SPEED_OF_LIGHT,
            camera=pinhole,
            provenance={} if provenance is None else provenance,
        )


@dataclass(frozen=True)
class LabelAxis:
    """The instants on which a surface is looked for.

    Parameters
    ----------
    coarse : int
        Bins of a coarse one.
    numbers : (labels,) int64 array
        Coarse bins that are labels.
    coarse_bins : int
        Coarse bins of the whole axis.
    """

    coarse: int
    numbers: NDArray[np.int64]
    coarse_bins: int

    def number_events(self, photons: PhotonImage) -> NDArray[np.int64]:
        """Return the coarse bin of each event."""
        return ((photons.bin + 0.5) / self.coarse).astype(np.int64)

    @property
    def places(self) -> NDArray[np.int64]:
        """Label of each coarse bin, or -1."""
        places = np.full(self.coarse_bins, -1)
        places[self.numbers] = np.arange(self.numbers.size)
        return places

    def to_bins(self, label: NDArray[np.int64]) -> FloatArray:
        """Return the instants in the middle of labels, in bins."""
        return np.asarray((self.numbers[label] + 0.5) * self.coarse - 0.5, dtype=np.float64)


@dataclass(frozen=True)
class Scene:
    """What a picture's photons are taken to be made of.

    Parameters
    ----------
    response : BinnedResponse
    background : float
        Photons of a pixel in a bin.
    """

    response: BinnedResponse
    background: float

    def scale(self, fraction: float) -> Scene:
        """Return what remains with a fraction of the photons."""
        return Scene(self.response, self.background * fraction)

    def count_signal(self, photons: PhotonImage) -> float:
        """Mean signal photons of a pixel."""
        mean = photons.photons / (photons.offsets.size - 1)
        return max(mean - self.background * photons.bins, MIN_SIGNAL_PHOTONS)


def estimate_surface(
    photons: PhotonImage,
    pulse: Pulse | None = None,
    learn: bool = True,
    max_returns: int = 1,
    seed: int = 0,
    progress: Callable[[float], object] | None = None,
) -> SurfaceImage:
    """Find one surface for every pixel, with the help of its neighbours.

    Parameters
    ----------
    photons : PhotonImage
    pulse : Pulse, optional
        Shape of a return; by default as wide as pairs of photons say.
    learn : bool
        Learn the shape from the photons, and use what was learnt if it explains the photons that
        are held back clearly better than `pulse`.
    max_returns : int
        Surfaces looked for in every pixel, one behind the other.
    seed : int
        Of the choice of the photons that are held back.
    progress : callable, optional
        Called with the fraction of the work that is done.

    Returns
    -------
    SurfaceImage
        Every pixel has a range; `SurfaceImage.outlier_probability` says what it is worth.

    Raises
    ------
    InputError
        No pulse is given and none can be recognised.

    Notes
    -----
    Memory: at most 2 GiB beside the photons.
    """
    report = (lambda _: None) if progress is None else progress
    width = measure_pulse_width(photons) if pulse is None else 0.0
    start = Pulse.gaussian(width) if pulse is None else pulse
    scene = Scene(BinnedResponse.from_pulse(start, photons.bin_width), estimate_background(photons))
    axis = choose_label_axis(photons, scene)
    train, test = photons.split(HELD_OUT_FRACTION, seed)
    training = scene.scale(1 - HELD_OUT_FRACTION)
    report(0.1)

    volume = compute_scores(train, training, axis)
    trials = []
    for cost in SLOPE_COSTS:
        labels, _ = match_labels(volume, train.image_shape, cost)
        trials.append((judge_surface(test, train, training, axis.to_bins(labels)), cost, labels))
        report(0.1 + 0.1 * len(trials))
    _, slope_cost, labels = max(trials, key=lambda trial: trial[0])
    surface = axis.to_bins(labels)

    learnt = None
    if learn or pulse is None:
        learnt = learn_scene(train, test, training, surface, required=pulse is None)
    if learnt is not None:
        scene = Scene(learnt, scene.background)
        training = scene.scale(1 - HELD_OUT_FRACTION)
        volume = compute_scores(train, training, axis)
    labels, margin = match_labels(volume, train.image_shape, slope_cost)
    surface = axis.to_bins(labels)
    report(0.6)
    reach, surface = choose_reach(train, test, training, surface)
    evidence = weigh_evidence(test, train, training, surface)
    to_probability = calibrate_outliers(margin.ravel(), evidence)
    report(0.8)

    systematic = LEARNT_RESPONSE_SIGMA_WIDTHS * scene.response.width if learnt is not None else 0.0
    plan = SurfacePlan(axis, slope_cost, reach, systematic, to_probability)
    to_range = SPEED_OF_LIGHT / 2 * photons.bin_width
    settings: dict[str, float | str] = {
        "response": "given" if learnt is None else "learnt",
        "pulse_fwhm_ps": scene.response.pulse.fwhm * 1e12,
        "background_photons_per_bin": scene.background,
        "slope_cost": slope_cost,
        "jump_cost": slope_cost * JUMP_COST_RATIO,
        "reach_px": reach,
        "response_sigma_m": systematic * to_range,
    }
    layers = [plan.locate(photons, scene)]
    rest = photons
    for _ in range(1, max_returns):
        rest = remove_return(rest, scene, layers[-1])
        if not rest.bin.size:
            break
        layers.append(keep_significant(rest, scene, plan.locate(rest, scene)))
    return combine_layers(layers, scene, to_range, settings)


@dataclass(frozen=True)
class SurfacePlan:
    """How the surface of a picture's photons is located, all choices made.

    Parameters
    ----------
    axis : LabelAxis
    slope_cost : float
        See `match_labels`.
    reach : int
        See `fit_surface`.
    systematic : float
        Standard deviation that no photons reduce, in bins.
    to_probability : callable
        See `calibrate_outliers`.
    """

    axis: LabelAxis
    slope_cost: float
    reach: int
    systematic: float
    to_probability: Callable[[NDArray[np.float32]], FloatArray]

    def locate(self, photons: PhotonImage, scene: Scene) -> FloatArray:
        """Find the strongest surface: (rows, columns, 4) array of instant and deviation in bins,
        photons, and probability of an outlier.

        Parameters
        ----------
        photons : PhotonImage
        scene : Scene
            Response and background.

        Returns
        -------
        (rows, columns, 4) float64 array
        """
        volume = compute_scores(photons, scene, self.axis)
        labels, margin = match_labels(volume, photons.image_shape, self.slope_cost)
        del volume
        nested = fit_surface(photons, scene, self.axis.to_bins(labels), max(self.reach // 2, 1))
        fitted = fit_surface(photons, scene, nested[..., 0], self.reach)
        # Where no photon is near, the label is all there is.
        counted = np.minimum(fitted[..., 1], scene.response.width)
        variance = counted**2 + estimate_bias(fitted, nested, self.reach) + self.systematic**2
        doubt = self.to_probability(margin)
        return np.stack([fitted[..., 0], np.sqrt(variance), fitted[..., 2], doubt], axis=-1)


def remove_return(photons: PhotonImage, scene: Scene, layer: FloatArray) -> PhotonImage:
    """Leave out the photons that a surface explains better than the background does.

    Parameters
    ----------
    photons : PhotonImage
    scene : Scene
    layer : (rows, columns, 4) array
        See `SurfacePlan.locate`.

    Returns
    -------
    PhotonImage
    """
    response = scene.response
    times = response.start + response.step * np.arange(response.density.size)
    bright = response.density >= MIN_EXPLAINED_DENSITY * response.density.max()
    first, last = times[bright][0], times[bright][-1]
    late = photons.bin - layer[..., 0].ravel()[photons.pixel]
    outside = ~((late >= first) & (late <= last))
    return photons.select(photons.count * outside)


def keep_significant(photons: PhotonImage, scene: Scene, layer: FloatArray) -> FloatArray:
    """Drop a further surface where the background alone would explain its photons.

    Parameters
    ----------
    photons : PhotonImage
        Those that no nearer surface explains.
    scene : Scene
    layer : (rows, columns, 4) array
        See `SurfacePlan.locate`.

    Returns
    -------
    (rows, columns, 4) float64 array
        NaN where the surface does not stand out of the background.
    """
    reach = 0.5 * scene.response.width + 1
    late = photons.bin - layer[..., 0].ravel()[photons.pixel]
    seen = np.bincount(
        photons.pixel, photons.count * (np.abs(late) <= reach), layer[..., 0].size
    ).reshape(layer.shape[:2])
    expected = scene.background * (2 * reach + 1)
    pooled = scipy.ndimage.uniform_filter(seen, 3, mode="nearest") * 9
    own = _find_chance(seen, expected) < MAX_OWN_CHANCE
    around = _find_chance(np.rint(pooled), 9 * expected) < MAX_POOLED_CHANCE
    return np.where((own & around)[..., np.newaxis], layer, np.nan)


def _find_chance(seen: NDArray[Any], expected: NDArray[Any] | float) -> FloatArray:
    """Chance of that many photons or more where a Poisson law with that mean holds."""
    found = scipy.special.gammainc(np.maximum(seen, 1), expected)  # scipy.stats loads for a second
    return np.where(seen > 0, found, 1.0)


def combine_layers(
    layers: list[FloatArray], scene: Scene, to_range: float, settings: dict[str, float | str]
) -> SurfaceImage:
    """Turn the returns found one after the other into images, each pixel's strongest first.

    Parameters
    ----------
    layers : list of (rows, columns, 4) arrays
        See `SurfacePlan.locate`.
    scene : Scene
    to_range : float
        Metres in a bin.
    settings : mapping

    Returns
    -------
    SurfaceImage
        The strongest layer of each pixel, the others in ``further``.
    """
    stack = np.stack(layers, axis=2)
    order = np.argsort(-np.nan_to_num(stack[..., 2], nan=-1.0), axis=2, kind="stable")
    stack = np.take_along_axis(stack, order[..., np.newaxis], axis=2)
    images = [
        SurfaceImage(
            range=stack[:, :, k, 0] * to_range,
            range_sigma=stack[:, :, k, 1] * to_range,
            intensity=stack[:, :, k, 2],
            outlier_probability=stack[:, :, k, 3],
            pulse=scene.response.pulse,
            settings=settings,
        )
        for k in range(len(layers))
    ]
    return replace(images[0], further=tuple(images[1:]))


def estimate_pixels(
    photons: PhotonImage,
    pulse: Pulse | None = None,
    false_alarm_rate: float = 0.01,
    background: ArrayLike | None = None,
    cycles: int | None = None,
) -> SurfaceImage:
    """Find the strongest return of every pixel by its own photons alone.

    Parameters
    ----------
    photons : PhotonImage
    pulse : Pulse, optional
        Shape of a return; by default as wide as pairs of photons say.
    false_alarm_rate : float
        Share of the pixels without a return in which one is announced; see `PhotonDetector`.
    background : (bins,) array, optional
        Shape of the background over the bins, as of a dark frame; by default what the pixels have
        in common.
    cycles : int, optional
        Laser cycles of each pixel, of a detector that counts the first photon of a cycle only.

    Returns
    -------
    SurfaceImage
        NaN where no return stands out. The probability of an outlier is that of a false alarm.

    Raises
    ------
    InputError
        No pulse is given and none can be recognised, or the time axis is shorter than two pulses.
    """
    shape = Pulse.gaussian(measure_pulse_width(photons)) if pulse is None else pulse
    detector = PhotonDetector(
        shape, photons.bin_width, photons.bins, false_alarm_rate, background=background
    )
    pixels = photons.offsets.size - 1
    if background is None:
        # once for the whole picture, from pixels all over it
        some = photons.histograms(slice(0, pixels, -(-pixels // SAMPLED_PIXELS)))
        learnt = detector.adapt(some).relative_background
        detector = replace(detector, background=learnt)
    found = np.full((3, pixels), np.nan)
    for piece in split_blocks(pixels, DETECTED_PIXELS_PER_BLOCK):
        arrivals = detector.locate(photons.histograms(piece), piece.start, cycles)
        found[:, piece] = (
            arrivals.range[:, 0],
            arrivals.confidence[:, 0],
            arrivals.photons[:, 0],
        )
    distance, sigma, signal = found.reshape(3, *photons.image_shape)
    seen = np.isfinite(distance)
    false_share = min(false_alarm_rate * pixels / max(int(seen.sum()), 1), 1.0)
    return SurfaceImage(
        range=distance,
        range_sigma=sigma,
        intensity=signal,
        outlier_probability=np.where(seen, false_share, np.nan),
        pulse=detector.shape,
        settings={
            "response": "learnt" if pulse is None else "given",
            "pulse_fwhm_ps": detector.shape.fwhm * 1e12,
            "false_alarm_rate": false_alarm_rate,
            "background": "given"
            if background is not None
            else "learnt"
            if np.ptp(detector.relative_background)
            else "even",
        },
    )


def estimate_background(photons: PhotonImage) -> float:
    """Background photons of a pixel in a bin: what most instants have, surfaces being at few.

    Parameters
    ----------
    photons : PhotonImage
    """
    groups = min(BACKGROUND_GROUPS, photons.bins)
    edges = np.linspace(0, photons.bins, groups + 1).astype(np.int64)
    level = np.add.reduceat(photons.time_profile, edges[:-1]) / np.diff(edges)
    pixels = photons.offsets.size - 1
    # a low quantile: bins with a surface in them are brighter than the background
    quiet = float(np.quantile(level, BACKGROUND_QUANTILE))
    return max(quiet, MIN_BACKGROUND_PHOTONS / photons.bins) / pixels


def choose_label_axis(photons: PhotonImage, scene: Scene) -> LabelAxis:
    """Cut the time axis into labels and leave out those at which nothing comes back anywhere.

    Parameters
    ----------
    photons : PhotonImage
    scene : Scene

    Returns
    -------
    LabelAxis
    """
    pixels = photons.offsets.size - 1
    coarse = max(1, round(scene.response.width / LABELS_PER_WIDTH))
    while True:
        total = int(np.ceil((photons.bins + 1) / coarse))
        axis = LabelAxis(coarse, np.arange(total), total)
        numbers = np.flatnonzero(find_occupied_bins(photons, scene, axis))
        if numbers.size == 0:
            numbers = np.arange(total)
        if 2 * 4 * pixels * numbers.size <= MAX_VOLUME_BYTES:
            return LabelAxis(coarse, numbers, total)
        # two float32 volumes, the scores and their sums, have to fit
        coarse *= 2


def find_occupied_bins(photons: PhotonImage, scene: Scene, axis: LabelAxis) -> NDArray[np.bool_]:
    """Coarse bins at which some tile of the picture is brighter than the background, and those
    around.

    Parameters
    ----------
    photons : PhotonImage
    scene : Scene
        Response and background, photons per pixel and bin.
    axis : LabelAxis
        The coarse time axis.

    Returns
    -------
    (coarse_bins,) bool array
    """
    rows, columns = photons.image_shape
    y, x = np.divmod(photons.pixel, columns)
    across = -(-columns // TILE_PX)
    tiles = -(-rows // TILE_PX) * across
    tile = (y // TILE_PX) * across + x // TILE_PX
    number = tile * axis.coarse_bins + axis.number_events(photons)
    counts = np.bincount(number, photons.count, tiles * axis.coarse_bins)
    counts = counts.reshape(tiles, axis.coarse_bins)
    length = max(1, round(scene.response.width / axis.coarse))
    pooled = scipy.ndimage.uniform_filter1d(counts, length, axis=1, mode="constant") * length
    # A tile may be brighter or darker than the others throughout.
    level = np.minimum(np.quantile(counts, 0.5, axis=1), counts.mean(axis=1))
    expected = length * np.maximum(
        level, scene.background * TILE_PX**2 * axis.coarse * (level == 0)
    )
    limit = expected + MIN_TILE_SIGNIFICANCE * np.sqrt(expected) + 2
    occupied = np.any(pooled > limit[:, np.newaxis], axis=0)
    return np.asarray(scipy.ndimage.binary_dilation(occupied, iterations=2 * LABELS_PER_WIDTH))


def compute_scores(photons: PhotonImage, scene: Scene, axis: LabelAxis) -> NDArray[np.float32]:
    """Log-likelihood ratio of a surface at each label against none, (pixels, labels).

    Parameters
    ----------
    photons : PhotonImage
    scene : Scene
    axis : LabelAxis

    Returns
    -------
    (pixels, labels) float32 array
    """
    from tofclip.lidar.photons import surface_kernels as kernels

    shares, first = scene.response.coarse_shares(axis.coarse)
    odds = scene.count_signal(photons) * shares / (scene.background * axis.coarse)
    weights = np.log1p(odds).astype(np.float32)
    score = np.empty((photons.offsets.size - 1, axis.numbers.size), np.float32)
    number, places = axis.number_events(photons), axis.places

    def work(piece: slice) -> None:
        kernels.score_labels(
            photons.offsets[piece.start : piece.stop + 1],
            number,
            photons.count,
            places,
            weights,
            first,
            score[piece],
        )

    run_blocks(work, score.shape[0], PIXELS_PER_BLOCK)
    return score


def match_labels(
    score: NDArray[np.float32], image_shape: tuple[int, int], slope_cost: float
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Find the labels of the most likely piecewise smooth surface.

    Parameters
    ----------
    score : (pixels, labels) float32 array
    image_shape : (int, int)
    slope_cost : float
        For a change by one label; others cost `JUMP_COST_RATIO` times as much.

    Returns
    -------
    (rows, columns) int64 array, (rows, columns) float32 array
        Labels, and by how much each beats the next best that is not beside it.
    """
    from tofclip.lidar.photons import surface_kernels as kernels

    cube = score.reshape(*image_shape, -1)
    total = np.zeros_like(cube)
    costs = np.float32(slope_cost), np.float32(slope_cost * JUMP_COST_RATIO)
    kernels.add_path_scores(cube, *costs, total)
    kernels.add_path_scores(cube[::-1, ::-1], *costs, total[::-1, ::-1])
    label, margin = np.empty(score.shape[0], np.int64), np.empty(score.shape[0], np.float32)
    summed = total.reshape(score.shape)
    apart = 2 * LABELS_PER_WIDTH

    def work(piece: slice) -> None:
        kernels.find_best_labels(
            score[piece], summed[piece], np.float32(7), apart, label[piece], margin[piece]
        )

    run_blocks(work, score.shape[0], PIXELS_PER_BLOCK)
    return label.reshape(image_shape), margin.reshape(image_shape)


def fit_surface(
    photons: PhotonImage,
    scene: Scene,
    surface: FloatArray,
    reach: int,
    rounds: int = PLANE_ROUNDS,
) -> FloatArray:
    """Move a surface to the likelihood's maximum, plane by plane.

    Parameters
    ----------
    photons : PhotonImage
    scene : Scene
    surface : (rows, columns) array
        Instants to start from, in bins.
    reach : int
        Pixels up to this far away share a plane.
    rounds : int
        Steps of Fisher scoring.

    Returns
    -------
    (rows, columns, 3) array
        See `surface_kernels.fit_planes`.
    """
    now = np.array(surface, dtype=np.float64)
    brightness = np.full(now.size, scene.count_signal(photons))
    slopes, gate = np.zeros((*now.shape, 2)), GATE_WIDTHS * scene.response.width
    fitted = np.empty((*now.shape, 3))
    for _ in range(rounds):
        sums = _measure_photons(photons, scene, now.ravel(), brightness).reshape(*now.shape, 3)
        _fit_planes(now, sums, reach, gate, slopes, fitted)
        now = fitted[..., 0].copy()
        brightness = np.maximum(fitted[..., 2].ravel(), MIN_SIGNAL_PHOTONS)
    return fitted


def _measure_photons(
    photons: PhotonImage, scene: Scene, surface: FloatArray, brightness: FloatArray
) -> FloatArray:
    """Slope and information of each pixel's likelihood, and its signal; see `measure_events`."""
    from tofclip.lidar.photons import surface_kernels as kernels

    response, sums = scene.response, np.empty((surface.size, 3))
    table = np.stack([response.log_slope, response.density / scene.background], axis=1)

    def work(piece: slice) -> None:
        kernels.measure_events(
            photons.offsets[piece.start : piece.stop + 1],
            photons.bin,
            photons.count,
            surface[piece],
            table,
            response.start,
            response.step,
            brightness[piece],
            sums[piece],
        )

    run_blocks(work, surface.size, PIXELS_PER_BLOCK)
    return sums


def _fit_planes(
    surface: FloatArray,
    sums: FloatArray,
    reach: int,
    gate: float,
    slopes: FloatArray,
    fitted: FloatArray,
) -> None:
    """Fit a plane around every pixel, `fitted` and `slopes` are overwritten; see `fit_planes`."""
    from tofclip.lidar.photons import surface_kernels as kernels

    def work(piece: slice) -> None:
        kernels.fit_planes(surface, sums, reach, gate, slopes, (piece.start, piece.stop), fitted)

    run_blocks(work, surface.shape[0], ROWS_PER_BLOCK)


def weigh_evidence(
    test: PhotonImage, train: PhotonImage, scene: Scene, surface: FloatArray
) -> FloatArray:
    """Log-likelihood ratio of each pixel's held-back photons: this surface against any instant.

    Parameters
    ----------
    test, train : PhotonImage
        The photons held back, and those that found the surface.
    scene : Scene
    surface : (rows, columns) array
        In bins.

    Returns
    -------
    (pixels,) array
    """
    from tofclip.lidar.photons import surface_kernels as kernels

    response = scene.response
    flat = np.ascontiguousarray(surface, dtype=np.float64).ravel()
    ahead = response.start
    late = train.bin - flat[train.pixel]
    inside = (late >= ahead) & (late <= -ahead + response.width)
    length = response.width - 2 * ahead
    seen = np.bincount(train.pixel, train.count * inside, flat.size).reshape(surface.shape)
    whole = train.photons_per_pixel
    pooled, total = (
        scipy.ndimage.uniform_filter(part, SIGNAL_POOL_PX, mode="nearest") for part in (seen, whole)
    )
    outside = np.maximum(total - pooled, 0) * length / max(train.bins - length, 1)
    signal = np.clip((pooled - outside) / np.maximum(total, 1e-9), 0.02, 0.98)
    evidence = np.empty(flat.size)
    density = response.density * train.bins
    kernels.sum_evidence(
        test.offsets,
        test.bin,
        test.count,
        flat,
        density,
        response.start,
        response.step,
        signal.ravel(),
        evidence,
    )
    return evidence


def judge_surface(
    test: PhotonImage, train: PhotonImage, scene: Scene, surface: FloatArray
) -> float:
    """Mean log-likelihood of the photons that were held back; see `weigh_evidence`.

    Parameters
    ----------
    test, train : PhotonImage
        Photons held back, and those that the surface was found from.
    scene : Scene
    surface : (rows, columns) float64 array
        Instants, bins.

    Returns
    -------
    float
        Nats per photon.
    """
    return float(weigh_evidence(test, train, scene, surface).mean())


def learn_scene(
    train: PhotonImage, test: PhotonImage, scene: Scene, surface: FloatArray, required: bool
) -> BinnedResponse | None:
    """Learn the response from the photons held back, around the surface that the others found.

    Parameters
    ----------
    train, test : PhotonImage
    scene : Scene
        With the response that is known so far.
    surface : (rows, columns) array
        In bins.
    required : bool
        There is no other response to stay with.

    Returns
    -------
    BinnedResponse or None
        None if the response known so far explains the photons as well.
    """
    fitted = fit_surface(train, scene, surface, RESPONSE_REACH_PX)[..., 0]
    before = weigh_evidence(test, train, scene, fitted)
    for _ in range(RESPONSE_ROUNDS):
        residual = test.bin - fitted.ravel()[test.pixel]
        pulse, later = learn_response(residual, test.count, scene.response.width, train.bin_width)
        scene = Scene(BinnedResponse(pulse, train.bin_width), scene.background)
        fitted = fit_surface(train, scene, fitted + later, RESPONSE_REACH_PX, TRIAL_ROUNDS)[..., 0]
    gain = weigh_evidence(test, train, scene, fitted) - before
    clear = MIN_LEARNT_SIGNIFICANCE * np.sqrt(gain.size) * gain.std() + MIN_LEARNT_GAIN
    return scene.response if required or gain.sum() > clear else None


def choose_reach(
    train: PhotonImage, test: PhotonImage, scene: Scene, surface: FloatArray
) -> tuple[int, FloatArray]:
    """Find the reach of the planes that explains the photons held back best.

    Parameters
    ----------
    train, test : PhotonImage
    scene : Scene
    surface : (rows, columns) array
        In bins.

    Returns
    -------
    int, (rows, columns) array
        Pixels, and the surface that it gives.
    """
    best, chosen, highest = REACHES_PX[0], surface, -np.inf
    rounds = PLANE_ROUNDS
    for reach in REACHES_PX:
        if reach > REACHES_PX[0] and 2 * reach + 1 > min(surface.shape):
            break
        surface = fit_surface(train, scene, surface, reach, rounds)[..., 0]
        rounds = TRIAL_ROUNDS
        value = judge_surface(test, train, scene, surface)
        if value <= highest:
            break
        best, chosen, highest = reach, surface, value
    return best, chosen


def estimate_bias(fitted: FloatArray, nested: FloatArray, reach: int) -> FloatArray:
    """Mean square, in bins, of what planes miss where a surface bends, (rows, columns).

    Two estimates of which one uses a part of the other's photons differ by the difference of their
    variances if neither is biased; what they differ by beyond that is bias.

    Parameters
    ----------
    fitted, nested : (rows, columns, 3) array
        Fits of `reach` and of half of it; see `fit_surface`.
    reach : int
        In pixels.

    Returns
    -------
    (rows, columns) float64 array
        Bins squared.
    """
    apart = (fitted[..., 0] - nested[..., 0]) ** 2
    wide, narrow = fitted[..., 1] ** 2, nested[..., 1] ** 2
    # A border that moved is not a bend.
    known = np.isfinite(wide) & np.isfinite(narrow) & (apart < 25 * narrow)
    excess = np.zeros(apart.shape)
    excess[known] = (apart - narrow)[known] + wide[known]
    number = scipy.ndimage.uniform_filter(known.astype(float), 2 * reach + 1, mode="nearest")
    mean = scipy.ndimage.uniform_filter(excess, 2 * reach + 1, mode="nearest") / np.maximum(
        number, 1e-9
    )
    bias: FloatArray = NESTED_BIAS_RATIO**2 * np.maximum(mean, 0)
    return bias


def calibrate_outliers(
    margin: NDArray[np.float32], evidence: FloatArray
) -> Callable[[NDArray[np.float32]], FloatArray]:
    """Learn the probability of an outlier from what the photons held back say.

    Parameters
    ----------
    margin : (pixels,) array
        By how much the label of each pixel beat the others.
    evidence : (pixels,) array
        See `weigh_evidence`.

    Returns
    -------
    callable
        Turns margins into probabilities: a logistic curve of the margin's logarithm.
    """
    feature = np.log1p(np.maximum(margin, 0)).astype(np.float64)
    ratio = np.clip(evidence, -30, 30)

    def misfit(coefficients: FloatArray) -> float:
        wrong = _logistic(coefficients[0] - np.exp(coefficients[1]) * feature)
        return -float(np.mean(np.log((1 - wrong) * np.exp(ratio) + wrong)))

    found = scipy.optimize.minimize(misfit, np.array([0.0, 0.0]), method="Nelder-Mead").x

    def to_probability(value: NDArray[np.float32]) -> FloatArray:
        known = np.log1p(np.maximum(value, 0)).astype(np.float64)
        return _logistic(found[0] - np.exp(found[1]) * known)

    return to_probability


def _logistic(value: FloatArray) -> FloatArray:
    # exp does not overflow, and at 40 the result is 0 or 1 within 1e-17
    result: FloatArray = 1 / (1 + np.exp(-np.clip(value, -40, 40)))
    return result
