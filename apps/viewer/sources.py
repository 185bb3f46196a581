"""Sources: clouds in files; hidden volumes; the recovered frames of one shot, refocused at any shear;
raw shots, recovered as they are looked at, from files or while they come in.
"""

from __future__ import annotations

import abc
import functools
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from apps.viewer.shots import LiveShots, Shots, make_view
from apps.viewer.source import Choice, Inflow, Picture, Setting, Source, View, make_cloud
from tofclip.arrays import Float32Array, FloatArray
from tofclip.camera import Camera, Measurement, Rectifier
from tofclip.camera.model import compute_ray_directions
from tofclip.camera.noise import MeasurementNoise, find_dazzled
from tofclip.errors import FileFormatError
from tofclip.lidar import PointCloud, depth
from tofclip.lidar.export import read_table
from tofclip.lidar.photons import PhotonCube
from tofclip.loading import CLOUD_SUFFIXES, load
from tofclip.plugins import METHODS, list_settings
from tofclip.recovery import FixedFocus, make_method
from tofclip.recovery.defects import (
    clip_from_below,
    describe_noise,
    find_clipping_level,
    mask_defects,
)
from tofclip.recovery.plan import recover_measurement
from tofclip.sequences.ranger import get_cached_camera
from tofclip.shots import Frames, Streak
from tofclip.solvers import DataTermMaker, LeastSquares, LinearInverse, Method
from tofclip.storage import Record
from tofclip.units import SPEED_OF_LIGHT

if TYPE_CHECKING:
    from apps.verbs.nlos_stream import VolumeStream
    from nlos import Volume

CLOUD_RATE_HZ = SHOT_RATE_HZ = 10.0
MAX_CACHED_CLOUDS, MAX_CACHED_VIEWS = 32, 16


class CloudSource(Source):
    """Clouds in files, shown one after the other; the last 32 looked at stay in memory."""

    def __init__(self, title: str, paths: Sequence[Path]) -> None:
        super().__init__(title, CLOUD_RATE_HZ, frame_name="cloud")
        self._paths = paths
        self._read = functools.lru_cache(MAX_CACHED_CLOUDS)(read_cloud)
        self.view(0)  # what cannot be read is refused before there is a page

    def __len__(self) -> int:
        return len(self._paths)

    def view(self, number: int) -> View:
        path = self._paths[number]
        return View(self._read(path), text=path.name if len(self) > 1 else "")


def read_cloud(path: Path) -> PointCloud:
    """Read a cloud or a picture of ranges, or another's table of x, y and z in metres."""
    try:
        content = load(path)
    except FileFormatError:  # a table of another program may have fewer columns
        if path.suffix.lower() not in CLOUD_SUFFIXES:
            raise
        table = read_table(path)
        if missing := [axis for axis in "xyz" if axis not in table]:
            raise FileFormatError(
                path, f"has no column '{missing[0]}', so it is not a point cloud"
            ) from None
        xyz = np.stack([np.ravel(table.pop(axis)) for axis in "xyz"], axis=-1)
        there = np.isfinite(xyz).all(axis=1)
        return make_cloud(xyz[there], {name: np.ravel(one)[there] for name, one in table.items()})
    if isinstance(content, PointCloud):
        return content
    if not isinstance(content, Record):
        raise FileFormatError(path, "is not a point cloud")
    fields = {name: one.values for name, one in content.fields.items()}
    distance = fields["range_m"] if "range_m" in fields else fields.get("Z")
    if distance is None or distance.ndim != 2:
        raise FileFormatError(path, "has no picture of ranges or depths to show")
    # The picture does not say its camera: a pinhole of the field of view that `tofclip lidar photons`
    # takes where none is given sees ranges as they are, widths maybe not.
    rows, columns = np.nonzero(np.isfinite(distance) & (distance > 0))
    rays = compute_ray_directions(Camera.pinhole(distance.shape), rows, columns)
    rays /= 1 if "range_m" in fields else rays[:, 2:]
    brightness = fields.get("intensity", fields.get("Y", np.ones_like(distance)))
    xyz = distance[rows, columns, np.newaxis] * rays
    return make_cloud(xyz, {"intensity": brightness[rows, columns]})


