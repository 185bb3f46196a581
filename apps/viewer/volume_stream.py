"""Hidden volumes that come in while one looks: the newest one is shown."""

from __future__ import annotations

import threading
from collections import deque
from typing import Protocol

import numpy as np

from apps.viewer.clouds import make_cloud
from apps.viewer.source import Source, View
from nlos import Volume

BRIGHT_FRACTION = 0.3
"""Of the brightest voxel: brighter ones are shown."""


class VolumeFeed(Protocol):
    """What a stream of volumes reports while it runs."""

    latency: float
    delivered: int
    failed: int
    ended: threading.Event

    latest: deque[Volume]
    """The newest alone."""


class VolumeStreamSource(Source):
    """The newest volume of a stream; every volume is a frame, and only the last one is kept.

    Parameters
    ----------
    title : str
    feed : VolumeFeed
        With a volume.
    """

    def __init__(self, title: str, feed: VolumeFeed) -> None:
        super().__init__(title, 1.0, frame_name="volume")
        self._feed = feed

    def __len__(self) -> int:
        return max(self._feed.delivered, 1)

    @property
    def oldest(self) -> int:
        return len(self) - 1

    @property
    def is_live(self) -> bool:
        return not self._feed.ended.is_set()

    @property
    def latency(self) -> float:
        return self._feed.latency

    @property
    def lost(self) -> int:
        return self._feed.failed

    def view(self, number: int) -> View:
        xyz, brightness = self._feed.latest[-1].points(BRIGHT_FRACTION)
        return View(make_cloud(xyz, {"brightness": np.asarray(brightness)}))
