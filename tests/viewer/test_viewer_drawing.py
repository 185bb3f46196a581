"""How often and in how much detail points are drawn, over time that the test sets."""

from __future__ import annotations

import numpy as np
import pytest
from viewer_scenes import PlaneSource

from apps.viewer.points import MIN_DRAWN_POINTS, DetailChooser, FramePacer
from apps.viewer.session import Session


def test_frames_of_the_last_two_seconds_are_counted() -> None:
    counter = FramePacer()
    for now in (0.0, 1.0, 1.5, 2.5):
        counter.record_sent(now, 1)
    assert counter.per_second(2.6) == 1.5


def test_large_clouds_are_sent_less_often() -> None:
    pace = FramePacer()
    pace.record_sent(1.0, 100)
    assert (pace.can_send(1.02), pace.can_send(1.04)) == (False, True)
    pace.record_sent(2.0, 1_000_000)
    assert (pace.can_send(2.4), pace.can_send(2.5)) == (False, True)


def test_the_slowest_browser_decides_how_many_points_are_drawn() -> None:
    detail = DetailChooser()
    assert detail.count(2_000_000, moving=False) == MIN_DRAWN_POINTS  # nothing is known yet
    assert detail.count(100, moving=True) == 100
    detail.points_per_s[1] = 1_000_000 / 0.02
    assert detail.count(2_000_000, moving=True) == 2_000_000
    detail.points_per_s[2] = 100_000 / 0.1
    assert detail.count(2_000_000, moving=False) == 500_000  # in half a second
    assert detail.count(2_000_000, moving=True) == 80_000
    detail.points_per_s[2] = 100.0
    assert detail.count(2_000_000, moving=True) == MIN_DRAWN_POINTS
    del detail.points_per_s[2]
    assert detail.count(2_000_000, moving=False) == 2_000_000


@pytest.mark.parametrize(
    ("drawn", "rate", "worthwhile"),
    [
        (15_000, 1e6, True),  # half a million could be
        (500_000, 1e6, False),
        (500_000, 1.2e6, False),
        (500_000, 2e6, True),
        (500_000, 0.4e6, True),
        (1_800_000, 1e7, True),  # all of them could
        (2_000_000, 1e7, False),
    ],
)
def test_a_cloud_is_sent_again_for_clearly_more_or_fewer_points(
    drawn: int, rate: float, worthwhile: bool
) -> None:
    detail = DetailChooser()
    detail.points_per_s[1] = rate
    assert detail.is_worthwhile(drawn, 2_000_000) == worthwhile


def test_a_large_cloud_is_thinned_while_frames_pass() -> None:
    session = Session(PlaneSource(points=4000))
    session.max_playing_points = 500
    assert len(session.frame_at(0.0).cloud) == 4000
    session.clock.play()
    playing = session.frame_at(0.1)
    # drawn by lot with replacement: of 500 about 30 meet another one
    assert 440 < len(playing.cloud) <= 500
    assert playing.points == 4000
    whole = session.source.view(playing.frame).cloud.xyz
    assert set(map(tuple, playing.cloud.xyz.tolist())) <= set(map(tuple, whole.tolist()))
    assert np.allclose(playing.cloud.xyz.mean(axis=0), whole.mean(axis=0), atol=0.06)
    session.clock.pause()
    assert session.frame_at(0.2).points == len(session.frame_at(0.2).cloud) == 4000
