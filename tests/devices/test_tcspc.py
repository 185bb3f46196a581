"""Files of photon-counting electronics."""

from __future__ import annotations

import io
import struct
import sys
import tracemalloc
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tcspc_files
from tcspc_files import PERIOD, RESOLUTION, make_decays

import devices
from devices import files as tcspc
from devices.files import PHOTON_DTYPE
from devices.transients import read_transient
from tofclip.errors import (
    FileFormatError,
    InputError,
    MissingDependencyError,
    StorageError,
    TofclipError,
)

ptufile = pytest.importorskip("ptufile")
sdtfile = pytest.importorskip("sdtfile")


@pytest.fixture
def decays() -> Any:
    return make_decays()


@pytest.fixture
def ptu(tmp_path: Path, decays: Any) -> Path:
    tcspc_files.write_ptu(tmp_path / "run.ptu", decays)
    return tmp_path / "run.ptu"


@pytest.fixture
def phu(tmp_path: Path, decays: Any) -> Path:
    tcspc_files.write_phu(tmp_path / "run.phu", decays)
    return tmp_path / "run.phu"


@pytest.fixture
def sdt(tmp_path: Path, decays: Any) -> Path:
    tcspc_files.write_sdt(tmp_path / "run.sdt", decays)
    return tmp_path / "run.sdt"


def test_photons_of_a_ptu(ptu: Path, decays: Any) -> None:
    with devices.open(f"file://{ptu}") as source:
        assert (source.is_live, source.is_seekable) == (False, True)
        records = np.concatenate([batch.records for batch in source])
        known = source.calibration
        assert source.read() is None
        source.seek(len(records) - 3)
        batch = source.read()
        assert batch is not None
        np.testing.assert_array_equal(batch.records, records[-3:])
        assert batch.first == len(records) - 3
        with pytest.raises(InputError, match="no number"):
            source.seek(len(records) + 1)
    assert source.stats.is_balanced
    assert source.read() is None
    assert records.dtype == PHOTON_DTYPE
    for channel, decay in enumerate(decays):
        counts = np.bincount(records["bin"][records["channel"] == channel], minlength=200)
        np.testing.assert_array_equal(counts, decay)
    assert known is not None
    assert known.attribute("resolution_s") == pytest.approx(RESOLUTION)
    assert known.attribute("laser_period_s") == pytest.approx(PERIOD, rel=1e-6)


def test_a_ptu_becomes_a_streak_image(ptu: Path, decays: Any) -> None:
    streak = read_transient(f"file://{ptu}?bins=200&start_ps=16", bin_width=RESOLUTION)
    # Bins of the file's own width, the first one in the middle of its first: every photon stays in
    # its bin.
    np.testing.assert_allclose(streak.counts, decays.T, atol=1e-3)
    np.testing.assert_allclose(streak.times[:2], [16e-12, 48e-12], rtol=1e-9)


@pytest.mark.parametrize("kind", ["phu", "sdt"])
def test_histograms_become_a_streak_image(
    request: pytest.FixtureRequest, kind: str, decays: Any
) -> None:
    path = request.getfixturevalue(kind)
    streak = read_transient(f"file://{path}")
    np.testing.assert_array_equal(streak.counts, decays.T)
    np.testing.assert_allclose(np.diff(streak.times), RESOLUTION, rtol=1e-6)
    assert read_transient(f"file://{path}", bin_width=1e-12).times[1] == pytest.approx(1e-12)


@pytest.mark.parametrize("kind", ["ptu", "phu", "sdt"])
def test_damaged_files_raise_only_our_own_errors(request: pytest.FixtureRequest, kind: str) -> None:
    path = request.getfixturevalue(kind)
    whole, random, messages = path.read_bytes(), np.random.default_rng(6), []
    for number in range(150):
        damaged = bytearray(whole)
        if number % 3 == 0:
            del damaged[int(random.integers(len(whole))) :]
        for place in random.integers(0, max(1, min(len(damaged), 3000)), 4):
            if damaged:
                damaged[min(int(place), len(damaged) - 1)] = int(random.integers(256))
        path.write_bytes(damaged)
        try:
            read_transient(f"file://{path}?bins=50")
        except TofclipError as fault:
            messages.append(str(fault))
    assert len(messages) > 20
    assert not any("\n" in message for message in messages)


