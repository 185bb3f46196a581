"""Recordings: replayed they are what was live; killed, cut and damaged they still open."""

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from instruments import joined
from numpy.testing import assert_array_equal
from test_faults import draw_tagger_script

import devices
from devices.emulation.harness import HOST
from devices.emulation.remoteex import EmulatedStreakCamera
from devices.emulation.scenes import EmulatedLight, simulate_light
from devices.emulation.timetag import CLOCK_HZ, MAX_TICK, PoissonStream
from devices.recorder import record_source
from devices.recording.check import repair, verify
from devices.recording.read import (
    HEADER_BYTES,
    SEARCH_BYTES,
    Block,
    BlockKind,
    Recording,
    ReplaySource,
)
from devices.recording.write import RecordingWriter, make_head
from devices.source import DecodedSource, Info, Piece, Stats, as_bytes
from devices.timetag_codec import RECORD_DTYPE, TimeTagCodec
from tofclip.errors import (
    DeviceDisconnectedError,
    DeviceTimeoutError,
    FileFormatError,
    InputError,
    StorageError,
)
from tofclip.storage import Field, Record

CODEC = TimeTagCodec()
TABLE = {"table": Field(np.arange(5.0), "s", ("code",))}
CALIBRATION = Record("calibration", TABLE, {"tick_s": 1e-9})
SIM = "sim+timetag://?seed=4&transfer_kib=1&records=8000&reconnect_s=2"
INFO = Info("a tagger", "7", {"clock_hz": 5})
PIECES = 12
ONE = Piece(CODEC.encode(np.array([(5, 1, 0)], RECORD_DTYPE)), 1)
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module", autouse=True)
def compiled():
    """Compile what every test needs, so that none of them is late."""
    with devices.open(SIM) as source:
        source.read(60.0)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.h5"


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out.h5"


def make_writer(path, overwrite=False):
    return RecordingWriter(
        path, make_head(CODEC, INFO, CALIBRATION, {"verb": "test"}), overwrite=overwrite
    )


def written(path, finish=True, stats=Stats(600, 600)):  # noqa: B008
    """Write a small recording and return its records, piece by piece."""
    writer, found = make_writer(path), []
    for number in range(PIECES):
        records = np.zeros(50, RECORD_DTYPE)
        records["time_ticks"] = 1000 * number + 10 * np.arange(1, 51)
        records["channels"] = 1 + number % 15
        writer.add(Piece(CODEC.encode(records), 50))
        found.append(records)
    if finish:
        writer.finish(stats)
    writer.close()
    return found


def list_blocks(path, *kinds):
    with Recording(path) as recording:
        blocks = [entry for entry in recording.blocks if isinstance(entry, Block)]
    return [block for block in blocks if block.kind in (kinds or BlockKind)]


def damage(path, place, mask=1):
    content = bytearray(path.read_bytes())
    content[place] ^= mask
    path.write_bytes(content)


def replayed(path):
    with ReplaySource(path) as source:
        return list(source)


def run_script(*words, **options):
    """Run Python on this tree."""
    command = [sys.executable, *map(str, words)]
    return subprocess.Popen(
        command, env={**os.environ, "PYTHONPATH": str(ROOT)}, text=True, **options
    )


def require_true_records(path, seed):
    """Compare a recording with the photons that there were: all come in order, none is made up."""
    ticks = joined(replayed(path))["time_ticks"]
    words = PoissonStream(5e5, CLOCK_HZ, seed).next_words(len(ticks) + 200, MAX_TICK)
    assert np.all(np.isin(ticks, CODEC.decode(as_bytes(words), CODEC.start).records["time_ticks"]))
    assert np.all(np.diff(ticks) > 0)


