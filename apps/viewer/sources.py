"""What can be looked at: clouds in files; the recovered frames of one shot, refocused at any shear;
raw shots, recovered as they are looked at, from files or while they come in; hidden volumes.
"""

from __future__ import annotations

import abc
import functools
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from apps.verbs.photons import DEFAULT_FIELD_OF_VIEW_DEG
from apps.viewer.source import (
    LINEAR_FRAMES_NOTE,
    LINEAR_NOTE,
    Capabilities,
    DisplayModes,
    FloatArray,
    Gate,
    Inflow,
    Source,
    TriangleMesh,
    View,
    Waveform,
    list_camera_notes,
)
from devices.transients import TrackedShots
from nlos import Volume
from tofclip.camera import Camera, Rectifier
from tofclip.errors import FileFormatError, InputError, TofclipError
from tofclip.files import format_error_line
from tofclip.lidar import Detection, PointCloud, Returns, depth, point_cloud
from tofclip.lidar.cloud import OPTIONAL_COLUMNS
from tofclip.lidar.export import read_table
from tofclip.lidar.geometry import compute_ray_directions
from tofclip.lidar.photons import make_pinhole
from tofclip.lidar.processing import select_points
from tofclip.lidar.significance import SCENE_BRIGHTNESS_QUANTILE
from tofclip.loading import load, outline
from tofclip.sequences.cache import get_cached_camera, prepare_inverse
from tofclip.sequences.ranger import RangingPipeline
from tofclip.sequences.streaming import stream_clouds
from tofclip.shots import Frames, Streak
from tofclip.solvers import LinearInverse, Method
from tofclip.storage import Record
from tofclip.units import SPEED_OF_LIGHT

Readings = NDArray[np.float32]

SHEAR_LIMITS = (-3.0, 3.0)  # pixels per view step between which a picture can be refocused
# of the strongest return of its pixel; weaker ones before it are mostly rays, which would hide it
MIN_PIXEL_SHARE = 0.3
MIN_FRAMES = 3  # without a neighbour on either side no return is located


class ShotRecovery:
    """Turns the measurements of one camera into frames, at any shear. `times` (frames,): time of
    flight of each column of measurements, s. By default the linear inverse: one operator and one
    matrix (columns, columns) for each of the last 16 shears, which every recovery of this process
    shares. Safe to share by threads.
    """

    def __init__(self, camera: Camera, times: FloatArray, method: Method | None = None) -> None:
        self.camera, self.times = camera, times
        self.method: Method = LinearInverse() if method is None else method
        self._cached_camera = get_cached_camera(camera)

    @property
    def is_linear(self) -> bool:
        """Whether frames are a quick look, by the linear inverse."""
        return isinstance(self.method, LinearInverse)

    def frames(self, measurements: Readings, shear: float, gate: Gate) -> Frames:
        """Recover the frames of a gate from the rectified measurements (columns, frames) of a shot."""
        part = np.ascontiguousarray(measurements[:, gate.frames])
        if self.is_linear:
            # Rounded, because sliders give numbers that differ by rounding only.
            operator = self._cached_camera.operator(round(shear, 6))
            inverse = prepare_inverse(LinearInverse(), operator, ~self.camera.dead_columns)
            found = inverse.recover(part).frames
        elif part.max(initial=0.0) > 0:
            valid = np.broadcast_to(~self.camera.dead_columns[:, np.newaxis], part.shape)
            found = self.method.recover(self.camera.operator(shear), part, valid).frames
        else:  # a dark gate has no brightest frame to set a prior's weight by
            found = np.zeros((part.shape[1], *self.camera.image_shape), np.float32)
        times = self.times[gate.frames]
        return Frames(found, times, self.camera, shears=np.full(times.size, shear))

    def view(
        self, measurements: Readings, shear: float, gate: Gate, least_intensity: float = 0.0
    ) -> View:
        """Recover the frames of a gate and locate their returns. `least_intensity`, counts,
        referred to 1 m: weaker returns are left out: a threshold relative to the gate would find
        noise in a dark one.
        """
        first = max(0, min(gate.first, self.times.size - MIN_FRAMES))
        widened = Gate(first, max(gate.stop, first + MIN_FRAMES))
        view = make_view(depth(self.frames(measurements, shear, widened)))
        return view if least_intensity <= 0 else select_brighter(view, least_intensity)


