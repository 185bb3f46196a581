"""Damaged bytes, in every way that a wire or a disk can damage them, through everything that takes
bytes from outside: every codec, the drivers' conversations, and files of every format.

Whatever comes in, only our own exceptions come out, and no more memory is taken than `Target.bound`
says. In the suite it is a sample, small where a target is slow; ``python
tests/devices/test_fuzz.py 100000`` shares that number of mutations out evenly and prints a table.
"""

import os
import subprocess
import sys
import tempfile
import time
import tracemalloc
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from unittest import mock

import h5py
import numpy as np
import pytest
import scipy.io
import tcspc_files
import tifffile
from PIL import Image

sys.path.append(str(Path(__file__).parents[1]))  # where this is no test but a script
from itex_files import encode_itex

from devices.address import Uri
from devices.frames import FrameCodec
from devices.linospad2 import LinoSpad2Codec, read_sidecar
from devices.recording.read import Block, BlockKind, BlockReader
from devices.remoteex import (
    Answer,
    AnswerCode,
    Command,
    RemoteExFeed,
    StreakOptions,
    parse_data_length,
    parse_integer,
)
from devices.source import Gap, as_bytes
from devices.spad512 import Spad512Feed, SpadOptions
from devices.tcp import TcpLink
from devices.timetag_codec import RECORD_DTYPE, TimeTagCodec, mark_wraps
from devices.transients import read_transient
from nlos import Capture
from nlos.io import read_capture
from tofclip import PointCloud
from tofclip.errors import DeviceDisconnectedError, DeviceTimeoutError, TofclipError
from tofclip.io import hamamatsu, read_streak
from tofclip.io.light_fields import read_light_field, write_light_field
from tofclip.io.streaks import outline_streak_file
from tofclip.lidar.photons.files import describe_photons, read_photons
from tofclip.light_field import LightField
from tofclip.storage import Field, Record, read_outline

SAMPLE = "sample"
MIN_JUDGED = 400
"""Of fewer inputs, all may well be refused."""
TELLING = np.array([0, 1, 0x7F, 0x80, 0xFF, 0x20, 0x2C, 0x0D, 0x23, 0x30, 0x39], np.uint8)
"""Bytes on which decisions hang: extremes, signs, separators, digits."""
Decode = Callable[[bytes], object]
FOLDER = tempfile.TemporaryDirectory()


@dataclass(frozen=True)
class Target:
    """Something that takes bytes from outside, with a few inputs that it likes.

    `slowness`: so many times fewer inputs are tried in a sample. `room`: bytes that decoding may take whatever
    the input. `notices_all`: every byte has a checksum, so that all may be refused. `is_file`: what is hardly the
    beginning of one, or something else behind it, is refused.
    """

    decode: Decode
    seeds: tuple[bytes, ...]
    slowness: int = 1
    room: int = 1 << 16
    notices_all: bool = False
    is_file: bool = False

    def bound(self, length):
        """Bytes that decoding an input of `length` bytes may take at most."""
        return self.room + 32 * length


def stream(codec, *seeds):
    """A codec, fed as by a stream: as much as is whole, after a loss, from any state."""

    def decode(data):
        view = as_bytes(data)
        view = view[: codec.count_complete_bytes(view)]
        found = codec.decode(view, codec.start)
        again = codec.decode(view, found.state, after_loss=True)
        for result in (found, again):
            assert len(result.records) + result.malformed == codec.count_records(view)

    return Target(decode, seeds)


def time_tags():
    records = np.zeros(200, RECORD_DTYPE)
    records["time_ticks"], records["channels"] = np.arange(200) << 30, 5
    codec = TimeTagCodec()
    return stream(codec, codec.encode(mark_wraps(records)), b"")


def line_sensor(counter):
    codec, random = LinoSpad2Codec("2212s", 3, counter), np.random.default_rng(1)
    records = np.zeros(60, codec.dtype)
    records["cycle"], records["pixel"] = np.arange(60) // 20, random.permutation(256)[:60]
    records["code"] = random.integers(0, 1 << 28, 60)
    return stream(codec, codec.encode(codec.sort_stamps(records)), b"")


