"""A simulated scene before the emulated time tagger: the photons' delays are the scene's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from devices.emulation.scenes import LineLight, simulate_line_light
from devices.emulation.timetag import (
    BLOCK_TICKS,
    CLOCK_HZ,
    MAX_TICK,
    PERIOD_TICKS,
    SCENE_SCALE,
    SYNC_MASK,
    PulsedSceneStream,
)
from devices.source import Records, as_bytes
from devices.timetag_codec import COUNTER_RANGE, WRAP, TimeTagCodec
from devices.transients import read_transient
from tofclip.errors import InputError

RATE = 2e6
STEPS = 50
"""Instants by which the duration of a row is stood for."""


@pytest.fixture(scope="module")
def light() -> LineLight:
    return simulate_line_light()


def seen(scene: PulsedSceneStream, limit: int, last: int = MAX_TICK) -> Records:
    found = TimeTagCodec().decode(as_bytes(scene.next_words(limit, last)), TimeTagCodec.start)
    assert found.malformed == 0
    return found.records


def test_delays_are_those_of_the_scene(light: LineLight) -> None:
    records = seen(PulsedSceneStream(light, RATE, CLOCK_HZ, 4), 400_000)
    is_pulse = records["channels"] & SYNC_MASK != 0
    assert np.all(records["time_ticks"][is_pulse] % PERIOD_TICKS == 0)
    assert np.all(np.diff(records["time_ticks"][is_pulse]) == PERIOD_TICKS)
    pulses = np.count_nonzero(is_pulse)
    expected = light.photons[:, 256 * np.array([1, 3, 5]) // 6]
    expected = expected * (RATE * PERIOD_TICKS / CLOCK_HZ * pulses / expected.sum())
    width = light.row_times[1] - light.row_times[0]
    instants = light.row_times[:, np.newaxis] + width * (np.arange(0.5, STEPS) / STEPS - 0.5)
    ticks = np.floor(instants * SCENE_SCALE * CLOCK_HZ).astype(int).ravel() % PERIOD_TICKS
    for pixel, channel in enumerate((2, 4, 8)):
        delays = records["time_ticks"][records["channels"] & channel != 0] % PERIOD_TICKS
        counts = np.bincount(delays, minlength=PERIOD_TICKS)
        known = np.bincount(ticks, np.repeat(expected[:, pixel] / STEPS, STEPS), PERIOD_TICKS)
        # Five standard deviations; two photons within a tick that count as one.
        tolerance = 5 * np.sqrt(known + 1) + known**2 / pulses
        assert np.all(np.abs(counts - known) < tolerance)
        assert counts.sum() > 50_000


def test_cuts_do_not_change_the_stream(light: LineLight) -> None:
    whole = seen(PulsedSceneStream(light, RATE, CLOCK_HZ, 5), 40_000)
    scene = PulsedSceneStream(light, RATE, CLOCK_HZ, 5)
    halves = (
        scene.next_words(10_000, MAX_TICK),
        scene.next_words(40_000, BLOCK_TICKS),
        scene.next_words(5, BLOCK_TICKS),
    )
    rest = scene.next_words(40_000 - sum(len(half) for half in halves) // 6, MAX_TICK)
    joined = np.concatenate([*halves, rest])
    assert len(halves[2]) == 0
    np.testing.assert_array_equal(TimeTagCodec().decode(joined, TimeTagCodec.start).records, whole)
    assert len(scene.next_words(0, MAX_TICK)) == 0


def test_the_counter_wraps_where_a_block_begins(light: LineLight) -> None:
    scene = PulsedSceneStream(light, RATE, CLOCK_HZ, 6)
    scene._block = COUNTER_RANGE // BLOCK_TICKS - 1
    before = COUNTER_RANGE - BLOCK_TICKS
    records = seen(scene, 40_000)
    assert records["time_ticks"][0] == before
    marks = records[records["flags"] == WRAP]
    assert marks["time_ticks"].tolist() == [COUNTER_RANGE]


def test_light_that_does_not_fit_is_refused(light: LineLight) -> None:
    with pytest.raises(InputError, match="rate"):
        PulsedSceneStream(light, 0, CLOCK_HZ, 1)
    with pytest.raises(InputError, match="within the laser's period of 1e-06 s"):
        PulsedSceneStream(replace(light, row_times=light.row_times + 1e-8), RATE, CLOCK_HZ, 1)


def test_it_becomes_a_streak_image_of_three_columns(light: LineLight) -> None:
    address = "sim+timetag://?seed=2&light=scene&seconds=0.4&period_ps=1000000"
    streak = read_transient(address, 1 / CLOCK_HZ)
    assert streak.counts.shape == (PERIOD_TICKS, 3)
    columns = light.photons[:, 256 * np.array([1, 3, 5]) // 6]
    mean = SCENE_SCALE * (light.row_times[:, np.newaxis] * columns).sum(0) / columns.sum(0)
    measured = (streak.times[:, np.newaxis] * streak.counts).sum(0) / streak.counts.sum(0)
    # Within a tick: a record says only in which one a photon came.
    np.testing.assert_allclose(measured, mean, atol=1 / CLOCK_HZ)
