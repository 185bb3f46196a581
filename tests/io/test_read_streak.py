"""Every format through the one door, and everything that must not pass it."""

import hashlib

import numpy as np
import pytest
import tifffile

from tofclip.camera import Camera
from tofclip.errors import (
    FileFormatError,
    InputError,
    MissingTimeAxisError,
    StorageError,
)
from tofclip.io import read_streak
from tofclip.shots import Frames, Streak


@pytest.fixture
def plain(tmp_path):
    """Write a TIFF as any other program would."""

    def write(picture, **options):
        tifffile.imwrite(tmp_path / "plain.tif", picture, **options)
        return tmp_path / "plain.tif"

    return write


def test_hpdta_counts_and_text(write_hpdta, pixels):
    streak = read_streak(write_hpdta(np.arange(20)))
    # Raw counts: the camera's offset of 100 is known from the text and still in the picture.
    np.testing.assert_array_equal(streak.counts, pixels)
    assert streak.counts.dtype == np.float32
    expected = {
        "Streak camera/Time Range": "20 ns",
        "Acquisition/ExposureTime": "300 ms",
        "Camera/Prop_ConversionFactorOffset": "100",
        "Application/Date": "5/2/2021",
        "DateTime": "2021:05:02 20:49:12",
    }
    assert expected.items() <= streak.metadata.items()


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "uint32", "int16", "float32", "float64"])
@pytest.mark.parametrize(
    "options",
    [{}, {"byteorder": ">"}, {"rowsperstrip": 3}, {"compression": "zlib"}],
    ids=["", "big", "strips", "zip"],
)
def test_plain_tiff_has_counts_and_no_time_axis(plain, dtype, options):
    picture = (np.arange(120).reshape(10, 12) + 1).astype(dtype)
    streak = read_streak(plain(picture, **options))
    np.testing.assert_array_equal(streak.counts, picture)
    with pytest.raises(MissingTimeAxisError):
        _ = streak.times
    assert (streak.saturated is None) == dtype.startswith("float")
    np.testing.assert_allclose(
        read_streak(streak.source, bin_width=5e-12).times, np.arange(10) * 5e-12, rtol=1e-15
    )


@pytest.mark.parametrize(
    ("picture", "fault", "problem"),
    [
        (np.zeros((4, 5), np.uint16), InputError, "every pixel is zero"),
        (np.full((4, 5), 255, np.uint8), InputError, "every pixel is saturated at 255 counts"),
        (np.array([[1.0, np.nan], [np.inf, 2.0]]), InputError, "2 pixels are NaN or infinite"),
        (np.full((4, 5), 1e300), InputError, "20 pixels are NaN or infinite"),
        (np.array([[1, -2], [-3, 4]], np.int16), InputError, "2 pixels are negative"),
        (np.ones((4, 5, 3), np.uint8), FileFormatError, "expected grey"),
        (np.ones((4, 5), np.complex64), FileFormatError, "expected grey"),
        (np.ones((3, 4, 5), np.uint16), FileFormatError, "holds 3 pictures"),
    ],
    ids=["zero", "saturated", "nan", "overflow", "negative", "colour", "complex", "pages"],
)
def test_unusable_pictures_are_refused(plain, picture, fault, problem):
    options = {"photometric": "rgb"} if picture.shape[-1] == 3 else {"photometric": "minisblack"}
    with pytest.raises(fault, match=rf"plain\.tif.*{problem}"):
        read_streak(plain(picture, **options))


@pytest.mark.parametrize(
    "content", [b"", b"hello, this is no picture", b"PK\x03\x04rest", b"II*\0", b"%PDF-1.4"]
)
@pytest.mark.parametrize("name", ["a.tif", "a.npz", "a.h5", "a"])
def test_other_files_are_refused_whatever_they_are_called(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FileFormatError, match="is empty" if not content else "is "):
        read_streak(tmp_path / name)


