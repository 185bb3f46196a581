"""The SPAD array's commands, and the driver against an emulated server that can fail."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from instruments import finish, read_gaps, take

import devices
from devices import counted_photons as photons
from devices.counted_photons import read_photons
from devices.emulation.harness import HOST, Connection, Fault, LoopbackServer
from devices.emulation.scenes import render_array_delays, render_array_light
from devices.emulation.spad512 import EmulatedSpadArray
from devices.frames import GateScan
from devices.source import Batch, Source
from devices.spad512 import (
    BIT_DEPTHS,
    IMAGE_WIDTHS_PX,
    ROWS,
    ExposureRequest,
    find_error_text,
)
from devices.tcp import TcpLink
from tofclip.errors import (
    DeviceDisconnectedError,
    DeviceError,
    DeviceNotFoundError,
    InputError,
    ProtocolError,
    ShapeError,
)

LIGHT = np.random.default_rng(2).uniform(0, 2e5, (ROWS, ROWS))

exposures = st.builds(
    ExposureRequest,
    st.sampled_from(BIT_DEPTHS[1:]),
    st.integers(1, 10**9).map(lambda nanoseconds: nanoseconds * 1e-9),
    st.integers(1, 1000),
    st.sampled_from(IMAGE_WIDTHS_PX),
)


@given(exposures)
def test_requests_come_back(exposure: ExposureRequest) -> None:
    found = ExposureRequest.decode(exposure.encode())
    assert found.seconds == pytest.approx(exposure.seconds, rel=1e-8)  # nine digits travel
    assert (found.bits, found.images, found.width) == (
        exposure.bits,
        exposure.images,
        exposure.width,
    )


def test_requests_as_the_makers_examples_write_them() -> None:
    assert ExposureRequest(8, 2e-3, 3, 128).encode() == b"I,8,2,3,0,1,0,1,128"  # milliseconds
    assert ExposureRequest(1, 2e-3, 3).encode() == b"I,1,2000,3,0,1,0,1,512"  # microseconds
    assert ExposureRequest(4, 2e-3, 3, 64).encode() == b"I,4,2000,3,0,1,0,1,64"  # these as well
    assert ExposureRequest(6, 2e-3, 3).encode() == b"I,6,2,3,0,1,0,1,512"
    # The vendor's class leaves the width out, and its gated mode has none.
    assert ExposureRequest.decode(b"I,8,2,3,0,1,0,1") == ExposureRequest(8, 2e-3, 3)
    gated = ExposureRequest(8, 2e-3, 3, gate=GateScan(10, 36, 5, 100))
    assert gated.encode() == b"G,8,2,3,10,36,0,5,100,0,1,0,1"
    assert ExposureRequest.decode(gated.encode()) == gated
    assert gated.frames == 30
    assert ExposureRequest(pile_up=True).encode_pile_up() == b"PU,1"


@pytest.mark.parametrize(
    "line", [b"", b"I,8", b"I,x,1,1,0,1,0,1,8", b"I,8,1,1,0,1,0,1,9", b"I,8,nan,1,0,1,0,1,8"]
)
def test_lines_that_request_nothing(line: bytes) -> None:
    with pytest.raises(ProtocolError):
        ExposureRequest.decode(line)


@pytest.mark.parametrize(
    ("exposure", "bits", "frame_bytes"),
    [
        (ExposureRequest(1), 1, 32768),
        (ExposureRequest(8, width=4), 8, 2048),
        (ExposureRequest(9, width=4), 16, 4096),
        (ExposureRequest(8, width=4, pile_up=True), 16, 4096),
    ],
)
def test_lengths_are_computed(exposure: ExposureRequest, bits: int, frame_bytes: int) -> None:
    assert (exposure.codec.bits, exposure.codec.pixel_bytes) == (bits, frame_bytes)


@pytest.mark.parametrize(
    "values",
    [
        (5,),
        (8, 0.0),
        (8, 1e9),
        (8, 1e-3, 0),
        (8, 1e-3, 1, 5),
        (1, 1e-3, 1, 256),
        (1, 1e-3, 1, 512, True),
    ],
)
def test_impossible_exposures_are_refused(values: tuple[Any, ...]) -> None:
    with pytest.raises(InputError):
        ExposureRequest(*values)


Array = Callable[..., EmulatedSpadArray]


@pytest.fixture
def array() -> Iterator[Array]:
    made = []

    def make(*faults: Fault, light: Any = LIGHT) -> EmulatedSpadArray:
        made.append(EmulatedSpadArray(light, 7, faults=faults))
        return made[-1]

    yield make
    for server in made:
        server.close()


def opened(server: EmulatedSpadArray | LoopbackServer, **values: object) -> Source:
    query = "&".join(f"{name}={value}" for name, value in {"width": 64, **values}.items())
    return devices.open(f"spad512://{HOST}:{server.port}?{query}")


@pytest.mark.parametrize(
    "values",
    [
        {"bits": 1, "width": 512, "exposure_us": 5},
        {"bits": 8},
        {"bits": 12, "images": 3},
        {"bits": 8, "pile_up": 1, "width": 4},
    ],
)
def test_pictures_come_bit_for_bit(array: Array, values: dict[str, int]) -> None:
    server = array()
    with opened(server, **values) as source:
        frames = take(source, 5)
        info = source.info.as_dict()
        finish(source)
    images = values.get("images", 1)
    exposure = ExposureRequest(
        values["bits"],
        values.get("exposure_us", 1000) * 1e-6,
        images,
        values.get("width", 64),
        "pile_up" in values,
    )
    for place, frame in enumerate(frames):
        sent = server.draw_frame(place // images, place % images, exposure).tobytes()
        assert exposure.codec.encode(frame.reshape(1)) == exposure.codec.pack_frame(place, sent)
    assert info["greeting"] == "SPAD512S emulated server, ready"
    assert info["serial"] == "EMULATED-1"
    assert (info["rows"], info["columns"]) == (512, values.get("width", 64))
    # LIGHT has up to 200 photons in the millisecond, or one in five microseconds: the picture is
    # Poisson about it, and not turned.
    expected = LIGHT[:, : exposure.width]
    counts = np.mean([frame["counts"] for frame in frames], axis=0)
    correlation = np.corrcoef(counts.ravel(), expected.ravel())[0, 1]
    assert correlation > (0.5 if values["bits"] == 1 else 0.95)


def test_pixels_that_spell_the_end_are_pixels() -> None:
    """DONE at the end of every piece that arrives: only the length tells where a picture ends."""
    pixels = np.frombuffer(b"DONE" * (512 * 4 // 4), np.uint8)

    def serve(connection: Connection) -> None:
        connection.send(b"hello")
        for said in (b"system", b"off"):
            connection.read_available()
            connection.send(said)
        while connection.read_available() is not None:
            for start in range(0, pixels.size, 512):
                connection.send(pixels[start : start + 512].tobytes())
            connection.send(b"DONE")

    with LoopbackServer(serve) as server, opened(server, width=4) as source:
        for frame in take(source, 3):
            np.testing.assert_array_equal(frame["counts"].ravel(), pixels)


def test_slow_answers_are_waited_for(array: Array) -> None:
    with opened(array(Fault(1, "timeout", 3), Fault(2, "short", 3))) as source:
        numbers = [int(frame["number"]) for frame in take(source, 5)]
        finish(source)
    assert numbers == [0, 1, 2, 3, 4]
    assert source.stats.timeouts >= 2


def test_after_an_unplugged_cable_the_pictures_go_on(array: Array) -> None:
    with opened(array(Fault(2, "unplug")), images=2) as source:
        gaps = read_gaps(source, 9)
        finish(source)
    assert (source.stats.reconnects, source.stats.malformed, gaps.count(True)) == (1, 1, 1)


@pytest.mark.parametrize(("amount", "torn"), [(1, 0), (2, 0), (3, 1)])
def test_what_the_server_complains_of_is_passed_on(array: Array, amount: int, torn: int) -> None:
    """With the mark behind the text, in front of it, or behind a part of a picture."""
    with (
        opened(array(Fault(1, "stall", amount))) as source,
        pytest.raises(DeviceError, match=r"he FIFO is full\."),
    ):
        take(source, 5)
    assert source.stats.is_balanced
    assert (source.stats.delivered, source.stats.malformed) == (1, 1)


def test_pixels_are_not_taken_for_complaints() -> None:
    assert find_error_text(b"\x00" * 900 + b"DONE") is None
    assert find_error_text(b"\x00\x81" * 90) is None
    assert find_error_text(b"\x81" * 90 + b"The FIFO is full.\nERROR") == "The FIFO is full. ERROR"
    assert find_error_text(b"\x81" * 90 + b"ERROR: hot\nDONE") == "ERROR: hot DONE"


def test_an_answer_of_another_length_is_noticed(array: Array) -> None:
    with (
        opened(array(Fault(1, "corrupt"))) as source,
        pytest.raises(ProtocolError, match="ended in b'GONE'"),
    ):
        take(source, 5)
    assert source.stats.is_balanced


def test_a_silent_server_counts_as_gone(array: Array) -> None:
    with opened(array(Fault(1, "timeout", 20)), timeout_s=0.3, reconnect_s=0.1) as source:
        take(source, 4)
        finish(source)
    assert source.stats.reconnects == 1


def test_a_server_that_stays_away(array: Array) -> None:
    server = array()
    with opened(server, reconnect_s=0.2) as source:
        take(source, 1)
        server.close()
        with pytest.raises(DeviceDisconnectedError, match="no answer came"):
            take(source, 10_000)
    assert source.stats.is_balanced


def test_nobody_there_and_values_that_cannot_be() -> None:
    with pytest.raises(DeviceNotFoundError):
        devices.open(f"spad512://{HOST}:1")
    for query in ("bits=5", "timeout_s=0", "speed=1", "exposure_us=-1"):
        with pytest.raises(InputError):
            devices.open(f"spad512://{HOST}:1?{query}")
    with pytest.raises(ShapeError):
        EmulatedSpadArray(np.ones((3, 4)), 0)
    with pytest.raises(InputError, match="faults are"):
        EmulatedSpadArray(LIGHT, 0, faults=[Fault(0, "lost")])


def test_the_emulated_array_looks_at_the_demonstration() -> None:
    with devices.open("sim+spad512://?seed=3&width=128&bits=8") as source:
        counts = take(source, 1)[0]["counts"]
        with pytest.raises(InputError):
            source.seek(0)
        finish(source)
    assert counts.shape == (512, 128)
    assert 0 < counts.mean() < 20  # 20 photons in a millisecond on a white pixel
    with pytest.raises(InputError, match="seed"):
        devices.open("sim+spad512://?seed=-1")


def test_single_bits_lie_as_the_other_depths_do(array: Array) -> None:
    """The hardware sends them turned by a quarter: one bright corner tells."""
    corner = np.zeros((ROWS, ROWS))
    corner[:100, :50] = 1e9
    with opened(array(light=corner), bits=1, width=512) as source:
        single = take(source, 1)[0]["counts"]
        finish(source)
    np.testing.assert_array_equal(single > 0, corner > 0)


class Unframed(EmulatedSpadArray):
    """Ends no text."""

    is_framed = False


def test_a_server_that_calibrates_itself_first_and_frames_nothing() -> None:
    server = Unframed(LIGHT, 7)
    server.must_calibrate = True
    with opened(server) as source:
        assert len(take(source, 2)) == 2
        finish(source)
    server.close()


def test_pictures_of_a_cut_scan_are_not_added(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures 0 and 1 of a scan of three, then a loss, then a whole scan."""
    dtype = np.dtype([("number", np.int64), ("counts", np.uint16, (2, 2))])
    records = np.zeros(6, dtype)
    records["number"] = [0, 1, 5, 6, 7, 8]
    records["counts"] = np.array([100, 200, 300, 1, 2, 3])[:, np.newaxis, np.newaxis]
    monkeypatch.setattr(photons, "read_batches", lambda *_: [Batch(records, 0)])
    total = photons._add_scans(None, 3, 1, 1)  # type: ignore[arg-type]
    np.testing.assert_array_equal(total[:, 0, 0], [1, 2, 3])


