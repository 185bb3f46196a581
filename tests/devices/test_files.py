"""Files as sources and as pictures: of photon-counting electronics (PTU in T2 and T3 mode, with
markers of lines and frames, PHU, SDT, TTBIN), and streak images.
"""

import io
import struct
import sys
import tracemalloc
import zipfile
from types import SimpleNamespace

import numpy as np
import pytest
import tcspc_files
import tifffile
from instruments import refuse
from itex_files import encode_itex
from numpy.testing import assert_allclose, assert_array_equal
from tcspc_files import PERIOD, RESOLUTION, T2_TICK, make_decays

import devices
from devices import files
from devices.files import PHOTON_DTYPE
from devices.transients import read_transient
from tofclip.errors import FileFormatError, InputError, MissingDependencyError, StorageError
from tofclip.io.tcspc import Checkpoint, PtuEvents
from tofclip.lidar.photons.files import describe_photons, read_photons

ptufile = pytest.importorskip("ptufile")
sdtfile = pytest.importorskip("sdtfile")

DECAYS = make_decays()


@pytest.fixture
def write(tmp_path):
    """Write the decays as a PTU, a PHU or an SDT, or a streak image of six rows with a time axis."""

    def write(kind):
        path = tmp_path / f"run.{kind}"
        if kind == "img":
            text = (
                '[Application],Date="1/2/2023",Software="HPD-TA"[Camera],CameraName="C1",'
                'SerialNumber="S/N: 5"[Scaling],ScalingYUnit="ns",ScalingYScalingFile=""'
            )
            times = {"Y": np.arange(6, dtype=np.float32) ** 1.5}
            path.write_bytes(encode_itex(np.arange(24, dtype="<u2").reshape(6, 4), text, times))
        else:
            getattr(tcspc_files, f"write_{kind}")(path, DECAYS)
        return path

    return write


def read_all(address):
    """Return all records of a source, and its calibration."""
    with devices.open(f"file://{address}") as source:
        return np.concatenate([batch.records for batch in source]), source.calibration


def test_photons_of_a_ptu(write):
    records, known = read_all(write("ptu"))
    assert records.dtype == PHOTON_DTYPE
    for channel, decay in enumerate(DECAYS):
        counts = np.bincount(records["bin"][records["channel"] == channel], minlength=200)
        assert_array_equal(counts, decay)
    assert known.attribute("resolution_s") == pytest.approx(RESOLUTION)
    assert known.attribute("laser_period_s") == pytest.approx(PERIOD, rel=1e-6)
    streak = read_transient(f"file://{write('ptu')}?bins=200&start_ps=16", bin_width=RESOLUTION)
    # Bins of the file's own width, the first one in the middle of its first: every photon stays in
    # its bin.
    assert_allclose(streak.counts, DECAYS.T, atol=1e-3)
    assert_allclose(streak.times[:2], [16e-12, 48e-12], rtol=1e-9)


@pytest.mark.parametrize("kind", ["phu", "sdt"])
def test_histograms_become_a_streak_image(write, kind):
    path = write(kind)
    streak = read_transient(f"file://{path}")
    assert_array_equal(streak.counts, DECAYS.T)
    assert_allclose(np.diff(streak.times), RESOLUTION, rtol=1e-6)
    assert read_transient(f"file://{path}", bin_width=1e-12).times[1] == pytest.approx(1e-12)


def test_a_picture_is_one_frame(write):
    path, counts = write("img"), np.arange(24).reshape(6, 4)
    with devices.open(f"file://{path}") as source:
        assert source.stats.unread == 1
        info = source.info.as_dict()
    assert (info["camera"], info["serial"], info["date"]) == ("C1", "S/N: 5", "1/2/2023")
    records, known = read_all(path)
    assert_array_equal(records["counts"], [counts])
    times = known.array("row_times", float, 1, "s")
    assert_allclose(times, np.arange(6) ** 1.5 * 1e-9, rtol=1e-6)
    streak = read_transient(f"file://{path}")
    assert_array_equal(streak.counts, counts)
    assert_array_equal(streak.times, times)