def frames(bits):
    codec = FrameCodec(6, 8, bits)
    records = np.zeros(5, codec.dtype)
    records["number"] = np.arange(5) * 3
    return stream(codec, codec.encode(records), b"")


def itex():
    text = '[Scaling],ScalingXScalingFile="",ScalingYUnit="ns",ScalingYScalingFile=""'
    tables = {"X": np.arange(9, dtype=np.float32), "Y": np.arange(7, dtype=np.float32)}
    seeds = [encode_itex(np.ones((7, 9), dtype), text, tables) for dtype in ("u1", "<u2", "<u4")]
    return Target(hamamatsu.decode_itex, tuple(seeds))


def hpdta_text():
    seed = b'[Scaling],ScalingYUnit="ns",ScalingYType=1,ScalingYScale=0.3,ScalingYScalingFile="Other"[Camera],Type=1'
    parse = hamamatsu.parse_text
    return Target(
        lambda data: hamamatsu.read_row_times(parse(data.decode("latin-1")), "/nowhere", 5), (seed,)
    )


def answers():
    def decode(data):
        answer = Answer.decode(data)
        assert parse_data_length(answer) >= 0
        if answer.code is AnswerCode.DONE:
            for word in answer.arguments:
                parse_integer(word, "a number")

    return Target(decode, (b"0,ImgRingBufferGet,672,508,2,0,14,99", b"4,LiveMonitor,RingBuffer,7"))


def recording():
    payload = time_tags().seeds[0]
    sizes = 200, len(payload), zlib.crc32(payload)
    blocks = [Block(BlockKind.PIECE, gap, 5, *sizes).pack() + payload for gap in Gap]

    def decode(data):
        fetch = lambda position, length: data[position : position + length]  # noqa: E731
        reader = BlockReader(Path("run.h5"), fetch, len(data))
        for entry in reader:
            if isinstance(entry, Block):
                reader.read_payload(entry)

    return Target(decode, (b"".join(blocks),))


class Replayed(TcpLink):
    """Stands in for a connection: says what it was given, then hangs up."""

    def __init__(self, data):
        self.name, self._buffer = "replayed", bytearray(data)

    def send(self, data, timeout):
        pass

    def close(self):
        pass

    def discard_available(self):
        return 0  # nothing comes before it is asked for

    def _fill_buffer(self, deadline, timeout):
        raise DeviceDisconnectedError("the replay is over")


def connect_to(*links):
    """Connect to each once; then nobody is there any more."""
    left = list(links)

    def connect(*place):
        if not left:
            raise DeviceDisconnectedError("it stays away")
        return left.pop(0)

    return connect


def converse(feed, pulls):
    """Open and close what opens."""
    assert feed.calibration is None or feed.info.instrument
    try:
        for _ in range(pulls):
            feed.pull(0.01)
    finally:
        feed.close()


def remoteex_session():
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

    def decode(both):
        connect = connect_to(*(Replayed(part) for part in both.partition(border)[::2]))
        options = StreakOptions(reconnect_s=0, timeout_s=0.01)
        with mock.patch("devices.remoteex.TcpLink", side_effect=connect):
            converse(RemoteExFeed("replayed", (1, 2), options), 2)

    return Target(decode, (said + border + data,), slowness=5)


