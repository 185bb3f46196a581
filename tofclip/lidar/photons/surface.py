"""The picture of ranges that counted photons give, and the returns that it lists.

Several returns of a pixel: what a surface explains is taken out, and the next one is looked for in
the rest.

The surface that a picture of few photons shows: neighbours lend each other theirs.

1. Semi-global matching over eight directions finds the instant of each pixel's surface on a coarse
   time axis: the most likely piecewise smooth one (Hirschmueller, IEEE Trans. Pattern Anal. 30,
   328, 2008), with log-matched filter responses as scores (`matching`).
2. Planes through the neighbours on the same surface, fitted to the likelihood of their photons
   (Fisher scoring), give the instant below a bin and its deviation (`planes`).
3. Further returns are looked for in what the first surface leaves (`layers`).

How much neighbours have to agree, how far they reach, the response and the probability of an
outlier come from the data: a part of the photons is held back, and what explains it best counts
(`held_out`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.camera import Camera
from tofclip.errors import CalibrationError
from tofclip.lidar.photons.held_out import (
    calibrate_outliers,
    choose_reach,
    judge_surface,
    learn_scene,
)
from tofclip.lidar.photons.image import FloatArray, PhotonImage, find_hot_pixels, leave_out_pixels
from tofclip.lidar.photons.matching import (
    JUMP_COST_RATIO,
    LabelAxis,
    choose_label_axis,
    compute_scores,
    match_labels,
)
from tofclip.lidar.photons.planes import estimate_bias, fit_surface
from tofclip.lidar.photons.response import (
    BinnedResponse,
    Scene,
    estimate_background,
    find_time_step,
    measure_pulse_width,
    require_plausible_pulse,
)
from tofclip.lidar.pulse import Pulse
from tofclip.lidar.range_calibration import correct_ranges
from tofclip.shots import Returns
from tofclip.units import SPEED_OF_LIGHT


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
    hot_pixels : (rows, columns) bool array, optional
        Pixels whose photons were left out; see `tofclip.lidar.photons.image`.
    """

    range: FloatArray
    range_sigma: FloatArray
    intensity: FloatArray
    outlier_probability: FloatArray
    pulse: Pulse
    settings: dict[str, float | str]
    further: tuple[SurfaceImage, ...] = ()
    hot_pixels: NDArray[np.bool_] | None = None

    def calibrate(self, camera: Camera, first_time: float = 0.0) -> SurfaceImage:
        """Return the ranges from the camera's time zero, with its range calibration applied.

        Parameters
        ----------
        camera : Camera
        first_time : float
            Reading of the time axis at the middle of the first bin, s.

        Returns
        -------
        SurfaceImage

        Raises
        ------
        CalibrationError
            The camera has another number of pixels.
        """
        if camera.image_shape != self.range.shape:
            raise CalibrationError(
                f"the camera has {camera.image_shape} pixels, the photons {self.range.shape}"
            )
        further = tuple(one.calibrate(camera, first_time) for one in self.further)
        # Light travels the range twice, hence half the speed.
        distance = self.range - SPEED_OF_LIGHT / 2 * (camera.time_zero - first_time)
        sigma = self.range_sigma
        if camera.range_calibration is not None:
            y, x = np.indices(self.range.shape)
            distance, _, sigma = correct_ranges(
                camera.range_calibration, distance, self.intensity, sigma, (y, x)
            )
        return replace(self, range=distance, range_sigma=sigma, further=further)

    def to_returns(self, camera: Camera, provenance: Mapping[str, Any] | None = None) -> Returns:
        """List the pixels with a range.

        Parameters
        ----------
        camera : Camera
            Says where the pixels look, see `make_pinhole`.
        provenance : mapping, optional
            How they came about.

        Returns
        -------
        tofclip.lidar.Returns
        """
        columns = self.range.shape[1]
        layers = [self, *self.further]
        distance = np.stack([layer.range for layer in layers], axis=2).reshape(-1, len(layers))
        order = np.argsort(distance, axis=1)
        pixel, nearness = np.nonzero(np.isfinite(np.take_along_axis(distance, order, axis=1)))
        layer = order[pixel, nearness]
        sigma, signal, doubt = (
            np.stack([getattr(one, name) for one in layers], axis=2).reshape(distance.shape)
            for name in ("range_sigma", "intensity", "outlier_probability")
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
            camera=camera,
            provenance={} if provenance is None else provenance,
            false_alarm=doubt[pixel, layer],
        )


def make_pinhole(image_shape: tuple[int, int], focal_length_px: float, pulse_fwhm: float) -> Camera:
    """Return a camera that only says where its pixels look.

    Parameters
    ----------
    image_shape : (int, int)
        Rows and columns.
    focal_length_px : float
        Distance of the pinhole from the picture, in pixels; the optical axis meets pixel
        ``(rows // 2, columns // 2)``.
    pulse_fwhm : float
        Full width at half maximum of a return, s.

    Returns
    -------
    Camera
        Of one view.
    """
    columns = image_shape[1]
    return Camera(
        np.array([min(columns / 2, columns - 1)]),
        np.zeros(1),
        image_shape,
        columns,
        pulse_fwhm=pulse_fwhm,
        focal_length_px=focal_length_px,
    )


