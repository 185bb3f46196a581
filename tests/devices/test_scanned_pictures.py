"""Pictures in files of photon counters: PTU with markers of lines and frames, in T2 and T3 mode, and
SDT.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tcspc_files
from tcspc_files import T2_TICK

from tofclip.errors import FileFormatError
from tofclip.io.tcspc import Checkpoint, PtuEvents
from tofclip.lidar.photons.files import describe_photons, read_photons

ptufile = pytest.importorskip("ptufile")
pytest.importorskip("sdtfile")

ROWS, COLUMNS, FRAMES = 5, 7, 3
PERIOD_TICKS, PIXEL_TICKS = 50_000, 200_000
SCAN: dict[str, float] = {
    "ImgHdr_Dimensions": 3,
    "ImgHdr_PixX": COLUMNS,
    "ImgHdr_PixY": ROWS,
    "ImgHdr_LineStart": 1,
    "ImgHdr_LineStop": 2,
    "ImgHdr_Frame": 3,
}


@pytest.fixture
def scan() -> dict[str, Any]:
    """Pulses, markers and photons of three frames, with a return of the scanner after each line, and
    the true pixel and delay of each photon in a line.
    """
    random = np.random.default_rng(5)
    line = COLUMNS * PIXEL_TICKS
    begin = 30_000 + np.arange(FRAMES * ROWS) * (line + 400_000)
    pulses = np.arange(0, begin[-1] + line + 500_000, PERIOD_TICKS)
    markers = np.concatenate(
        [
            np.stack([begin[::ROWS] - 20_000, np.full(FRAMES, 4)], axis=1),
            np.stack([begin, np.full(len(begin), 1)], axis=1),
            np.stack([begin + line, np.full(len(begin), 2)], axis=1),
        ]
    )
    time = np.sort(random.integers(1, pulses[-1], 4000))
    time = time[time % PERIOD_TICKS != 0]  # not with a pulse: which comes first would be chance
    own = np.searchsorted(begin, time, "right") - 1
    inside = (own >= 0) & (time < begin[own] + line) & ~np.isin(time, markers[:, 0])
    return {
        "pulses": pulses,
        "markers": markers,
        "photons": np.stack([time, random.integers(0, 2, len(time))], axis=1),
        "y": own[inside] % ROWS,
        "x": (time - begin[own])[inside] // PIXEL_TICKS,
        "delay": time[inside] % PERIOD_TICKS,
    }


def write_scan(path: Path, scan: dict[str, Any], **tags: float) -> None:
    tcspc_files.write_ptu_t2(
        path, scan["pulses"], scan["photons"], scan["markers"], {**SCAN, **tags}
    )


def make_cube(scan: dict[str, Any], x: Any, bin_ticks: int) -> Any:
    cube = np.zeros((ROWS, COLUMNS, PERIOD_TICKS // bin_ticks), int)
    np.add.at(cube, (scan["y"], x, scan["delay"] // bin_ticks), 1)
    return cube


@pytest.mark.parametrize("chunk", [333, 1 << 20])
@pytest.mark.parametrize("dwell_ms", [0.0, PIXEL_TICKS * T2_TICK * 1e3])
def test_markers_make_a_picture_of_a_file_in_t2_mode(
    tmp_path: Path,
    scan: dict[str, Any],
    dwell_ms: float,
    chunk: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Pixels by the markers where lines begin and end, or by the dwell time that the file gives."""
    monkeypatch.setattr("tofclip.io.tcspc.CHUNK_EVENTS", chunk)
    write_scan(tmp_path / "scan.ptu", scan, ImgHdr_TimePerPixel=dwell_ms)
    found = read_photons(tmp_path / "scan.ptu")
    assert found.image_shape == (ROWS, COLUMNS)
    assert found.bin_width == T2_TICK
    np.testing.assert_array_equal(
        np.bincount(found.pixel, minlength=ROWS * COLUMNS).reshape(ROWS, COLUMNS),
        make_cube(scan, scan["x"], PERIOD_TICKS)[..., 0],
    )
    order = np.lexsort((scan["delay"], scan["y"] * COLUMNS + scan["x"]))
    np.testing.assert_allclose(
        found.bin[np.lexsort((found.bin, found.pixel))], scan["delay"][order], atol=0.01
    )
    described = describe_photons(tmp_path / "scan.ptu")
    assert described["layout"] == "events"
    assert described["arrays"]["x"] == f"{len(scan['x'])} uint16"


def test_every_other_line_of_a_scan_both_ways_is_turned(
    tmp_path: Path, scan: dict[str, Any]
) -> None:
    write_scan(tmp_path / "scan.ptu", scan, ImgHdr_BiDirect=1)
    found = read_photons(tmp_path / "scan.ptu")
    turned = np.where(scan["y"] % 2, COLUMNS - 1 - scan["x"], scan["x"])
    np.testing.assert_array_equal(
        np.bincount(found.pixel, minlength=ROWS * COLUMNS).reshape(ROWS, COLUMNS),
        make_cube(scan, turned, PERIOD_TICKS)[..., 0],
    )


@pytest.mark.parametrize(
    ("tags", "said"),
    [
        ({"ImgHdr_PixX": 0}, "a picture of 5 x 0 pixels"),
        ({"ImgHdr_SinCorrection": 80}, "scanned in a sine"),
        ({"ImgHdr_LineStart": 4}, "no markers where lines begin"),
        ({"ImgHdr_LineStop": 4}, "no markers where lines end"),
    ],
)
def test_scans_that_cannot_be_put_together(
    tmp_path: Path, scan: dict[str, Any], tags: dict[str, float], said: str
) -> None:
    write_scan(tmp_path / "scan.ptu", scan, **tags)
    with pytest.raises(FileFormatError, match=said):
        read_photons(tmp_path / "scan.ptu")


def test_a_picture_in_t3_mode(tmp_path: Path) -> None:
    cube = np.random.default_rng(1).poisson(2, (2, 3, 4, 2, 60)).astype(np.uint16)
    ptufile.imwrite(
        tmp_path / "t3.ptu",
        cube,
        global_resolution=25e-9,
        tcspc_resolution=32e-12,
        pixel_time=1e-4,
    )
    found = read_photons(tmp_path / "t3.ptu")
    assert found.image_shape == (3, 4)
    assert found.count.sum() == cube.sum()
    per_pixel = np.bincount(found.pixel, found.count, 12).reshape(3, 4)
    np.testing.assert_array_equal(per_pixel, cube.sum(axis=(0, 3, 4)))


@pytest.mark.parametrize("channels", [1, 3])
def test_pictures_of_an_sdt_keep_their_shape(tmp_path: Path, channels: int) -> None:
    cube = np.random.default_rng(1).poisson(2, (channels, 4, 6, 50)).astype(np.uint16)
    tcspc_files.write_sdt(tmp_path / "image.sdt", cube)
    found = read_photons(tmp_path / "image.sdt")
    assert found.image_shape == (4, 6)
    assert found.bin_width == pytest.approx(tcspc_files.RESOLUTION)
    per_pixel = np.bincount(found.pixel, found.count, 24).reshape(4, 6)
    np.testing.assert_array_equal(per_pixel, cube.sum(axis=(0, 3)))


def test_events_beyond_2_gib(tmp_path: Path) -> None:
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
    np.testing.assert_array_equal(last.delay[-len(photons) :], expected.delay)
    np.testing.assert_array_equal(last.channel[-len(photons) :], expected.channel)