def test_what_cannot_be_read(
    tmp_path: Path, ptu: Path, phu: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(StorageError, match="no such file"):
        devices.open(f"file://{tmp_path}/absent.sdt")
    (tmp_path / "other.phu").write_bytes(b"something else")
    with pytest.raises(FileFormatError, match="damaged or unsupported"):
        devices.open(f"file://{tmp_path}/other.phu")
    with pytest.raises(InputError, match="'x' is unknown"):
        devices.open(f"file://{ptu}?x=1")
    monkeypatch.setattr(tcspc, "MAX_HISTOGRAM_FILE_BYTES", 100)
    with pytest.raises(FileFormatError, match="larger than 100 bytes"):
        devices.open(f"file://{phu}")
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "ptufile", None)
    with pytest.raises(MissingDependencyError, match=r"install 'tofclip\[tcspc\]'"):
        devices.open(f"file://{ptu}")


@pytest.mark.parametrize(
    ("curves", "resolution", "problem"),
    [
        ([], 1e-12, "histograms of no bins"),
        ([np.ones(3), np.ones(4)], 1e-12, r"\[3, 4\] bins"),
        ([np.ones(3)], 0.0, "last 0.0 s"),
    ],
)
def test_histograms_that_cannot_be(curves: list[Any], resolution: float, problem: str) -> None:
    with pytest.raises(FileFormatError, match=problem):
        tcspc._stack_histograms(curves, resolution, "", Path("run.sdt"))


def read_all(address: str) -> Any:
    with devices.open(address) as source:
        return np.concatenate([batch.records for batch in source])


