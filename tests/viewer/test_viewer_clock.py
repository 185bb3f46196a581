"""Playback over time that the test sets."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apps.viewer.session import MAX_SPEED, MIN_SPEED, PlaybackClock
from tofclip.errors import InputError


def test_frames_follow_the_time_and_the_speed() -> None:
    clock = PlaybackClock(8.0, lambda: range(100), loop=False)
    clock.play()
    assert [clock.tick(now) for now in (5.0, 5.0625, 5.125, 6.0)] == [0, 0, 1, 8]
    clock.set_speed(4.0)
    assert clock.tick(7.0) == 40
    clock.pause()
    assert clock.tick(60.0) == 40
    clock.play()  # the pause does not count
    assert clock.tick(70.0) == 40


def test_the_end_stops_it_or_begins_anew() -> None:
    clock = PlaybackClock(10.0, lambda: range(4), loop=False)
    clock.play()
    clock.tick(0.0)
    assert (clock.tick(9.0), clock.playing) == (3, False)
    clock.play()
    assert clock.frame == 0
    clock.loop = True
    clock.tick(10.0)
    assert (clock.tick(10.55), clock.playing) == (1, True)


def test_a_loop_runs_through_the_frames_that_are_left_at_their_own_pace() -> None:
    """Of a live source the first ones are forgotten: frame 10 of 4 to 9 is 4, and so on."""
    clock = PlaybackClock(10.0, lambda: range(4, 10))
    clock.jump(4)
    clock.play()
    clock.tick(0.0)
    # In the middle of each frame's tenth of a second.
    due = [clock.tick(0.05 + number / 10) for number in range(15)]
    assert due == [4 + number % 6 for number in range(15)]


def test_steps_and_jumps_stay_among_the_frames() -> None:
    clock = PlaybackClock(10.0, lambda: range(5))
    clock.jump(3)
    assert clock.frame == 3
    clock.play()
    clock.step(-1)
    assert (clock.frame, clock.playing) == (2, False)
    clock.step(10)
    assert clock.frame == 4
    clock.frames = lambda: range(2, 5)
    clock.jump(-7)
    assert clock.frame == 2


def test_frames_that_are_forgotten_are_left() -> None:
    clock = PlaybackClock(10.0, lambda: range(10))
    clock.jump(1)
    clock.frames = lambda: range(6, 20)
    assert clock.tick(0.0) == 6


@given(
    st.floats(-1e3, 1e3), st.integers(1, 50), st.lists(st.floats(0, 1e4), min_size=2, max_size=6)
)
def test_there_is_no_other_frame_than_those_that_exist(
    speed: float, count: int, times: list[float]
) -> None:
    clock = PlaybackClock(25.0, lambda: range(count))
    clock.set_speed(speed)
    assert MIN_SPEED <= clock.speed <= MAX_SPEED
    clock.play()
    assert all(0 <= clock.tick(now) < count for now in sorted(times))


def test_a_clock_that_stands_still_is_refused() -> None:
    with pytest.raises(InputError, match="positive"):
        PlaybackClock(0.0, lambda: range(3))
