"""LinoSPAD2's calibration, and its recordings and simulations as sources."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import devices
from devices import linospad2 as recordings
from devices.emulation.linospad2 import SimulatedBoard, draw_uneven_calibration
from devices.emulation.scenes import LineLight, make_line_instrument, simulate_line_light
from devices.histogram import BinAxis, StampHistogram
from devices.linospad2 import (
    CODES_PER_PERIOD,
    BoardCalibration,
    LinoSpad2Codec,
    load_calibration,
    read_sidecar,
)
from devices.source import Source
from tofclip.camera import Camera
from tofclip.errors import FileFormatError, InputError, ShapeError, StorageError


@pytest.fixture
def uneven() -> BoardCalibration:
    """Codes of random widths that fill the period, random offsets, two hot pixels."""
    random = np.random.default_rng(7)
    ends = np.cumsum(random.uniform(0.2, 2, (256, CODES_PER_PERIOD)), axis=1)
    return BoardCalibration(
        ends * (2500e-12 / ends[:, -1:]), random.uniform(-6e-9, 4e-9, 256), np.array([15, 231])
    )


def test_times_follow_the_formula(uneven: BoardCalibration) -> None:
    records = np.zeros(1000, LinoSpad2Codec().dtype)
    random = np.random.default_rng(2)
    records["pixel"], records["code"] = (
        random.integers(0, 256, 1000),
        random.integers(0, 1 << 28, 1000),
    )
    expected = [
        (code - code % 140) * 2500 / 140
        + uneven.code_ends[pixel, code % 140] * 1e12
        + uneven.offsets[pixel] * 1e12
        for _, code, pixel in records.tolist()
    ]
    # float64 resolves 5 ms to 1e-18 s; the table's own digits were multiplied by 1e12 and back.
    np.testing.assert_allclose(
        uneven.times(records), np.array(expected) * 1e-12, atol=1e-16, rtol=1e-14
    )


def test_recorded_boards(shared_data: Path) -> None:
    folder = shared_data / "devices" / "linospad2"
    for board, hot in (("NL11_#33_2212b", 66), ("B7d_#28_2212s", 37)):
        mask = folder / f"mask_{board.rsplit('_', 1)[0]}.txt"
        found = load_calibration(folder / f"TDC_{board}.csv", folder / f"Offset_{board}.npy", mask)
        np.testing.assert_allclose(found.code_ends[:, -1].max(), 2500e-12, rtol=1e-12)
        assert hot in found.hot_pixels
        raw = np.loadtxt(folder / f"TDC_{board}.csv", delimiter=",", skiprows=1)
        offset = np.load(folder / f"Offset_{board}.npy")
        records = np.array([(0, 140 * 7 + 93, 100)], LinoSpad2Codec().dtype)
        expected = 7 * 2500 + raw[100, 94] + offset[100]
        np.testing.assert_allclose(found.times(records) * 1e12, [expected], rtol=1e-12)


def test_a_calibration_survives_storage(uneven: BoardCalibration, tmp_path: Path) -> None:
    for board in (uneven, BoardCalibration.ideal()):
        board.to_record().save(tmp_path / "board.h5")
        found = BoardCalibration.from_record(type(board.to_record()).load(tmp_path / "board.h5"))
        np.testing.assert_array_equal(found.code_ends, board.code_ends)
        np.testing.assert_array_equal(found.offsets, board.offsets)
        np.testing.assert_array_equal(found.hot_pixels, board.hot_pixels)


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
def test_impossible_tables_are_refused(
    uneven: BoardCalibration, change: dict[str, Any], problem: str
) -> None:
    arguments = {"code_ends": uneven.code_ends, "offsets": uneven.offsets, **change}
    with pytest.raises((ShapeError, InputError), match=problem):
        BoardCalibration(**arguments)


@pytest.fixture
def recording(tmp_path: Path, uneven: BoardCalibration) -> Path:
    """A recording's name, with all its companions; the recording itself is not needed here."""
    table = np.column_stack([np.arange(256), uneven.code_ends * 1e12])
    header = "," + ",".join(map(str, range(140)))
    np.savetxt(tmp_path / "codes.csv", table, delimiter=",", header=header, comments="")
    np.save(tmp_path / "offsets.npy", uneven.offsets * 1e12)
    (tmp_path / "hot.txt").write_text("15\n231\n")
    return tmp_path / "run.dat"