GATED = "mode=gated&gate_steps=30&gate_step_ps=700&binning=16"


def test_a_gated_array_is_a_flash_lidar() -> None:
    """Scans of a gate become the scene's ranges in one call."""
    counted = read_photons(f"sim+spad512://?seed=1&{GATED}")
    image = counted.to_image()
    assert counted.counts.shape == (30, 32, 32)
    assert counted.pulse is not None
    # A pixel shows its light up to the last opening before the light's delay.
    blocks = render_array_delays().reshape(32, 16, 32, 16)
    earliest, latest = blocks.min(axis=(1, 3)), blocks.max(axis=(1, 3))
    bright = render_array_light().reshape(32, 16, 32, 16).mean(axis=(1, 3)) > 0.3
    even = bright & (latest - earliest < 1e-11)  # NaN where a part of the pixel sees nothing
    half = (counted.counts.max(axis=0) + counted.counts.min(axis=0)) / 2
    last = counted.times[29 - np.argmax(counted.counts[::-1] > half, axis=0)]
    step, edge = counted.bin_width, 2e-10
    assert even.sum() > 50
    assert np.all(last[even] - edge <= earliest[even])
    assert np.all(earliest[even] <= last[even] + step + edge)
    assert image.bins == 30


def test_a_scan_that_was_cut_is_left_out(array: Array) -> None:
    server = EmulatedSpadArray(
        LIGHT, 7, faults=[Fault(0, "unplug")], delays=np.full((ROWS, ROWS), 8e-9)
    )
    address = f"spad512://{HOST}:{server.port}?mode=gated&gate_steps=4&gate_step_ps=1500"
    counted = read_photons(f"{address}&scans=2&binning=16")
    with devices.open(address) as source:
        numbers = [int(frame["number"]) for frame in take(source, 4)]
    server.close()
    assert numbers == [0, 1, 2, 3]
    sums = counted.counts.sum(axis=(1, 2))
    # Open at 5, 6.5 and 8 ns for 5 ns, light at 8: half of it in the third, none in the fourth.
    assert sums[0] == pytest.approx(sums[1], rel=0.01)
    assert sums[2] == pytest.approx(sums[0] / 2, rel=0.1)
    assert sums[3] < sums[0] / 20


