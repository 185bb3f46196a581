"""Recordings: replayed they are what was live; killed, cut and damaged they still open."""

from __future__ import annotations

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
from test_faults import draw_tagger_script

import devices
from devices.recorder import record_source
from devices.recording.check import repair, verify
from devices.recording.read import (
    HEADER_BYTES,
    SEARCH_BYTES,
    Block,
    BlockHeader,
    BlockKind,
    Recording,
    ReplaySource,
)
from devices.recording.write import RecordingWriter, make_head
from devices.source import Batch, DecodedSource, Gap, Info, Piece, Records, Stats, as_bytes
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
CALIBRATION = Record(
    "calibration", {"table": Field(np.arange(5.0), "s", ("code",))}, {"tick_s": 1e-9}
)
SIM = "sim+timetag://?seed=4&transfer_kib=1&records=8000&reconnect_s=2"
PIECES = 12
ONE = Piece(CODEC.encode(np.array([(5, 1, 0)], RECORD_DTYPE)), 1)


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """Compile what every test needs, so that none of them is late."""
    with devices.open(SIM) as source:
        source.read(60.0)


def make_writer(path: Path, overwrite: bool = False) -> RecordingWriter:
    return RecordingWriter(path, make_head(CODEC, Info("x"), None, {}), overwrite)


def list_blocks(path: Path, kind: BlockKind | None = None) -> list[Block]:
    with Recording(path) as recording:
        blocks = [entry for entry in recording.blocks if isinstance(entry, Block)]
    return [block for block in blocks if kind in (None, block.header.kind)]


def damage(path: Path, place: int, mask: int = 1) -> None:
    content = bytearray(path.read_bytes())
    content[place] ^= mask
    path.write_bytes(content)


def written(path: Path, finish: bool = True, stats: Stats = Stats(600, 600)) -> list[Records]:  # noqa: B008
    """Write a small recording and return its records, piece by piece."""
    head = make_head(CODEC, Info("a tagger", "7", {"clock_hz": 5}), CALIBRATION, {"verb": "test"})
    writer = RecordingWriter(path, head)
    found = []
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


def replayed(path: Path) -> list[Batch]:
    with ReplaySource(path) as source:
        return list(source)


def joined(batches: list[Batch]) -> Records:
    return np.concatenate([np.empty(0, RECORD_DTYPE), *(batch.records for batch in batches)])


@pytest.mark.parametrize("seed", range(2, 8))
def test_a_replay_is_what_was_live_bit_for_bit(tmp_path: Path, seed: int) -> None:
    script = ",".join(
        f"{f.kind}@{f.transfer}:{f.amount if f.amount < 600 else 1}"
        for f in draw_tagger_script(seed)
    )
    source = devices.open(f"{SIM}&faults={script}")
    assert isinstance(source, DecodedSource)
    writer = RecordingWriter(
        tmp_path / "run.h5", make_head(source.codec, source.info, source.calibration, {})
    )
    source.tap = writer.add
    live: list[Batch] = []
    with source:
        try:
            while (batch := source.read(0.3)) is not None:
                live.append(batch)
        except (DeviceTimeoutError, OSError):
            pass
    writer.close()
    again = replayed(tmp_path / "run.h5")
    assert [(one.first, one.after_gap) for one in again] == [
        (one.first, one.after_gap) for one in live
    ]
    assert [one.records.tobytes() for one in again] == [one.records.tobytes() for one in live]
    assert len(live) > 5


def test_everything_about_the_instrument_is_kept(tmp_path: Path) -> None:
    records = written(tmp_path / "run.h5")
    with devices.open(f"file://{tmp_path / 'run.h5'}") as source:
        assert source.info == Info("a tagger", "7", {"clock_hz": 5})
        assert source.calibration is not None
        np.testing.assert_array_equal(source.calibration.fields["table"].values, np.arange(5.0))
        assert source.calibration.fields["table"].units == "s"
        assert (source.is_live, source.is_seekable) == (False, True)
        np.testing.assert_array_equal(joined(list(source)), np.concatenate(records))
        assert source.stats == Stats(600, 600)
    with Recording(tmp_path / "run.h5") as recording:
        assert recording.head.provenance == {"verb": "test"}


