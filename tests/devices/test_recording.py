"""Recordings: replayed they are what was live; killed, cut and damaged they still open."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import h5py
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

import devices
from devices.codec import Records, as_bytes
from devices.decoded_source import DecodedSource
from devices.emulation.faults import draw_fault_script
from devices.recorder import record_source
from devices.recording.appendable_file import DATASET_NAME, AppendableFile
from devices.recording.blocks import HEADER_BYTES, BlockHeader, BlockKind
from devices.recording.check import repair, verify
from devices.recording.checksum import lookup3
from devices.recording.reader import Block, Recording
from devices.recording.writer import RecordingWriter, make_head
from devices.replay import ReplaySource
from devices.ring import Gap, Piece
from devices.source import Batch, Info, Source
from devices.statistics import Stats
from devices.timetag.codec import RECORD_DTYPE, TimeTagCodec
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


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """Compile what every test needs, so that none of them is late."""
    with devices.open(SIM) as source:
        source.read(60.0)


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


@pytest.mark.parametrize("seed", range(6))
def test_a_replay_is_what_was_live_bit_for_bit(tmp_path: Path, seed: int) -> None:
    script = ",".join(
        f"{f.kind}@{f.transfer}:{f.amount if f.amount < 600 else 1}"
        for f in draw_fault_script(seed, 30)
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


def test_any_hdf5_program_opens_it_at_every_moment(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    content = b"begin"
    file = AppendableFile(
        path,
        Record("recording", {}, {"note": "x"}, {"calibration": CALIBRATION}),
        lambda _: content,
    )
    for number in range(1, 30):
        piece = np.random.default_rng(number).bytes(997 * number)
        file.append(piece[:100], piece[100:])
        with h5py.File(path) as opened:
            assert opened[DATASET_NAME].shape == (len(content),)
        file.commit()
        file.commit()
        content += piece
        assert file.length == len(content)
        with h5py.File(path) as opened:
            assert opened[DATASET_NAME][:].tobytes() == content
            assert opened["calibration/table"][3] == 3
    file.close()
    file.close()
    with h5py.File(path, "r+") as opened:  # and may go on with it
        opened.attrs["looked_at"] = 1
    with h5py.File(path) as opened:
        assert opened[DATASET_NAME][:].tobytes() == content


def test_the_checksum_is_the_published_one() -> None:
    # The self-test values in Jenkins's lookup3.c.
    assert lookup3(b"") == 0xDEADBEEF
    assert lookup3(b"Four score and seven years ago") == 0x17770551


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
        assert (
            repair(path, tmp_path / "whole.h5").bytes >= found.bytes
        )  # with what was written but not yet told
        with_records += found.records > 0
    assert with_records >= 12  # most moments are after the first flush


def require_true_records(path: Path, seed: int) -> None:
    """Compare a recording with the photons that there were: all come in order, none is made up."""
    from devices.emulation.photons import MAX_TICK, PoissonStream
    from devices.emulation.timetag import CLOCK_HZ

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


def test_a_recording_can_be_recorded(tmp_path: Path) -> None:
    written(tmp_path / "run.h5")
    record_source(devices.open(f"file://{tmp_path / 'run.h5'}"), tmp_path / "again.h5")
    assert (
        joined(replayed(tmp_path / "again.h5")).tobytes()
        == joined(replayed(tmp_path / "run.h5")).tobytes()
    )


def test_an_instrument_that_fails_leaves_a_whole_recording(tmp_path: Path) -> None:
    with pytest.raises(DeviceDisconnectedError):
        record_source(
            devices.open(
                f"{SIM}&reconnect_s=0.1&faults=unplug@9:99999".replace("reconnect_s=2&", "")
            ),
            tmp_path / "r.h5",
        )
    found = verify(tmp_path / "r.h5")
    assert (found.complete, found.is_sound) == (True, True)
    assert "did not come back" in found.fault
    assert found.records == 9 * 1024 // 6


def test_a_source_without_bytes_cannot_be_recorded(tmp_path: Path) -> None:
    class Wordless(Source):
        info, stats = Info("a file"), Stats()

        def read(self, timeout: float = 0.0) -> Batch | None:
            return None

        def close(self) -> None:
            pass

    with pytest.raises(InputError, match="nothing to record"):
        record_source(Wordless(), tmp_path / "run.h5")


def test_seeking(tmp_path: Path) -> None:
    records = np.concatenate(written(tmp_path / "run.h5"))
    with ReplaySource(tmp_path / "run.h5") as source:
        for target in (0, 49, 50, 51, 333, 120, 599, 0):
            source.seek(target)
            batch = source.read()
            assert batch is not None
            assert batch.first == target
            np.testing.assert_array_equal(joined([batch, *source]), records[target:])
            assert source.stats == Stats(600, 600)
        source.seek(600)
        assert source.read() is None
        for wrong in (-1, 601):
            with pytest.raises(InputError, match="record"):
                source.seek(wrong)


def test_a_paced_replay_waits_as_long_as_the_recorder_did(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = {"ns": 10**18, "s": 0.0, "slept": 0.0}
    monkeypatch.setattr("devices.recording.writer.time_ns", lambda: clock["ns"])
    writer = RecordingWriter(tmp_path / "run.h5", make_head(CODEC, Info("x"), None, {}))
    one = np.array([(5, 1, 0)], RECORD_DTYPE)
    for _ in range(2):
        writer.add(Piece(CODEC.encode(one), 1))
        clock["ns"] += 500_000_000
    writer.close()

    def sleep(seconds: float) -> None:
        clock["s"] += seconds
        clock["slept"] += seconds

    monkeypatch.setattr("devices.replay.monotonic", lambda: clock["s"])
    monkeypatch.setattr("devices.replay.sleep", sleep)
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
    with Recording(path) as recording:
        blocks = [entry for entry in recording.blocks if isinstance(entry, Block)]
        begin = recording._raw.id.get_offset()
    victim = data.draw(st.integers(1, PIECES))  # block 0 is the head
    where = data.draw(st.integers(blocks[victim].position, blocks[victim].end - 1))
    content = bytearray(path.read_bytes())
    content[begin + where] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    found = verify(path)
    assert not found.is_sound
    assert (found.damaged_blocks, found.blocks) == (1, PIECES + 1)
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


def test_a_file_that_hdf5_cannot_open_is_rebuilt(tmp_path: Path) -> None:
    path, out = tmp_path / "run.h5", tmp_path / "out.h5"
    pieces = written(path, finish=False)
    content = path.read_bytes()
    path.write_bytes(bytes(2000) + content[2000:-20])
    with pytest.raises(FileFormatError, match="no recording"):
        verify(path)
    found = repair(path, out)
    assert found.damaged_blocks == 1  # the one that was cut off
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
        verify(tmp_path / "absent.h5")
    with pytest.raises(StorageError, match="no such file"):
        repair(tmp_path / "absent.h5", tmp_path / "out.h5")
    with pytest.raises(StorageError, match="folder does not exist"):
        RecordingWriter(tmp_path / "absent" / "run.h5", make_head(CODEC, Info("x"), None, {}))


def test_records_of_other_kinds_and_unknown_codecs_are_refused(tmp_path: Path) -> None:
    CALIBRATION.save(tmp_path / "other.h5")
    with pytest.raises(FileFormatError, match="no recording"):
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
