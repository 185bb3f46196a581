"""Files of photon-counting electronics, written here byte by byte or by the libraries' own writers."""

from __future__ import annotations

import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import devices
from devices import tcspc
from devices.tcspc import PHOTON_DTYPE
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

RESOLUTION = 32e-12
PERIOD = 25e-9


@pytest.fixture
def decays() -> Any:
    """Counts of two channels in 200 bins, (channels, bins)."""
    decay = 20 * np.exp(-np.arange(200) / 30)
    return np.random.default_rng(2).poisson([decay, np.roll(decay, 40)]).astype(np.uint16)


@pytest.fixture
def ptu(tmp_path: Path, decays: Any) -> Path:
    path = tmp_path / "run.ptu"
    image = decays[np.newaxis, np.newaxis, np.newaxis]  # frame, line, pixel, channel, bin
    options = {"global_resolution": PERIOD, "tcspc_resolution": RESOLUTION, "pixel_time": 1e-3}
    ptufile.imwrite(path, image, **options)
    return path


def tag(name: str, kind: int, value: bytes) -> bytes:
    return struct.pack("<32siI8s", name.encode(), -1, kind, value)


def integer(name: str, value: int) -> bytes:
    return tag(name, 0x10000008, struct.pack("<q", value))


def real(name: str, value: float) -> bytes:
    return tag(name, 0x20000008, struct.pack("<d", value))


@pytest.fixture
def phu(tmp_path: Path, decays: Any) -> Path:
    """Header, tags, histograms of uint32."""

    def content(offset: int) -> bytes:
        tags = [
            integer("Measurement_Mode", 0),
            integer("Measurement_SubMode", 1),
            real("MeasDesc_Resolution", RESOLUTION),
            integer("HistoResult_NumberOfCurves", len(decays)),
            integer("HistoResult_BitsPerBin", 32),
        ]
        for number in range(len(decays)):
            for name, value in (
                ("HistResDscr_DataOffset", offset + number * decays.shape[1] * 4),
                ("HistResDscr_HistogramBins", decays.shape[1]),
            ):
                tags.append(struct.pack("<32siIq", name.encode(), number, 0x10000008, value))
        tags.append(tag("Header_End", 0xFFFF0008, bytes(8)))
        return b"PQHISTO\0" + b"1.0".ljust(8, b"\0") + b"".join(tags)

    path = tmp_path / "run.phu"
    path.write_bytes(content(len(content(0))) + decays.astype("<u4").tobytes())
    return path


@pytest.fixture
def sdt(tmp_path: Path, decays: Any) -> Path:
    """One block for each channel."""
    bins = decays.shape[1]
    info = b"*IDENTIFICATION\r\n  ID        : SPC Setup & Data File\r\n  Title     : x\r\n*END\r\n"
    header = np.zeros(1, np.dtype(sdtfile.sdtfile.FILE_HEADER).newbyteorder("<"))
    measurement = np.zeros(1, np.dtype(sdtfile.sdtfile.MEASURE_INFO).newbyteorder("<"))
    block = np.dtype(sdtfile.sdtfile.BLOCK_HEADER).newbyteorder("<")
    measurement["adc_re"], measurement["tac_r"], measurement["tac_g"] = bins, RESOLUTION * bins, 1
    at = header.nbytes + len(info)
    header["revision"], header["chksum"], header["header_valid"] = 0x0F, 0x55AA, 0x5555
    header["info_offs"], header["info_length"] = header.nbytes, len(info)
    header["meas_desc_block_offs"], header["meas_desc_block_length"] = at, measurement.nbytes
    header["no_of_meas_desc_blocks"], header["no_of_data_blocks"] = 1, len(decays)
    at += measurement.nbytes
    header["data_block_offs"], header["data_block_length"] = at, bins * 2
    blocks = b""
    for curve in decays:
        one = np.zeros(1, block)
        one["data_offs"], one["next_block_offs"] = (
            at + block.itemsize,
            at + block.itemsize + bins * 2,
        )
        one["block_length"] = bins * 2
        blocks += one.tobytes() + curve.astype("<u2").tobytes()
        at += block.itemsize + bins * 2
    path = tmp_path / "run.sdt"
    path.write_bytes(header.tobytes() + info + measurement.tobytes() + blocks)
    return path


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


def test_what_cannot_be_read(tmp_path: Path, ptu: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(StorageError, match="no such file"):
        devices.open(f"file://{tmp_path}/absent.sdt")
    (tmp_path / "other.phu").write_bytes(b"something else")
    with pytest.raises(FileFormatError, match="damaged or unsupported"):
        devices.open(f"file://{tmp_path}/other.phu")
    with pytest.raises(InputError, match="'x' is unknown"):
        devices.open(f"file://{ptu}?x=1")
    monkeypatch.setattr(tcspc, "MAX_FILE_BYTES", 100)
    with pytest.raises(FileFormatError, match="larger than 100 bytes"):
        devices.open(f"file://{ptu}")
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "ptufile", None)
    with pytest.raises(MissingDependencyError, match=r"install tofclip\[tcspc\]"):
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
        tcspc._make_histogram_records(curves, resolution, "", Path("run.sdt"))
