"""What can be looked at: anything that gives a view of points, and facts about it, for each of its
frames; and several of them at once, as layers of one scene.
"""

from __future__ import annotations

import abc
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Generic, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import AnyArray, BoolArray, Float32Array, FloatArray
from tofclip.lidar import PointCloud
from tofclip.lidar.cloud import complete_cloud

if TYPE_CHECKING:
    from nlos.export import Mesh

Frame = TypeVar("Frame")
Picture = Float32Array  # (rows, columns)
Limits = tuple[float, float]  # both inclusive
NO_LIMITS: Limits = (-np.inf, np.inf)


@dataclass(frozen=True)
class View:
    """What a source shows in one frame, and the facts about it."""

    cloud: PointCloud
    pixels: NDArray[np.int32] | None = None  # (n, 2), row and column that saw each point
    surface: Mesh | None = None  # drawn instead of the points
    # (n,) points that are not due are not shown, though they count for the colours; all by default
    due: BoolArray | None = None
    # (n,) number of the source, from 1, where several are in one view
    layers: NDArray[np.uint8] = field(default_factory=lambda: np.empty(0, np.uint8))
    # of the brightest; below 1 points are soft balls, the clearer the fainter they are
    opacity: float = 1.0
    time: float = np.nan  # time of flight of the frame, s; NaN where frames have none
    whole_name: str = ""  # what is shown where it is not one frame, such as a maximum projection
    text: str = ""  # what the frame is beyond its number and time, in a few words
    caption: str = ""  # of which frames the points are, where that is not the one frame
    notes: tuple[str, ...] = ()  # what has to be known about this view

    def select(self, chosen: AnyArray) -> Self:
        """Return a view of some of the points, by mask or by numbers."""
        pixels = None if self.pixels is None else self.pixels[chosen]
        due = None if self.due is None else self.due[chosen]
        layers = self.layers[chosen] if self.layers.size else self.layers
        return replace(self, cloud=self.cloud[chosen], pixels=pixels, due=due, layers=layers)


@dataclass
class Setting:
    """A number that is set by a slider while one looks."""

    name: str  # with its unit
    low: float
    high: float
    step: float
    value: float
    hint: str = ""
    group: str = ""  # under which it stands with others


OFF_ON = "off", "on"  # the options of a choice that is a box to tick


@dataclass
class Choice:
    """A word that is chosen from a list while one looks."""

    name: str
    options: tuple[str, ...]
    value: str
    hint: str | None = None
    group: str = ""


@dataclass(frozen=True)
class Inflow:
    """What comes into a source while one looks; nothing by default."""

    oldest: int = 0  # first frame that is still there
    is_live: bool = False  # whether frames are added
    data_rate: float = 0.0  # frames per second
    # from when the instrument took a shot, by its own clock where it sends one, until it could be
    # shown, s; NaN where nothing comes in
    latency: float = np.nan
    lost: int = 0  # shots that were taken and are not shown, wherever they were lost
    failure_text: str = ""  # what ended it early, in a line


class KeptFrames(Generic[Frame]):
    """The last frames of those that come while one looks, numbered from the first that came."""

    def __init__(self) -> None:
        self._frames: deque[Frame] = deque()
        self._lock, self._count = threading.Lock(), 0

    def __len__(self) -> int:
        return self._count

    @property
    def oldest(self) -> int:
        return self._count - len(self._frames)

    def append(self, frame: Frame, most: int) -> None:
        """Add a frame, and forget old ones beyond so many."""
        with self._lock:
            self._frames.append(frame)
            self._count += 1
            if len(self._frames) > most:
                self._frames.popleft()

    def get(self, number: int) -> Frame:
        """Return a frame, or the nearest that is kept."""
        with self._lock:
            return self._frames[min(max(number - self.oldest, 0), len(self._frames) - 1)]


@dataclass
class Source(abc.ABC):
    """A row of frames, numbered from 0."""

    title: str  # what the page calls it
    rate: float  # frames per second at natural speed
    frame_name: str = "frame"  # what a frame is: an instant's frame, a slice, a shot or a cloud
    # (frames,), time of flight of each frame, s, where frames are the instants of one transient
    times: FloatArray | None = None
    # what has to be known about everything that is shown, such as that ranges have no time zero
    notes: tuple[str, ...] = ()
    settings: tuple[Setting | Choice, ...] = ()  # what is set while one looks; `view` obeys them
    quantity: str = "range"  # what says most about the points, which are coloured by it at first

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

    def pictures(self, number: int) -> Mapping[str, Picture]:
        """Return pictures of a frame by name: "streak", "intensity", "depth" (m, NaN if none)."""
        return {}

    def waveform(
        self, number: int, pixel: tuple[int, int], time: float, layer: int = 1
    ) -> FloatArray | None:
        """Return times, s, about `time` and a pixel's counts, (2, n); None if not known."""
        return None

    def close(self) -> None:  # noqa: B027 - most sources hold nothing
        """Let go of files and instruments."""