NEEDED = 'firmware = "2212s"\ntimestamps_per_cycle = 20\nabsolute_counter = true\n'


def test_a_complete_sidecar(recording: Path, uneven: BoardCalibration) -> None:
    recording.with_suffix(".toml").write_text(
        NEEDED
        + 'board = "B7d"\ncode_table = "codes.csv"\noffset_table = "offsets.npy"\nhot_pixels = "hot.txt"\n'
        'laser_period_ps = 25000\ncamera = "camera.h5"\n'
    )
    found = read_sidecar(recording)
    assert found.codec == LinoSpad2Codec("2212s", 20, True)
    np.testing.assert_allclose(
        found.calibration.code_ends, uneven.code_ends, rtol=1e-15, atol=1e-24
    )
    assert found.calibration.hot_pixels.tolist() == [15, 231]
    assert (found.board, found.camera) == ("B7d", "camera.h5")
    assert found.laser_period == pytest.approx(25e-9, rel=1e-12)


def test_the_least_sidecar_means_an_ideal_board(recording: Path) -> None:
    recording.with_suffix(".toml").write_text(NEEDED)
    found = read_sidecar(recording)
    np.testing.assert_array_equal(found.calibration.code_ends, BoardCalibration.ideal().code_ends)
    assert (found.laser_period, found.camera) == (None, "")


def test_a_recording_without_a_sidecar_is_refused(recording: Path) -> None:
    with pytest.raises(
        StorageError, match=r"firmware, timestamps_per_cycle, absolute_counter into run\.toml"
    ):
        read_sidecar(recording)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("firmware = ", "is not TOML"),
        ("\xff", "lacks the key|is not TOML"),
        ('firmware = "2212s"\n', "lacks the key 'timestamps_per_cycle'"),
        (NEEDED + "speed = 3\n", "unknown key 'speed'"),
        (NEEDED.replace("20", '"20"'), "timestamps_per_cycle must be a int"),
        (NEEDED.replace("20", "true"), "timestamps_per_cycle must be a int"),
        (NEEDED.replace("20", "0"), "1..16384"),
        (NEEDED.replace("2212s", "x"), "2212b or 2212s"),
        (NEEDED + 'code_table = "codes.csv"\n', "belong together"),
        (NEEDED + 'hot_pixels = "hot.txt"\n', "needs code_table"),
        (
            NEEDED + 'code_table = "hot.txt"\noffset_table = "offsets.npy"\n',
            "must have 141 columns",
        ),
        (NEEDED + 'code_table = "codes.csv"\noffset_table = "hot.txt"\n', "holds no table"),
        (NEEDED + "laser_period_ps = -1.0\n", "must be a positive number"),
        (NEEDED + "laser_period_ps = nan\n", "must be a positive number"),
        ("#" * 70000, "larger than any description"),
    ],
)
def test_sidecars_that_say_nothing_useful(recording: Path, text: str, problem: str) -> None:
    recording.with_suffix(".toml").write_text(text)
    with pytest.raises(FileFormatError, match=problem):
        read_sidecar(recording)


@pytest.mark.parametrize("shape", [b"(9256000000000,), }", b"(256,            }"])
def test_a_table_whose_header_lies(recording: Path, shape: bytes) -> None:
    """It claims more than the file holds, or is cut off."""
    path = recording.parent / "offsets.npy"
    path.write_bytes(path.read_bytes().replace(b"(256,), }".ljust(len(shape)), shape))
    with pytest.raises(FileFormatError, match="holds no table of numbers"):
        load_calibration(recording.parent / "codes.csv", path)