VOXEL_MODE, SURFACE_MODE, SLICE_MODE = "voxels", "surface", "slices"
PROJECTION_MODE = "maximum projection"
THRESHOLD_HINT = "share of the brightest voxel below which nothing is shown"
VOLUME_PLAY_TIME_S = 8.0
BRIGHT_FRACTION = 0.3  # of the brightest voxel: brighter ones are shown
OPACITY_HINT = "of voxels at the upper limit of the colours; those at the lower one are clear. 1: all are opaque"


class VolumeSource(Source):
    """A volume; frame `n` is slice `n` in z, which matters where slices are shown."""

    def __init__(self, title: str, volume: Volume) -> None:
        rate = max(1.0, volume.grid.z.size / VOLUME_PLAY_TIME_S)
        can_have_surface = min(volume.grid.shape) > 1 and volume.magnitude.any()
        surface = (SURFACE_MODE,) if can_have_surface else ()
        modes = (PROJECTION_MODE, VOXEL_MODE, *surface, SLICE_MODE)
        self.mode = Choice("show as", modes, PROJECTION_MODE)
        self.threshold = Setting("threshold", 0.02, 0.98, 0.01, BRIGHT_FRACTION, THRESHOLD_HINT)
        self.opacity = Setting("opacity", 0.02, 1.0, 0.02, 1.0, OPACITY_HINT)
        settings = self.mode, self.threshold, self.opacity
        super().__init__(title, rate, "slice", settings=settings, quantity="brightness")
        self.volume = volume
        self._magnitude = volume.magnitude.astype(np.float32)
        self._make_view = functools.lru_cache(1)(self._make_view_of)

    def __len__(self) -> int:
        return self.volume.grid.z.size

    def view(self, number: int) -> View:
        mode = self.mode.value
        if mode == SLICE_MODE:
            view = self._make_view(mode, self.threshold.value, number)
            return replace(view, text=f"z {self.volume.grid.z[number]:.3f} m")
        text = f"of all {len(self)} slices"
        view = self._make_view(mode, self.threshold.value, 0)
        view = replace(view, opacity=self.opacity.value)
        return replace(view, whole_name=mode, text=text, caption=f"{mode} {text}")

    def pictures(self, number: int) -> Mapping[str, Picture]:
        projection = self.volume.maximum_projection()
        bright = projection.brightness >= self.threshold.value * self._magnitude.max()
        is_slice = self.mode.value == SLICE_MODE
        return {
            "intensity": self._magnitude[number] if is_slice else projection.brightness,
            "depth": np.where(bright, projection.depth, np.nan).astype(np.float32),
        }

    def _make_view_of(self, mode: str, threshold: float, number: int) -> View:
        surface, grid = None, self.volume.grid
        if mode == SURFACE_MODE:
            surface = self.volume.surface(min(max(threshold, 0.01), 0.99))
            xyz, light = surface.vertices, np.ones(len(surface.vertices), np.float32)
        else:
            bright = (self._magnitude >= threshold * self._magnitude.max()) & (self._magnitude > 0)
            if mode == SLICE_MODE:
                bright[:] = False
                bright[number] = True  # all of it: a slice shows the dark as well
            elif mode == PROJECTION_MODE:
                front = np.zeros_like(bright)
                np.put_along_axis(front, self._magnitude.argmax(axis=0)[np.newaxis], True, axis=0)
                bright &= front
            z, y, x = np.nonzero(bright)
            xyz = np.stack([grid.x[x], grid.y[y], grid.z[z]], axis=-1)
            light = self._magnitude[z, y, x]
        cloud = make_cloud(xyz, {"brightness": light})
        # Depth behind the wall is more useful than the distance from the origin of its coordinates.
        return View(replace(cloud, range=cloud.xyz[:, 2]), surface=surface)


class VolumeStreamSource(Source):
    """The newest volume of a stream that has one; every volume is a frame, the last one is kept."""

    def __init__(self, title: str, stream: VolumeStream) -> None:
        super().__init__(title, 1.0, frame_name="volume", quantity="brightness")
        self._stream = stream

    def __len__(self) -> int:
        return max(self._stream.delivered, 1)

    @property
    def inflow(self) -> Inflow:
        stream, oldest = self._stream, len(self) - 1
        is_live = not stream.ended.is_set()
        return Inflow(oldest, is_live, latency=stream.latency, lost=stream.failed)

    def view(self, number: int) -> View:
        xyz, brightness = self._stream.latest[-1].points(BRIGHT_FRACTION)
        return View(make_cloud(xyz, {"brightness": np.asarray(brightness)}))


