"""LinoSPAD2's recordings and simulations as sources."""

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
from devices.linospad2 import BoardCalibration, LinoSpad2Codec
from devices.source import Source
from tofclip.camera import Camera
from tofclip.errors import FileFormatError, InputError, ShapeError, StorageError

CODEC = LinoSpad2Codec("2212s", 24, True)
SIDECAR = 'firmware = "2212s"\ntimestamps_per_cycle = 24\nabsolute_counter = true\n'


@pytest.fixture(scope="module")
def light() -> LineLight:
    return simulate_line_light()


@pytest.fixture
def board(light: LineLight) -> SimulatedBoard:
    return SimulatedBoard(light, draw_uneven_calibration(3), CODEC, 300, 3)


@pytest.fixture
def recording(tmp_path: Path, board: SimulatedBoard, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Twenty cycles, read five at a time."""
    monkeypatch.setattr(recordings, "PIECE_BYTES", 5 * CODEC.cycle_bytes)
    path = tmp_path / "run.dat"
    path.write_bytes(b"".join(board.encode_cycle(number) for number in range(20)))
    path.with_suffix(".toml").write_text(SIDECAR)
    return path


def records_of(source: Source) -> NDArray[Any]:
    return np.concatenate([batch.records for batch in source])


@pytest.mark.parametrize("scheme", ["linospad2", "file"])
def test_a_recording_gives_every_stamp(recording: Path, board: SimulatedBoard, scheme: str) -> None:
    expected = CODEC.decode(np.frombuffer(recording.read_bytes(), np.uint8), 0).records
    with devices.open(f"{scheme}://{recording}") as source:
        assert not source.is_live
        assert source.is_seekable
        np.testing.assert_array_equal(records_of(source), expected)
        assert source.read() is None
        assert "not public" in str(source.info.details["limits"])
    assert source.stats.is_balanced
    assert source.stats.delivered == len(expected)
    assert source.read() is None


def test_going_back_and_forth(recording: Path) -> None:
    with devices.open(f"linospad2://{recording}") as source:
        whole = records_of(source)
        for record in (0, 1, len(whole) // 2, len(whole) - 1, len(whole), 3):
            source.seek(record)
            found = list(source)
            if found:
                assert found[0].first == record
            came = np.concatenate([whole[:0], *(batch.records for batch in found)])
            np.testing.assert_array_equal(came, whole[record:])
        for absent in (-1, len(whole) + 1):
            with pytest.raises(InputError):
                source.seek(absent)


def test_a_recording_that_was_cut_off(recording: Path) -> None:
    with devices.open(f"linospad2://{recording}") as source:
        whole = records_of(source)
    recording.write_bytes(recording.read_bytes()[:-10])
    with devices.open(f"linospad2://{recording}") as source:
        found = records_of(source)
    np.testing.assert_array_equal(found, whole[whole["cycle"] < 19])
    assert (source.stats.malformed, source.stats.is_balanced, source.stats.unread) == (1, True, 0)
    recording.write_bytes(b"short")
    with pytest.raises(FileFormatError, match="one cycle takes"):
        devices.open(f"linospad2://{recording}")


def test_what_cannot_be_opened(recording: Path) -> None:
    with pytest.raises(InputError, match="not public"):
        devices.open("linospad2://")
    with pytest.raises(InputError, match="'x' is unknown"):
        devices.open(f"linospad2://{recording}?x=1")
    recording.unlink()
    with pytest.raises(StorageError, match="no such file"):
        devices.open(f"linospad2://{recording}")


def test_a_recordings_calibration_has_laser_and_camera(recording: Path) -> None:
    make_line_instrument().camera.to_record().save(recording.parent / "camera.h5")
    recording.with_suffix(".toml").write_text(
        SIDECAR + 'laser_period_ps = 25000\ncamera = "camera.h5"\n'
    )
    with devices.open(f"linospad2://{recording}") as source:
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