@pytest.mark.parametrize(
    "query",
    ["gate_steps=3", "mode=gated&bits=4", "mode=gated&width=64", "mode=gated&gate_step_ps=1"],
)
def test_gates_that_cannot_be(query: str) -> None:
    with pytest.raises(InputError):
        devices.open(f"sim+spad512://?{query}")


def test_what_counts_no_photons_in_time() -> None:
    with pytest.raises(InputError, match="mode=gated"):
        read_photons("sim+spad512://?seed=1&width=4")
    with pytest.raises(InputError, match="must be positive"):
        read_photons("sim+spad512://?mode=gated&scans=0")


def test_clients_of_the_vendor_are_answered() -> None:
    """Commands without an end, eight fields, the information first: as others' clients speak."""
    server = Unframed(LIGHT, 7, delays=np.full((ROWS, ROWS), 8e-9))
    with TcpLink(HOST, server.port, 5) as link:
        assert link.read_available(8192, 5).split()[0] == b"SPAD512S"
        said = {}
        for command in (
            b"D",
            b"R",
            b"V",
            b"V,3.0",
            b"AE,0,1",
            b"CALIB,0",
            b"PU,1",
            b"PU,0",
            b"F,c0",
        ):
            link.send(command, 5)
            said[command] = link.read_available(8192, 5).decode()
        assert len(said[b"D"].splitlines()) == 9
        assert [float(word) for word in said[b"R"].split(",")][4:] == [4e7, 100.0]
        assert len(said[b"V"].split(",")) == 2
        assert said[b"F,c0"].startswith("ERROR")
        link.send(b"Gf,1,18,5,1", 5)
        lines = link.read_available(8192, 5).decode().splitlines()
        assert lines[2:] == [
            "The number of gate steps is 1388",
            "The gate offset is 0 ps",
            "The minimum gate step size is 18 ps",
        ]
        for command, pictures in ((b"I,8,1.0,2,0,0,0,1", 2), (b"G,8,1.0,1,3,36,0,5,0,0,1,0,1", 3)):
            link.send(command, 5)
            data = link.read_exactly(pictures * ROWS * ROWS + 4, 1 << 22, 10)
            assert data.endswith(b"DONE")
    server.close()
