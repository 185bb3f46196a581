"""LinoSPAD2's calibration, and its recordings and simulations as sources."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import devices
from devices import linospad2
from devices.emulation.linospad2 import SimulatedBoard, draw_uneven_calibration
from devices.emulation.scenes import make_line_instrument, simulate_light
from devices.histogram import BinAxis, StampHistogram
from devices.linospad2 import BoardCalibration, LinoSpad2Codec, load_calibration, read_sidecar
from devices.transients import read_transient
from tofclip.camera import Camera
from tofclip.errors import FileFormatError, InputError, ShapeError, StorageError
from tofclip.lidar import depth
from tofclip.recovery import recover
from tofclip.simulate import score_returns

CODEC = LinoSpad2Codec("2212s", 24, True)
SIDECAR = 'firmware = "2212s"\ntimestamps_per_cycle = 24\nabsolute_counter = true\n'


@pytest.fixture(scope="module")
def uneven():
    return replace(draw_uneven_calibration(7), hot_pixels=np.array([15, 231]))


@pytest.fixture(scope="module")
def light():
    return simulate_light("small")


def write_tables(folder, board):
    """Write a board's tables, in ps, and return the lines that name them."""
    table = np.column_stack([np.arange(256), board.code_ends * 1e12])
    np.savetxt(folder / "codes.csv", table, delimiter=",", header="codes", comments="")
    np.save(folder / "offsets.npy", board.offsets * 1e12)
    (folder / "hot.txt").write_text("".join(f"{pixel}\n" for pixel in board.hot_pixels))
    return 'code_table = "codes.csv"\noffset_table = "offsets.npy"\nhot_pixels = "hot.txt"\n'


def test_times_follow_the_formula(uneven):
    records, random = np.zeros(1000, LinoSpad2Codec().dtype), np.random.default_rng(2)
    records["pixel"] = random.integers(0, 256, 1000)
    records["code"] = random.integers(0, 1 << 28, 1000)
    expected = [
        (code - code % 140) * 2500 / 140
        + uneven.code_ends[pixel, code % 140] * 1e12
        + uneven.offsets[pixel] * 1e12
        for _, code, pixel in records.tolist()
    ]
    # float64 resolves 5 ms to 1e-18 s; the table's own digits were multiplied by 1e12 and back.
    known = np.array(expected) * 1e-12
    assert_allclose(uneven.times(records), known, atol=1e-16, rtol=1e-14)


@pytest.mark.parametrize(("board", "hot"), [("NL11_#33_2212b", 66), ("B7d_#28_2212s", 37)])
@pytest.mark.nightly
def test_recorded_boards(shared_data, light, board, hot):
    """Measured unevenness of two boards: codes up to 112 ps wide, pixels out of step by 11 ns, ten
    of them hot. They see the scene with their own tables only.
    """
    folder = shared_data / "devices" / "linospad2"
    name, firmware = board.rsplit("_", 1)
    code_table, offset_table = folder / f"TDC_{board}.csv", folder / f"Offset_{board}.npy"
    tables = load_calibration(code_table, offset_table, folder / f"mask_{name}.txt")
    assert_allclose(tables.code_ends[:, -1].max(), 2500e-12, rtol=1e-12)
    assert hot in tables.hot_pixels
    raw = np.loadtxt(code_table, delimiter=",", skiprows=1)
    records = np.array([(0, 140 * 7 + 93, 100)], LinoSpad2Codec().dtype)
    expected = 7 * 2500 + raw[100, 94] + np.load(offset_table)[100]
    assert_allclose(tables.times(records) * 1e12, [expected], rtol=1e-12)
    codec = LinoSpad2Codec(firmware)
    simulated, errors = SimulatedBoard(light, tables, codec, 8000, 1), []
    for known in (tables, BoardCalibration.ideal()):
        histogram = StampHistogram(BinAxis(20e-12, 576, 0.0, 25e-9), known)
        for number in range(100):
            words = np.frombuffer(simulated.encode_cycle(number), np.uint8)
            histogram.add(codec.decode(words, codec.start).records)
        returns = depth(recover(replace(histogram.to_streak(), camera=light.camera)))
        try:
            errors.append(score_returns(returns, light.truth)["median_depth_error_m"])
        except InputError:  # none is on the target
            errors.append(np.inf)
    # 0.8 mm with the tables; without them 90 mm or more, or nothing that the shot bears out: the pixels'
    # offsets are 11 ns or 1.6 m apart.
    assert errors[0] < 1.5e-3
    assert errors[1] > 0.05


