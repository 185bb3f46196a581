"""Damaged bytes, in every way that a wire or a disk can damage them, through every codec.

Whatever comes in, only our own exceptions come out, and no more memory is taken than `Target.bound` says. In the suite
it is a sample; ``python tests/devices/test_fuzz.py 200000`` runs as many mutations as it is told and prints a table.
"""

from __future__ import annotations

import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from devices.codec import Codec, as_bytes
from devices.frames import FrameCodec
from devices.ledger import Ledger
from devices.linospad2.codec import LinoSpad2Codec
from devices.linospad2.sidecar import read_sidecar
from devices.recording.blocks import BlockHeader, Kind
from devices.recording.reader import Block, BlockReader
from devices.remoteex.client import RemoteEx, announced
from devices.remoteex.protocol import Answer, Code, Command, whole_number
from devices.remoteex.source import LiveSettings, RemoteExFeed
from devices.ring import Gap
from devices.spad512.protocol import Exposure
from devices.spad512.source import Spad512Feed
from devices.timetag.codec import RECORD, TimeTagCodec, mark_wraps
from devices.uri import Uri
from tofclip.errors import DeviceDisconnectedError, DeviceTimeoutError, ProtocolError, TofclipError
from tofclip.io import hpdta, itex

SUITE_MUTATIONS = 24_000


Decode = Callable[[bytes], object]


@dataclass(frozen=True)
class Target:
    """Something that takes bytes from outside, with a few inputs that it likes.

    `slowness`: so many times fewer inputs are tried. `room`: bytes that decoding may take whatever the input.
    """

    decode: Decode
    seeds: tuple[bytes, ...]
    slowness: int = 1
    room: int = 1 << 16

    def bound(self, length: int) -> int:
        """Bytes that decoding an input of `length` bytes may take at most."""
        return self.room + 32 * length


def stream(codec: Codec) -> Decode:
    """Feed a codec as a stream would: as much as is whole, after a loss, from any state."""

    def decode(data: bytes) -> None:
        view = as_bytes(data)
        view = view[: codec.whole(view)]
        found = codec.decode(view, codec.start)
        assert len(found.records) + found.malformed == codec.count(view)
        again = codec.decode(view, found.state, after_loss=True)
        assert len(again.records) + again.malformed == codec.count(view)

    return decode


def _time_tags() -> Target:
    records = np.zeros(200, RECORD)
    records["time_ticks"], records["channels"] = np.arange(200) << 30, 5
    codec = TimeTagCodec()
    return Target(stream(codec), (codec.encode(mark_wraps(records)), b""))


def _line_sensor(counter: bool) -> Target:
    codec = LinoSpad2Codec("2212s", 3, counter)
    random = np.random.default_rng(1)
    records = np.zeros(60, codec.dtype)
    records["cycle"], records["pixel"] = np.arange(60) // 20, random.permutation(256)[:60]
    records["code"] = random.integers(0, 1 << 28, 60)
    return Target(stream(codec), (codec.encode(codec.sort_stamps(records)), b""))


def _frames(bits: int) -> Target:
    codec = FrameCodec(6, 8, bits)
    records = np.zeros(5, codec.dtype)
    records["number"] = np.arange(5) * 3
    return Target(stream(codec), (codec.encode(records), b""))


def _itex() -> Target:
    text = '[Scaling],ScalingXScalingFile="",ScalingYUnit="ns",ScalingYScalingFile=""'
    tables = {"X": np.arange(9, dtype=np.float32), "Y": np.arange(7, dtype=np.float32)}
    seeds = [itex.encode(itex.ItexImage(np.ones((7, 9), dtype), text, tables=tables)) for dtype in ("u1", "<u2", "<u4")]
    return Target(lambda data: itex.encode(itex.decode(data)), tuple(seeds))


def _answer(data: bytes) -> None:
    answer = Answer.decode(data)
    assert announced(answer) >= 0
    if answer.code is Code.DONE:
        for word in answer.arguments:
            whole_number(word, "a number")


def _recording() -> Target:
    payload = _time_tags().seeds[0]
    blocks = [BlockHeader.of(Kind.PIECE, payload, 5, 200, gap).packed() + payload for gap in Gap]

    def decode(data: bytes) -> None:
        reader = BlockReader(Path("run.h5"), lambda position, length: data[position : position + length], len(data))
        for entry in reader:
            if isinstance(entry, Block):
                reader.payload(entry)

    return Target(decode, (b"".join(blocks),))


