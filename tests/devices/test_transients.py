"""From an address to a streak image."""

import time
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from devices import transients
from devices.address import Options, option
from devices.source import Batch, Info, Source, Stats
from devices.timetag_codec import RECORD_DTYPE
from devices.transients import TransientStream, read_transient
from tofclip.errors import InputError, MissingTimeAxisError
from tofclip.storage import Field, Record


class Canned(Source):
    """Gives what a test has put into it."""

    def __init__(self, batches, calibration=None):
        self._batches, self._calibration = list(batches), calibration

    info = Info("canned")
    stats = Stats()
    calibration = property(lambda self: self._calibration)

    def read(self, timeout=0.0):
        return self._batches.pop(0) if self._batches else None

    def close(self):
        self._batches.clear()


@pytest.fixture
def canned(monkeypatch):
    """Let canned:// open the source that was made last."""

    class Last(Canned):
        def __init__(self, batches, calibration=None):
            super().__init__(batches, calibration)
            monkeypatch.setattr(transients.registry, "open_parsed", lambda uri: self)

    return Last


def tags(rows):
    return np.array(rows, RECORD_DTYPE)


def test_tags_of_two_channels(canned):
    before, after = tags([(0, 1, 0), (3, 2, 0)]), tags([(9, 4, 0), (10, 1, 0), (12, 4, 0)])
    canned(
        [Batch(before), Batch(after, 2, after_gap=True)],
        Record("calibration", attributes={"tick_s": 1e-9}),
    )
    streak = read_transient("canned://?bins=5&pixels=1,2&start_ps=500", bin_width=1e-9)
    expected = np.zeros((5, 2))
    expected[3, 0] = expected[2, 1] = (
        1  # the photon at 9 came after a gap, and no pulse before it is known
    )
    assert_allclose(streak.counts, expected, atol=1e-6)
    assert_allclose(streak.times, 0.5e-9 + np.arange(5) * 1e-9, rtol=1e-12)


def frames(*numbers):
    records = np.zeros(len(numbers), [("number", "<i8"), ("counts", "<u2", (3, 4))])
    records["number"] = numbers
    records["counts"] = np.array(numbers)[:, None, None]
    return records


def test_frames_are_added_up(canned):
    times = np.array([0.0, 1e-12, 3e-12])
    batches = [Batch(frames(1, 2)), Batch(frames(5, 7)), Batch(frames(100))]
    batches[0].records["counts"][0, 2, 3] = 65535
    canned(batches, Record("streak_calibration", {"row_times": Field(times, "s", ("row",))}))
    streak = read_transient("canned://?frames=3")
    expected = np.full((3, 4), 8.0)
    expected[2, 3] += 65534
    assert_array_equal(streak.counts, expected)
    assert_array_equal(streak.times, times)
    assert streak.saturated is not None
    assert np.argwhere(streak.saturated).tolist() == [[2, 3]]
    canned([Batch(frames(1))])
    with pytest.raises(MissingTimeAxisError):
        _ = read_transient("canned://").times
    canned([Batch(frames(1))])
    assert read_transient("canned://?frames=9", bin_width=2e-12).times.tolist() == [
        0.0,
        2e-12,
        4e-12,
    ]


def test_shots_are_counted_on_where_an_instrument_begins_anew(canned):
    canned([Batch(frames(3, 4)), Batch(frames(1, 2), 2, after_gap=True)])
    stream = TransientStream("canned://")
    assert [stream.stamp.number for _ in stream] == [3, 4, 6, 7]


def test_a_source_s_own_values_are_not_taken_for_how_to_gather(
    monkeypatch,
):
    @dataclass(frozen=True)
    class OwnOptions(Options):
        frames: int = option(1)

    own = []

    def open_own(uri):
        own.append(OwnOptions.from_uri(uri).frames)
        return Canned([Batch(frames(1, 2))])

    monkeypatch.setattr(transients.registry.SOURCES, "registered", {"own": open_own})
    streak = read_transient("own://?frames=30&seconds=5")
    assert (own, streak.counts.max()) == ([30], 1)  # of the first frame alone
    shots = TransientStream("own://?frames=30")
    assert [shot.counts.max() for shot in shots] == [1, 2]
    with pytest.raises(InputError, match="'second' is unknown; own takes frames"):
        read_transient("own://?second=5")


def test_where_it_came_from_is_told():
    address = "sim+linospad2://?seed=4&cycles=2&photons=500"
    streak = read_transient(address + "&bins=600")
    assert streak.source == address + "&bins=600"
    past = streak.provenance
    assert past["source"]["instrument"] == "simulated LinoSPAD2"
    assert past["stats"]["delivered"] == pytest.approx(1000, abs=200)
    assert streak.counts.shape == (600, 256)
    assert streak.camera is not None
    assert read_transient(address).counts.shape == (1250, 256)  # the laser's 25 ns in bins of 20 ps


def test_sources_that_give_no_transient(canned):
    canned([])
    with pytest.raises(InputError, match="ended before it gave anything"):
        read_transient("canned://")
    canned([Batch(np.zeros(3, [("temperature", "f4")]))])
    with pytest.raises(InputError, match="records of temperature are not photons"):
        read_transient("canned://")
    for values, said in (("", "is not known"), ("?period_ps=9", "shorter than the laser's period")):
        canned([Batch(tags([(1, 1, 0)]))], Record("calibration", attributes={"tick_s": 1e-9}))
        with pytest.raises(InputError, match=said):
            read_transient(f"canned://{values}", bin_width=1.0)


def test_a_slow_viewer_gets_the_newest_picture_and_is_told_of_the_others():
    stream = TransientStream("sim+remoteex://?seed=2&scene=small&frame_rate=100")
    next(stream)
    assert stream.is_live
    for _ in range(2):
        time.sleep(0.8)
        next(stream)
        assert stream.stamp is not None
        assert 0 < stream.stamp.taken_at <= stream.stamp.received_at
        assert time.monotonic() - stream.stamp.taken_at < 0.6
    stats = stream.stats
    assert stats.dropped_host + stats.lost_device > 10
    assert stream.shots_acquired >= 3 + stats.dropped_host + stats.lost_device
    stream.close()
    assert stream.stats.is_balanced