def spad512_session():
    """Greeting, two requests of two pictures, the end."""
    options = SpadOptions(images=2, width=4, timeout_s=1e-9, reconnect_s=0)
    pictures = bytes(range(256)) * (options.codec.pixel_bytes * 2 // 256)

    def decode(data):
        texts = [b"hello", b"", b"system", b"", b"off", b""]

        class Server(Replayed):
            def read_available(self, limit, timeout):
                text = texts.pop(0) if texts else super().read_available(limit, timeout)
                if not text:
                    raise DeviceTimeoutError("it is quiet")
                return text

        connect = connect_to(Server(data))
        with (
            mock.patch("devices.spad512._SILENCE_S", 0),
            mock.patch("devices.spad512.TcpLink", side_effect=connect),
        ):
            converse(Spad512Feed("replayed", 1, options), 4)

    return Target(decode, ((pictures + b"DONE") * 2,), slowness=5)


def make_path(name):
    """Return where a file of that name can be written, in a folder of its own."""
    path = Path(FOLDER.name, name.replace(".", "_"), name)
    path.parent.mkdir()
    return path


def sidecar():
    path = make_path("run.toml")

    def decode(data):
        path.write_bytes(data)
        read_sidecar(path.with_suffix(".dat"))

    seed = b'firmware = "2212b"\ntimestamps_per_cycle = 512\nabsolute_counter = false\nlaser_period_ps = 25e3\n'
    return Target(decode, (seed,), slowness=2, room=1 << 21)  # a board's tables have 36 000 numbers


def file(
    name,
    write,
    *read,
    other=None,
    notices_all=False,
    slowness=20,
):
    """A format: a name with the suffix that readers expect, what writes a sound file (or an `other`
    one), and readers, of which all are tried; what the first raises is raised.
    """

    def make():
        path = make_path(name)

        def decode(data):
            path.write_bytes(data)
            faults = []
            for reader in read:
                try:
                    reader(path)
                except Exception as fault:
                    faults.append(fault)
            if faults:
                raise faults[0]

        seeds = []
        for writer in (write, other or write):
            writer(path)
            seeds.append(path.read_bytes())
        # The libraries' own tables and buffers, whatever the file; what it claims would be far more.
        return Target(decode, tuple(seeds), slowness, 1 << 24, notices_all, is_file=True)

    return make


COUNTS = np.random.default_rng(0).integers(0, 60, (12, 16)).astype(np.uint16)
CUBE = np.random.default_rng(1).poisson(0.3, (4, 5, 24)).astype(np.uint16)
POINTS = np.random.default_rng(3).random((9, 3))
WALL = np.stack([*np.meshgrid(np.arange(3.0), np.arange(2.0)), np.zeros((2, 3))], axis=-1)
CAPTURE = Capture(np.ones((8, 2, 3), np.float32), WALL, np.zeros(3), 1e-11)
VIEWS = np.random.default_rng(2).random((4, 6, 5)).astype(np.float32)
LIGHT_FIELD = LightField(VIEWS, np.array([(v, u) for v in (0.0, 1.0) for u in (0.0, 1.0)]))
ONES = np.ones(9, np.float32)
CLOUD = PointCloud(POINTS.astype(np.float32), ONES, ONES, ONES, np.ones(9, np.uint8), ONES)
RECORD = Record("streak", {"counts": Field(CUBE, "count", ("y", "x", "time"))}, {"a": 2.5})
STREAKS = (read_streak, outline_streak_file)
HPDTA_TEXT = '[Application],Date="x"[Scaling],ScalingYUnit="ns",ScalingYType=1,ScalingYScale=0.3'


def write_itex(path):
    text = '[Scaling],ScalingYUnit="ns",ScalingYScalingFile=""'
    path.write_bytes(encode_itex(COUNTS, text, {"Y": np.arange(12, dtype=np.float32)}))


def write_lift(path):
    rectify = {f"rectify_norm_{axes}": np.eye(3) for axes in ("xy", "uv")}
    rectify |= {f"rectify_poly_{axis}": np.ones(6) for axis in "uv"}
    lens = {"lens_centre_px": np.linspace(4, 12, 3), "lens_angle_deg": np.linspace(80, 100, 3)}
    flags = {"resample_flag": 1, "image_inverted_flag": 0, "rectify_kind": "polynomial2"}
    sizes = {"region_size_px": 4.0, "dt_s": 1e-12}
    np.savez_compressed(path, streak_raw=COUNTS, **rectify, **lens, **flags, **sizes)


def write_tal(path):
    with h5py.File(path, "w", libver="v110") as opened:
        opened["H"], opened["H_format"] = CAPTURE.signal, np.array([1])
        opened["sensor_grid_xyz"], opened["laser_grid_xyz"] = CAPTURE.wall, np.zeros((1, 1, 3))
        opened["delta_t"] = 0.003


def write_mat_struct(path):
    scene = {"data": np.ones((6, 1, 8)), "laserPos": POINTS[:6], "cameraPos": POINTS[:1]}
    scene |= {"laserOrigin": np.ones(3), "cameraOrigin": np.ones(3), "deltat": 0.1}
    scipy.io.savemat(path, {"dataset": scene})


def write_mat_cells(path):
    cells = np.empty((2, 3), dtype=object)
    for place in np.ndindex(2, 3):
        cells[place] = np.arange(4.0)
    scipy.io.savemat(path, {"spad": cells, "bin_width_ps": 50.0}, do_compression=True)


def write_npz_capture(path):
    np.savez(path, H=CAPTURE.signal, wall_xyz=CAPTURE.wall, laser_xyz=np.zeros(3), delta_t_s=1e-11)


def write_npz_light_field(path):
    pictures = (255 * VIEWS.reshape(2, 2, 6, 5)).astype(np.uint8)
    np.savez_compressed(path, lf=pictures, scale=1 / 255, u=np.arange(2), v=np.arange(2))


def write_pages(path):
    pages = np.moveaxis(CUBE, 2, 0)
    tifffile.imwrite(path, pages, compression="zlib", photometric="minisblack")


def write_hpdta(path):
    tifffile.imwrite(path, COUNTS, description=HPDTA_TEXT, metadata=None)


def write_tiff(path):
    tifffile.imwrite(path, COUNTS, compression="zlib")


def write_png(path):
    Image.fromarray((255 * VIEWS[0]).astype(np.uint8)).save(path)


def read_cube(path):
    describe_photons(path)
    read_photons(path, 50e-12, "yxt")


def read_folder(path):
    read_light_field(path.parent)


def count_file(suffix):
    write = getattr(tcspc_files, f"write_{suffix}")
    decays = tcspc_files.make_decays()
    return file(
        f"a.{suffix}",
        lambda path: write(path, decays),
        lambda path: read_transient(f"file://{path}?bins=50"),
        slowness=2,
    )


def cloud_file(suffix):
    # pages of an E57 have 1024 bytes, each with its CRC-32C
    is_checked = suffix == "e57"
    readers = (PointCloud.load, PointCloud.read_outline)
    return file(f"a.{suffix}", CLOUD.save, *readers, notices_all=is_checked)


TARGETS = {
    "RemoteEx sessions": remoteex_session,
    "SPAD512 sessions": spad512_session,
    "LinoSPAD2 sidecars": sidecar,
    "blocks of recordings": recording,
    "time tags": time_tags,
    "LinoSPAD2": lambda: line_sensor(counter=False),
    "LinoSPAD2 with counter": lambda: line_sensor(counter=True),
    "frames of single bits": lambda: frames(1),
    "frames of 16 bits": lambda: frames(16),
    "frames of 32 bits": lambda: frames(32),
    "ITEX": itex,
    "HPD-TA text": hpdta_text,
    "RemoteEx answers": answers,
    "RemoteEx commands": lambda: Target(
        Command.decode, (b"DevParamSet(TD,MCP Gain,0)", b"AcqStop()")
    ),
    "SPAD512 requests": lambda: Target(
        SpadOptions.decode, (b"I,8,2,3,0,1,0,1,128", b"I,1,2.5e-3,1,0,1,0,1,512")
    ),
    "addresses": lambda: Target(
        lambda data: Uri.parse(data.decode("latin-1")).host_and_port(9),
        (b"remoteex://lab-7:1001?seed=4&rate=x", b"spad512://[::1]:99?seed=1"),
    ),
    "own HDF5": file("a.h5", RECORD.save, Record.load, read_outline, notices_all=True),
    "y-tal HDF5": file("a.hdf5", write_tal, read_capture),
    "TIFF shots": file("a.tif", write_hpdta, *STREAKS, other=write_tiff),
    "ITEX shots": file("a.img", write_itex, *STREAKS),
    "LIFT archives": file("a.npz", write_lift, *STREAKS),
    "NPZ captures": file("b.npz", write_npz_capture, read_capture),
    "NPZ light fields": file("c.npz", write_npz_light_field, read_light_field),
    "MAT captures": file("a.mat", write_mat_struct, read_capture),
    "MAT photons": file("b.mat", write_mat_cells, read_cube),
    "NPY photons": file("a.npy", lambda path: np.save(path, CUBE), read_cube),
    "TIFF photons": file("b.tif", write_pages, read_cube),
    "EXR light fields": file(
        "a.exr", lambda path: write_light_field(LIGHT_FIELD, path), read_light_field
    ),
    "PNG light fields": file("v_0_0.png", write_png, read_folder),
    **{f"{name.upper()} clouds": cloud_file(name) for name in ("ply", "pcd", "csv", "las", "e57")},
    **{f"{name.upper()} counts": count_file(name) for name in ("ptu", "phu", "sdt")},
}


def mutations(seeds, random):
    """Damage inputs for ever: bits flipped, bytes replaced, pieces cut, repeated, moved, filled and
    invented.
    """
    while True:
        data = bytearray(seeds[random.integers(len(seeds))])
        for _ in range(random.integers(1, 4)):
            _damage(data, random)
        yield bytes(data)


def _damage(data, random):
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


def list_nothing(seed):
    """Files that are none, or no more than the beginning of one."""
    begin, noise = seed[:8], np.random.default_rng(1).bytes(len(seed))
    ends = (b"", noise, bytes(len(seed)))
    return [b"", seed[:1], noise, b"Dear friend,\n" * 99, *(begin + end for end in ends)]


def attack(target, count):
    """Decode so many damaged inputs; return how many were refused, and most bytes taken.

    An AssertionError shows an exception that is not ours, or too much memory, with the input that
    does it.
    """
    for data in target.seeds:
        target.decode(data)  # compile, and fill caches, before memory is watched
    refused, most = 0, 0
    nothing = [data for seed in target.seeds for data in list_nothing(seed) if target.is_file]
    damaged = mutations(target.seeds, np.random.default_rng(2))
    tracemalloc.start()
    try:
        for data in chain(nothing, islice(damaged, count)):
            tracemalloc.reset_peak()
            before = tracemalloc.get_traced_memory()[0]
            message = ""
            try:
                target.decode(data)
            except TofclipError as fault:
                message = str(fault)
            except Exception as fault:
                raise AssertionError(f"{data!r} raises {type(fault).__name__}: {fault}") from fault
            assert message or data not in nothing, f"{data[:99]!r} is taken for a file"
            refused += bool(message) and data not in nothing
            assert "\n" not in message, data
            taken = tracemalloc.get_traced_memory()[1] - before
            assert taken <= target.bound(len(data)), f"{data!r} takes {taken} bytes"
            most = max(most, taken)
    finally:
        tracemalloc.stop()
    return refused, most


@pytest.mark.parametrize(
    "words",
    [("3000", SAMPLE), pytest.param(("100000",), marks=pytest.mark.nightly)],
    ids=["sample", "all"],
)
def test_damaged_input_raises_only_our_own_errors_and_takes_little_memory(
    words,
):
    """In a process of its own: threads that other libraries leave behind take memory as well."""
    command = [sys.executable, __file__, *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=3600, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert [line[:24].strip() for line in done.stdout.splitlines()[1:]] == list(TARGETS)


def main(total, is_sample):
    """Attack every target and print what came of it; of a sample, slow targets get less."""
    # OpenEXR's library prints what it thinks of a file, past Python's streams.
    sys.stdout, sys.stderr = (os.fdopen(os.dup(number), "w", buffering=1) for number in (1, 2))
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for number in (1, 2):
        os.dup2(nowhere, number)
    print(f"{'target':24} {'inputs':>9} {'refused':>9} {'most bytes':>11} {'per second':>11}")
    for name, make in TARGETS.items():
        target, began = make(), time.perf_counter()
        count = -(-total // len(TARGETS)) // (target.slowness if is_sample else 1)
        refused, most = attack(target, count)
        assert refused < count or count < MIN_JUDGED or target.notices_all, (
            f"{name}: the damage is so heavy that nothing ever gets beyond the first check"
        )
        assert most > 0, f"{name}: no memory was watched"
        rate = count / (time.perf_counter() - began)
        print(f"{name:24} {count:9} {refused:9} {most:11} {rate:11.0f}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100_000, SAMPLE in sys.argv)