class Replayed:
    """Stands in for a connection: says what it was given, then hangs up."""

    name = "replayed"

    def __init__(self, data: bytes) -> None:
        self._left = data

    def send(self, data: bytes, timeout: float) -> None:
        pass

    def close(self) -> None:
        pass

    def some(self, limit: int, timeout: float) -> bytes:
        if not self._left:
            raise DeviceDisconnectedError("the replay is over")
        return self._taken(limit)

    def exactly(self, length: int, limit: int, timeout: float) -> bytes:
        if not 0 <= length <= limit:
            raise ProtocolError("too much")
        if length > len(self._left):
            raise DeviceDisconnectedError("the replay is over")
        return self._taken(length)

    def until(self, end: bytes, limit: int, timeout: float) -> bytes:
        found = self._left.find(end)
        if found < 0:
            raise DeviceDisconnectedError("the replay is over")
        message = self._taken(found)
        self._taken(len(end))
        return message

    def _taken(self, length: int) -> bytes:
        taken, self._left = self._left[:length], self._left[length:]
        return taken


def _remoteex_session() -> Target:
    """A whole conversation: greetings, the start, messages, pictures, a table; then the end, whatever comes."""
    picture = np.arange(24, dtype="<u2").tobytes()
    said = (
        b"RemoteEx Ready\r0,AcqLiveMonitor\r4,LiveMonitor,RingBuffer,0,1\r0,AcqStart\r"
        b"0,ImgRingBufferGet,6,4,2,0,0,1\r0,DevParamGet,20 ns\r0,DevParamGet,Operate\r0,DevParamGet,30\r"
        b"0,ImgDataGet,4,1\r4,LiveMonitor,RingBuffer,1,9\r0,ImgRingBufferGet,6,4,2,0,1,9\r0,DevParamSet\r0,AcqStop\r"
        b"0,AcqLiveMonitor\r"
    )
    data = b"RemoteEx Data Ready\r" + picture + np.arange(4, dtype="<f4").tobytes() + picture
    border = b"<border>"

    def decode(both: bytes) -> None:
        links = [Replayed(part) for part in both.partition(border)[::2]]
        with mock.patch("devices.remoteex.client.TcpLink", side_effect=lambda *_: links.pop(0)):
            feed = RemoteExFeed(lambda: RemoteEx("replayed", 1, 2, 0.01), Ledger(), LiveSettings(reconnect=0))
            assert feed.calibration is None or feed.info.instrument
        with mock.patch.object(feed, "_reconnect", side_effect=DeviceDisconnectedError("it stays away")):
            try:
                for _ in range(2):
                    feed.pull(0.01)
            finally:
                feed.close()

    return Target(decode, (said + border + data,), slowness=5)


