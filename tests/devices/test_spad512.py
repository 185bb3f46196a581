"""The SPAD array's commands, and the driver against an emulated server that can fail."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

import devices
from devices.emulation.faults import Fault
from devices.loopback import HOST, Connection, LoopbackServer
from devices.source import Source
from devices.spad512.emulator import EmulatedSpadArray
from devices.spad512.protocol import BIT_DEPTHS, IMAGE_WIDTHS_PX, ROWS, TERMINATOR, ExposureRequest
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
    found = ExposureRequest.decode(exposure.encode().removesuffix(TERMINATOR))
    assert found.seconds == pytest.approx(exposure.seconds, rel=1e-8)  # nine digits travel
    assert (found.bits, found.images, found.width) == (
        exposure.bits,
        exposure.images,
        exposure.width,
    )


def test_requests_as_the_makers_examples_write_them() -> None:
    assert ExposureRequest(8, 2e-3, 3, 128).encode() == b"I,8,2,3,0,1,0,1,128\n"  # milliseconds
    assert ExposureRequest(1, 2e-3, 3).encode() == b"I,1,2000,3,0,1,0,1,512\n"  # microseconds
    assert ExposureRequest(pile_up=True).encode_pile_up() == b"PU,1\n"


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


def taken(source: Source, frames: int) -> list[Any]:
    found: list[Any] = []
    while len(found) < frames:
        batch = source.read(10)
        assert batch is not None
        found += list(batch.records)
    return found


def finished(source: Source) -> None:
    source.stop()
    while source.read(10) is not None:
        pass
    source.close()
    assert source.stats.is_balanced, source.stats


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
        frames = taken(source, 5)
        info = source.info.as_dict()
        finished(source)
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
    assert (info["rows"], info["columns"]) == (512, values.get("width", 64))
    if values["bits"] > 1:
        # LIGHT has up to 200 photons in the millisecond: the picture is Poisson about it, and not
        # turned.
        expected = LIGHT[:, : exposure.width] * 1e-3
        counts = np.mean([frame["counts"] for frame in frames], axis=0)
        assert np.corrcoef(counts.ravel(), expected.ravel())[0, 1] > 0.95


def test_pixels_that_spell_the_end_are_pixels() -> None:
    """DONE at the end of every piece that arrives: only the length tells where a picture ends."""
    pixels = np.frombuffer(b"DONE" * (512 * 4 // 4), np.uint8)

    def serve(connection: Connection) -> None:
        connection.send(b"hello")
        connection.read_request(TERMINATOR)
        connection.send(b"off")
        while connection.read_request(TERMINATOR) is not None:
            for start in range(0, pixels.size, 512):
                connection.send(pixels[start : start + 512].tobytes())
            connection.send(b"DONE")

    with LoopbackServer(serve) as server, opened(server, width=4) as source:
        for frame in taken(source, 3):
            np.testing.assert_array_equal(frame["counts"].ravel(), pixels)


def test_slow_answers_are_waited_for(array: Array) -> None:
    with opened(array(Fault(1, "timeout", 3), Fault(2, "short", 3))) as source:
        numbers = [int(frame["number"]) for frame in taken(source, 5)]
        finished(source)
    assert numbers == [0, 1, 2, 3, 4]
    assert source.stats.timeouts >= 2


def test_after_an_unplugged_cable_the_pictures_go_on(array: Array) -> None:
    with opened(array(Fault(2, "unplug")), images=2) as source:
        gaps = []
        while source.stats.delivered < 9:
            batch = source.read(10)
            assert batch is not None
            gaps += [batch.after_gap]
        finished(source)
    assert (source.stats.reconnects, source.stats.malformed, gaps.count(True)) == (1, 1, 1)


def test_what_the_server_complains_of_is_passed_on(array: Array) -> None:
    with (
        opened(array(Fault(1, "stall"))) as source,
        pytest.raises(DeviceError, match=r"The FIFO is full\. ERROR"),
    ):
        taken(source, 5)
    assert source.stats.is_balanced


def test_an_answer_of_another_length_is_noticed(array: Array) -> None:
    with (
        opened(array(Fault(1, "corrupt"))) as source,
        pytest.raises(ProtocolError, match="ended in b'GONE'"),
    ):
        taken(source, 5)
    assert source.stats.is_balanced


def test_a_silent_server_counts_as_gone(array: Array) -> None:
    with opened(array(Fault(1, "timeout", 20)), timeout_s=0.3, reconnect_s=0.1) as source:
        taken(source, 4)
        finished(source)
    assert source.stats.reconnects == 1


def test_a_server_that_stays_away(array: Array) -> None:
    server = array()
    with opened(server, reconnect_s=0.2) as source:
        taken(source, 1)
        server.close()
        with pytest.raises(DeviceDisconnectedError, match="nobody answered"):
            taken(source, 10_000)
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
        counts = taken(source, 1)[0]["counts"]
        with pytest.raises(InputError):
            source.seek(0)
        finished(source)
    assert counts.shape == (512, 128)
    assert 0 < counts.mean() < 20  # 20 photons in a millisecond on a white pixel
    with pytest.raises(InputError, match="seed"):
        devices.open("sim+spad512://?seed=-1")