def list_recovery_notes(recovery: ShotRecovery) -> tuple[str, ...]:
    """Return what has to be said about clouds that were recovered while one looks."""
    quick = (LINEAR_NOTE,) if recovery.is_linear else ()
    return quick + list_camera_notes(recovery.camera)


def make_view(returns: Returns, cloud: PointCloud | None = None) -> View:
    """Return the points of returns and which pixel saw them; `cloud`: of these, where it is known."""
    points = point_cloud(returns) if cloud is None else cloud
    return View(points, np.stack([returns.y, returns.x], axis=-1))


def find_min_intensity(whole: PointCloud) -> float:
    """Return the intensity below which a return of a shot does not count, as `Detection` has it for
    all of its frames.
    """
    if not whole.intensity.size:
        return 0.0
    scene = float(np.quantile(whole.intensity, SCENE_BRIGHTNESS_QUANTILE))
    return scene * Detection().min_scene_fraction


def select_brighter(view: View, intensity: float) -> View:
    """Return the points with a minimum number of counts."""
    return _select(view, view.cloud.intensity >= intensity)


def leave_out_rays(view: View) -> View:
    """Return a view without dim points: of the whole scene, and beside a brighter one of their
    pixel.
    """
    found = select_brighter(view, find_min_intensity(view.cloud))
    if found.pixels is None or len(found.cloud) == 0:
        return found
    strongest = np.zeros(found.pixels.max(axis=0) + 1, np.float32)
    row, column = found.pixels.T
    np.maximum.at(strongest, (row, column), found.cloud.intensity)
    return _select(found, found.cloud.intensity >= MIN_PIXEL_SHARE * strongest[row, column])


def _select(view: View, kept: NDArray[np.bool_]) -> View:
    return View(select_points(view.cloud, kept), None if view.pixels is None else view.pixels[kept])


CLOUD_SUFFIXES = (".ply", ".pcd", ".csv", ".npz", ".las", ".laz", ".e57")
CLOUD_RATE_HZ = 10.0
MAX_CACHED_CLOUDS = 32


class CloudSource(Source):
    """Clouds in files, shown one after the other; the last 32 looked at stay in memory."""

    def __init__(self, title: str, paths: Sequence[Path]) -> None:
        super().__init__(title, CLOUD_RATE_HZ, frame_name="cloud")
        self._paths = list(paths)
        self._read = functools.lru_cache(MAX_CACHED_CLOUDS)(
            lambda number: View(read_cloud(self._paths[number]))
        )
        if not self._paths:
            raise InputError(f"{title}: there is no cloud to show")
        cloud = self.view(0).cloud
        # Of a cloud of this program: the dim rays that few views leave around bright things would
        # hide the others. What intensities of other programs mean is not known.
        if np.any(cloud.range_sigma > 0):
            self.min_intensity = find_min_intensity(cloud)

    def __len__(self) -> int:
        return len(self._paths)

    def describe_frame(self, number: int) -> str:
        """Name the file of cloud `number`."""
        return self._paths[number].name if len(self._paths) > 1 else ""

    def view(self, number: int) -> View:
        return self._read(number)


def find_clouds(folder: Path) -> list[Path]:
    """Return the files of a folder that are clouds by their names, in order."""
    return sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in CLOUD_SUFFIXES and path.name[0] != "."
    )