@pytest.mark.parametrize("seed", range(2, 8))
def test_a_replay_is_what_was_live_batch_for_batch(path, seed):
    faults = [(f.kind, f.transfer, f.amount % 600 or 1) for f in draw_tagger_script(seed)]
    script = ",".join(f"{kind}@{transfer}:{amount}" for kind, transfer, amount in faults)
    source = devices.open(f"{SIM}&faults={script}")
    assert isinstance(source, DecodedSource)
    writer = make_writer(path)
    source.tap = writer.add
    live = []
    with source:
        try:
            while (batch := source.read(0.3)) is not None:
                live.append(batch)
        except (DeviceTimeoutError, OSError):
            pass
    writer.close()
    again = replayed(path)
    assert len(live) > 5
    for figures in (
        lambda one: (one.first, one.after_gap),
        lambda one: one.records.tobytes(),
    ):
        assert list(map(figures, again)) == list(map(figures, live))


def test_everything_about_the_instrument_is_kept(path):
    before, records = time.time_ns(), written(path)
    with devices.open(f"file://{path}") as source:
        assert source.info == INFO
        assert source.calibration is not None
        assert_array_equal(source.calibration.array("table", float, 1, "s"), np.arange(5))
        assert_array_equal(joined(list(source)), np.concatenate(records))
        assert source.stats == Stats(600, 600)
    with Recording(path) as recording:
        assert recording.head.provenance == {"verb": "test"}
    times = [block.time_ns for block in list_blocks(path)]
    # ns since 1970; both clocks are read one after the other, and the system may set one meanwhile
    assert before - 10**9 < times[0] <= times[-1] < time.time_ns() + 10**9
    assert times == sorted(times)


def test_it_can_be_read_at_every_moment(path):
    """Nothing waits for more to come."""
    writer, content = make_writer(path), b""
    for number in range(1, 30):
        piece = np.random.default_rng(number).bytes(6 * number)
        writer.add(Piece(piece, number))
        content += piece
        with Recording(path) as recording:
            blocks = list_blocks(path, BlockKind.PIECE)
            assert b"".join(map(recording.blocks.read_payload, blocks)) == content
            assert recording.head.children["calibration"].fields["table"].values[3] == 3
    assert writer.bytes_written == len(content)
    writer.close()
    writer.close()


def test_a_recording_of_version_0_1_0_opens(path, out):
    """It was made by that version's own `RecordingWriter`."""
    content = bytearray((Path(__file__).parent / "data" / "recording_0_1_0.h5").read_bytes())
    path.write_bytes(content)
    with devices.open(f"file://{path}") as source:
        assert source.info == INFO
        assert source.calibration is not None
        assert source.calibration.fields["table"].values[3] == 3
        batches = [(len(one), one.after_gap) for one in source]
        assert batches == [(50, False), (50, False), (50, True)]
    assert repair(path, out).complete
    for version in (path, out):
        found = verify(version)
        assert (found.is_sound, found.complete, found.records, found.gaps) == (True, True, 150, 1)
    assert joined(replayed(out)).tobytes() == joined(replayed(path)).tobytes()
    for position in range(0, 3000, 97):  # its HDF5 part may be damaged as one likes
        content[position] ^= 0x10
    path.write_bytes(content)
    assert verify(path).records == 150


def test_a_killed_recorder_of_a_stream_that_pauses_has_all_that_came(path):
    """The recorder is the product's, without a hook of the test."""
    count = 1700
    address = f"sim+timetag://?seed=6&pace=realtime&rate=5e5&records={count}"  # then it is dark
    recorder = run_script(
        "-m", "tofclip", "record", address, "--out", path, stdout=subprocess.DEVNULL
    )
    try:
        deadline = time.monotonic() + 60
        while not path.exists() or verify(path).records < count:
            assert time.monotonic() < deadline, verify(path) if path.exists() else "no file"
            assert recorder.poll() is None
            time.sleep(0.05)
    finally:
        recorder.kill()
        recorder.wait()
    found = verify(path)
    assert (found.is_sound, found.complete, found.records) == (True, False, count)
    require_true_records(path, 6)