def _spad512_session() -> Target:
    """Greeting, two requests of two pictures, the end."""
    exposure = Exposure(8, 1e-3, 2, 4)
    pictures = bytes(range(256)) * (exposure.codec.pixel_bytes * 2 // 256)

    def decode(data: bytes) -> None:
        texts = [b"hello", b"", b"off", b""]

        class Server(Replayed):
            def some(self, limit: int, timeout: float) -> bytes:
                text = texts.pop(0) if texts else super().some(limit, timeout)
                if not text:
                    raise DeviceTimeoutError("it is quiet")
                return text

        with mock.patch("devices.spad512.source._QUIET", 0):
            feed = Spad512Feed(lambda: Server(data), Ledger(), exposure, 0.0, 0.0)  # type: ignore[arg-type,return-value]
        with mock.patch.object(feed, "_reconnect", side_effect=DeviceDisconnectedError("it stays away")):
            try:
                for _ in range(4):
                    feed.pull(0.0)
            finally:
                feed.close()

    return Target(decode, ((pictures + b"DONE") * 2,), slowness=5)


def _sidecar() -> Target:
    folder = tempfile.TemporaryDirectory()
    path = Path(folder.name, "run.toml")

    def decode(data: bytes) -> None:
        assert folder.name  # it lives as long as this function
        path.write_bytes(data)
        read_sidecar(path.with_suffix(".dat"))

    seed = b'firmware = "2212b"\ntimestamps_per_cycle = 512\nabsolute_counter = false\nlaser_period_ps = 25e3\n'
    return Target(decode, (seed,), slowness=2, room=1 << 21)  # a board's tables have 36 000 numbers


TARGETS = {
    "RemoteEx sessions": _remoteex_session(),
    "SPAD512 sessions": _spad512_session(),
    "LinoSPAD2 sidecars": _sidecar(),
    "blocks of recordings": _recording(),
    "time tags": _time_tags(),
    "LinoSPAD2": _line_sensor(counter=False),
    "LinoSPAD2 with counter": _line_sensor(counter=True),
    "frames of single bits": _frames(1),
    "frames of 16 bits": _frames(16),
    "frames of 32 bits": _frames(32),
    "ITEX": _itex(),
    "HPD-TA text": Target(
        lambda data: hpdta.row_times(hpdta.parse_text(data.decode("latin-1")), "/nowhere", 5),
        (b'[Scaling],ScalingYUnit="ns",ScalingYType=1,ScalingYScale=0.3,ScalingYScalingFile="Other"[Camera],Type=1',),
    ),
    "RemoteEx answers": Target(
        _answer,
        (
            Answer(Code.DONE, "ImgRingBufferGet", ("672", "508", "2", "0", "14", "99")).encode()[:-1],
            Answer(Code.MESSAGE, "LiveMonitor", ("RingBuffer", "7")).encode()[:-1],
        ),
    ),
    "RemoteEx commands": Target(lambda data: Command.decode(data), (b"DevParamSet(TD,MCP Gain,0)", b"AcqStop()")),
    "SPAD512 requests": Target(
        lambda data: Exposure.decode(data), (b"I,8,2,3,0,1,0,1,128", b"I,1,2.5e-3,1,0,1,0,1,512")
    ),
    "addresses": Target(
        lambda data: Uri.parse(data.decode("latin-1")).host_and_port(9),
        (b"remoteex://lab-7:1001?seed=4&rate=x", b"spad512://[::1]:99?seed=1"),
    ),
}

TELLING = np.array([0, 1, 0x7F, 0x80, 0xFF, 0x20, 0x2C, 0x0D, 0x23, 0x30, 0x39], np.uint8)
"""Bytes on which decisions hang: extremes, signs, separators, digits."""


def mutations(seeds: tuple[bytes, ...], random: np.random.Generator) -> Iterator[bytes]:
    """Damage inputs for ever: bits flipped, bytes replaced, pieces cut, repeated, moved, filled and invented."""
    while True:
        data = bytearray(seeds[random.integers(len(seeds))])
        for _ in range(random.integers(1, 4)):
            _damage(data, random)
        yield bytes(data)


def _damage(data: bytearray, random: np.random.Generator) -> None:
    kind, length = random.integers(7), len(data)
    at = int(random.integers(length)) if length else 0
    size = int(random.integers(1, 17))
    if kind == 0 and length:
        data[at] ^= 1 << int(random.integers(8))
    elif kind == 1 and length:
        data[at] = int(random.choice(TELLING))
    elif kind == 2:
        del data[at:]
    elif kind == 3:
        del data[at : at + size]
    elif kind == 4:
        data[at:at] = data[at : at + size] * int(random.integers(1, 20))
    elif kind == 5:
        data[at : at + size] = bytes([int(random.choice(TELLING))]) * size
    else:
        data[at:at] = random.bytes(size)


def attack(target: Target, count: int, seed: int) -> tuple[int, int]:
    """Decode `count` damaged inputs; return how many were refused, and most bytes taken beyond the bound's share.

    Raises
    ------
    AssertionError
        An exception that is not ours, or too much memory, with the input that does it.
    """
    for data in target.seeds:
        target.decode(data)  # compile, and fill caches, before memory is watched
    refused, most = 0, 0
    damaged = mutations(target.seeds, np.random.default_rng(seed))
    tracemalloc.start()
    try:
        for _ in range(count):
            data = next(damaged)
            tracemalloc.reset_peak()
            before = tracemalloc.get_traced_memory()[0]
            message = ""
            try:
                target.decode(data)
            except TofclipError as fault:
                message = str(fault)
            except Exception as fault:
                raise AssertionError(f"{data!r} raises {type(fault).__name__}: {fault}") from fault
            refused += bool(message)
            assert "\n" not in message, data
            taken = tracemalloc.get_traced_memory()[1] - before
            assert taken <= target.bound(len(data)), f"{data!r} takes {taken} bytes"
            most = max(most, taken)
    finally:
        tracemalloc.stop()
    return refused, most


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_input_raises_only_our_own_errors_and_takes_little_memory(name: str) -> None:
    target = TARGETS[name]
    count = SUITE_MUTATIONS // len(TARGETS) // target.slowness
    refused, most = attack(target, count, seed=1)
    assert refused < count  # the damage is not so heavy that nothing ever gets beyond the first check
    assert most > 0


def main(total: int) -> None:
    """Attack every target and print what came of it."""
    print(f"{'target':24} {'inputs':>9} {'refused':>9} {'most bytes':>11} {'per second':>11}")
    for name, target in TARGETS.items():
        began = time.perf_counter()
        count = -(-total // len(TARGETS)) // target.slowness
        refused, most = attack(target, count, seed=2)
        print(f"{name:24} {count:9} {refused:9} {most:11} {count / (time.perf_counter() - began):11.0f}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100_000)