@pytest.mark.parametrize(
    ("text", "problem"), [("15\n256", "beyond"), ("1e400", "no table"), ("9" * 30, "beyond")]
)
def test_hot_pixels_that_are_none(recording: Path, text: str, problem: str) -> None:
    folder = recording.parent
    (folder / "hot.txt").write_text(text)
    with pytest.raises(FileFormatError, match=problem):
        load_calibration(folder / "codes.csv", folder / "offsets.npy", folder / "hot.txt")
    (folder / "hot.txt").write_text("")
    found = load_calibration(folder / "codes.csv", folder / "offsets.npy", folder / "hot.txt")
    assert found.hot_pixels.size == 0


def test_companions_that_are_absent_or_too_large(recording: Path) -> None:
    recording.with_suffix(".toml").write_text(
        NEEDED + 'code_table = "absent"\noffset_table = "offsets.npy"\n'
    )
    with pytest.raises(StorageError, match="absent: no such file"):
        read_sidecar(recording)
    with open(recording.parent / "codes.csv", "wb") as file:
        file.truncate(1 << 30)
    with pytest.raises(FileFormatError, match="larger than any table"):
        load_calibration(recording.parent / "codes.csv", recording.parent / "offsets.npy")


CODEC = LinoSpad2Codec("2212s", 24, True)
SIDECAR = 'firmware = "2212s"\ntimestamps_per_cycle = 24\nabsolute_counter = true\n'


@pytest.fixture(scope="module")
def light() -> LineLight:
    return simulate_line_light()


@pytest.fixture
def board(light: LineLight) -> SimulatedBoard:
    return SimulatedBoard(light, draw_uneven_calibration(3), CODEC, 300, 3)