def make_cloud(xyz: AnyArray, known: Mapping[str, AnyArray] | None = None) -> PointCloud:
    """Make a cloud of positions (n, 3), m; what is not known follows from them, or is 0."""
    known, nothing = known or {}, np.zeros(len(xyz), np.float32)
    # Files of earlier versions call it confidence.
    also_called = {"intensity": "brightness", "range_sigma": "confidence"}
    found = {name: known.get(other, nothing) for name, other in also_called.items()}
    return complete_cloud(xyz, {**found, **known})


BESIDE_HINT = "moved to the right by this many widths of the first layer"


class LayeredSource(Source):
    """Sources that are shown together, each on and off and moved aside. The first that has several
    frames has the time line; of the others the frame nearest in time is shown, or that of the same
    number.
    """

    def __init__(self, sources: Sequence[Source]) -> None:
        moving = (one for one in sources if len(one) > 1 or one.inflow.is_live)
        self._sources, self._lead = sources, next(moving, sources[0])
        lead, quantities = self._lead, {one.quantity for one in sources}
        titles = [f"{number} {one.title}" for number, one in enumerate(sources, 1)]
        self.switches = [Choice("shown", OFF_ON, "on", group=title) for title in titles]
        self.shifts = [
            Setting("beside", -2.0, 2.0, 0.1, 0.0, BESIDE_HINT, title) for title in titles
        ]
        settings: list[Setting | Choice] = []
        for title, source, switch, shift in zip(
            titles, sources, self.switches, self.shifts, strict=True
        ):
            for setting in source.settings:
                setting.group = title
            own = switch, shift
            settings += own
            settings += source.settings
        notes = [f"{one.title}: {note}" for one in sources for note in one.notes]
        title = ", ".join(one.title for one in sources)
        super().__init__(title, lead.rate, lead.frame_name, lead.times, tuple(notes))
        self.settings = tuple(settings)
        self.quantity = quantities.pop() if len(quantities) == 1 else "range"
        x = sources[0].view(0).cloud.xyz[:, 0]
        self._width = np.ptp(x) if x.size else 1.0

    def __len__(self) -> int:
        return len(self._lead)

    @property
    def inflow(self) -> Inflow:
        return self._lead.inflow

    def view(self, number: int) -> View:
        shown = [n for n, switch in enumerate(self.switches) if switch.value == "on"]
        views = [self._sources[n].view(self._find_frame(self._sources[n], number)) for n in shown]
        clouds = [one.cloud for one in views]
        sizes = [len(cloud) for cloud in clouds]
        lead = self._lead.view(number)
        if not views:
            return replace(lead.select(np.zeros(len(lead.cloud), bool)), surface=None)
        shifts = np.repeat([self._width * self.shifts[n].value for n in shown], sizes)
        names = [name for name, one in vars(clouds[0]).items() if isinstance(one, np.ndarray)]
        joined: Any = {
            name: np.concatenate([getattr(one, name) for one in clouds]) for name in names
        }
        cloud = PointCloud(**joined)
        aside = np.stack([shifts, 0 * shifts, 0 * shifts], axis=1).astype(np.float32)
        surfaces = [one.surface for one in views if one.surface is not None]
        return replace(
            lead,
            cloud=replace(cloud, xyz=cloud.xyz + aside),
            pixels=np.concatenate([_fill(one.pixels, (len(one.cloud), 2), -1) for one in views]),
            due=np.concatenate([_fill(one.due, (len(one.cloud),), True) for one in views]),
            layers=np.repeat(np.array(shown, np.uint8) + np.uint8(1), sizes),
            surface=surfaces[0] if surfaces else None,
            opacity=min(one.opacity for one in views),
            notes=tuple(note for one in views for note in one.notes),
        )

    def pictures(self, number: int) -> Mapping[str, Picture]:
        return {
            f"{n} {name}": picture
            for n, one in enumerate(self._sources, 1)
            for name, picture in one.pictures(self._find_frame(one, number)).items()
        }

    def waveform(
        self, number: int, pixel: tuple[int, int], time: float, layer: int = 1
    ) -> FloatArray | None:
        source = self._sources[layer - 1]
        return source.waveform(self._find_frame(source, number), pixel, time)

    def close(self) -> None:
        for source in self._sources:
            source.close()

    def _find_frame(self, source: Source, number: int) -> int:
        """Return the frame of a source that is shown with frame `number` of the first one."""
        if source is not self._lead and source.times is not None and self.times is not None:
            return np.abs(source.times - self.times[number]).argmin()
        return min(max(number, source.inflow.oldest), len(source) - 1)


def _fill(values: AnyArray | None, shape: tuple[int, ...], by: Any) -> AnyArray:
    return np.full(shape, by) if values is None else values