NO_TIME_ZERO_NOTE = "no time zero: ranges are right up to a constant (--time-zero-ns)"
LINEAR_NOTE = "linear inverse, which leaves rays: methods tv and l1 do not"
METHOD_HINT = "recovers what is shown once more, with few iterations; at first, as it was recovered"
# methods that cannot refocus; they take some ten seconds, for which a single shot has the time
UNFOCUSED = ("surfaces", "auto")
# enough to read what is written on a surface; `tofclip recover` takes 40
LOOK_METHOD, LOOK_ITERATIONS = "l1", 25


class Measured(NamedTuple):
    """What a camera measured of a shot."""

    measurement: Measurement
    noise: MeasurementNoise | None  # None where it is not known
    data_term: DataTermMaker = LeastSquares


SHEAR_LIMITS = (-3.0, 3.0)  # pixels per view step between which a picture can be refocused
SHEAR_HINT = "recovers once more, at this shear in pixels per view step; 0: as it was"
NEAR_FRAMES = 16  # on either side of a return, that its waveform shows: some pulses
ALL_FRAMES = slice(None)


@functools.cache
def make_look_method(name: str, weight: float | None = None) -> Method:
    """Return a method with few iterations, to look by; `weight` of its prior: its own by default."""
    takes = list_settings(METHODS[name])
    iterations = LOOK_ITERATIONS if {"iterations", "start"} & takes.keys() else None
    made: Any = make_method(name, iterations=iterations, weight=weight)
    return made


class RecoveredSource(Source):
    """Light over time that one camera measured, from which frames can be recovered at any shear.

    `measured_times` (frames,): time of flight of each column of measurements, s; `method`: what it
    is recovered by at first, with this `weight` of its prior. Safe to share by threads.
    """

    def __init__(
        self,
        title: str,
        rate: float,
        camera: Camera,
        measured_times: FloatArray,
        method: str = LOOK_METHOD,
        weight: float | None = None,
    ) -> None:
        super().__init__(title, rate)
        self.camera, self.measured_times = camera, measured_times
        self._first_method, self._weight = method, weight
        self._cached_camera = get_cached_camera(camera)
        options = (method, *(one for one in METHODS if one not in (method, *UNFOCUSED)))
        self.method_choice = Choice("method", options, method, METHOD_HINT)
        self.refocus = Setting("refocus", *SHEAR_LIMITS, 0.1, 0.0, SHEAR_HINT)
        self.settings = self.method_choice, *((self.refocus,) if camera.views > 1 else ())
        # Without a time zero all ranges are off by one constant.
        self.notes = (NO_TIME_ZERO_NOTE,) if camera.time_zero == 0 else ()
        self._recover_view = functools.lru_cache(MAX_CACHED_VIEWS)(
            lambda _, number, shear: make_view(depth(self.recover(number, shear)))
        )

    @property
    def method(self) -> Method:
        name = self.method_choice.value
        if name not in METHODS or name in UNFOCUSED:
            name = LOOK_METHOD
        return make_look_method(name, self._weight if name == self._first_method else None)

    @property
    def method_notes(self) -> tuple[str, ...]:
        return (LINEAR_NOTE,) if self.method_choice.value == LinearInverse.name else ()

    @abc.abstractmethod
    def measure(self, number: int) -> Measured:
        """Return what the camera measured of a shot."""

    def recover(self, number: int, shear: float = 0.0, part: slice = ALL_FRAMES) -> Frames:
        """Recover frames of shot `number`, as `tofclip recover` does."""
        measurement, noise, data_term = self.measure(number)
        method = self.method
        return recover_measurement(
            method,
            self._cached_camera,
            self.measured_times[part],
            Measurement(measurement.values[:, part], measurement.valid[:, part]),
            noise if method.has_prior else None,
            # rounded, because sliders give numbers that differ by rounding only
            FixedFocus(round(shear, 6)),
            data_term=data_term,
        )

    def recover_frames(self, number: int, part: slice = ALL_FRAMES) -> Frames:
        return self.recover(number, part=part)

    def waveform(
        self, number: int, pixel: tuple[int, int], time: float, layer: int = 1
    ) -> FloatArray:
        row, column = pixel
        frames = self.recover_frames(number, find_near(self.measured_times, time))
        return np.stack([frames.times, frames.values[:, row, column]])


def find_near(times: FloatArray, time: float) -> slice:
    """Return the frames about a time."""
    middle = np.searchsorted(times, time)
    return slice(max(0, middle - NEAR_FRAMES), middle + NEAR_FRAMES + 1)


