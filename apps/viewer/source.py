"""What can be looked at: anything that gives a cloud for each of its frames."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera
from tofclip.errors import InputError
from tofclip.lidar import PointCloud

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class View:
    """What a source shows in one frame."""

    cloud: PointCloud
    # (n, 2), row and column of the pixel that saw each point
    pixels: NDArray[np.int32] | None = None


@dataclass(frozen=True)
class Waveform:
    """A pixel's signal over time."""

    times: FloatArray  # (n,), time of flight, s
    counts: NDArray[np.float32]  # (n,)


@dataclass(frozen=True)
class TriangleMesh:
    """A surface: vertices (v, 3) in m and corners (f, 3) of each triangle."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]


@dataclass(frozen=True)
class Gate:
    """Frames of a transient from `first` up to, not including, `stop`."""

    first: int
    stop: int

    @property
    def frames(self) -> slice:
        """As an index."""
        return slice(self.first, self.stop)


@dataclass
class DisplayModes:
    """How a source shows itself, where it can be shown in several ways."""

    names: tuple[str, ...] = ()  # the ways there are; empty where there is one only
    current: str = ""
    threshold: float = 0.3  # share of the brightest voxel below which nothing is shown


@dataclass
class Setting:
    """A number that is set by a slider while one looks."""

    name: str  # with its unit
    low: float
    high: float
    step: float
    value: float
    hint: str = ""


@dataclass(frozen=True)
class Capabilities:
    """What a source can do beyond showing its frames."""

    # (frames,), time of flight of each frame, s, of a source whose frames are the instants of one
    # transient
    times: FloatArray | None = None
    # least and largest shear of a refocus, pixels per view step; None where it cannot be refocused
    shears: tuple[float, float] | None = None


@dataclass(frozen=True)
class Inflow:
    """What comes into a source while one looks; nothing by default."""

    oldest: int = 0  # first frame that is still there
    is_live: bool = False  # whether frames are added
    data_rate: float = 0.0  # frames per second
    # from when the instrument took a shot, by its own clock where it sends one, until it could be
    # shown, s; NaN where nothing comes in
    latency: float = float("nan")
    lost: int = 0  # shots that were taken and are not shown, wherever they were lost
    failure_text: str = ""  # what ended it early, in a line


@dataclass
class Source(abc.ABC):
    """A row of frames, numbered from 0."""

    title: str  # what the page calls it
    rate: float  # frames per second at natural speed
    capabilities: Capabilities = field(default_factory=Capabilities)
    display_modes: DisplayModes = field(default_factory=DisplayModes)
    frame_name: str = "frame"  # what a frame is: an instant's frame, a slice, a shot or a cloud
    # what has to be known about everything that is shown, such as that ranges have no time zero
    notes: tuple[str, ...] = ()
    settings: tuple[Setting, ...] = ()  # what is set by sliders, beyond what all sources have
    # counts; dimmer points are left out until the filters are reset. 0 for none
    min_intensity: float = 0.0

    @abc.abstractmethod
    def __len__(self) -> int:
        """Number of frames so far."""

    @abc.abstractmethod
    def view(self, number: int) -> View:
        """Return what is to be seen in frame `number`."""

    @property
    def inflow(self) -> Inflow:
        """What comes in while one looks."""
        return Inflow()

    @property
    def refocus_note(self) -> str:
        """What has to be said while a refocus is shown; empty where there is nothing to say."""
        return ""

    @property
    def whole_name(self) -> str:
        """What is shown where it is all frames, such as a maximum projection; empty where it is one."""
        return ""

    def describe_frame(self, number: int) -> str:
        """Say in a few words what frame `number` is, beyond its time, if anything."""
        return ""

    def pictures(self, number: int, gate: Gate) -> Mapping[str, NDArray[np.float32]]:
        """Return pictures of frame `number`, or of a transient's gate, by name: "streak",
        "intensity", "depth" (m, NaN where there is none).
        """
        return {}

    def waveform(self, number: int, pixel: tuple[int, int]) -> Waveform | None:
        """Return the signal of a pixel (row, column) in frame `number`, None where it is not known."""
        return None

    def refocus(self, number: int, shear: float, gate: Gate) -> View:
        """Recover the frames of a gate once more, at another shear, pixels per view step."""
        raise InputError(f"{self.title} holds no measurements, so it cannot be refocused")

    def surface(self) -> TriangleMesh | None:
        """Return the surface to draw instead of points, None where points are shown."""
        return None

    def close(self) -> None:  # noqa: B027 - most sources hold nothing
        """Let go of files and instruments."""


NO_TIME_ZERO_NOTE = "no time zero: ranges are right up to a constant (--time-zero-ns)"
LINEAR_NOTE = "quick look (linear): --method tv shows it sharper"
LINEAR_FRAMES_NOTE = "quick look (linear): tofclip recover --method tv gives sharper frames"


def list_camera_notes(camera: Camera) -> tuple[str, ...]:
    """Return what has to be said about ranges that a camera measured: without a time zero all of them
    are off by one constant.
    """
    return (NO_TIME_ZERO_NOTE,) if camera.time_zero == 0 else ()


def make_empty_cloud() -> PointCloud:
    """Return a cloud without points."""
    empty: Any = np.empty(0, np.float32)
    return PointCloud(
        np.empty((0, 3), np.float32), empty, empty, empty, np.empty(0, np.uint8), empty
    )
