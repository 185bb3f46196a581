"""The surface that a picture of few photons shows: neighbours lend each other theirs.

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

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tofclip.lidar.photons.held_out import (
    calibrate_outliers,
    choose_reach,
    judge_surface,
    learn_scene,
)
from tofclip.lidar.photons.hot_pixels import find_hot_pixels, leave_out_pixels
from tofclip.lidar.photons.layers import combine_layers, keep_significant, remove_return
from tofclip.lidar.photons.matching import (
    JUMP_COST_RATIO,
    LabelAxis,
    choose_label_axis,
    compute_scores,
    match_labels,
)
from tofclip.lidar.photons.photon_image import FloatArray, PhotonImage
from tofclip.lidar.photons.planes import estimate_bias, fit_surface
from tofclip.lidar.photons.response import (
    BinnedResponse,
    find_time_step,
    measure_pulse_width,
    require_plausible_pulse,
)
from tofclip.lidar.photons.scene import Scene, estimate_background
from tofclip.lidar.photons.surface_image import SurfaceImage
from tofclip.lidar.pulse import Pulse
from tofclip.units import SPEED_OF_LIGHT

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