def test_pictures_without_a_time_axis(tmp_path):
    path = tmp_path / "plain.tif"
    tifffile.imwrite(path, np.ones((3, 5), np.uint16))
    assert read_all(path)[1] is None
    streak = read_transient(f"file://{path}", bin_width=1e-12)
    assert streak.times[2] == pytest.approx(2e-12)


@pytest.mark.parametrize("kind", ["ptu", "phu", "sdt", "img"])
def test_what_every_file_refuses(write, kind, monkeypatch):
    path = write(kind)
    with devices.open(f"file://{path}") as source, pytest.raises(InputError, match="no number"):
        source.seek(10**9)
    refuse(f"file://{path}?x=1", "'x' is unknown")
    if kind != "img":
        library = "sdtfile" if kind == "sdt" else "ptufile"
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, library, None)
            refuse(f"file://{path}", r"install 'tofclip\[tcspc\]'", MissingDependencyError)
    if kind in ("phu", "sdt"):
        with monkeypatch.context() as patch:
            patch.setattr(files, "MAX_HISTOGRAM_FILE_BYTES", 100)
            refuse(f"file://{path}", "larger than 100 bytes", FileFormatError)
    path.write_bytes(b"something else")
    with pytest.raises(FileFormatError):
        devices.open(f"file://{path}")
    path.unlink()
    refuse(f"file://{path}", "no such file", StorageError)