def test_it_can_be_read_at_every_moment(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    head = make_head(CODEC, Info("a tagger", "7"), CALIBRATION, {})
    writer = RecordingWriter(path, head)
    content = b""
    for number in range(1, 30):
        piece = np.random.default_rng(number).bytes(6 * number)
        writer.add(Piece(piece, number))
        content += piece
        with Recording(path) as recording:
            read = [
                recording.blocks.read_payload(one) for one in list_blocks(path, BlockKind.PIECE)
            ]
            assert b"".join(read) == content
            assert recording.head.children["calibration"].fields["table"].values[3] == 3
    assert writer.bytes_written == len(content)
    writer.close()
    writer.close()


def test_a_recording_of_version_0_1_0_opens(tmp_path: Path) -> None:
    """It was made by that version's own `RecordingWriter`."""
    path = tmp_path / "run.h5"
    path.write_bytes((Path(__file__).parent / "data" / "recording_0_1_0.h5").read_bytes())
    found = verify(path)
    assert (found.is_sound, found.complete, found.records, found.gaps) == (True, True, 150, 1)
    with devices.open(f"file://{path}") as source:
        assert source.info == Info("a tagger", "7", {"clock_hz": 5})
        assert source.calibration is not None
        assert source.calibration.fields["table"].values[3] == 3
        assert [(len(one), one.after_gap) for one in source] == [
            (50, False),
            (50, False),
            (50, True),
        ]
    assert repair(path, tmp_path / "new.h5").complete
    again = verify(tmp_path / "new.h5")
    assert (again.is_sound, again.complete, again.records, again.gaps) == (True, True, 150, 1)
    assert joined(replayed(tmp_path / "new.h5")).tobytes() == joined(replayed(path)).tobytes()
    content = bytearray(path.read_bytes())
    for position in range(0, 3000, 97):  # its HDF5 part may be damaged as one likes
        content[position] ^= 0x10
    path.write_bytes(content)
    assert verify(path).records == 150


def test_killed_recorders_leave_what_they_flushed(tmp_path: Path) -> None:
    script = Path(__file__).with_name("killed_recorders.py")
    command = [sys.executable, str(script), str(tmp_path), "20", "5"]
    root = {**os.environ, "PYTHONPATH": str(script.parents[2])}
    done = subprocess.run(
        command, env=root, capture_output=True, text=True, timeout=120, check=True
    )
    with_records = 0
    for line in done.stdout.splitlines():
        name, flushed = line.split()
        path = tmp_path / name
        if not path.exists():
            assert int(flushed) == -1
            continue
        found = verify(path)
        assert found.is_sound
        assert not found.complete
        assert found.bytes >= int(flushed)
        require_true_records(path, int(name.removeprefix("run").removesuffix(".h5")))
        assert repair(path, tmp_path / "whole.h5").bytes >= found.bytes
        with_records += found.records > 0
    assert with_records >= 10  # every other one is killed after its first report


def test_a_killed_recorder_of_a_stream_that_pauses_has_all_that_came(tmp_path: Path) -> None:
    """Nothing waits for more to come: the recorder is the product's, without a hook of the test."""
    path, count = tmp_path / "run.h5", 1700
    address = f"sim+timetag://?seed=6&pace=realtime&rate=5e5&records={count}"  # then it is dark
    script = (
        "import sys, pathlib, devices; from devices.recorder import record_source;"
        "record_source(devices.open(sys.argv[1]), pathlib.Path(sys.argv[2]))"
    )
    root = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    recorder = subprocess.Popen([sys.executable, "-c", script, address, str(path)], env=root)
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


def require_true_records(path: Path, seed: int) -> None:
    """Compare a recording with the photons that there were: all come in order, none is made up."""
    from devices.emulation.timetag import CLOCK_HZ, MAX_TICK, PoissonStream

    ticks = joined(replayed(path))["time_ticks"]
    words = PoissonStream(5e5, CLOCK_HZ, seed).next_words(len(ticks) + 200, MAX_TICK)
    known = CODEC.decode(as_bytes(words), CODEC.start).records["time_ticks"]
    assert np.all(np.isin(ticks, known))
    assert np.all(np.diff(ticks) > 0)


def test_a_full_disk_keeps_what_was_recorded(tmp_path: Path) -> None:
    """A limit on file size stands for the full disk."""
    path = tmp_path / "run.h5"
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


def test_recording_for_some_time(tmp_path: Path) -> None:
    seen: list[float] = []
    done = record_source(
        devices.open(f"{SIM}&pace=realtime&rate=1e5"),
        tmp_path / "run.h5",
        0.3,
        {"a": 1},
        seen.append,
    )
    found = verify(tmp_path / "run.h5")
    assert found.is_sound
    assert found.complete
    assert found.stats == done.stats.as_dict()
    assert found.bytes == done.bytes == 6 * done.stats.delivered > 0
    assert 0.3 <= done.seconds < 5
    assert seen[0] < 0.3
    assert found.as_dict()["sound"] is True


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
def test_accounts_must_agree_with_the_records(tmp_path: Path, stats: Stats, sound: bool) -> None:
    written(tmp_path / "run.h5", stats=stats)
    found = verify(tmp_path / "run.h5")
    assert (found.is_sound, found.records, found.damaged_blocks) == (sound, 600, 0)


def test_an_instrument_that_fails_leaves_a_whole_recording(tmp_path: Path) -> None:
    with pytest.raises(DeviceDisconnectedError):
        record_source(
            devices.open(
                f"{SIM}&faults=unplug@9:99999".replace("reconnect_s=2", "reconnect_s=0.1")
            ),
            tmp_path / "r.h5",
        )
    found = verify(tmp_path / "r.h5")
    assert (found.complete, found.is_sound) == (True, True)
    assert "did not come back" in found.fault
    assert found.records == 9 * 1024 // 6


def test_a_paced_replay_waits_as_long_as_the_recorder_did(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = {"ns": 10**18, "s": 0.0, "slept": 0.0}
    monkeypatch.setattr("devices.recording.write.monotonic_ns", lambda: clock["ns"])
    writer = make_writer(tmp_path / "run.h5")
    for _ in range(2):
        writer.add(ONE)
        clock["ns"] += 500_000_000
    writer.close()

    def sleep(seconds: float) -> None:
        clock["s"] += seconds
        clock["slept"] += seconds

    monkeypatch.setattr("devices.recording.read.monotonic", lambda: clock["s"])
    monkeypatch.setattr("devices.recording.read.sleep", sleep)
    with devices.open(f"file://{tmp_path / 'run.h5'}?pace=realtime") as source:
        source.read()
        assert clock["slept"] == 0
        clock["s"] += 0.1  # the reader's own work
        with pytest.raises(DeviceTimeoutError, match=r"is due in 0\.35 s"):
            source.read(0.05)
        assert clock["slept"] == pytest.approx(0.05)
        assert source.read(5.0) is not None
        assert clock["s"] == pytest.approx(0.5)
        assert source.calibration is None


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_damage_is_found_and_the_rest_is_saved(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("damage")
    path, out = folder / "run.h5", folder / "out.h5"
    pieces = written(path)
    blocks = list_blocks(path)
    assert [one.header.kind for one in blocks[:2]] == [BlockKind.HEAD] * 2
    blocks = blocks[1:]
    victim = data.draw(st.integers(1, PIECES))  # block 0 is the head
    where = data.draw(st.integers(blocks[victim].position, blocks[victim].end - 1))
    damage(path, where, data.draw(st.integers(1, 255)))
    found = verify(path)
    assert not found.is_sound
    assert (found.damaged_blocks, found.blocks) == (1, PIECES + 3)  # three heads, one ending
    assert not found.complete
    assert found.damaged_bytes == HEADER_BYTES + 300
    with pytest.raises(FileFormatError, match="damaged"):
        replayed(path)
    repair(path, out)
    saved = replayed(out)
    kept = [records for number, records in enumerate(pieces, 1) if number != victim]
    np.testing.assert_array_equal(joined(saved), np.concatenate(kept))
    gaps = [number for number, batch in enumerate(saved) if batch.after_gap]
    assert gaps == ([victim - 1] if victim < PIECES else [])
    assert verify(out).is_sound
    assert not verify(out).complete
    repair(out, folder / "again.h5")
    record_source(devices.open(f"file://{out}"), folder / "recorded.h5")
    assert not verify(folder / "again.h5").complete
    assert not verify(folder / "recorded.h5").complete


def test_a_file_without_its_front_and_end_is_rebuilt(tmp_path: Path) -> None:
    path, out = tmp_path / "run.h5", tmp_path / "out.h5"
    pieces = written(path, finish=False)
    content = path.read_bytes()
    path.write_bytes(bytes(2000) + content[2000:-20])
    assert verify(path).damaged_blocks == 2
    found = repair(path, out)
    assert found.damaged_blocks == 2  # one head, and the one that was cut off
    np.testing.assert_array_equal(joined(replayed(out)), np.concatenate(pieces[:-1]))
    with ReplaySource(out) as source:
        assert source.calibration is not None
        assert source.info.serial == "7"


@pytest.mark.parametrize("content", [b"", b"not HDF5 at all" * 100])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "run.h5"
    path.write_bytes(content)
    for attempt in (Recording, verify, lambda path: repair(path, tmp_path / "out.h5")):
        with pytest.raises(FileFormatError):
            attempt(path)
        with pytest.raises(StorageError, match="no such file"):
            attempt(tmp_path / "absent.h5")
    with pytest.raises(StorageError, match="folder does not exist"):
        make_writer(tmp_path / "absent" / "run.h5")


def test_records_of_other_kinds_and_unknown_codecs_are_refused(tmp_path: Path) -> None:
    CALIBRATION.save(tmp_path / "other.h5")
    with pytest.raises(FileFormatError, match="not a recording"):
        Recording(tmp_path / "other.h5")
    foreign = Record("recording", {}, {"codec": "unheard", "codec_settings": "{}", "info": "{}"})
    RecordingWriter(tmp_path / "run.h5", foreign).close()
    with pytest.raises(FileFormatError, match="unheard"):
        ReplaySource(tmp_path / "run.h5")


def test_headers_that_cannot_be_are_none() -> None:
    good = BlockHeader.of(BlockKind.PIECE, b"abc", 5, 1, Gap.LOSS)
    assert BlockHeader.unpack(good.pack()) == good
    assert good.matches(b"abc")
    assert not good.matches(b"abd")
    for wrong in (
        good.pack()[:-1],
        b"x" + good.pack()[1:],
        BlockHeader(BlockKind.PIECE, Gap.NONE, 0, 0, 1 << 40, 0).pack(),
    ):
        assert BlockHeader.unpack(wrong) is None


def test_one_flipped_bit_costs_one_block(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    pieces = written(path)
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    places = {*range(60), *rng.integers(len(content), size=340).tolist()}
    for place in places:
        flipped = bytearray(content)
        flipped[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        found = verify(path)
        assert found.damaged_blocks == 1
        assert not found.is_sound
        assert found.records >= 50 * (PIECES - 1)
        assert found.complete == (found.records == 50 * PIECES and bool(found.stats)) or (
            not found.complete  # a broken header may have been anything
        )
        assert repair(path, tmp_path / "out.h5").records == found.records
    assert len(pieces) == PIECES


def test_a_truncated_recording_is_good_up_to_its_end_and_says_that_it_is_cut(
    tmp_path: Path,
) -> None:
    path = tmp_path / "run.h5"
    written(path)
    content = path.read_bytes()
    ends = [block.end for block in list_blocks(path, BlockKind.PIECE)]
    for length in (*range(5000, len(content), 997), len(content) - 1, *ends):
        path.write_bytes(content[:length])
        found = verify(path)
        assert found.records == 50 * sum(end <= length for end in ends)
        assert (found.is_sound, found.complete) == (True, False)
        repair(path, tmp_path / "out.h5")
        again = verify(tmp_path / "out.h5")
        assert (again.is_sound, again.complete, again.records) == (True, False, found.records)


@pytest.mark.parametrize("before_border", range(1, 9))
def test_a_block_is_found_wherever_the_search_before_it_stops(
    tmp_path: Path, before_border: int
) -> None:
    """Of its first eight bytes so many lie before the border of what is searched at once."""
    path = tmp_path / "run.h5"
    writer = make_writer(path)
    damaged_at = path.stat().st_size
    long = SEARCH_BYTES + 1 - before_border
    writer.add(Piece(bytes(long - HEADER_BYTES), 0))
    writer.add(ONE)
    writer.close()
    damage(path, damaged_at)
    found = verify(path)
    assert (found.records, found.damaged_blocks, found.damaged_bytes) == (1, 1, long)


def test_blocks_say_when_they_were_recorded(tmp_path: Path) -> None:
    """By this computer's clock, ns since 1970."""
    before = time.time_ns()
    written(tmp_path / "run.h5")
    after = time.time_ns()
    times = [block.header.time_ns for block in list_blocks(tmp_path / "run.h5")]
    # Both clocks are read one after the other, and the system may set one meanwhile.
    assert before - 10**9 < times[0] <= times[-1] < after + 10**9
    assert times == sorted(times)


def test_a_second_recorder_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    first = make_writer(path)
    for overwrite in (False, True):
        with pytest.raises(StorageError, match="another recorder"):
            make_writer(path, overwrite)
    first.add(Piece(b"", 0))
    first.close()
    with pytest.raises(InputError, match="overwrite=True"):
        make_writer(path)
    make_writer(path, overwrite=True).close()
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.h5"]
    assert path.stat().st_mode & 0o777 == 0o666 & ~_umask()


def _umask() -> int:
    mask = os.umask(0o22)
    os.umask(mask)
    return mask


@pytest.mark.parametrize("how", ["removed", "replaced"])
def test_a_file_that_is_gone_is_noticed(tmp_path: Path, how: str) -> None:
    path = tmp_path / "run.h5"
    seen: list[float] = []

    def watch(seconds: float) -> None:
        if not seen:
            path.unlink()
            if how == "replaced":
                path.write_bytes(b"something else")
        seen.append(seconds)

    quiet = f"{SIM}&pace=realtime&rate=1"
    with pytest.raises(StorageError, match="removed or replaced"):
        record_source(devices.open(quiet), path, 10, watch=watch)
    assert seen[-1] < 5


def test_what_a_quiet_stream_brought_is_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    writer = make_writer(path)
    writer.add(ONE)
    assert verify(path).records == 1  # although nothing comes after it
    writer.close()


def test_a_clock_that_is_set_does_not_stop_a_replay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = make_writer(tmp_path / "run.h5")
    for offset in (0, 10**18, -(10**18), 0):  # as a file of another program might say
        writer._clock_offset_ns += offset
        writer.add(ONE)
    writer.close()
    slept: list[float] = []
    monkeypatch.setattr("devices.recording.read.sleep", slept.append)
    with ReplaySource(tmp_path / "run.h5", is_paced=True) as source:
        for _ in range(4):
            assert source.read(60.0) is not None
    assert max(slept) < 10.1  # ten seconds, and what this machine takes between two readings


def test_a_seek_that_fails_leaves_the_tap(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    written(path)
    damage(path, list_blocks(path)[6].payload_position)
    with ReplaySource(path) as source:
        source.tap = lambda piece: None
        with pytest.raises(FileFormatError, match="damaged"):
            source.seek(599)
        assert source.tap is not None


def test_a_reader_thread_never_dies_silently(monkeypatch: pytest.MonkeyPatch) -> None:
    class BrokenError(Exception):
        pass

    def fail(*_: object) -> None:
        raise BrokenError("of an unforeseen kind")

    for method in ("pull", "close"):
        with monkeypatch.context() as patch:
            patch.setattr(f"devices.timetag.TimeTaggerFeed.{method}", fail)
            source = devices.open(SIM)
            source.stop()
            with pytest.raises(BrokenError):
                list(source)
            source.close()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_stops_and_drains(tmp_path: Path, number: signal.Signals) -> None:
    """What waits in the buffer is recorded before the recorder ends."""
    path = tmp_path / "run.h5"
    source = devices.open("sim+timetag://?pace=realtime&rate=1e6")
    reads = 0
    read = source.read

    def slow_read(timeout: float = 5.0) -> Batch | None:
        nonlocal reads
        reads += 1
        if reads == 3:
            time.sleep(0.3)
            os.kill(os.getpid(), number)
        return read(timeout)

    source.read = slow_read  # type: ignore[method-assign]
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