def test_a_calibration_survives_storage(uneven, tmp_path):
    for board in (uneven, BoardCalibration.ideal()):
        board.to_record().save(tmp_path / "board.h5")
        found = BoardCalibration.from_record(type(board.to_record()).load(tmp_path / "board.h5"))
        for name in ("code_ends", "offsets", "hot_pixels"):
            assert_array_equal(getattr(found, name), getattr(board, name))


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"code_ends": np.zeros((3, 140))}, "must have shape"),
        ({"offsets": np.full(256, np.nan)}, "must be finite"),
        ({"code_ends": np.full((256, 140), 3e-9)}, "clock's 2.5 ns"),
        ({"code_ends": np.tile(np.linspace(2e-9, 0, 140), (256, 1))}, "must not go back"),
        ({"hot_pixels": np.array([256])}, "hot pixels must lie within"),
    ],
)
def test_impossible_tables_are_refused(change, problem):
    with pytest.raises((ShapeError, InputError), match=problem):
        replace(BoardCalibration.ideal(), **change)


@pytest.fixture
def recording(tmp_path, uneven):
    """A recording's name, with all its companions; the recording itself is not needed here."""
    write_tables(tmp_path, uneven)
    return tmp_path / "run.dat"


def test_sidecars_say_all_or_the_least(recording, uneven):
    tables = write_tables(recording.parent, uneven)
    rest = 'board = "B7d"\nlaser_period_ps = 25000\ncamera = "camera.h5"\n'
    recording.with_suffix(".toml").write_text(SIDECAR + tables + rest)
    found = read_sidecar(recording)
    assert found.codec == CODEC
    assert_allclose(found.calibration.code_ends, uneven.code_ends, rtol=1e-15, atol=1e-24)
    assert found.calibration.hot_pixels.tolist() == [15, 231]
    assert (found.board, found.camera) == ("B7d", "camera.h5")
    assert found.laser_period == pytest.approx(25e-9, rel=1e-12)
    recording.with_suffix(".toml").write_text(SIDECAR)
    found, ideal = read_sidecar(recording), BoardCalibration.ideal()
    assert_array_equal(found.calibration.code_ends, ideal.code_ends)
    assert (found.laser_period, found.camera) == (None, "")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (None, r"firmware, timestamps_per_cycle, absolute_counter into run\.toml"),
        ("firmware = ", "is not a TOML file"),
        ("\xff", "lacks the key|is not a TOML"),
        ('firmware = "2212s"\n', "lacks the key 'timestamps_per_cycle'"),
        (SIDECAR + "speed = 3\n", "unknown key 'speed'"),
        (SIDECAR.replace("24", '"24"'), "timestamps_per_cycle must be a int"),
        (SIDECAR.replace("24", "true"), "timestamps_per_cycle must be a int"),
        (SIDECAR.replace("24", "0"), "1..16384"),
        (SIDECAR.replace("2212s", "x"), "2212b or 2212s"),
        (SIDECAR + 'code_table = "codes.csv"\n', "belong together"),
        (SIDECAR + 'hot_pixels = "hot.txt"\n', "needs code_table"),
        (SIDECAR + 'code_table = "hot.txt"\noffset_table = "offsets.npy"\n', "have 141 columns"),
        (SIDECAR + 'code_table = "codes.csv"\noffset_table = "hot.txt"\n', "holds no table"),
        (SIDECAR + 'code_table = "absent"\noffset_table = "offsets.npy"\n', "no such file"),
        (SIDECAR + 'code_table = "large"\noffset_table = "offsets.npy"\n', "larger than any table"),
        (SIDECAR + "laser_period_ps = -1.0\n", "must be a positive number"),
        (SIDECAR + "laser_period_ps = nan\n", "must be a positive number"),
        ("#" * (1 << 20) + "\n", "larger than any TOML"),
    ],
)
def test_sidecars_that_say_nothing_useful(recording, text, problem):
    with open(recording.parent / "large", "wb") as file:
        file.truncate(1 << 30)
    if text is not None:
        recording.with_suffix(".toml").write_text(text)
    with pytest.raises((FileFormatError, StorageError), match=problem):
        read_sidecar(recording)


@pytest.mark.parametrize("shape", [b"(9256000000000,), }", b"(256,            }"])
def test_a_table_whose_header_lies(recording, shape):
    """It claims more than the file holds, or is cut off."""
    path = recording.parent / "offsets.npy"
    path.write_bytes(path.read_bytes().replace(b"(256,), }".ljust(len(shape)), shape))
    with pytest.raises(FileFormatError, match="holds no table of numbers"):
        load_calibration(recording.parent / "codes.csv", path)