@pytest.mark.parametrize("count", [3, pytest.param(60, marks=pytest.mark.nightly)])
def test_whenever_a_signal_comes_the_gain_goes_down(tmp_path, count):
    """And the file is whole."""
    camera = EmulatedStreakCamera(EmulatedLight.of(simulate_light("small"), 1), 50)
    port, data_port = camera.ports
    address = f"remoteex://{HOST}:{port}?data_port={data_port}&mcp_gain=40"
    words = (ROOT / "tests/devices/ended_recorders.py", tmp_path, count, 7, address)
    ended = 0
    with run_script(*words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as script:
        assert script.stdin is not None
        assert script.stdout is not None
        for line in script.stdout:
            name, file, status, seconds = line.split()
            assert (int(status), float(seconds) < 10) == (130, True), line
            assert (camera.gain, camera.is_running) == ("0", False), line
            if (tmp_path / file).exists():  # it came so far
                found = verify(tmp_path / file)
                assert (found.is_sound, found.complete) == (True, True), name
                assert found.fault == "interrupted", name
                assert found.records == found.stats["delivered"]
            ended += 1
            script.stdin.write("next\n")
            script.stdin.flush()
    assert (ended, script.returncode) == (count, 0)
    camera.close()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_stops_and_drains(path, number):
    """What waits in the buffer is recorded before the recorder ends."""
    source = devices.open("sim+timetag://?pace=realtime&rate=1e6")
    reads, read = 0, source.read

    def slow_read(timeout=5.0):
        nonlocal reads
        reads += 1
        if reads == 3:
            time.sleep(0.3)
            os.kill(os.getpid(), number)
        return read(timeout)

    source.read = slow_read
    before = signal.signal(number, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            record_source(source, path)
        assert signal.getsignal(number) is signal.default_int_handler
    finally:
        signal.signal(number, before)
    found = verify(path)
    assert (found.is_sound, found.complete, found.fault) == (True, True, "interrupted")
    assert found.stats["unread"] == 0
    assert found.records == found.stats["delivered"] > 200_000


def test_a_full_disk_keeps_what_was_recorded(path):
    """A limit on file size stands for the full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, before[1]))
        with pytest.raises(StorageError, match="what was recorded so far is safe"):
            record_source(devices.open("sim+timetag://?transfer_kib=8"), path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    found = verify(path)
    assert found.is_sound
    assert found.bytes > 200_000
    assert "what was recorded so far is safe" in found.fault


def test_recording_for_some_time(path):
    seen = []
    source = devices.open(f"{SIM}&pace=realtime&rate=1e5")
    done, found = record_source(source, path, 0.3, {"a": 1}, seen.append), verify(path)
    assert (found.is_sound, found.complete) == (True, True)
    assert found.as_dict()["sound"] is True
    assert found.stats == done.stats.as_dict()
    assert found.bytes == done.bytes == 6 * done.stats.delivered > 0
    assert 0.3 <= done.seconds < 5
    assert seen[0] < 0.3


@pytest.mark.parametrize(
    ("stats", "sound"),
    [
        (Stats(600, 600), True),
        (Stats(600, 550, unread=50), True),  # interrupted between tapping and decoding a piece
        (Stats(601, 600, malformed=1), True),  # the end of a record never came
        (Stats(601, 601), False),
        (Stats(550, 550), False),
    ],
)
def test_accounts_must_agree_with_the_records(path, stats, sound):
    written(path, stats=stats)
    found = verify(path)
    assert (found.is_sound, found.records, found.damaged_blocks) == (sound, 600, 0)


def test_an_instrument_that_fails_leaves_a_whole_recording(path):
    address = f"{SIM}&faults=unplug@9:99999".replace("reconnect_s=2", "reconnect_s=0.1")
    with pytest.raises(DeviceDisconnectedError):
        record_source(devices.open(address), path)
    found = verify(path)
    assert (found.complete, found.is_sound) == (True, True)
    assert "did not come back" in found.fault
    assert found.records == 9 * 1024 // 6


def test_a_paced_replay_waits_as_long_as_the_recorder_did(path, monkeypatch):
    clock = {"ns": 10**18, "s": 0.0, "slept": 0.0}
    monkeypatch.setattr("devices.recording.write.monotonic_ns", lambda: clock["ns"])
    writer = make_writer(path)
    for _ in range(2):
        writer.add(ONE)
        clock["ns"] += 500_000_000
    writer.close()

    def sleep(seconds):
        clock["s"] += seconds
        clock["slept"] += seconds

    monkeypatch.setattr("devices.recording.read.monotonic", lambda: clock["s"])
    monkeypatch.setattr("devices.recording.read.sleep", sleep)
    with devices.open(f"file://{path}?pace=realtime") as source:
        source.read()
        assert clock["slept"] == 0
        clock["s"] += 0.1  # the reader's own work
        with pytest.raises(DeviceTimeoutError, match=r"is due in 0\.35 s"):
            source.read(0.05)
        assert clock["slept"] == pytest.approx(0.05)
        assert source.read(5.0) is not None
        assert clock["s"] == pytest.approx(0.5)


def test_a_clock_that_is_set_does_not_stop_a_replay(path, monkeypatch):
    writer = make_writer(path)
    for offset in (0, 10**18, -(10**18), 0):  # as a file of another program might say
        writer._clock_offset_ns += offset
        writer.add(ONE)
    writer.close()
    slept = []
    monkeypatch.setattr("devices.recording.read.sleep", slept.append)
    with ReplaySource(path, is_paced=True) as source:
        for _ in range(4):
            assert source.read(60.0) is not None
    assert max(slept) < 10.1  # ten seconds, and what this machine takes between two readings


@settings(max_examples=15)
@given(st.data())
def test_damage_is_found_and_the_rest_is_saved(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("damage")
    path, out, again = folder / "run.h5", folder / "out.h5", folder / "again.h5"
    pieces, blocks = written(path), list_blocks(path)
    assert [one.kind for one in blocks[:2]] == [BlockKind.HEAD] * 2
    victim = data.draw(st.integers(1, PIECES))
    block = blocks[1 + victim]
    damage(
        path, data.draw(st.integers(block.position, block.end - 1)), data.draw(st.integers(1, 255))
    )
    found = verify(path)
    assert (found.is_sound, found.complete) == (False, False)
    assert (found.damaged_blocks, found.blocks) == (1, PIECES + 3)  # three heads, one ending
    assert found.damaged_bytes == HEADER_BYTES + 300
    with pytest.raises(FileFormatError, match="damaged"):
        replayed(path)
    repair(path, out)
    saved = replayed(out)
    kept = [records for number, records in enumerate(pieces, 1) if number != victim]
    assert_array_equal(joined(saved), np.concatenate(kept))
    gaps = [number for number, batch in enumerate(saved) if batch.after_gap]
    assert gaps == ([victim - 1] if victim < PIECES else [])
    assert (verify(out).is_sound, verify(out).complete) == (True, False)
    repair(out, again)
    assert not verify(again).complete
    record_source(devices.open(f"file://{out}"), again, overwrite=True)
    assert not verify(again).complete


def test_a_block_that_is_gone_without_a_trace_is_missed(path, out):
    pieces, gone = written(path), list_blocks(path, BlockKind.PIECE)[1]
    content = path.read_bytes()
    path.write_bytes(content[: gone.position] + content[gone.end :])
    found = verify(path)
    assert (found.damaged_blocks, found.damaged_bytes, found.complete) == (1, 0, False)
    repair(path, out)
    saved = replayed(out)
    assert_array_equal(joined(saved), np.concatenate([pieces[0], *pieces[2:]]))
    assert [number for number, batch in enumerate(saved) if batch.after_gap] == [1]


def test_a_file_without_its_front_and_end_is_rebuilt(path, out):
    pieces = written(path, finish=False)
    path.write_bytes(bytes(2000) + path.read_bytes()[2000:-20])
    # one head, and the piece that was cut off
    assert verify(path).damaged_blocks == repair(path, out).damaged_blocks == 2
    assert_array_equal(joined(replayed(out)), np.concatenate(pieces[:-1]))
    with ReplaySource(out) as source:
        assert source.calibration is not None
        assert source.info.serial == "7"


def test_one_flipped_bit_costs_one_block(path, out):
    written(path)
    content, random = path.read_bytes(), np.random.default_rng(0)
    for place in {*range(0, 60, 3), *random.integers(len(content), size=12).tolist()}:
        path.write_bytes(content)
        damage(path, place, 1 << int(random.integers(8)))
        found = verify(path)
        assert (found.damaged_blocks, found.is_sound) == (1, False)
        assert found.records >= 50 * (PIECES - 1)
        # a broken header may have been anything
        assert not found.complete or (found.records == 50 * PIECES and found.stats)
        assert repair(path, out).records == found.records


def test_a_truncated_recording_is_good_up_to_its_end_and_says_that_it_is_cut(path, out):
    written(path)
    content = path.read_bytes()
    ends = [block.end for block in list_blocks(path, BlockKind.PIECE)]

    def figures(found):
        return found.is_sound, found.complete, found.records

    for length in (*range(5000, len(content), 997), len(content) - 1, *ends):
        path.write_bytes(content[:length])
        expected = (True, False, 50 * sum(end <= length for end in ends))
        assert figures(verify(path)) == expected
        repair(path, out)
        assert figures(verify(out)) == expected


@pytest.mark.parametrize("before_border", range(1, 9))
def test_a_block_is_found_wherever_the_search_before_it_stops(path, before_border):
    """Of its first eight bytes so many lie before the border of what is searched at once."""
    writer = make_writer(path)
    damaged_at = path.stat().st_size
    long = SEARCH_BYTES + 1 - before_border
    writer.add(Piece(bytes(long - HEADER_BYTES), 0))
    writer.add(ONE)
    writer.close()
    damage(path, damaged_at)
    found = verify(path)
    assert (found.records, found.damaged_blocks, found.damaged_bytes) == (1, 1, long)


ATTEMPTS = (
    Recording,
    verify,
    lambda path: repair(path, path.with_name("out.h5")),
)


@pytest.mark.parametrize("attempt", ATTEMPTS)
def test_other_files_are_refused(path, attempt):
    for content in (b"", b"not HDF5 at all" * 100):
        path.write_bytes(content)
        with pytest.raises(FileFormatError):
            attempt(path)
    with pytest.raises(StorageError, match="no such file"):
        attempt(path.with_name("absent.h5"))
    CALIBRATION.save(path)
    with pytest.raises(FileFormatError, match="not a recording"):
        attempt(path)


def test_recordings_that_cannot_be_opened_or_written(path):
    foreign = Record("recording", {}, {"codec": "unheard", "codec_settings": "{}", "info": "{}"})
    RecordingWriter(path, foreign).close()
    with pytest.raises(FileFormatError, match="unheard"):
        ReplaySource(path)
    with pytest.raises(StorageError, match="folder does not exist"):
        make_writer(path.parent / "absent" / "run.h5")


def test_a_second_recorder_is_refused(path):
    first = make_writer(path)
    for overwrite in (False, True):
        with pytest.raises(StorageError, match="another recorder"):
            make_writer(path, overwrite)
    first.close()
    with pytest.raises(InputError, match="overwrite=True"):
        make_writer(path)
    make_writer(path, overwrite=True).close()
    assert [entry.name for entry in path.parent.iterdir()] == ["run.h5"]
    mask = os.umask(0o22)
    os.umask(mask)
    assert path.stat().st_mode & 0o777 == 0o666 & ~mask


@pytest.mark.parametrize("how", ["removed", "replaced"])
def test_a_file_that_is_gone_is_noticed(path, how):
    seen = []

    def watch(seconds):
        if not seen:
            path.unlink()
            if how == "replaced":
                path.write_bytes(b"something else")
        seen.append(seconds)

    quiet = f"{SIM}&pace=realtime&rate=1"
    with pytest.raises(StorageError, match="removed or replaced"):
        record_source(devices.open(quiet), path, 10, watch=watch)
    assert seen[-1] < 5


def test_a_seek_that_fails_leaves_the_tap(path):
    written(path)
    damage(path, list_blocks(path)[6].payload_position)
    with ReplaySource(path) as source:
        source.tap = lambda piece: None
        with pytest.raises(FileFormatError, match="damaged"):
            source.seek(599)
        assert source.tap is not None