@pytest.mark.parametrize("pieces", [1, 7, 40])
def test_a_ptu_is_the_same_in_pieces(
    ptu: Path, pieces: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Photons that are read a piece at a time, as of a file that does not fit into memory."""
    whole = read_all(f"file://{ptu}")
    monkeypatch.setattr("tofclip.io.tcspc.CHUNK_EVENTS", -(-len(whole) // pieces))
    np.testing.assert_array_equal(read_all(f"file://{ptu}"), whole)
    with devices.open(f"file://{ptu}") as source:
        source.seek(len(whole) // 2)
        batch = source.read()
        assert batch is not None
        np.testing.assert_array_equal(batch.records, whole[len(whole) // 2 :][: len(batch.records)])
        assert batch.first == len(whole) // 2


@pytest.mark.parametrize("chunk", [13, 1 << 20])
def test_photons_of_a_file_in_t2_mode(
    tmp_path: Path, chunk: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Times from the last pulse before each photon, over overflows and pieces."""
    monkeypatch.setattr("tofclip.io.tcspc.CHUNK_EVENTS", chunk)
    random = np.random.default_rng(3)
    pulses = 500 + 400_000 * np.arange(300)  # 120 us: over three overflows of 34 us
    own = np.sort(random.integers(0, 300, 200))
    delay, channel = random.integers(1, 399_000, 200), random.integers(0, 2, 200)
    events = np.stack([pulses[own] + delay, channel], axis=1)
    early = np.array([[100, 0]])  # before the first pulse: no time can be given
    tcspc_files.write_ptu_t2(tmp_path / "t2.ptu", pulses, np.concatenate([early, events]))
    with devices.open(f"file://{tmp_path}/t2.ptu") as source:
        records = np.concatenate([batch.records for batch in source])
        known = source.calibration
    assert known is not None
    order = np.argsort(events[:, 0], kind="stable")
    np.testing.assert_array_equal(records["bin"], delay[order])
    np.testing.assert_array_equal(records["sync"], own[order])
    np.testing.assert_array_equal(records["channel"], channel[order])
    assert known.attribute("laser_period_s") == pytest.approx(400e-9)
    assert known.attribute("resolution_s") == tcspc_files.T2_TICK
    with pytest.raises(FileFormatError, match="name their channel: sync="):
        devices.open(f"file://{tmp_path}/t2.ptu?sync=9")


def test_the_pulses_channel_reaches_a_file_that_is_recovered(tmp_path: Path) -> None:
    """Of a time tagger's recording ``sync`` says how photons are put together, of a PTU how it is read."""
    pulses = 500 + 400_000 * np.arange(300)
    photons = np.concatenate(
        [
            np.stack([pulses + 1, np.full(300, 1)], axis=1),
            [[pulses[7] + 500, 0], [pulses[9] + 900, 0]],
        ]
    )
    tcspc_files.write_ptu_t2(tmp_path / "t2.ptu", pulses, photons)
    streak = read_transient(f"file://{tmp_path}/t2.ptu?sync=1&bins=100")
    assert streak.counts.sum() == pytest.approx(2, abs=1e-3)


class StandInTags:
    """A block of tags as Swabian Instruments' library returns it: time in ps, channel, type and tags
    that were lost.
    """

    def __init__(self, tags: Any) -> None:
        self.getTimestamps = lambda: tags[:, 0].copy()
        self.getChannels = lambda: tags[:, 1].astype(np.int32)
        self.getEventTypes = lambda: tags[:, 2].astype(np.uint8)
        self.getMissedEvents = lambda: tags[:, 3].astype(np.uint16)


class StandInReader:
    """Their reader of files; the file is an array."""

    def __init__(self, path: str) -> None:
        self._tags, self._next = np.load(path), 0

    def getConfiguration(self) -> str:
        return "{}"

    def hasData(self) -> bool:
        return self._next < len(self._tags)

    def getData(self, tags: int) -> StandInTags:
        self._next += tags
        return StandInTags(self._tags[self._next - tags : self._next])


@pytest.fixture
def ttbin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A file with pulses on channel 2 and photons on rising edges of 1 and falling ones of 3; how
    long after its pulse each photon came, and its channel.
    """
    random = np.random.default_rng(4)
    pulses = 1000 + 12_500 * np.arange(2000)
    own = np.sort(random.integers(0, 2000, 1500))
    delay, channel = random.integers(1, 12_499, 1500), random.choice([-3, 1], 1500)
    tags = np.concatenate(
        [
            [[10, 1, 0, 0], [5_000_000, 0, 4, 17]],  # before the first pulse; a loss of 17 tags
            np.stack([pulses, np.full(2000, 2), np.zeros(2000), np.zeros(2000)], axis=1),
            np.stack([pulses[own] + delay, channel, np.zeros(1500), np.zeros(1500)], axis=1),
        ]
    ).astype(np.int64)
    order = np.argsort(tags[:, 0], kind="stable")
    with open(tmp_path / "run.ttbin", "wb") as file:
        np.save(file, tags[order])
    library = SimpleNamespace(FileReader=StandInReader, setLogger=lambda log: None)
    monkeypatch.setitem(sys.modules, "Swabian", SimpleNamespace(TimeTagger=library))
    monkeypatch.setitem(sys.modules, "Swabian.TimeTagger", library)
    by_time = np.lexsort((delay, own))
    return tmp_path / "run.ttbin", own[by_time], delay[by_time], channel[by_time]


@pytest.mark.parametrize("chunk", [100, 1 << 20])
def test_photons_of_a_ttbin(ttbin: Any, chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcspc, "SWABIAN_CHUNK_TAGS", chunk)
    path, own, delay, channel = ttbin
    with devices.open(f"file://{path}?sync=2") as source:
        records = np.concatenate([batch.records for batch in source])
        known, stats = source.calibration, source.stats
        source.seek(700)
        batch = source.read()
        assert batch is not None
        np.testing.assert_array_equal(batch.records, records[700 : 700 + len(batch)])
        assert source.info.details["inputs"] == "-3,1"
    np.testing.assert_array_equal(records["sync"], own)
    np.testing.assert_array_equal(records["bin"], delay)
    np.testing.assert_array_equal(records["channel"], channel == 1)
    assert (stats.delivered, stats.lost_device, stats.is_balanced) == (1500, 17, True)
    assert known is not None
    assert known.attribute("laser_period_s") == pytest.approx(12.5e-9)
    streak = read_transient(f"file://{path}?sync=2")
    np.testing.assert_allclose(streak.counts.sum(axis=0), [sum(channel == -3), sum(channel == 1)])


def test_a_ttbin_that_cannot_be_read(ttbin: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    path = ttbin[0]
    with pytest.raises(InputError, match="name the channel of the laser's pulses: sync=1"):
        devices.open(f"file://{path}")
    with pytest.raises(InputError, match=r"sync=\.\.\., other channels are"):
        devices.open(f"file://{path}?sync=9")
    monkeypatch.setitem(sys.modules, "Swabian.TimeTagger", None)
    with pytest.raises(MissingDependencyError, match="pip install 'swabian-timetagger'"):
        devices.open(f"file://{path}?sync=2")


def test_what_swabians_own_library_says_of_a_damaged_file(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("Swabian.TimeTagger")
    (tmp_path / "run.ttbin").write_bytes(b"SITT" + bytes(500))
    with pytest.raises(FileFormatError, match="Incorrect Header"):
        devices.open(f"file://{tmp_path}/run.ttbin?sync=1")
    assert capfd.readouterr().err == ""


def test_the_shape_of_an_sdt_image(tmp_path: Path) -> None:
    cube = np.random.default_rng(1).poisson(2, (1, 4, 6, 50)).astype(np.uint16)
    tcspc_files.write_sdt(tmp_path / "image.sdt", cube)
    with devices.open(f"file://{tmp_path}/image.sdt") as source:
        records = np.concatenate([batch.records for batch in source])
        assert source.calibration.attributes["rows"] == 4  # type: ignore[union-attr]
        assert source.info.details["columns"] == 6
    np.testing.assert_array_equal(records["histogram"].reshape(cube[0].shape), cube[0])


PACKED = 0x1000


def pack_sdt(path: Path, data: bytes, compression: int = zipfile.ZIP_DEFLATED) -> None:
    """Write a file of one block that is a ZIP archive of `data`, as newer programs do."""
    tcspc_files.write_sdt(path, np.ones((1, 50), np.uint16))
    layout = np.dtype(sdtfile.sdtfile.BLOCK_HEADER).newbyteorder("<")
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", compression) as opened:
        opened.writestr("data_block", data)
    whole = path.read_bytes()
    block = np.frombuffer(whole[-100 - layout.itemsize : -100], layout).copy()
    block["block_type"] |= PACKED
    block["next_block_offs"] = block["data_offs"] + len(archive.getvalue())
    path.write_bytes(whole[: -100 - layout.itemsize] + block.tobytes() + archive.getvalue())


def test_packed_blocks_are_read_and_take_no_more_than_they_hold(tmp_path: Path) -> None:
    path, counts = tmp_path / "run.sdt", np.arange(50, dtype="<u2")
    pack_sdt(path, counts.tobytes())
    np.testing.assert_array_equal(read_transient(f"file://{path}").counts[:, 0], counts)
    whole = path.read_bytes()
    size = struct.pack("<I", len(whole))  # where the block ends: three gigabytes later
    far = whole.replace(size, struct.pack("<I", 3_400_000_000))
    assert far != whole
    for bomb in (far, None):
        if bomb is None:
            pack_sdt(path, bytes(1 << 24), zipfile.ZIP_LZMA)  # 16 MiB out of 3 kB
        else:
            path.write_bytes(bomb)
        tracemalloc.start()
        try:
            with pytest.raises(FileFormatError, match="block 0"):
                read_transient(f"file://{path}")
            assert tracemalloc.get_traced_memory()[1] < 1 << 22
        finally:
            tracemalloc.stop()