@pytest.fixture
def stamps(tmp_path, light, monkeypatch):
    """Twenty cycles, read five at a time, with a sidecar that names laser and camera."""
    monkeypatch.setattr(linospad2, "PIECE_BYTES", 5 * CODEC.unit_bytes)
    board = SimulatedBoard(light, draw_uneven_calibration(3), CODEC, 300, 3)
    path = tmp_path / "run.dat"
    path.write_bytes(b"".join(board.encode_cycle(number) for number in range(20)))
    make_line_instrument().camera.to_record().save(tmp_path / "camera.h5")
    path.with_suffix(".toml").write_text(
        SIDECAR + 'laser_period_ps = 25000\ncamera = "camera.h5"\n'
    )
    return path


def records_of(source):
    return np.concatenate([batch.records for batch in source])


@pytest.mark.parametrize("scheme", ["linospad2", "file"])
def test_a_recording_gives_every_stamp(stamps, scheme):
    expected = CODEC.decode(np.frombuffer(stamps.read_bytes(), np.uint8), 0).records
    with devices.open(f"{scheme}://{stamps}") as source:
        assert_array_equal(records_of(source), expected)
        assert "not public" in str(source.info.details["limits"])
        known = source.calibration
    assert source.stats.delivered == len(expected)
    assert known is not None
    assert known.attribute("laser_period_s") == pytest.approx(25e-9)
    assert Camera.from_record(known.child("camera", "camera")).slit_width_px == 256


def test_a_recording_that_was_cut_off(stamps):
    with devices.open(f"linospad2://{stamps}") as source:
        whole = records_of(source)
    stamps.write_bytes(stamps.read_bytes()[:-10])
    with devices.open(f"linospad2://{stamps}") as source:
        found = records_of(source)
    assert_array_equal(found, whole[whole["cycle"] < 19])
    assert (source.stats.malformed, source.stats.is_balanced, source.stats.unread) == (1, True, 0)
    stamps.write_bytes(b"short")
    with pytest.raises(FileFormatError, match="one cycle takes"):
        devices.open(f"linospad2://{stamps}")
    stamps.unlink()
    with pytest.raises(StorageError, match="no such file"):
        devices.open(f"linospad2://{stamps}")


def test_a_recording_becomes_the_scene(tmp_path, light):
    """Words in a file, a sidecar, a laser's period and a camera: everything that a real board would
    leave.
    """
    board, path = draw_uneven_calibration(9), tmp_path / "run.dat"
    simulated = SimulatedBoard(light, board, LinoSpad2Codec(), 8000, 9)
    path.write_bytes(b"".join(simulated.encode_cycle(number) for number in range(60)))
    light.camera.save(tmp_path / "camera.h5")
    path.with_suffix(".toml").write_text(
        'firmware = "2212b"\ntimestamps_per_cycle = 512\nabsolute_counter = false\n'
        + write_tables(tmp_path, board)
        + 'laser_period_ps = 25000\ncamera = "camera.h5"\n'
    )
    streak = read_transient(f"linospad2://{path}?bins=576")
    figures = score_returns(depth(recover(streak)), light.truth)
    # 0.4 mm with a million photons more; 6 ps or 1 mm is a third of a code.
    assert figures["median_depth_error_m"] < 1e-3
    assert figures["share_within_one_bin"] > 0.9


def test_a_simulations_cycles_are_what_was_asked_for():
    address = "sim+linospad2://?seed=5&cycles=3&photons=2000&counter=1&firmware=2212s"
    with devices.open(address) as source:
        found = records_of(source)
    assert found["cycle"].max() == 2
    assert len(found) == pytest.approx(6000, abs=5 * 80)  # Poisson
    # 4 ms in ticks of 7.5 ns.
    assert np.unique(found["counter"]).tolist() == [0, 533333, 1066667]


def test_a_cycle_that_is_full_keeps_the_first_stamps(light):
    codec, board = LinoSpad2Codec(timestamps=4), draw_uneven_calibration(0)
    data = np.frombuffer(SimulatedBoard(light, board, codec, 256, 1).encode_cycle(0), np.uint8)
    assert 100 < codec.count_records(data) < 256
    nearly_dark = SimulatedBoard(light, board, CODEC, 1e-9, 1)
    assert nearly_dark.encode_cycle(0) == bytes(CODEC.unit_bytes)