@pytest.mark.parametrize("pieces", [1, 7, 40])
def test_a_ptu_is_the_same_in_pieces(write, pieces, monkeypatch):
    """Photons that are read a piece at a time, as of a file that does not fit into memory."""
    path = write("ptu")
    whole, _ = read_all(path)
    monkeypatch.setattr("tofclip.io.tcspc.CHUNK_EVENTS", -(-len(whole) // pieces))
    assert_array_equal(read_all(path)[0], whole)
    with devices.open(f"file://{path}") as source:
        source.seek(len(whole) // 2)
        batch = next(source)
    assert_array_equal(batch.records, whole[len(whole) // 2 :][: len(batch)])
    assert batch.first == len(whole) // 2


PULSES = 500 + 400_000 * np.arange(300)  # 120 us: over three overflows of 34 us


@pytest.mark.parametrize("chunk", [13, 1 << 20])
def test_photons_of_a_file_in_t2_mode(tmp_path, chunk, monkeypatch):
    """Times from the last pulse before each photon, over overflows and pieces."""
    monkeypatch.setattr("tofclip.io.tcspc.CHUNK_EVENTS", chunk)
    random, path = np.random.default_rng(3), tmp_path / "t2.ptu"
    own = np.sort(random.integers(0, 300, 200))
    delay, channel = random.integers(1, 399_000, 200), random.integers(0, 2, 200)
    events = np.stack([PULSES[own] + delay, channel], axis=1)
    early = np.array([[100, 0]])  # before the first pulse: no time can be given
    tcspc_files.write_ptu_t2(path, PULSES, np.concatenate([early, events]))
    records, known = read_all(path)
    order = np.argsort(events[:, 0], kind="stable")
    for name, values in (("bin", delay), ("sync", own), ("channel", channel)):
        assert_array_equal(records[name], values[order])
    assert known.attribute("laser_period_s") == pytest.approx(400e-9)
    assert known.attribute("resolution_s") == T2_TICK
    refuse(f"file://{path}?sync=9", "name their channel: sync=", FileFormatError)


def test_the_pulses_channel_reaches_a_file_that_is_recovered(tmp_path):
    """Of a time tagger's recording ``sync`` says how photons are put together, of a PTU how it is read."""
    pulses = np.stack([PULSES + 1, np.full(300, 1)], axis=1)
    photons = np.array([[PULSES[7] + 500, 0], [PULSES[9] + 900, 0]])
    tcspc_files.write_ptu_t2(tmp_path / "t2.ptu", PULSES, np.concatenate([pulses, photons]))
    streak = read_transient(f"file://{tmp_path}/t2.ptu?sync=1&bins=100")
    assert streak.counts.sum() == pytest.approx(2, abs=1e-3)


# Swabian Instruments' files


class StandInReader:
    """Their reader of files; the file is an array: time in ps, channel, type and tags that were lost."""

    def __init__(self, path):
        self._tags, self._next = np.load(path), 0

    def getConfiguration(self):
        return "{}"

    def hasData(self):
        return self._next < len(self._tags)

    def getData(self, tags):
        found, self._next = self._tags[self._next : self._next + tags], self._next + tags
        return SimpleNamespace(
            getTimestamps=lambda: found[:, 0].copy(),
            getChannels=lambda: found[:, 1].astype(np.int32),
            getEventTypes=lambda: found[:, 2].astype(np.uint8),
            getMissedEvents=lambda: found[:, 3].astype(np.uint16),
        )


@pytest.fixture
def ttbin(tmp_path, monkeypatch):
    """A file with pulses on channel 2 and photons on rising edges of 1 and falling ones of 3; the
    pulse of each photon, how long after it it came, and its channel.
    """
    random = np.random.default_rng(4)
    pulses = 1000 + 12_500 * np.arange(2000)
    own = np.sort(random.integers(0, 2000, 1500))
    delay, channel = random.integers(1, 12_499, 1500), random.choice([-3, 1], 1500)
    special = [[10, 1, 0, 0], [5_000_000, 0, 4, 17]]  # before the first pulse; a loss of 17 tags
    tags = np.zeros((3502, 4), np.int64)
    tags[:2], tags[2:2002, 0], tags[2:2002, 1] = special, pulses, 2
    tags[2002:, 0], tags[2002:, 1] = pulses[own] + delay, channel
    with open(tmp_path / "run.ttbin", "wb") as file:
        np.save(file, tags[np.argsort(tags[:, 0], kind="stable")])
    library = SimpleNamespace(FileReader=StandInReader, setLogger=lambda log: None)
    monkeypatch.setitem(sys.modules, "Swabian", SimpleNamespace(TimeTagger=library))
    monkeypatch.setitem(sys.modules, "Swabian.TimeTagger", library)
    by_time = np.lexsort((delay, own))
    return tmp_path / "run.ttbin", own[by_time], delay[by_time], channel[by_time]


@pytest.mark.parametrize("chunk", [100, 1 << 20])
def test_photons_of_a_ttbin(ttbin, chunk, monkeypatch):
    monkeypatch.setattr(files, "SWABIAN_CHUNK_TAGS", chunk)
    path, own, delay, channel = ttbin
    with devices.open(f"file://{path}?sync=2") as source:
        records = np.concatenate([batch.records for batch in source])
        known, stats = source.calibration, source.stats
        source.seek(700)
        batch = next(source)
        assert_array_equal(batch.records, records[700 : 700 + len(batch)])
        assert source.info.details["inputs"] == "-3,1"
    for name, values in (("sync", own), ("bin", delay), ("channel", channel == 1)):
        assert_array_equal(records[name], values)
    assert (stats.delivered, stats.lost_device, stats.is_balanced) == (1500, 17, True)
    assert known is not None
    assert known.attribute("laser_period_s") == pytest.approx(12.5e-9)
    streak = read_transient(f"file://{path}?sync=2")
    assert_allclose(streak.counts.sum(axis=0), [sum(channel == -3), sum(channel == 1)])


def test_a_ttbin_that_cannot_be_read(ttbin, monkeypatch):
    path = ttbin[0]
    refuse(f"file://{path}", "name the channel of the laser's pulses: sync=1")
    refuse(f"file://{path}?sync=9", r"sync=\.\.\., other channels are")
    monkeypatch.setitem(sys.modules, "Swabian.TimeTagger", None)
    refuse(f"file://{path}?sync=2", "pip install 'swabian-timetagger'", MissingDependencyError)


def test_what_swabians_own_library_says_of_a_damaged_file(tmp_path, capfd):
    pytest.importorskip("Swabian.TimeTagger")
    (tmp_path / "run.ttbin").write_bytes(b"SITT" + bytes(500))
    refuse(f"file://{tmp_path}/run.ttbin?sync=1", "Incorrect Header", FileFormatError)
    assert capfd.readouterr().err == ""


# Pictures


@pytest.mark.parametrize("channels", [1, 3])
def test_pictures_of_an_sdt_keep_their_shape(tmp_path, channels):
    cube, path = np.random.default_rng(1).poisson(2, (channels, 4, 6, 50)), tmp_path / "image.sdt"
    tcspc_files.write_sdt(path, cube.astype(np.uint16))
    found = read_photons(path)
    assert found.image_shape == (4, 6)
    assert found.bin_width == pytest.approx(RESOLUTION)
    per_pixel = np.bincount(found.pixel, found.count, 24).reshape(4, 6)
    assert_array_equal(per_pixel, cube.sum(axis=(0, 3)))
    records, known = read_all(path)
    assert (known.attributes["rows"], known.attributes["columns"]) == (4, 6)
    assert_array_equal(records["histogram"].reshape(cube.shape), cube)


def pack_sdt(path, data, compression=zipfile.ZIP_DEFLATED):
    """Write a file of one block that is a ZIP archive of `data`, as newer programs do."""
    tcspc_files.write_sdt(path, np.ones((1, 50), np.uint16))
    layout = np.dtype(sdtfile.sdtfile.BLOCK_HEADER).newbyteorder("<")
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", compression) as opened:
        opened.writestr("data_block", data)
    whole = path.read_bytes()
    block = np.frombuffer(whole[-100 - layout.itemsize : -100], layout).copy()
    block["block_type"] |= 0x1000  # packed
    block["next_block_offs"] = block["data_offs"] + len(archive.getvalue())
    path.write_bytes(whole[: -100 - layout.itemsize] + block.tobytes() + archive.getvalue())


def test_packed_blocks_are_read_and_take_no_more_than_they_hold(tmp_path):
    path, counts = tmp_path / "run.sdt", np.arange(50, dtype="<u2")
    pack_sdt(path, counts.tobytes())
    assert_array_equal(read_transient(f"file://{path}").counts[:, 0], counts)
    whole = path.read_bytes()
    size = struct.pack("<I", len(whole))  # where the block ends: three gigabytes later
    far = whole.replace(size, struct.pack("<I", 3_400_000_000))
    assert far != whole
    pack_sdt(path, bytes(1 << 24), zipfile.ZIP_LZMA)  # 16 MiB out of 3 kB
    for bomb in (far, path.read_bytes()):
        path.write_bytes(bomb)
        tracemalloc.start()
        try:
            with pytest.raises(FileFormatError, match="block 0"):
                read_transient(f"file://{path}")
            assert tracemalloc.get_traced_memory()[1] < 1 << 22
        finally:
            tracemalloc.stop()


def test_a_picture_in_t3_mode(tmp_path):
    cube = np.random.default_rng(1).poisson(2, (2, 3, 4, 2, 60)).astype(np.uint16)
    options = {"global_resolution": PERIOD, "tcspc_resolution": RESOLUTION, "pixel_time": 1e-4}
    ptufile.imwrite(tmp_path / "t3.ptu", cube, **options)
    found = read_photons(tmp_path / "t3.ptu")
    assert found.image_shape == (3, 4)
    assert found.count.sum() == cube.sum()
    per_pixel = np.bincount(found.pixel, found.count, 12).reshape(3, 4)
    assert_array_equal(per_pixel, cube.sum(axis=(0, 3, 4)))


ROWS, COLUMNS, FRAMES = 5, 7, 3
PERIOD_TICKS, PIXEL_TICKS = 50_000, 200_000
SCAN = {
    "ImgHdr_Dimensions": 3,
    "ImgHdr_PixX": COLUMNS,
    "ImgHdr_PixY": ROWS,
    "ImgHdr_LineStart": 1,
    "ImgHdr_LineStop": 2,
    "ImgHdr_Frame": 3,
}


class Scan:
    """Pulses, markers and photons of three frames, with a return of the scanner after each line, and
    the true pixel and delay of each photon in a line.
    """

    def __init__(self, path):
        self.path = path
        random, line = np.random.default_rng(5), COLUMNS * PIXEL_TICKS
        begin = 30_000 + np.arange(FRAMES * ROWS) * (line + 400_000)
        self.pulses = np.arange(0, begin[-1] + line + 500_000, PERIOD_TICKS)
        ticks = np.concatenate([begin[::ROWS] - 20_000, begin, begin + line])
        bits = np.repeat([4, 1, 2], [FRAMES, len(begin), len(begin)])
        self.markers = np.stack([ticks, bits], axis=1)
        time = np.sort(random.integers(1, self.pulses[-1], 4000))
        time = time[time % PERIOD_TICKS != 0]  # not with a pulse: which comes first would be chance
        self.photons = np.stack([time, random.integers(0, 2, len(time))], axis=1)
        own = np.searchsorted(begin, time, "right") - 1
        inside = (own >= 0) & (time < begin[own] + line) & ~np.isin(time, ticks)
        self.y, self.delay = own[inside] % ROWS, time[inside] % PERIOD_TICKS
        self.x = (time - begin[own])[inside] // PIXEL_TICKS

    def write(self, **tags):
        """Write a file with these tags besides those of the scan."""
        tcspc_files.write_ptu_t2(
            self.path, self.pulses, self.photons, self.markers, {**SCAN, **tags}
        )
        return self.path

    def require_pixels(self, found, x):
        """Require as many photons in each pixel as there were."""
        expected = np.zeros((ROWS, COLUMNS), int)
        np.add.at(expected, (self.y, x), 1)
        counts = np.bincount(found.pixel, minlength=ROWS * COLUMNS).reshape(ROWS, COLUMNS)
        assert_array_equal(counts, expected)


@pytest.fixture
def scan(tmp_path):
    return Scan(tmp_path / "scan.ptu")


@pytest.mark.parametrize("chunk", [333, 1 << 20])
@pytest.mark.parametrize("dwell_ms", [0.0, PIXEL_TICKS * T2_TICK * 1e3])
def test_markers_make_a_picture_of_a_file_in_t2_mode(scan, dwell_ms, chunk, monkeypatch):
    """Pixels by the markers where lines begin and end, or by the dwell time that the file gives."""
    monkeypatch.setattr("tofclip.io.tcspc.CHUNK_EVENTS", chunk)
    path = scan.write(ImgHdr_TimePerPixel=dwell_ms)
    found, described = read_photons(path), describe_photons(path)
    assert found.image_shape == (ROWS, COLUMNS)
    assert found.bin_width == T2_TICK
    scan.require_pixels(found, scan.x)
    order = np.lexsort((scan.delay, scan.y * COLUMNS + scan.x))
    bins = found.bin[np.lexsort((found.bin, found.pixel))]
    assert_allclose(bins, scan.delay[order], atol=0.01)
    assert described["layout"] == "events"
    assert described["arrays"]["x"] == f"{len(scan.x)} uint16"


def test_every_other_line_of_a_scan_both_ways_is_turned(scan):
    found = read_photons(scan.write(ImgHdr_BiDirect=1))
    scan.require_pixels(found, np.where(scan.y % 2, COLUMNS - 1 - scan.x, scan.x))


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("PixX", 0, "a picture of 5 x 0 pixels"),
        ("SinCorrection", 80, "scanned in a sine"),
        ("LineStart", 4, "no markers where lines begin"),
        ("LineStop", 4, "no markers where lines end"),
    ],
)
def test_scans_that_cannot_be_put_together(scan, name, value, said):
    path = scan.write(**{f"ImgHdr_{name}": value})
    with pytest.raises(FileFormatError, match=said):
        read_photons(path)


def test_events_beyond_2_gib(tmp_path):
    """A sparse file: photons are written where it has 2.5 GiB already, and read from there."""
    path = tmp_path / "large.ptu"
    tcspc_files.write_ptu(path, np.ones((1, 20), np.uint16))
    whole = PtuEvents(path)
    expected, _ = whole.decode(0, Checkpoint())
    head = bytearray(path.read_bytes()[: whole._offset])
    place = head.index(b"TTResult_NumberOfRecords")
    events = 5 << 27
    head[place + 40 : place + 48] = events.to_bytes(8, "little")
    photons = np.fromfile(path, "<u4", offset=whole._offset)
    with open(path, "wb") as file:
        file.write(head)
        file.seek(whole._offset + 4 * (events - len(photons)))
        file.write(photons.tobytes())
    assert path.stat().st_size > 5 << 29
    large = PtuEvents(path)
    assert large.events == events
    last, _ = large.decode(large.pieces - 1, Checkpoint())
    assert expected.is_photon.sum() == 20
    assert_array_equal(last.delay[-len(photons) :], expected.delay)
    assert_array_equal(last.channel[-len(photons) :], expected.channel)
