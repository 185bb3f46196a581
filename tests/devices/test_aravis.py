"""Industrial cameras through Aravis: its own emulated camera where it is installed, and everywhere a
stand-in for the library whose frames can be lost, torn and renumbered.
"""

import sys
from collections import deque
from types import SimpleNamespace

import numpy as np
import pytest
from instruments import finish, refuse, take
from numpy.testing import assert_allclose, assert_array_equal

import devices
from devices.aravis import UNNUMBERED, find_cameras, load_aravis
from devices.emulation.aravis import EmulatedCamera
from devices.emulation.scenes import EmulatedLight, simulate_light
from devices.transients import TransientStream, read_photons, read_transient
from tofclip.errors import (
    DeviceDisconnectedError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    MissingDependencyError,
)
from tofclip.recovery import FixedFocus
from tofclip.sequences.ranger import RangingPipeline
from tofclip.sequences.streaming import stream_clouds


@pytest.fixture
def aravis():
    try:
        return load_aravis()
    except MissingDependencyError as fault:
        pytest.skip(str(fault))


def test_the_emulated_camera_loses_nothing(aravis, monkeypatch):
    """Pictures of 128 KiB, so that the system's buffer holds one while this process must wait."""
    monkeypatch.setattr(
        EmulatedCamera, "prepare", lambda self, camera: camera.set_region(0, 0, 256, 256)
    )
    address = "sim+aravis://?frame_rate=200&exposure_us=500&gain=2&pixel_format=Mono16"
    with devices.open(address) as source:
        info = source.info.as_dict()
        frames = take(source, 60)
        finish(source)
    assert (info["pixel_format"], info["exposure_us"], info["gain"]) == ("Mono16", 500.0, 2.0)
    assert [int(frame["number"]) for frame in frames] == list(range(60))
    assert frames[0]["counts"].shape == (info["rows"], info["columns"])
    assert np.ptp(frames[0]["counts"]) > 0
    stats = source.stats
    assert (stats.lost_device, stats.malformed, stats.dropped_host) == (0, 0, 0)


@pytest.mark.parametrize("lost_per_thousand", [3, 100])
def test_frames_with_missing_packets_are_counted(aravis, lost_per_thousand, monkeypatch):
    """Of a frame's 211 packets few are lost, or one in ten, so that none is whole; where the first
    one is lost, the frame comes without an identifier.
    """
    sent = []
    picture = EmulatedLight.of(simulate_light("small"), 1).draw_frame(0)

    def draw_and_note(self, number):
        sent.append(number)
        return picture

    monkeypatch.setattr(EmulatedLight, "draw_frame", draw_and_note)
    numbers = []
    address = f"sim+aravis://?scene=small&frame_rate=60&lost_per_thousand={lost_per_thousand}"
    with devices.open(address) as source:
        while len(sent) < 60:
            try:
                batch = source.read(0.1)
            except DeviceTimeoutError:
                continue
            assert batch is not None
            numbers += batch.records["number"].tolist()
        finish(source)
    stats = source.stats
    # A frame that was on its way when the camera was stopped is in no account; every other one is.
    assert len(sent) - 2 <= stats.acquired <= len(sent)
    assert stats.malformed > (50 if lost_per_thousand == 100 else 10)
    # Aravis says of each frame that some of it came, unless all of its packets were lost.
    assert (stats.lost_device, stats.dropped_host) == (0, 0)
    assert np.all(np.diff(numbers) > 0)
    if numbers:
        assert numbers[-1] + 1 - len(numbers) <= stats.malformed


class StandInBuffer(SimpleNamespace):
    """A frame as Aravis hands it over: every ``get_...`` returns what it was made with."""

    def __getattr__(self, name):
        return lambda: vars(self)[name.removeprefix("get_")]

    def set_frame_id(self, frame_id):
        self.frame_id = frame_id