def read_cloud(path: Path) -> PointCloud:
    """Read a cloud of this program, or another's table of points with at least x, y and z in
    metres.
    """
    if path.suffix.lower() == ".h5":
        return PointCloud.load(path)
    record = None if path.suffix.lower() not in (".npz", ".exr") else outline(path)
    if record is not None and record.kind in ("range image", "depth picture"):
        return _place_pixels(load(path))
    table = read_table(path)
    if missing := [axis for axis in "xyz" if axis not in table]:
        raise FileFormatError(path, f"has no column '{missing[0]}', so it is not a point cloud")
    xyz = np.stack([table[axis] for axis in "xyz"], axis=-1)
    return make_cloud(xyz[np.all(np.isfinite(xyz), axis=1)] if len(table) == 3 else xyz, table)


def _place_pixels(picture: Record) -> PointCloud:
    """Points of a picture that does not say its camera, seen by a pinhole of the field of view that
    `tofclip lidar photons` takes where none is given: ranges are the file's, widths are not.
    """
    fields = {name: one.values for name, one in picture.fields.items()}
    distance = fields["range_m"] if "range_m" in fields else fields.get("Z")
    if distance is None or distance.ndim != 2:
        raise FileFormatError(picture.origin, "has no picture of ranges or depths to show")
    rows, columns = np.nonzero(np.isfinite(distance) & (distance > 0))
    focal_length_px = distance.shape[1] / 2 / np.tan(np.deg2rad(DEFAULT_FIELD_OF_VIEW_DEG) / 2)
    camera = make_pinhole(distance.shape, float(focal_length_px), 1e-10)
    rays = compute_ray_directions(camera, rows, columns)
    rays /= rays[:, 2:] if "range_m" not in fields else 1
    brightness = fields.get("intensity", fields.get("Y", np.ones_like(distance)))
    return make_cloud(
        distance[rows, columns, np.newaxis] * rays, {"intensity": brightness[rows, columns]}
    )


def make_cloud(xyz: NDArray[Any], known: dict[str, NDArray[Any]] | None = None) -> PointCloud:
    """Make a cloud of positions (n, 3), m; columns that are not known follow from them, or are 0.
    ``"brightness"`` counts as intensity.
    """
    known = known or {}
    distance = np.linalg.norm(xyz, axis=1)
    nothing = np.zeros(len(xyz), np.float32)
    columns: dict[str, Any] = {
        "intensity": known.get("intensity", known.get("brightness", nothing)),
        # Files of earlier versions call it confidence.
        "range_sigma": known.get("range_sigma", known.get("confidence", nothing)),
        "range": known.get("range", distance),
        "return_number": known.get("return_number", np.ones(len(xyz), np.uint8)),
        # Light travels the range twice.
        "time": known.get("time", 2 * distance / SPEED_OF_LIGHT),
        **{name: known[name] for name in OPTIONAL_COLUMNS if name in known},
    }
    return PointCloud(xyz=xyz, **columns)


TRANSIENT_PLAY_TIME_S = 12.0  # a whole transient at natural speed


