"""Streak images in files as sources."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile
from itex_files import encode_itex

import devices
from devices.transients import read_transient
from tofclip.errors import FileFormatError, InputError, StorageError

TEXT = (
    '[Application],Date="1/2/2023",Software="HPD-TA"[Camera],CameraName="C1",SerialNumber="S/N: 5"'
    '[Scaling],ScalingYUnit="ns",ScalingYScalingFile=""'
)


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    """Six rows of four pixels with a time axis."""
    pixels = np.arange(24, dtype="<u2").reshape(6, 4)
    content = encode_itex(pixels, TEXT, {"Y": np.arange(6, dtype=np.float32) ** 1.5})
    (tmp_path / "shot.img").write_bytes(content)
    return tmp_path / "shot.img"


def test_a_picture_is_one_frame(picture: Path) -> None:
    with devices.open(f"file://{picture}") as source:
        assert (source.is_live, source.is_seekable) == (False, True)
        assert source.stats.unread == 1
        (batch,) = source
        np.testing.assert_array_equal(batch.records["counts"][0], np.arange(24).reshape(6, 4))
        assert source.stats.delivered == 1
        source.seek(0)
        assert source.read() is not None
        source.seek(1)
        assert source.read() is None
        with pytest.raises(InputError, match="no number 2"):
            source.seek(2)
        info, known = source.info.as_dict(), source.calibration
        source.seek(0)
    assert source.read() is None
    assert source.stats.is_balanced
    assert (info["camera"], info["serial"], info["date"]) == ("C1", "S/N: 5", "1/2/2023")
    assert known is not None
    np.testing.assert_allclose(
        known.array("row_times", float, 1, "s"), np.arange(6) ** 1.5 * 1e-9, rtol=1e-6
    )


def test_a_picture_becomes_a_streak_image(picture: Path) -> None:
    streak = read_transient(f"file://{picture}")
    np.testing.assert_array_equal(streak.counts, np.arange(24).reshape(6, 4))
    np.testing.assert_allclose(streak.times, np.arange(6) ** 1.5 * 1e-9, rtol=1e-6)


def test_pictures_without_a_time_axis(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "plain.tif", np.ones((3, 5), np.uint16))
    with devices.open(f"file://{tmp_path}/plain.tif") as source:
        assert source.calibration is None
    assert read_transient(f"file://{tmp_path}/plain.tif", bin_width=1e-12).times[
        2
    ] == pytest.approx(2e-12)


def test_recorded_pictures(shared_data: Path) -> None:
    with devices.open(f"file://{shared_data}/devices/streak/operate_mode.img") as source:
        batch = source.read()
        assert batch is not None
        assert batch.records["counts"].shape == (1, 512, 672)
        assert source.info.details["camera"] == "Orca R2"


def test_what_cannot_be_opened(tmp_path: Path, picture: Path) -> None:
    with pytest.raises(StorageError):
        devices.open(f"file://{tmp_path}/absent.img")
    with pytest.raises(InputError, match="'x' is unknown"):
        devices.open(f"file://{picture}?x=1")
    picture.write_bytes(picture.read_bytes()[:100])
    with pytest.raises(FileFormatError):
        devices.open(f"file://{picture}")