class StandInLibrary:
    """As much of Aravis as the driver needs; `frames` are sent when acquisition is started, and what
    it was asked is in `reported`.
    """

    BufferStatus = SimpleNamespace(SUCCESS="success", CLEARED="cleared", ABORTED="aborted")
    AcquisitionMode = SimpleNamespace(CONTINUOUS="continuous")
    GvStreamSocketBuffer = SimpleNamespace(FIXED="fixed")
    Buffer = SimpleNamespace(new_allocate=lambda payload: StandInBuffer())

    def __init__(self, pictures, frames):
        self.reported = {}
        self.underruns = self.gone_for = 0
        self._frames = frames
        self.Camera = SimpleNamespace(new=self._open)
        self.answers = {
            "get_vendor_name": "Stand-in",
            "get_model_name": "camera",
            "get_device_serial_number": "S1",
            "get_pixel_format_as_string": f"Mono{8 * pictures.itemsize}",
            "get_region": (0, 0, pictures.shape[2], pictures.shape[1]),
            "get_payload": 1,
            "is_gv_device": False,
            "gv_get_packet_size": 1036,
            "get_gain": 0.0,
            "get_frame_rate": 10.0,
        }

    def _open(self, place):
        if self.gone_for:
            self.gone_for -= 1
            raise RuntimeError("No camera found")
        return self

    def __getattr__(self, name):
        if name in self.answers:
            return lambda: self.answers[name]
        if name == "set_property":
            return self.reported.__setitem__
        if name.startswith("set_"):
            return lambda value: self.reported.__setitem__(name, value)
        if name in ("start_acquisition", "stop_acquisition"):
            return lambda: self.reported.__setitem__(name, True)
        raise AttributeError(name)

    def get_exposure_time(self):
        if self.gone_for:
            raise RuntimeError("timeout")
        return 1000.0

    def create_stream(self, *nothing):
        self._waiting = deque(StandInBuffer(**vars(frame)) for frame in self._frames)
        return self

    def push_buffer(self, buffer):
        pass

    def timeout_pop_buffer(self, wait_us):
        return self._waiting.popleft() if self._waiting else None

    def get_info_uint64_by_name(self, name):
        return self.underruns


@pytest.fixture
def stand_in(monkeypatch):
    def make(pictures, ids, torn=()):
        frames = [
            StandInBuffer(
                frame_id=frame_id,
                status="missing-packets" if place in torn else "success",
                data=pictures[place % len(pictures)].tobytes(),
                timestamp=10**9 + place * 10**7,
            )
            for place, frame_id in enumerate(ids)
        ]
        library = StandInLibrary(pictures, frames)
        monkeypatch.setattr("devices.aravis.load_aravis", lambda: library)
        return library

    return make


def read_numbers(address, frames):
    with devices.open(address) as source:
        numbers = [int(frame["number"]) for frame in take(source, frames)]
        finish(source)
    return numbers, source.stats


SMALL = np.arange(24, dtype=np.uint16).reshape(2, 3, 4)


def test_identifiers_tell_what_is_missing(stand_in):
    """Across the end of 16 bits; one comes late, one is torn, two found no buffer."""
    library = stand_in(SMALL, [65533, 65535, 1, 65534, 4, 5, 8], torn=(4,))
    library.underruns = 2
    numbers, stats = read_numbers("aravis://lab?exposure_us=50&gain=3&frame_rate=9", 5)
    assert numbers == [0, 2, 3, 7, 10]
    assert (stats.delivered, stats.malformed, stats.acquired) == (5, 1, 11)
    assert (stats.dropped_host, stats.lost_device) == (2, 3)
    settings = {"set_exposure_time": 50, "set_gain": 3, "set_frame_rate": 9}
    assert library.reported.items() >= settings.items()
    assert library.reported["stop_acquisition"]


def test_a_frame_without_its_first_packet_is_counted_once(stand_in):
    """Aravis leaves it the identifier that its buffer had, so that the next frame tells."""
    unknown = UNNUMBERED
    ids = [unknown, 2, unknown, 4, unknown, unknown, 8, 9, unknown]
    stand_in(SMALL, ids, torn=(0, 2, 4, 5, 8))
    numbers, stats = read_numbers("aravis://lab", 4)
    assert numbers == [1, 3, 7, 8]
    assert (stats.delivered, stats.malformed, stats.lost_device) == (4, 5, 1)
    assert stats.acquired == 10