class TransientSource(Source):
    """Recovered frames: frame `n` of the source is instant `n`; the cloud is that of all instants.

    Refocusing needs measurements. Where they are not at hand, as with a file of frames,
    the camera predicts them from the frames, which explain the measured ones but for the recovery's
    residual.

    `measurements` (columns, frames): rectified, of the frames; `method`: of a refocus; the linear
    inverse by default.
    """

    def __init__(
        self,
        title: str,
        frames: Frames,
        measurements: Readings | None = None,
        method: Method | None = None,
    ) -> None:
        shears = SHEAR_LIMITS if frames.camera.views > 1 else None
        capabilities = Capabilities(frames.times, shears)
        super().__init__(title, frames.times.size / TRANSIENT_PLAY_TIME_S, capabilities)
        self.frames = frames
        self._recovery = ShotRecovery(frames.camera, frames.times, method)
        self.notes = list_camera_notes(frames.camera)
        if measurements is not None:
            self.notes = list_recovery_notes(self._recovery)
        elif frames.figures.get("method") == LinearInverse.name:
            self.notes = (LINEAR_FRAMES_NOTE, *self.notes)
        self._measured = measurements

    def __len__(self) -> int:
        return int(self.frames.times.size)

    def view(self, number: int) -> View:
        return self._full_view

    def recover_frames(self, number: int) -> Frames:
        """Return the frames of the one shot that there is."""
        return self.frames

    def pictures(self, number: int, gate: Gate) -> Mapping[str, NDArray[np.float32]]:
        distance = np.maximum(self.frames.times[gate.frames], 0) * SPEED_OF_LIGHT / 2
        # As the intensity of a point, referred to 1 m: far objects would be lost beside near ones.
        light = np.tensordot((distance**2).astype(np.float32), self.frames.values[gate.frames], 1)
        return {
            "streak": self._measurements.T,
            "intensity": light,
            "depth": render_depth(self._full_view, self.frames.camera.image_shape),
        }

    @property
    def refocus_note(self) -> str:
        return LINEAR_NOTE if self._recovery.is_linear else ""

    def waveform(self, number: int, pixel: tuple[int, int]) -> Waveform:
        row, column = pixel
        return Waveform(self.frames.times, self.frames.values[:, row, column])

    def refocus(self, number: int, shear: float, gate: Gate) -> View:
        least = find_min_intensity(self._full_view.cloud)
        return self._recovery.view(self._measurements, shear, gate, least)

    @cached_property
    def _full_view(self) -> View:
        # Surfaces were found with their points; frames are searched for theirs.
        if self.frames.returns is not None:
            return make_view(self.frames.returns)
        # Of these the dim ones, rays that few views leave around bright things, would hide the others.
        return leave_out_rays(make_view(depth(self.frames)))

    @cached_property
    def _measurements(self) -> Readings:
        """What the camera read or would read, (columns, frames); neighbouring frames of one shear
        share an operator.
        """
        if self._measured is not None:
            return self._measured
        frames, shears = self.frames, self.frames.shears
        measurements = np.empty((frames.camera.slit_width_px, frames.times.size), np.float32)
        cuts = np.flatnonzero(np.concatenate([[True], np.diff(shears) != 0, [True]]))
        for first, stop in pairwise(cuts.tolist()):
            operator = frames.camera.operator(float(shears[first]))
            measurements[:, first:stop] = operator(
                np.ascontiguousarray(np.moveaxis(frames.values[first:stop], 0, -1))
            )
        return measurements