@pytest.mark.parametrize("bin_width", [0, -1e-12, np.nan, np.inf])
def test_an_impossible_bin_width_is_refused(plain, bin_width):
    with pytest.raises(InputError, match="bin width must be a positive number of seconds"):
        read_streak(plain(np.ones((4, 5), np.uint16)), bin_width=bin_width)


def claim_too_much(path):
    tifffile.imwrite(path, np.ones((4, 5), np.uint16))
    with tifffile.TiffFile(path, mode="r+") as tiff:
        for name in ("ImageLength", "ImageWidth"):
            tiff.pages.first.tags[name].overwrite(2**31 - 1)


def break_off(path):
    with tifffile.TiffWriter(path) as writer:
        for _ in range(64):
            writer.write(np.ones((20, 30), np.uint16), metadata=None, contiguous=False)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def write_frames(path):
    camera, values = Camera([5.0], [0.0], (3, 4), 10), np.ones((2, 3, 4), np.float32)
    Frames(values, np.array([0.0, 1e-12]), camera).to_record().save(path.with_suffix(".h5"))
    path.with_suffix(".h5").rename(path)


@pytest.mark.parametrize(
    ("make", "fault", "problem"),
    [
        (claim_too_much, FileFormatError, "claims an impossible size"),
        (break_off, FileFormatError, "is truncated: its picture 32 is missing"),
        (write_frames, FileFormatError, "holds a frames record, expected streak"),
        (lambda path: None, StorageError, r"shot\.tif: no such file"),
        (lambda path: path.mkdir(), StorageError, "is a folder"),
    ],
)
def test_files_that_are_no_streak_image_are_refused(tmp_path, make, fault, problem):
    make(tmp_path / "shot.tif")
    with pytest.raises(fault, match=problem):
        read_streak(tmp_path / "shot.tif")


def test_our_own_file_is_known_whatever_its_name(tmp_path, pixels):
    past = {"settings": {"a": 1}}
    Streak(pixels, 20e-12 * np.arange(20), provenance=past).save(tmp_path / "without_suffix")
    got = read_streak(tmp_path / "without_suffix")
    np.testing.assert_array_equal(got.counts, pixels)
    assert got.provenance["earlier"] == past


def test_provenance_names_file_and_bin_width(plain):
    path = plain(np.ones((4, 5), np.uint16))
    found, digest = read_streak(path, bin_width=2e-11).provenance, hashlib.sha256(path.read_bytes())
    assert found["settings"] == {"bin_width_s": 2e-11}
    assert found["inputs"] == [{"name": "plain.tif", "sha256": digest.hexdigest()}]


def test_recorded_flash_lidar_shot(shared_data):
    """Known of this shot: 1008 rows, from 18.78 ps each at the start to 20.49 ps at the end, 19.41
    ps on average.
    """
    streak = read_streak(shared_data / "clip" / "scene5.tif")
    assert streak.counts.shape == (1008, 1344)
    steps = np.diff(streak.times)
    # Half of the last known digit, and the five rows that the shot leaves out at the slow end.
    np.testing.assert_allclose([steps[0], steps.mean()], [18.78e-12, 19.41e-12], atol=0.005e-12)
    assert 20.47e-12 < steps[-1] < 20.495e-12
    assert streak.times[0] == pytest.approx(4 * 18.78e-12, rel=1e-3)
    assert streak.metadata["Streak camera/Time Range"] == "20 ns"
    assert streak.metadata["Acquisition/areSource"] == "0,4,1344,1008"
    assert np.count_nonzero(streak.saturated) == np.count_nonzero(streak.counts == 65535) == 4


@pytest.mark.parametrize("name", ["LinePattern", "LinePattern_bkg", "DotPattern", "DotPattern_bkg"])
def test_recorded_focus_pictures_have_no_time_axis(shared_data, name):
    streak = read_streak(shared_data / "clip" / f"{name}.tif")
    assert streak.counts.shape == (1016, 1344)
    assert streak.row_times is None
    assert streak.metadata["Streak camera/Mode"] == "Focus"