def test_packets_without_a_buffer_are_counted_as_frames(stand_in):
    """A picture takes three packets: 10 of those that found no buffer are four frames, no more."""
    library = stand_in(SMALL, [1, 3, 9])
    library.answers["is_gv_device"], library.underruns = True, 10
    _, stats = read_numbers("aravis://lab", 3)
    assert (stats.dropped_host, stats.lost_device) == (4, 2)


def test_a_streak_picture_has_its_rows_in_time(stand_in):
    """The address says how long they take; when the first one is swept, the time zero does."""
    light = simulate_light("small")
    counts = np.random.default_rng(1).poisson(light.photons).astype(np.uint16)
    stand_in(counts[np.newaxis], list(range(1, 4)))
    row_ps = (light.row_times[1] - light.row_times[0]) * 1e12
    streak = read_transient(f"aravis://?row_ps={row_ps}")
    assert_array_equal(streak.counts, counts)
    assert_allclose(np.diff(streak.times), np.diff(light.row_times), rtol=1e-9)


def test_each_streak_picture_of_the_emulated_camera_becomes_a_cloud(aravis):
    """Over the network protocol: the clouds are those of the pictures that it drew."""
    shots = TransientStream("sim+aravis://?scene=small&frame_rate=10&seed=1&policy=block")
    light = EmulatedLight.of(simulate_light("small"), 1)
    camera = simulate_light("small").camera
    first = next(shots)
    pipeline = RangingPipeline.for_shot(first, camera, FixedFocus(0.0), camera.time_zero)
    clouds = [result.cloud for result in stream_clouds([first, next(shots), next(shots)], pipeline)]
    shots.close()
    assert shots.stats.lost_device == shots.stats.malformed == 0
    assert len(clouds) == 3
    for cloud in clouds:
        assert len(cloud) > 100
        assert 1.6 < np.median(cloud.range) < 3.3
    assert_allclose(first.times, light.row_times)
    assert any(np.array_equal(first.counts, light.draw_frame(n)) for n in range(65400, 65420))


def test_gated_frames_become_photons_in_time(stand_in):
    pictures = np.arange(4 * 24, dtype=np.uint16).reshape(4, 4, 6)
    # Of the first scan a frame is lost: it is left out, and the second one counts.
    stand_in(pictures[[0, 1, 3, 0, 1, 2, 3]], [1, 2, 4, 5, 6, 7, 8])
    gate = "mode=gated&gate_steps=4&gate_step_ps=1000&gate_width_ns=2&gate_offset_ps=500"
    counted = read_photons(f"aravis://?{gate}")
    assert_array_equal(counted.counts, pictures)
    assert_allclose(counted.times, 1e-9 * (0.5 + np.arange(4)))


def test_a_camera_that_goes_away(stand_in):
    library = stand_in(SMALL, [1, 2])
    with devices.open("aravis://?timeout_s=0.1&reconnect_s=0.2") as source:
        take(source, 2)
        library.gone_for = 1  # and then it is back
        batch = source.read(10)
        assert batch is not None
        assert batch.after_gap
        assert source.stats.reconnects == 1
        library.gone_for = 99
        with pytest.raises(DeviceDisconnectedError, match="no answer came"):
            take(source, 9)
    assert source.stats.is_balanced


def test_what_cannot_be_opened(stand_in):
    library = stand_in(SMALL, [])
    library.answers["get_pixel_format_as_string"] = "BayerRG8"
    refuse("aravis://", "choose pixel_format")
    library.gone_for = 99
    refuse("aravis://10.0.0.9", "No camera found", DeviceNotFoundError)


def test_without_the_library_one_line_names_it(monkeypatch):
    load_aravis.cache_clear()
    monkeypatch.setattr("devices.aravis.SYSTEM_PACKAGES", ())
    monkeypatch.setitem(sys.modules, "gi", None)
    try:
        refuse("aravis://", r"apt install python3-gi gir1\.2-aravis", MissingDependencyError)
        assert find_cameras() == []
    finally:
        load_aravis.cache_clear()