MIN_EXPLAINED_DENSITY = 0.003
"""Of the response's peak: photons where it is brighter belong to the surface."""

MAX_OWN_CHANCE, MAX_POOLED_CHANCE = 0.02, 1e-4
"""That the background alone shows as many photons at a further surface, in the pixel and in the
nine pixels around it."""


def remove_return(photons: PhotonImage, scene: Scene, layer: FloatArray) -> PhotonImage:
    """Leave out the photons that a surface explains better than the background does.

    `layer` (rows, columns, 4): see `SurfacePlan.locate`.
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

    `photons`: those that no nearer surface explains; `layer` (rows, columns, 4): see
    `SurfacePlan.locate`. Returns (rows, columns, 4): naN where the surface does not stand out of
    the background.
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
    layers: list[FloatArray],
    max_returns: int,
    scene: Scene,
    to_range: float,
    settings: dict[str, float | str],
) -> SurfaceImage:
    """Turn the returns found one after the other into images, each pixel's strongest first.

    `layers`: see `SurfacePlan.locate`; `max_returns`: of these the strongest in each pixel are
    returned; `to_range`: metres in a bin. Returns the strongest layer of each pixel, the others in
    ``further``.
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
        for k in range(min(max_returns, len(layers)))
    ]
    return replace(images[0], further=tuple(images[1:]))


HELD_OUT_FRACTION = 0.25

SLOPE_COSTS = (1.5, 4.0, 10.0)
"""Log-likelihood that a change of the surface by one label has to bring."""

LEARNT_RESPONSE_SIGMA_WIDTHS = 1 / 8
"""Standard deviation of where the surface lies in a response that was learnt from the scene.

Its shape varies from surface to surface with tilt, material and brightness; a response that is
given is taken as exact."""


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
        Every pixel has a range, a hot one that of its neighbours;
        `SurfaceImage.outlier_probability` says what it is worth.

    Raises
    ------
    InputError
        No pulse is given and none can be recognised.

    Notes
    -----
    Memory: at most 2 GiB beside the photons.
    """
    report = (lambda _: None) if progress is None else progress
    hot = find_hot_pixels(photons)
    photons = leave_out_pixels(photons, hot)
    photons = photons.join_bins(find_time_step(photons))
    width = measure_pulse_width(photons) if pulse is None else 0.0
    start = Pulse.gaussian(width) if pulse is None else pulse
    require_plausible_pulse(photons, start)
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
        require_plausible_pulse(photons, learnt.pulse)
        training = scene.scale(1 - HELD_OUT_FRACTION)
        del volume  # before there is another one
        volume = compute_scores(train, training, axis)
    labels, margin = match_labels(volume, train.image_shape, slope_cost)
    del volume
    surface = axis.to_bins(labels)
    report(0.6)
    reach, surface = choose_reach(train, test, training, surface)
    to_probability = calibrate_outliers(test, train, training, surface, margin)
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
        "hot_pixels": int(hot.sum()),
    }
    layers = [plan.locate(photons, scene)]
    rest = photons
    # A surface goes on where another one stops: behind an edge the second of a pixel may be found
    # only when the third of the picture is looked for.
    for _ in range(max_returns if max_returns > 1 else 0):
        rest = remove_return(rest, scene, layers[-1])
        if not rest.bin.size:
            break
        further = keep_significant(rest, scene, plan.locate(rest, scene))
        if np.isnan(further).all():
            break
        layers.append(further)
    found = combine_layers(layers, max_returns, scene, to_range, settings)
    return replace(found, hot_pixels=hot)


@dataclass(frozen=True)
class SurfacePlan:
    """How the surface of a picture's photons is located, all choices made."""

    axis: LabelAxis
    slope_cost: float  # see `match_labels`
    reach: int  # see `fit_surface`
    systematic: float  # standard deviation that no photons reduce, in bins
    to_probability: Callable[[NDArray[np.float32]], FloatArray]  # see `calibrate_outliers`

    def locate(self, photons: PhotonImage, scene: Scene) -> FloatArray:
        """Find the strongest surface: (rows, columns, 4) array of instant and deviation in bins,
        photons, and probability of an outlier.

        `scene`: response and background. Returns (rows, columns, 4).
        """
        volume = compute_scores(photons, scene, self.axis)
        labels, margin = match_labels(volume, photons.image_shape, self.slope_cost)
        del volume
        nested = fit_surface(photons, scene, self.axis.to_bins(labels), max(self.reach // 2, 1))
        fitted = fit_surface(photons, scene, nested[..., 0], self.reach)
        # Where no photon is near, the label is all there is.
        counted = np.minimum(fitted[..., 1], scene.response.width)
        variance = (
            counted**2
            + estimate_bias(fitted, nested, self.reach, scene.response.width)
            + self.systematic**2
        )
        doubt = self.to_probability(margin)
        return np.stack([fitted[..., 0], np.sqrt(variance), fitted[..., 2], doubt], axis=-1)
