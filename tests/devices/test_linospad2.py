"""LinoSPAD2's words, against words put together by hand, and its calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from numpy.typing import NDArray

from devices.linospad2 import (
    CODES_PER_PERIOD,
    FIRMWARES,
    MAX_TIMESTAMPS,
    BoardCalibration,
    LinoSpad2Codec,
    load_calibration,
    read_sidecar,
)
from devices.registry import build_codec
from devices.source import Records, as_bytes
from tofclip.errors import FileFormatError, InputError, ShapeError, StorageError
from tofclip.threads import THREADS_VARIABLE

unhurried = settings(deadline=None)  # the first call compiles

codecs = st.builds(LinoSpad2Codec, st.sampled_from(FIRMWARES), st.integers(1, 6), st.booleans())


@st.composite
def streams(draw: st.DrawFn) -> tuple[LinoSpad2Codec, Records]:
    """A codec and time stamps that its stream can hold."""
    codec = draw(codecs)
    seed = draw(st.integers(0, 2**32 - 1))
    random = np.random.default_rng(seed)
    records = np.zeros(draw(st.integers(0, 300)), codec.dtype)
    records["cycle"] = random.integers(0, 5, len(records))
    records["pixel"] = random.integers(0, 256, len(records))
    records["code"] = random.integers(0, 1 << 28, len(records))
    if codec.counter:
        records["counter"] = random.integers(0, 1 << 63, 5, dtype=np.uint64)[records["cycle"]]
    records = codec.sort_stamps(records)
    queue = records["cycle"].astype(int) * 64 + codec.address_of[records["pixel"]] // 4
    first = np.searchsorted(queue, queue)
    return codec, records[np.arange(len(records)) - first < codec.timestamps]


def words(codec: LinoSpad2Codec, cycles: int) -> NDArray[Any]:
    return np.zeros((cycles, codec.cycle_words), "<u4")


@unhurried
@given(streams())
def test_decoding_gives_back_what_was_encoded(stream: tuple[LinoSpad2Codec, Records]) -> None:
    codec, records = stream
    data = as_bytes(codec.encode(records))
    found = codec.decode(data, codec.start)
    assert found.malformed == 0
    assert found.records.dtype == codec.dtype
    np.testing.assert_array_equal(found.records, records)
    assert codec.count_records(data) == len(records)
    assert codec.count_complete_bytes(data) == len(data)


@unhurried
@given(streams(), st.data())
def test_a_stream_may_be_cut_between_cycles(
    stream: tuple[LinoSpad2Codec, Records], data: st.DataObject
) -> None:
    codec, records = stream
    whole = as_bytes(codec.encode(records))
    cut = codec.count_complete_bytes(whole[: data.draw(st.integers(0, len(whole)))])
    first = codec.decode(whole[:cut], codec.start)
    second = codec.decode(whole[cut:], first.state)
    np.testing.assert_array_equal(np.concatenate([first.records, second.records]), records)


@pytest.mark.parametrize(
    ("firmware", "converter", "address", "pixel"),
    [
        ("2212b", 0, 3, 3),
        ("2212b", 63, 1, 253),
        ("2212b", 5, 0, 20),
        ("2212s", 0, 3, 192),
        ("2212s", 63, 1, 127),
    ],
)
def test_words_written_by_hand(firmware: str, converter: int, address: int, pixel: int) -> None:
    codec = LinoSpad2Codec(firmware, timestamps=3)
    stream = words(codec, 2)
    stream[1, converter * 3 + 2] = 1 << 31 | address << 28 | 1234567
    stream[1, converter * 3 + 1] = 0x7FFFFFFF  # bit 31 says that there is none
    found = codec.decode(as_bytes(stream.tobytes()), 10)
    assert found.records.tolist() == [(11, 1234567, pixel)]
    assert (found.malformed, found.state) == (0, 12)


def test_the_absolute_counter_is_two_words_low_first() -> None:
    codec = LinoSpad2Codec(timestamps=2, counter=True)
    stream = words(codec, 1)
    stream[0, :3] = [0x89ABCDEF, 0x01234567, 1 << 31 | 7]
    found = codec.decode(as_bytes(stream.tobytes()), 0).records
    assert found["counter"].tolist() == [0x0123456789ABCDEF]
    assert (found["code"].tolist(), found["pixel"].tolist()) == ([7], [0])


def test_stamps_of_the_converter_without_pixels_are_malformed() -> None:
    codec = LinoSpad2Codec(timestamps=4)
    stream = words(codec, 3)
    stream[1, 0] = stream[2, 64 * 4 : 64 * 4 + 2] = 1 << 31 | 5
    data = as_bytes(stream.tobytes())
    found = codec.decode(data, 0)
    assert (len(found.records), found.malformed, codec.count_records(data)) == (1, 2, 3)


def test_threads_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    codec = LinoSpad2Codec(timestamps=20)
    stream = (
        np.random.default_rng(1)
        .integers(0, 1 << 32, (1500, codec.cycle_words), dtype=np.uint64)
        .astype("<u4")
    )
    data = as_bytes(stream.tobytes())
    monkeypatch.setenv(THREADS_VARIABLE, "1")
    alone = codec.decode(data, 0)
    monkeypatch.setenv(THREADS_VARIABLE, "3")
    together = codec.decode(data, 0)
    np.testing.assert_array_equal(together.records, alone.records)
    assert together.malformed == alone.malformed == np.count_nonzero(stream[:, 64 * 20 :] >> 31)
    assert len(alone.records) == np.count_nonzero(stream[:, : 64 * 20] >> 31)


def test_the_codec_is_built_again_from_its_settings() -> None:
    codec = LinoSpad2Codec("2212s", 20, True)
    assert build_codec("linospad2", codec.settings) == codec


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("2208",), "2212b or 2212s"),
        (("2212b", 0), "1..16384"),
        (("2212b", MAX_TIMESTAMPS + 1), "1..16384"),
    ],
)
def test_impossible_settings_are_refused(arguments: tuple[Any, ...], problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        LinoSpad2Codec(*arguments)


def test_half_a_cycle_is_refused() -> None:
    with pytest.raises(InputError, match="whole number"):
        LinoSpad2Codec().decode(np.zeros(9, np.uint8), 0)


@pytest.mark.parametrize(
    ("rows", "problem"),
    [
        ([(0, 1, 256)], "pixel below 256"),
        ([(0, 1 << 28, 0)], "code below"),
        ([(1, 1, 0), (0, 1, 0)], "in order"),
        ([(0, 1, 9), (0, 1, 0)], "in order"),
        ([(0, 1, 0), (0, 2, 1), (0, 3, 2)], "more time stamps"),
        ([(1 << 31, 1, 0)], "in pieces"),
    ],
)
def test_stamps_that_no_stream_holds(rows: list[tuple[int, int, int]], problem: str) -> None:
    codec = LinoSpad2Codec(timestamps=2)
    with pytest.raises(InputError, match=problem):
        codec.encode(np.array(rows, codec.dtype))


def test_a_cycle_has_one_counter() -> None:
    codec = LinoSpad2Codec(counter=True)
    with pytest.raises(InputError, match="same counter"):
        codec.encode(np.array([(5, 0, 1, 0), (6, 0, 1, 0)], codec.dtype))
    with pytest.raises(InputError, match="one-dimensional array"):
        LinoSpad2Codec().encode(np.array([(5, 0, 1, 0)], codec.dtype))


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