def render_depth(view: View, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return the range of each pixel's most intense return, m; NaN where nothing came back."""
    picture = np.full(shape, np.nan, np.float32)
    if view.pixels is not None:
        upwards = np.argsort(view.cloud.intensity, kind="stable")  # the last one written wins
        row, column = view.pixels[upwards].T
        picture[row, column] = view.cloud.range[upwards]
    return picture


SHOT_RATE_HZ = 10.0
MAX_CACHED_VIEWS = 16


class ShotSource(Source):
    """Shots of one camera, wherever they come from; frame `n` is the cloud of shot `n`. `row_times`
    (rows,): instant of each row, s; `method`: the linear inverse by default.
    """

    def __init__(
        self,
        title: str,
        camera: Camera,
        row_times: NDArray[np.float64],
        method: Method | None = None,
    ) -> None:
        self.recovery = ShotRecovery(camera, row_times - camera.time_zero, method)
        super().__init__(
            title,
            SHOT_RATE_HZ,
            Capabilities(shears=SHEAR_LIMITS if camera.views > 1 else None),
            frame_name="shot",
            notes=list_recovery_notes(self.recovery),
        )
        self._recover_view = functools.lru_cache(MAX_CACHED_VIEWS)(
            lambda number: self.recovery.view(self.measurements(number), 0.0, self._full_gate)
        )

    @cached_property
    def rectifier(self) -> Rectifier:
        """What takes the sweep off a shot."""
        return Rectifier(self.recovery.camera, self.recovery.times.size)

    @abc.abstractmethod
    def measurements(self, number: int) -> Readings:
        """Return the rectified measurements of a shot, (columns, rows)."""

    def rectify(self, streak: Streak) -> Readings:
        """Take dark level and sweep off a shot."""
        return self.rectifier.measure(streak.counts, streak.saturated).values

    def view(self, number: int) -> View:
        return self._recover_view(number)

    def recover_frames(self, number: int) -> Frames:
        """Return all frames of shot `number`."""
        return self.recovery.frames(self.measurements(number), 0.0, self._full_gate)

    def pictures(self, number: int, gate: Gate) -> Mapping[str, NDArray[np.float32]]:
        measurements = self.measurements(number)
        # the 64 frames about the brightest one: a picture of all would cost as much as the cloud
        brightest = int(measurements.sum(axis=0).argmax())
        about = Gate(max(0, brightest - 32), min(int(self.recovery.times.size), brightest + 32))
        bright = self.recovery.frames(measurements, 0.0, about)
        return {
            "streak": measurements.T,
            "intensity": bright.values.sum(axis=0),
            "depth": render_depth(self.view(number), self.recovery.camera.image_shape),
        }

    def waveform(self, number: int, pixel: tuple[int, int]) -> Waveform:
        frames = self.recover_frames(number)
        return Waveform(frames.times, frames.values[:, pixel[0], pixel[1]].copy())

    def refocus(self, number: int, shear: float, gate: Gate) -> View:
        return self.recovery.view(self.measurements(number), shear, self._full_gate)

    @property
    def _full_gate(self) -> Gate:
        return Gate(0, int(self.recovery.times.size))


class StoredShotSource(ShotSource):
    """Shots in files, each read when it is looked at; the measurements of the last one are kept."""

    def __init__(
        self,
        title: str,
        shots: Sequence[Callable[[], Streak]],
        camera: Camera,
        method: Method | None = None,
    ) -> None:
        super().__init__(title, camera, shots[0]().times, method)
        self._shots = shots
        self._last: tuple[int, Readings] | None = None

    def __len__(self) -> int:
        return len(self._shots)

    def measurements(self, number: int) -> Readings:
        if self._last is None or self._last[0] != number:
            self._last = (number, self.rectify(self._shots[number]()))
        return self._last[1]


VOXEL_MODE, SURFACE_MODE, PROJECTION_MODE, SLICE_MODE = (
    "voxels",
    "surface",
    "maximum projection",
    "slices",
)
VOLUME_PLAY_TIME_S = 8.0


class VolumeSource(Source):
    """A volume; frame `n` is slice `n` in z, which matters where slices are shown."""

    def __init__(self, title: str, volume: Volume) -> None:
        super().__init__(
            title, max(1.0, volume.grid.z.size / VOLUME_PLAY_TIME_S), frame_name="slice"
        )
        can_have_surface = min(volume.grid.shape) > 1 and bool(volume.magnitude.any())
        surface = (SURFACE_MODE,) if can_have_surface else ()
        names = (PROJECTION_MODE, VOXEL_MODE, *surface, SLICE_MODE)
        self.display_modes = DisplayModes(names, PROJECTION_MODE)
        self.volume = volume
        self._magnitude = volume.magnitude.astype(np.float32)
        self._views: dict[tuple[str, float, int], View] = {}

    def __len__(self) -> int:
        return int(self.volume.grid.z.size)

    @property
    def whole_name(self) -> str:
        return "" if self.display_modes.current == SLICE_MODE else self.display_modes.current

    def describe_frame(self, number: int) -> str:
        if self.whole_name:
            return f"of all {len(self)} slices"
        return f"z {self.volume.grid.z[number]:.3f} m"

    def view(self, number: int) -> View:
        chosen = self.display_modes.current
        key = (chosen, self.display_modes.threshold, number if chosen == SLICE_MODE else 0)
        if key not in self._views:
            self._views = {key: self._make_view(number)}
        return self._views[key]

    def pictures(self, number: int, gate: Gate) -> Mapping[str, NDArray[np.float32]]:
        projection = self.volume.maximum_projection()
        bright = projection.brightness >= self.display_modes.threshold * self._magnitude.max()
        return {
            "intensity": self._magnitude[number]
            if self.display_modes.current == SLICE_MODE
            else projection.brightness,
            "depth": np.where(bright, projection.depth, np.nan).astype(np.float32),
        }

    def surface(self) -> TriangleMesh | None:
        if self.display_modes.current != SURFACE_MODE:
            return None
        mesh = self.volume.surface(min(max(self.display_modes.threshold, 0.01), 0.99))
        return TriangleMesh(mesh.vertices, mesh.faces)

    def _make_view(self, number: int) -> View:
        if self.display_modes.current == SURFACE_MODE:
            mesh = self.surface()
            vertices = np.empty((0, 3), np.float32) if mesh is None else mesh.vertices
            return View(self._make_cloud(vertices, np.ones(len(vertices), np.float32)))
        if self.display_modes.current not in self.display_modes.names:
            raise InputError(
                f"a volume is shown as {', '.join(self.display_modes.names)}, not as '{self.display_modes.current}'"
            )
        shown = self._select_voxels(number)
        z, y, x = np.nonzero(shown)
        grid = self.volume.grid
        xyz = np.stack([grid.x[x], grid.y[y], grid.z[z]], axis=-1)
        return View(self._make_cloud(xyz, self._magnitude[z, y, x]))

    def _select_voxels(self, number: int) -> NDArray[np.bool_]:
        """Which voxels are drawn, (z, y, x)."""
        bright: NDArray[np.bool_] = (
            self._magnitude >= self.display_modes.threshold * self._magnitude.max()
        ) & (self._magnitude > 0)
        if self.display_modes.current == SLICE_MODE:
            bright[:] = False
            bright[number] = True  # all of it: a slice shows the dark as well
        elif self.display_modes.current == PROJECTION_MODE:
            front = np.zeros_like(bright)
            np.put_along_axis(front, self._magnitude.argmax(axis=0)[np.newaxis], True, axis=0)
            bright &= front
        return bright

    def _make_cloud(self, xyz: NDArray[Any], brightness: NDArray[Any]) -> PointCloud:
        cloud = make_cloud(xyz, {"brightness": brightness})
        # Depth behind the wall is more useful than the distance from the origin of its coordinates.
        return replace(cloud, range=cloud.xyz[:, 2])


BRIGHT_FRACTION = 0.3  # of the brightest voxel: brighter ones are shown


class VolumeFeed(Protocol):
    """What a stream of volumes reports while it runs."""

    latency: float
    delivered: int
    failed: int
    ended: threading.Event

    latest: deque[Volume]  # the newest alone


class VolumeStreamSource(Source):
    """The newest volume of a stream that has one; every volume is a frame, the last one is kept."""

    def __init__(self, title: str, feed: VolumeFeed) -> None:
        super().__init__(title, 1.0, frame_name="volume")
        self._feed = feed

    def __len__(self) -> int:
        return max(self._feed.delivered, 1)

    @property
    def inflow(self) -> Inflow:
        feed = self._feed
        is_live = not feed.ended.is_set()
        return Inflow(len(self) - 1, is_live, latency=feed.latency, lost=feed.failed)

    def view(self, number: int) -> View:
        xyz, brightness = self._feed.latest[-1].points(BRIGHT_FRACTION)
        return View(make_cloud(xyz, {"brightness": np.asarray(brightness)}))


MAX_CACHED_SHOTS = 32
STOP_TIMEOUT_S = 10.0  # for the shot under way and for letting go of the instrument
RATE_WINDOW_SHOTS = 8  # arrivals over which the data rate is averaged


class LiveShotSource(ShotSource):
    """Shots that an iterator delivers, made into clouds as they come; the last 32 can be looked at
    again.

    Clouds are those of `tofclip.sequences.streaming.stream_clouds`, one shot at a time on all cores,
    so that each is seen soon. Of the shots that come meanwhile only the newest waits, so that what
    one sees is never late; `lost` counts the others wherever it happened, in the instrument, its
    driver or here.

    The end of `shots`, or a fault of an instrument, ends the source; what came can still be looked
    at. `method`: the linear inverse by default: others take seconds for a shot.
    """

    def __init__(
        self,
        title: str,
        shots: Iterator[Streak] | TrackedShots,
        camera: Camera,
        method: Method | None = None,
    ) -> None:
        self._shots = shots if isinstance(shots, TrackedShots) else TrackedShots(shots)
        first = next(self._shots, None)
        if first is None:
            raise InputError(f"{title}: the source ended before it gave anything")
        if isinstance(first, TofclipError):
            raise first
        super().__init__(title, camera, first.times, method)
        self._cache: deque[tuple[Readings, View]] = deque(maxlen=MAX_CACHED_SHOTS)
        self._arrivals: deque[float] = deque(maxlen=RATE_WINDOW_SHOTS + 1)
        self._count, self._failure_text = 0, ""
        self._latency, self._lost = float("nan"), 0
        self._pipeline = RangingPipeline(camera, first.times)
        self.rectifier = self._pipeline.rectifier  # knows the sweep already
        self._lock, self._stopping = threading.Lock(), threading.Event()
        self._ended = False
        measurements = self.rectify(first)
        self._append_entry(measurements, make_view(self._pipeline.find_returns(measurements)))
        self._thread = threading.Thread(target=self._run, name="live shots", daemon=True)
        self._thread.start()

    def __len__(self) -> int:
        return self._count

    @property
    def inflow(self) -> Inflow:
        with self._lock:
            rate = 0.0
            if len(self._arrivals) > 1 and not self._ended:
                span = self._arrivals[-1] - self._arrivals[0]
                rate = (len(self._arrivals) - 1) / max(span, 1e-9)
            oldest = self._count - len(self._cache)
            state = (self._latency, self._lost, self._failure_text)
            return Inflow(oldest, not self._ended, rate, *state)

    def view(self, number: int) -> View:
        return self._find_entry(number)[1]

    def measurements(self, number: int) -> Readings:
        return self._find_entry(number)[0]

    def close(self) -> None:
        self._stopping.set()
        self._thread.join(STOP_TIMEOUT_S)

    def _find_entry(self, number: int) -> tuple[Readings, View]:
        """Return what is kept of a shot, or of the nearest that is."""
        with self._lock:
            place = number - (self._count - len(self._cache))
            return self._cache[min(max(place, 0), len(self._cache) - 1)]

    def _run(self) -> None:
        try:
            with ThreadPoolExecutor(1) as worker:
                how: Any = {"policy": "drop_oldest", "executor": worker, "at_once": 1}
                stream = stream_clouds(self._shots, self._pipeline, **how)
                # closing the generator stops its threads and the instrument
                with closing(stream) as clouds:
                    for made in clouds:
                        if self._stopping.is_set():
                            break
                        stamp = self._shots.get_stamp(made.shot + 1)  # the first one is shown
                        self._append_entry(made.measurements, make_view(made.returns, made.cloud))
                        age = stamp.compute_age()
                        self._latency = made.latency if age is None else age
                        self._lost = self._shots.count_dropped(stamp, self._count)
        except Exception as fault:
            # Whatever ends it is shown on the page: an exception on this thread would be lost.
            self._failure_text = format_error_line(fault)
        finally:
            self._lost = self._shots.count_shots(self._count).dropped
            self._ended = True

    def _append_entry(self, measurements: Readings, view: View) -> None:
        if not self.recovery.is_linear:
            # seconds of work, meanwhile the newest shot waits and older ones are dropped
            view = self.recovery.view(measurements, 0.0, self._full_gate)
        with self._lock:
            self._cache.append((measurements, view))
            self._count += 1
            self._arrivals.append(time.monotonic())
