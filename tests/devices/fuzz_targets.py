"""What takes bytes from outside: every codec, the drivers' conversations, and files of every format."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np
from fuzz_files import FORMATS, FileFormat, encode_itex

from devices.address import Uri
from devices.frames import FrameCodec
from devices.linospad2 import LinoSpad2Codec, read_sidecar
from devices.recording.read import Block, BlockHeader, BlockKind, BlockReader
from devices.remoteex import (
    Answer,
    AnswerCode,
    Command,
    RemoteExClient,
    RemoteExFeed,
    StreakOptions,
    parse_data_length,
    parse_integer,
)
from devices.source import Codec, Gap, as_bytes
from devices.spad512 import ExposureRequest, Spad512Feed, SpadOptions
from devices.tcp import TcpLink
from devices.timetag_codec import RECORD_DTYPE, TimeTagCodec, mark_wraps
from tofclip.errors import DeviceDisconnectedError, DeviceTimeoutError
from tofclip.io import hamamatsu as hpdta

FILE_SLOWNESS = 20
Decode = Callable[[bytes], object]


@dataclass(frozen=True)
class Target:
    """Something that takes bytes from outside, with a few inputs that it likes.

    `slowness`: so many times fewer inputs are tried in a sample. `room`: bytes that decoding may take whatever
    the input. `notices_all`: no damage at all is let through, as every byte has a checksum.
    """

    decode: Decode
    seeds: tuple[bytes, ...]
    slowness: int = 1
    room: int = 1 << 16
    notices_all: bool = False

    def bound(self, length: int) -> int:
        """Bytes that decoding an input of `length` bytes may take at most."""
        return self.room + 32 * length


def stream(codec: Codec) -> Decode:
    """Feed a codec as a stream would: as much as is whole, after a loss, from any state."""

    def decode(data: bytes) -> None:
        view = as_bytes(data)
        view = view[: codec.count_complete_bytes(view)]
        found = codec.decode(view, codec.start)
        assert len(found.records) + found.malformed == codec.count_records(view)
        again = codec.decode(view, found.state, after_loss=True)
        assert len(again.records) + again.malformed == codec.count_records(view)

    return decode


def _time_tags() -> Target:
    records = np.zeros(200, RECORD_DTYPE)
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
    seeds = [encode_itex(np.ones((7, 9), dtype), text, tables) for dtype in ("u1", "<u2", "<u4")]
    return Target(hpdta.decode_itex, tuple(seeds))


def _answer(data: bytes) -> None:
    answer = Answer.decode(data)
    assert parse_data_length(answer) >= 0
    if answer.code is AnswerCode.DONE:
        for word in answer.arguments:
            parse_integer(word, "a number")


def _recording() -> Target:
    payload = _time_tags().seeds[0]
    blocks = [BlockHeader.of(BlockKind.PIECE, payload, 5, 200, gap).pack() + payload for gap in Gap]

    def decode(data: bytes) -> None:
        reader = BlockReader(
            Path("run.h5"), lambda position, length: data[position : position + length], len(data)
        )
        for entry in reader:
            if isinstance(entry, Block):
                reader.read_payload(entry)

    return Target(decode, (b"".join(blocks),))


class Replayed(TcpLink):
    """Stands in for a connection: says what it was given, then hangs up."""

    def __init__(self, data: bytes) -> None:
        self.name, self._buffer = "replayed", bytearray(data)

    def send(self, data: bytes, timeout: float) -> None:
        pass

    def close(self) -> None:
        pass

    def discard_available(self) -> int:
        return 0  # nothing comes before it is asked for

    def _fill_buffer(self, deadline: float, timeout: float) -> None:
        raise DeviceDisconnectedError("the replay is over")


def _remoteex_session() -> Target:
    """A whole conversation: greetings, the start, messages, pictures, a table; then the end,
    whatever comes.
    """
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
        with mock.patch("devices.remoteex.TcpLink", side_effect=lambda *_: links.pop(0)):
            feed = RemoteExFeed(
                lambda: RemoteExClient("replayed", 1, 2, 0.01), StreakOptions(reconnect_s=0)
            )
            assert feed.calibration is None or feed.info.instrument
        with mock.patch.object(
            feed, "_reconnect", side_effect=DeviceDisconnectedError("it stays away")
        ):
            try:
                for _ in range(2):
                    feed.pull(0.01)
            finally:
                feed.close()

    return Target(decode, (said + border + data,), slowness=5)


def _spad512_session() -> Target:
    """Greeting, two requests of two pictures, the end."""
    options = SpadOptions(images=2, width=4, timeout_s=1e-9)
    pictures = bytes(range(256)) * (options.request.codec.pixel_bytes * 2 // 256)

    def decode(data: bytes) -> None:
        texts = [b"hello", b"", b"system", b"", b"off", b""]

        class Server(Replayed):
            def read_available(self, limit: int, timeout: float) -> bytes:
                text = texts.pop(0) if texts else super().read_available(limit, timeout)
                if not text:
                    raise DeviceTimeoutError("it is quiet")
                return text

        with mock.patch("devices.spad512._SILENCE_S", 0):
            feed = Spad512Feed(lambda: Server(data), options)
        with mock.patch.object(
            feed, "_reconnect", side_effect=DeviceDisconnectedError("it stays away")
        ):
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


def _file(file_format: FileFormat) -> Target:
    folder = tempfile.TemporaryDirectory()

    def decode(data: bytes) -> None:
        assert folder.name  # it lives as long as this function
        file_format.decode(Path(folder.name), data)

    # The libraries' own tables and buffers, whatever the file; what it claims would be far more.
    return Target(
        decode,
        file_format.seeds(),
        FILE_SLOWNESS,
        room=1 << 24,
        notices_all=file_format.notices_all,
    )


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
        lambda data: hpdta.read_row_times(hpdta.parse_text(data.decode("latin-1")), "/nowhere", 5),
        (
            b'[Scaling],ScalingYUnit="ns",ScalingYType=1,ScalingYScale=0.3,ScalingYScalingFile="Other"[Camera],Type=1',
        ),
    ),
    "RemoteEx answers": Target(
        _answer,
        (
            Answer(
                AnswerCode.DONE, "ImgRingBufferGet", ("672", "508", "2", "0", "14", "99")
            ).encode()[:-1],
            Answer(AnswerCode.MESSAGE, "LiveMonitor", ("RingBuffer", "7")).encode()[:-1],
        ),
    ),
    "RemoteEx commands": Target(
        lambda data: Command.decode(data), (b"DevParamSet(TD,MCP Gain,0)", b"AcqStop()")
    ),
    "SPAD512 requests": Target(
        lambda data: ExposureRequest.decode(data),
        (b"I,8,2,3,0,1,0,1,128", b"I,1,2.5e-3,1,0,1,0,1,512"),
    ),
    "addresses": Target(
        lambda data: Uri.parse(data.decode("latin-1")).host_and_port(9),
        (b"remoteex://lab-7:1001?seed=4&rate=x", b"spad512://[::1]:99?seed=1"),
    ),
    **{name: _file(file_format) for name, file_format in FORMATS.items()},
}
