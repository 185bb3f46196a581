"""Several sources in one scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apps.viewer.source import OFF_ON, Choice, Inflow, Picture, Setting, Source, View
from tofclip.arrays import FloatArray
from tofclip.lidar import PointCloud

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
        self._width = float(np.ptp(x)) if x.size else 1.0

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
        cloud = _join_clouds(clouds)
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
            return int(np.abs(source.times - self.times[number]).argmin())
        return min(max(number, source.inflow.oldest), len(source) - 1)


def _fill(values: NDArray[Any] | None, shape: tuple[int, ...], by: Any) -> NDArray[Any]:
    return np.full(shape, by) if values is None else values


def _join_clouds(clouds: Sequence[PointCloud]) -> PointCloud:
    names = [name for name, column in vars(clouds[0]).items() if isinstance(column, np.ndarray)]
    columns: Any = {name: np.concatenate([getattr(one, name) for one in clouds]) for name in names}
    return PointCloud(**columns)