def render_depth(view: View, shape: tuple[int, int]) -> Picture:
    """Return the range of each pixel's most intense return, m; NaN where nothing came back."""
    picture = np.full(shape, np.nan, np.float32)
    if view.pixels is not None:
        upwards = np.argsort(view.cloud.intensity, kind="stable")  # the last one written wins
        row, column = view.pixels[upwards].T
        picture[row, column] = view.cloud.range[upwards]
    return picture


TRANSIENT_PLAY_TIME_S = 12.0  # a whole transient at natural speed
# which points of a transient are shown: those of light that has come back by now, comes back now,
# or ever does
GATE_UP_TO_FRAME, GATE_AROUND_FRAME = "up to the frame", "around the frame"
GATE_ALL_TIMES = "all times"
GATE_HINT = "which points of the transient are shown: those whose light has come back by the current frame, ..."
HALF_GATE_HINT = "frames before and after the current one, for 'around the frame'"


class TransientSource(RecoveredSource):
    """Recovered frames: frame `n` of the source is instant `n`; the cloud is that of all instants, the
    same as `tofclip cloud` makes.

    Another method, or another focus, needs measurements. Where the frames do not hold theirs, the
    camera predicts them from the frames, which explain the measured ones but for the recovery's
    residual.
    """

    def __init__(self, title: str, frames: Frames) -> None:
        rate = frames.times.size / TRANSIENT_PLAY_TIME_S
        name = str(frames.figures.get("method", LOOK_METHOD))
        settings = frames.provenance.get("settings", {})
        weight = re.search(r"\bweight=([\d.e+-]+)", str(settings.get("method", "")))
        known = float(weight[1]) if weight else None
        super().__init__(title, rate, frames.camera, frames.times, name, known)
        self.times, self.frames = frames.times, frames
        modes = (GATE_UP_TO_FRAME, GATE_AROUND_FRAME, GATE_ALL_TIMES)
        self.gate = Choice("time gate", modes, GATE_UP_TO_FRAME, GATE_HINT)
        self.half_gate = Setting("gate half-width", 1, 200, 1, 12, HALF_GATE_HINT)
        self.settings = (self.gate, self.half_gate, *self.settings)

    def __len__(self) -> int:
        return self.frames.times.size

    def find_gate(self, number: int) -> range:
        """Return the frames whose points are shown."""
        half, count = int(self.half_gate.value), len(self)
        if self.gate.value == GATE_AROUND_FRAME:
            return range(max(0, number - half), min(count, number + half + 1))
        return range(number + 1 if self.gate.value == GATE_UP_TO_FRAME else count)

    def view(self, number: int) -> View:
        gate, every = self.find_gate(number), range(len(self))
        shear, method = self.refocus.value, self.method_choice.value
        is_as_it_was = shear == 0 and method == self._first_method
        view = self._whole_view if is_as_it_was else self._recover_view(method, 0, shear)
        times, due = self.frames.times, None
        if gate != every:
            half = (times[-1] - times[0]) / (2 * max(1, times.size - 1))
            first = times[gate.start] - half if gate.start > 0 else -np.inf
            due = (view.cloud.time >= first) & (view.cloud.time <= times[gate.stop - 1] + half)
        return replace(
            view,
            due=due,
            time=times[number],
            caption=f"all {gate.stop} frames"
            if gate == every
            else f"frames {gate.start + 1} to {gate.stop}",
            notes=self.method_notes,
        )

    def measure(self, number: int) -> Measured:
        return self._measured

    def recover_frames(self, number: int, part: slice = ALL_FRAMES) -> Frames:
        return self.frames[part]

    def pictures(self, number: int) -> Mapping[str, Picture]:
        gate = self.find_gate(number)
        frames = slice(gate.start, gate.stop)
        distance = np.maximum(self.frames.times[frames], 0) * SPEED_OF_LIGHT / 2
        # As the intensity of a point, referred to 1 m: far objects would be lost beside near ones.
        light = np.tensordot((distance**2).astype(np.float32), self.frames.values[frames], 1)
        return {
            "streak": self._measured.measurement.values.T,
            "intensity": light,
            "depth": render_depth(self._whole_view, self.camera.image_shape),
        }

    @cached_property
    def _whole_view(self) -> View:
        return make_view(depth(self.frames))

    @cached_property
    def _measured(self) -> Measured:
        """What the camera read, where it was dazzled what it would have read."""
        frames, predictions = self.frames, self._predictions
        alive = np.repeat(~self.camera.dead_columns[:, np.newaxis], len(self), axis=1)
        if not frames.measured.size:
            return Measured(Measurement(predictions, alive), None)
        noise, known = MeasurementNoise.from_figures(frames.figures), np.isfinite(frames.measured)
        whole = Measurement(np.where(known, frames.measured, predictions), alive)
        dazzled = find_dazzled(whole, noise) if noise is not None else ~alive
        return Measured(Measurement(whole.values, known | (dazzled & alive)), noise)

    @cached_property
    def _predictions(self) -> Float32Array:
        """What the camera would read; neighbouring frames of one shear share an operator."""
        frames, shears = self.frames, self.frames.shears
        measurements = np.empty((frames.camera.slit_width_px, frames.times.size), np.float32)
        cuts = np.flatnonzero(np.concatenate([[True], np.diff(shears) != 0, [True]]))
        for first, stop in pairwise(cuts.tolist()):
            operator = frames.camera.operator(float(shears[first]))
            values = np.ascontiguousarray(np.moveaxis(frames.values[first:stop], 0, -1))
            measurements[:, first:stop] = operator(values)
        return measurements


