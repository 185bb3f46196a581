"""The camera's parallax from an ordinary shot: time gives the range of each gate, agreement of the
views its shear.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera, Measurement, measure
from tofclip.camera.calibration import (
    FocusCurve,
    Parallax,
    find_sharpest_shears,
    fit_parallax_to_shears,
)
from tofclip.camera.calibration.parallax import GATE_METHOD
from tofclip.camera.calibration.registration import count_registration_iterations
from tofclip.errors import CalibrationError, InputError
from tofclip.recovery.shot import Shot
from tofclip.solvers import Progress, ignore_progress
from tofclip.units import SPEED_OF_LIGHT

FloatArray = NDArray[np.float64]

MIN_GATES = 3


@dataclass(frozen=True)
class ShotParallax:
    """What a shot says about the parallax.

    Parameters
    ----------
    camera : Camera
        With sweep, gains, centres, lenslet pitch and focus distance.
    parallax : Parallax
    distances : (gates,) array
        Mean range of each gate's light, m.
    curve : FocusCurve
    """

    camera: Camera
    parallax: Parallax
    distances: FloatArray
    curve: FocusCurve


def fit_parallax_to_shot(
    shot: Shot,
    gates: int,
    shears: tuple[float, float, int],
    progress: Progress = ignore_progress,
) -> ShotParallax:
    """Fit lenslet pitch and focus distance to the shears at which a shot's gates are in focus.

    Parameters
    ----------
    shot : Shot
        Of a scene at several ranges, with a true time zero. A sweep that is not known is estimated
        from the shot.
    gates : int
        Number of gates, of equal brightness.
    shears : (float, float, int)
        First and last shear tried and their number, pixels per view step.
    progress : callable
        Called with the number of frame iterations just done.

    Returns
    -------
    ShotParallax
        The camera with what was found, and the shears of the gates that it was found from.

    Raises
    ------
    CalibrationError
        Fewer than two gates have their best shear within those tried.
    InputError
        Fewer than three gates.
    """
    if gates < MIN_GATES:
        raise InputError(f"a parallax needs {MIN_GATES} gates or more, got {gates}")
    shot = shot.fit_camera(progress)
    camera, times = shot.camera, shot.times
    measurement = measure(shot.streak.counts, shot.streak.saturated, camera)
    if times[0] <= 0:
        raise CalibrationError(
            "light cannot come before time zero: give the camera's (`time_zero`)"
        )
    cut, distances = split_gates_by_brightness(measurement, times, gates)
    curve = find_sharpest_shears(measurement, camera, cut, np.linspace(*shears), progress)
    found = fit_parallax_to_shears(curve.shears, distances, curve.weight)
    return ShotParallax(found.apply_to(camera), found, distances, curve)


def count_parallax_work(shot: Shot, shears: tuple[float, float, int]) -> int:
    """Return how many frame iterations `fit_parallax_to_shot` reports at most.

    Parameters
    ----------
    shot : Shot
    shears : (float, float, int)
        First, last and number of shears.

    Returns
    -------
    int
    """
    rows = shot.streak.counts.shape[0]
    fitting = count_registration_iterations() if shot.camera.sweep is None else 0
    return fitting + shears[2] * GATE_METHOD.work(rows)


def split_gates_by_brightness(
    measurement: Measurement, times: FloatArray, number: int
) -> tuple[list[slice], FloatArray]:
    """Cut the frames into gates of equal brightness (root of the light); also their light's mean
    range, m.

    `times` (frames,): times of flight, s; `number`: gates asked for; where light is concentrated
    there may be fewer. Returns `ranges` (gates,): metres.
    """
    light = np.maximum((measurement.values * measurement.valid).sum(axis=0, dtype=np.float64), 0)
    # the root, so that a bright near surface does not take all gates
    share = np.cumsum(np.sqrt(light)) / np.sqrt(light).sum()
    edges = np.searchsorted(share, np.arange(1, number) / number) + 1
    cuts = np.unique(np.concatenate([[0], edges, [light.size]])).tolist()
    gates = [slice(first, last) for first, last in pairwise(cuts)]
    instants = [
        # a gate without light has a mean time too
        np.average(times[gate], weights=light[gate] + np.finfo(np.float64).tiny)
        for gate in gates
    ]
    return gates, SPEED_OF_LIGHT * np.array(instants) / 2
