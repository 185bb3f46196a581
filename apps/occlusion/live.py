"""Seeing past an occluder while one looks: a person who walks behind it, or a recording of one's own
behind a time gate.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from apps.figures.style import tone_map
from apps.occlusion.experiment import (
    BASELINE_M,
    OCCLUDER_DISTANCE_M,
    WALK_PLACES_M,
    Experiment,
    ExperimentSettings,
    OcclusionScene,
)
from apps.viewer.source import Inflow, KeptFrames, Picture, Setting, Source, View, make_cloud
from apps.viewer.sources import RecoveredSource, TransientSource
from tofclip.errors import InputError
from tofclip.files import format_error_line
from tofclip.occlusion import TimedMeasurements, separate_occluder
from tofclip.simulate.light_fields import CameraArray
from tofclip.units import MILLIMETRE, SPEED_OF_LIGHT

MAX_KEPT_FRAMES = 32
# pixels brighter than this fraction of a picture's brightest hundredth are points of the scene
BRIGHT_FRACTION, WHITE_QUANTILE = 0.2, 0.99

STOP_TIMEOUT_S = 20.0
KEPT_OUT = "light from nearer than this is kept out of"

ONE_CAMERA, ONE_CAMERA_GATED = "one camera", "one camera behind the gate"
CLIP_GATED, TRUTH = "ToF-CLIP behind the gate", "truth, no occluder"
ALL_LIGHT = "all light"
SHOWN_SIDE_PX, GAP_PX = 192, 6  # of the pictures beside the scene, and between two of them


@dataclass(frozen=True)
class WalkFrame:
    """A step of the walk, as it was seen."""

    view: View  # occluder and person, each at its own distance; its text: what the formula promises
    pictures: Mapping[str, Picture]  # by what each of them shows


class WalkSource(Source):
    """A person who walks behind an occluder, measured as fast as this machine can; sliders hold."""

    def __init__(self, scene: OcclusionScene, settings: ExperimentSettings) -> None:
        near, far = OCCLUDER_DISTANCE_M / MILLIMETRE, scene.distance / MILLIMETRE
        width = scene.region.width / MILLIMETRE
        hint = f"of its solid part; the views are {BASELINE_M / MILLIMETRE:g} mm apart"
        self._width = Setting("occluder width (mm)", 1.0, 20.0, 0.5, width, hint)
        middle, hint = round((near + far) / 2), f"{KEPT_OUT} the picture"
        self._gate = Setting("gate opens (mm)", near - 15, far + 15, 1.0, middle, hint)
        super().__init__(
            f"{scene.title}, live", 2.0, frame_name="step", settings=(self._width, self._gate)
        )
        self._scene, self._settings = scene, settings
        self._kept, self._stopping = KeptFrames[WalkFrame](), threading.Event()
        self._seconds, self._failure_text = float("nan"), ""
        self._walk = itertools.cycle([*WALK_PLACES_M, *WALK_PLACES_M[-2:0:-1]])
        self._take_step()
        self._thread = threading.Thread(target=self._run, name="walk", daemon=True)
        self._thread.start()

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def inflow(self) -> Inflow:
        is_live, oldest = self._thread.is_alive(), self._kept.oldest
        rate = 1 / self._seconds if is_live else 0.0
        return Inflow(oldest, is_live, rate, self._seconds, failure_text=self._failure_text)

    def view(self, number: int) -> View:
        return self._kept.get(number).view

    def pictures(self, number: int) -> Mapping[str, Picture]:
        pictures = self._kept.get(number).pictures
        return {
            f"{left} | {right}": pair_pictures(pictures[left], pictures[right])
            for left, right in ((ONE_CAMERA, CLIP_GATED), (ONE_CAMERA_GATED, TRUTH))
        }

    def close(self) -> None:
        self._stopping.set()
        self._thread.join(STOP_TIMEOUT_S)

    def _run(self) -> None:
        try:
            while not self._stopping.is_set():
                self._take_step()
        except Exception as fault:
            # Whatever ends it is shown on the page: an exception on this thread would be lost.
            self._failure_text = format_error_line(fault)

    def _take_step(self) -> None:
        started = time.monotonic()
        scene = self._scene.widen_occluder(self._width.value * MILLIMETRE)
        settings = replace(self._settings, seed=self._settings.seed + len(self))
        there = Experiment(scene.move_target(next(self._walk)), settings)
        self._kept.append(look_behind(there, self._gate.value * MILLIMETRE), MAX_KEPT_FRAMES)
        self._seconds = time.monotonic() - started


def look_behind(experiment: Experiment, opens: float) -> WalkFrame:
    """Measure a scene and recover what stands before and behind a gate that opens at a distance, m."""
    measurements = experiment.measurements
    front, behind, distances = separate_at(measurements, opens)
    middle = experiment.pictures[len(experiment.pictures) // 2]
    opens_at = measurements.rig.compute_flight_time(np.array([opens]))[0]
    cut = np.searchsorted(measurements.time_axis.times, opens_at)
    pictures = {
        ONE_CAMERA: middle.sum(axis=-1),
        ONE_CAMERA_GATED: middle[..., cut:].sum(axis=-1),
        CLIP_GATED: behind,
        TRUTH: experiment.truth,
    }
    view = _place_pictures(measurements.rig.array, [front, behind], distances)
    return WalkFrame(replace(view, text=describe_region(experiment.scene)), pictures)


def separate_at(
    measurements: TimedMeasurements, opens: float
) -> tuple[Picture, Picture, tuple[float, float]]:
    """Recover what comes back before a gate opens, m, and after, and both distances."""
    returns = measurements.split_returns(opens)
    found = separate_occluder(measurements, returns=returns)
    if found.sees_target:
        return found.occluder, found.target, (found.distances[0], found.distances[1])
    (distance,), dark = found.distances, np.zeros_like(found.occluder)
    if returns[0].bins.stop == measurements.time_axis.bins:  # all light came through the gate
        return dark, found.occluder, (opens, distance)
    return found.occluder, dark, (distance, opens)


def pair_pictures(left: Picture, right: Picture) -> Picture:
    """Put two pictures of one shape beside each other, enlarged, each at its own brightness."""
    times = max(1, SHOWN_SIDE_PX // max(left.shape))
    parts = (tone_map(np.maximum(one, 0)) for one in (left, right))
    first, second = (one.repeat(times, 0).repeat(times, 1) for one in parts)
    gap = np.ones((len(first), GAP_PX))
    return np.hstack([first, gap, second]).astype(np.float32)


def describe_region(scene: OcclusionScene) -> str:
    """Say what the formula of the inactive region promises for a scene."""
    width, behind = scene.region.width / MILLIMETRE, scene.behind / MILLIMETRE
    if not scene.region.is_bounded:
        return f"{width:g} mm wide, as the views are apart or wider: nothing is promised"
    hidden = scene.region.length / MILLIMETRE
    word = "seen" if behind > hidden else "hidden"
    return f"hides {hidden:.0f} mm behind it; person at {behind:.0f} mm: {word}"


def _place_pictures(
    array: CameraArray, pictures: list[Picture], distances: tuple[float, float]
) -> View:
    """Put the bright pixels of each picture at its distance."""
    places, light = [], []
    for picture, distance in zip(pictures, distances, strict=True):
        bright = picture > BRIGHT_FRACTION * max(float(np.quantile(picture, WHITE_QUANTILE)), 1e-12)
        row, column = np.nonzero(bright)
        middle = np.array(picture.shape) // 2
        across = (column - middle[1]) / array.focal_length_px * distance
        down = (row - middle[0]) / array.focal_length_px * distance
        places.append(np.stack([across, down, np.full(len(row), distance)], axis=-1))
        light.append(picture[bright])
    xyz = np.concatenate(places).astype(np.float32)
    return View(make_cloud(xyz, {"intensity": np.concatenate(light)}))


class GatedSource(Source):
    """Shots behind a time gate: what comes back from nearer is kept out of cloud and picture."""

    def __init__(self, shots: Source) -> None:
        if not isinstance(shots, RecoveredSource):
            raise InputError(
                f"{shots.title}: a gate needs light over time: give shots, frames or an instrument"
            )
        self._shots = shots
        # The gate is moved more often than the shot changes.
        self._recover = lru_cache(1)(shots.recover_frames)
        ranges = shots.view(0).cloud.range
        low, high = (
            (float(one) for one in np.percentile(ranges, (0, 100))) if len(ranges) else (0.0, 1.0)
        )
        low, high = np.floor(100 * low) / 100, np.ceil(100 * high) / 100
        hint = f"{KEPT_OUT} cloud and picture"
        self._gate = Setting("gate opens (m)", low, high, 0.01, low, hint)
        super().__init__(
            f"{shots.title}, behind a gate",
            min(shots.rate, 10.0),
            frame_name="shot",
            notes=shots.notes,
            settings=(self._gate,),
        )

    def __len__(self) -> int:
        return 1 if isinstance(self._shots, TransientSource) else len(self._shots)

    @property
    def inflow(self) -> Inflow:
        inflow = self._shots.inflow
        return replace(inflow, oldest=min(inflow.oldest, len(self) - 1))

    def view(self, number: int) -> View:
        whole = self._shots.view(number)
        behind = whole.cloud.range >= self._gate.value
        return View(whole.cloud, whole.pixels).select(behind)

    def pictures(self, number: int) -> Mapping[str, Picture]:
        frames = self._recover(number)
        distance: Any = SPEED_OF_LIGHT * frames.times / 2
        behind = frames.values[distance >= self._gate.value].sum(axis=0)
        pair = pair_pictures(frames.values.sum(axis=0), behind)
        return {f"{ALL_LIGHT} | {CLIP_GATED}": pair}

    def close(self) -> None:
        self._shots.close()