class ShotSource(Source):
    """Shots, from files or while they come in; frame `n` is the cloud of shot `n`."""

    _shots: Shots

    def __len__(self) -> int:
        return len(self._shots)

    @property
    def inflow(self) -> Inflow:
        return self._shots.inflow

    def close(self) -> None:
        self._shots.close()


class StreakSource(ShotSource, RecoveredSource):
    """Streak images of one camera. `row_times` (rows,): instant of each row, s."""

    def __init__(
        self,
        title: str,
        shots: Shots,
        camera: Camera,
        row_times: FloatArray,
        method: str = LOOK_METHOD,
    ) -> None:
        super().__init__(title, SHOT_RATE_HZ, camera, row_times - camera.time_zero, method)
        self.frame_name = "shot"
        self._shots, self._rectifier = shots, Rectifier(camera, row_times.size)
        self._measure = functools.lru_cache(2)(self._measure_shot)

    def view(self, number: int) -> View:
        made, name = self._shots.get(number).view, self.method_choice.value
        shear = self.refocus.value
        if made is None or shear or self._shots.method_name != name:
            made = self._recover_view(name, number, shear)
        return replace(made, notes=self.method_notes)

    def measure(self, number: int) -> Measured:
        return self._measure(number)

    def _measure_shot(self, number: int) -> Measured:
        shot = self._shots.get(number).shot
        assert isinstance(shot, Streak)
        streak = mask_defects(shot, self.camera.pulse_fwhm)
        measurement = self._rectifier.measure(streak.counts, streak.saturated)
        data_term = clip_from_below(streak, find_clipping_level(streak.counts))
        return Measured(measurement, describe_noise(streak, measurement), data_term)

    def pictures(self, number: int) -> Mapping[str, Picture]:
        view, light = self.view(number), np.zeros(self.camera.image_shape, np.float32)
        if view.pixels is not None:
            np.add.at(light, tuple(view.pixels.T), view.cloud.intensity)
        picture = render_depth(view, light.shape)
        streak = self.measure(number).measurement.values.T
        return {"streak": streak, "intensity": light, "depth": picture}


class PhotonSource(ShotSource):
    """Histograms of a picture as they come."""

    def __init__(self, title: str, shots: LiveShots, camera: Camera) -> None:
        super().__init__(title, SHOT_RATE_HZ, frame_name="shot")
        self._shots, self.camera = shots, camera
        self.notes = (NO_TIME_ZERO_NOTE,) if camera.time_zero == 0 else ()

    def view(self, number: int) -> View:
        made = self._shots.get(number).view
        assert made is not None
        return made

    def pictures(self, number: int) -> Mapping[str, Picture]:
        light = self._shots.get(number).shot.counts.sum(axis=0, dtype=np.float32)
        depth_picture = render_depth(self.view(number), self.camera.image_shape)
        return {"intensity": light, "depth": depth_picture}

    def waveform(
        self, number: int, pixel: tuple[int, int], time: float, layer: int = 1
    ) -> FloatArray:
        shot, (row, column) = self._shots.get(number).shot, pixel
        assert isinstance(shot, PhotonCube)
        times = shot.times - self.camera.time_zero
        near = find_near(times, time)
        return np.stack([times[near], shot.counts[near, row, column]])