@pytest.fixture
def stamps(tmp_path: Path, board: SimulatedBoard, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Twenty cycles, read five at a time."""
    monkeypatch.setattr(recordings, "PIECE_BYTES", 5 * CODEC.cycle_bytes)
    path = tmp_path / "run.dat"
    path.write_bytes(b"".join(board.encode_cycle(number) for number in range(20)))
    path.with_suffix(".toml").write_text(SIDECAR)
    return path


def records_of(source: Source) -> NDArray[Any]:
    return np.concatenate([batch.records for batch in source])


@pytest.mark.parametrize("scheme", ["linospad2", "file"])
def test_a_recording_gives_every_stamp(stamps: Path, board: SimulatedBoard, scheme: str) -> None:
    expected = CODEC.decode(np.frombuffer(stamps.read_bytes(), np.uint8), 0).records
    with devices.open(f"{scheme}://{stamps}") as source:
        assert not source.is_live
        assert source.is_seekable
        np.testing.assert_array_equal(records_of(source), expected)
        assert source.read() is None
        assert "not public" in str(source.info.details["limits"])
    assert source.stats.is_balanced
    assert source.stats.delivered == len(expected)
    assert source.read() is None


def test_a_recording_that_was_cut_off(stamps: Path) -> None:
    with devices.open(f"linospad2://{stamps}") as source:
        whole = records_of(source)
    stamps.write_bytes(stamps.read_bytes()[:-10])
    with devices.open(f"linospad2://{stamps}") as source:
        found = records_of(source)
    np.testing.assert_array_equal(found, whole[whole["cycle"] < 19])
    assert (source.stats.malformed, source.stats.is_balanced, source.stats.unread) == (1, True, 0)
    stamps.write_bytes(b"short")
    with pytest.raises(FileFormatError, match="one cycle takes"):
        devices.open(f"linospad2://{stamps}")


def test_recordings_that_cannot_be_opened(stamps: Path) -> None:
    with pytest.raises(InputError, match="not public"):
        devices.open("linospad2://")
    with pytest.raises(InputError, match="'x' is unknown"):
        devices.open(f"linospad2://{stamps}?x=1")
    stamps.unlink()
    with pytest.raises(StorageError, match="no such file"):
        devices.open(f"linospad2://{stamps}")


def test_a_recordings_calibration_has_laser_and_camera(stamps: Path) -> None:
    make_line_instrument().camera.to_record().save(stamps.parent / "camera.h5")
    stamps.with_suffix(".toml").write_text(
        SIDECAR + 'laser_period_ps = 25000\ncamera = "camera.h5"\n'
    )
    with devices.open(f"linospad2://{stamps}") as source:
        known = source.calibration
    assert known is not None
    assert known.attribute("laser_period_s") == pytest.approx(25e-9)
    assert Camera.from_record(known.child("camera", "camera")).slit_width_px == 256


def test_a_simulation_is_the_same_again() -> None:
    found = []
    for _ in range(2):
        with devices.open(
            "sim+linospad2://?seed=5&cycles=3&photons=2000&counter=1&firmware=2212s"
        ) as source:
            found.append(records_of(source))
            assert source.stats.is_balanced
    np.testing.assert_array_equal(found[0], found[1])
    assert found[0]["cycle"].max() == 2
    assert len(found[0]) == pytest.approx(6000, abs=5 * 80)  # Poisson
    # 4 ms in ticks of 7.5 ns.
    assert np.unique(found[0]["counter"]).tolist() == [0, 533333, 1066667]


def test_the_light_comes_back_out_of_the_words(light: LineLight) -> None:
    """Through uneven codes and pixels out of step, the histogram is the scene's own streak image,
    up to its noise.
    """
    with devices.open("sim+linospad2://?seed=2&cycles=60") as source:
        known = source.calibration
        assert known is not None
        axis = BinAxis(20e-12, len(light.row_times), 0.0, 25e-9)
        histogram = StampHistogram(axis, BoardCalibration.from_record(known))
        for batch in source:
            histogram.add(batch.records)
    counts = histogram.counts
    expected = light.photons * (counts.sum() / light.photons.sum())
    assert counts.sum() == pytest.approx(60 * 6000, rel=0.01)
    # A photon's place is known to about a code, 18 ps: edges are softer than the light's own, sums
    # over 3 rows are not.
    rows = len(expected) // 3
    coarse, wanted = (
        values[: rows * 3].reshape(rows, 3, 256).sum(axis=1) for values in (counts, expected)
    )
    bright = wanted > 20
    assert np.corrcoef(coarse[bright], wanted[bright])[0, 1] > 0.98
    centre = (coarse * np.arange(rows)[:, None]).sum(axis=0) / coarse.sum(axis=0)
    truth = (wanted * np.arange(rows)[:, None]).sum(axis=0) / wanted.sum(axis=0)
    # Some 1400 photons in each pixel, spread over a few hundred rows by the background.
    assert np.median(np.abs(centre - truth)) < 3


def test_a_cycle_that_is_full_keeps_the_first_stamps(light: LineLight) -> None:
    crowded = SimulatedBoard(
        light, draw_uneven_calibration(0), LinoSpad2Codec(timestamps=4), 256, 1
    )
    data = np.frombuffer(crowded.encode_cycle(0), np.uint8)
    assert 100 < LinoSpad2Codec(timestamps=4).count_records(data) < 256
    nearly_dark = SimulatedBoard(light, draw_uneven_calibration(0), CODEC, 1e-9, 1)
    assert nearly_dark.encode_cycle(0) == bytes(CODEC.cycle_bytes)


def test_in_real_time_a_cycle_takes_its_time() -> None:
    simulate_line_light()  # kept, so that opening takes no time
    began = time.monotonic()
    with devices.open("sim+linospad2://?cycles=30&photons=10&timestamps=4&pace=realtime") as source:
        records_of(source)
        assert time.monotonic() - began > 29 * 4e-3


@pytest.mark.parametrize(
    "query",
    ["seed=-1", "cycles=-1", "photons=0", "photons=1e9", "firmware=1", "timestamps=0", "x=1"],
)
def test_simulations_that_cannot_be(query: str) -> None:
    with pytest.raises(InputError):
        devices.open(f"sim+linospad2://?{query}")


def test_a_board_needs_its_own_number_of_pixels(light: LineLight) -> None:
    with pytest.raises(ShapeError):
        SimulatedBoard(
            replace(light, photons=np.ones((5, 3))), draw_uneven_calibration(0), CODEC, 5, 0
        )
