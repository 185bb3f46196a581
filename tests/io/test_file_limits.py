"""Small files that claim to be large: every reader refuses them before it takes memory.

Each file is of a few kilobytes, or compressed as far as deflate goes, and claims at least half a
gibibyte.
"""

from __future__ import annotations

import contextlib
import io
import os
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
import tifffile
from PIL import Image

from nlos.io import read_capture
from tofclip import PointCloud, load
from tofclip.errors import FileFormatError, InputError, StorageError, TofclipError
from tofclip.files import MAX_UNPACKED_BYTES, find_array_limit, require_bounded_size
from tofclip.io import read_streak
from tofclip.io.light_fields import read_light_field
from tofclip.io.streaks import StreakStack, outline_streak_file
from tofclip.lidar.photons.files import read_photons

HUGE = 1 << 29
ROOM_BYTES = 16 << 20


def make_npy_header(shape: tuple[int, ...], descr: str = "<f8") -> bytes:
    buffer = io.BytesIO()
    layout = {"descr": descr, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(buffer, layout)
    return buffer.getvalue()


def write_npz(path: Path, compression: int = zipfile.ZIP_DEFLATED, **shapes: Any) -> None:
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, shape in shapes.items():
            archive.writestr(f"{name}.npy", make_npy_header(shape))


def write_lift_bomb(folder: Path) -> Path:
    write_npz(folder / "shot.npz", streak_raw=(HUGE, 8), resample_flag=(), image_inverted_flag=())
    return folder / "shot.npz"


def write_lzma_bomb(folder: Path) -> Path:
    # LZMA packs ten thousand bytes into one: no size that such an archive states means anything.
    write_npz(folder / "shot.npz", zipfile.ZIP_LZMA, streak_raw=(8, 8))
    return folder / "shot.npz"


def write_light_field_bomb(folder: Path) -> Path:
    write_npz(folder / "field.npz", lf=(8, 8, HUGE, 8), u=(8,), v=(8,), scale=())
    return folder / "field.npz"


def write_capture_bomb(folder: Path) -> Path:
    names = ("wall_xyz", "laser_xyz", "delta_t_s")
    write_npz(folder / "capture.npz", H=(HUGE, 8), **dict.fromkeys(names, (3,)))
    return folder / "capture.npz"


def write_cloud_bomb(folder: Path) -> Path:
    write_npz(folder / "cloud.npz", x_m=(HUGE,))
    return folder / "cloud.npz"


def write_tiff_bomb(folder: Path) -> Path:
    path = folder / "shot.tif"
    tifffile.imwrite(path, np.ones((64, 64), np.uint16), compression="zlib")
    with tifffile.TiffFile(path, mode="r+") as tiff:
        for name in ("ImageLength", "ImageWidth", "RowsPerStrip"):
            tiff.pages.first.tags[name].overwrite(1 << 14)
    return path


def write_table_bomb(folder: Path) -> Path:
    """An HPD-TA picture whose time axis is said to have almost 10^9 entries."""
    text = (
        '[Application],Date="x"[Scaling],ScalingYUnit="ns",ScalingYType=2,'
        'ScalingYScalingFile="#0000100,999999999"[Acquisition],areSource="0,0,9,9"'
    )
    options = {"description": text, "metadata": None}
    tifffile.imwrite(folder / "shot.tif", np.ones((9, 9), np.uint16), **options)
    return folder / "shot.tif"


def write_tal_bomb(folder: Path, external: bool = False) -> Path:
    path = folder / "tal.hdf5"
    with h5py.File(path, "w") as file:
        for name in ("H_format", "sensor_grid_xyz", "laser_grid_xyz", "delta_t"):
            file[name] = np.ones(3)
        if external:
            (folder / "secret").write_bytes(bytes(800))
            file.create_dataset("H", (100,), "f8", external=[(str(folder / "secret"), 0, 800)])
        else:
            file.create_dataset("H", (HUGE, 8), "f8", chunks=(64, 8), compression="gzip")
    return path


def write_external_data(folder: Path) -> Path:
    return write_tal_bomb(folder, external=True)


def write_mat_bomb(folder: Path) -> Path:
    """A struct whose data are compressed zeros, and say that they are more than they are."""
    path = folder / "scene.mat"
    scipy.io.savemat(path, {"rect_data": np.zeros((4, 4, 8)), "width": 0.5}, do_compression=True)
    content = bytearray(path.read_bytes())
    length = struct.unpack("<I", content[132:136])[0]
    element = bytearray(zlib.decompress(content[136 : 136 + length]))
    place = element.index(struct.pack("<3i", 4, 4, 8))
    element[place : place + 12] = struct.pack("<3i", 1 << 10, 1 << 10, 1 << 10)
    packed = zlib.compress(bytes(element))
    rest = content[136 + length :]
    path.write_bytes(bytes(content[:132]) + struct.pack("<I", len(packed)) + packed + rest)
    return path


def write_exr_bomb(folder: Path) -> Path:
    import OpenEXR

    path = folder / "field.exr"
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    part = OpenEXR.Part(header, {"Y": np.ones((4, 4), np.float32)}, "v=0,u=0")
    OpenEXR.File([part]).write(str(path))
    small, large = struct.pack("<4i", 0, 0, 3, 3), struct.pack("<4i", 0, 0, (1 << 27) - 1, 3)
    path.write_bytes(path.read_bytes().replace(small, large))
    return path


def write_exr_folder_bomb(folder: Path) -> Path:
    write_exr_bomb(folder)
    return folder


def write_png_bomb(folder: Path) -> Path:
    Image.new("L", (1 << 14, 1 << 13)).save(folder / "view_0_0.png", compress_level=9)
    content = bytearray((folder / "view_0_0.png").read_bytes())
    content[16:24] = struct.pack(">2I", 1 << 15, 1 << 14)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    (folder / "view_0_0.png").write_bytes(content)
    return folder


def write_stack_bomb(folder: Path) -> Path:
    with h5py.File(folder / "stack.h5", "w") as file:
        options = {"chunks": (1, 64, 8), "compression": "gzip"}
        file.create_dataset("counts", (4, HUGE, 8), "f4", **options)
    return folder / "stack.h5"


def write_linked_stack(folder: Path) -> Path:
    with h5py.File(folder / "other.h5", "w") as file:
        file["counts"] = np.ones((2, 3, 4), np.float32)
    with h5py.File(folder / "stack.h5", "w") as file:
        file["counts"] = h5py.ExternalLink("other.h5", "counts")
    return folder / "stack.h5"


def write_las_bomb(folder: Path) -> Path:
    laspy = pytest.importorskip("laspy")
    table = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    table.write(folder / "cloud.las")
    content = bytearray((folder / "cloud.las").read_bytes())
    content[247:255] = struct.pack("<Q", HUGE)  # number of points, of version 1.4
    (folder / "cloud.las").write_bytes(content)
    return folder / "cloud.las"


BOMBS: list[tuple[Callable[[Path], Path], Callable[[Path], Any]]] = [
    (write_lift_bomb, read_streak),
    (write_lift_bomb, outline_streak_file),
    (write_lzma_bomb, read_streak),
    (write_light_field_bomb, read_light_field),
    (write_capture_bomb, read_capture),
    (write_cloud_bomb, PointCloud.load),
    (write_cloud_bomb, load),
    (write_tiff_bomb, read_streak),
    (write_tiff_bomb, outline_streak_file),
    (write_table_bomb, read_streak),
    (write_tal_bomb, read_capture),
    (write_external_data, read_capture),
    (write_mat_bomb, read_capture),
    (write_exr_bomb, read_light_field),
    (write_exr_folder_bomb, read_capture),
    (write_png_bomb, read_light_field),
    (write_stack_bomb, StreakStack),
    (write_linked_stack, StreakStack),
    (write_las_bomb, PointCloud.load),
]


@contextlib.contextmanager
def at_most(size: int) -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < size
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("write", "read"), BOMBS, ids=[f"{w.__name__[6:]}-{r.__name__}" for w, r in BOMBS]
)
def test_a_file_that_claims_more_than_it_can_hold_is_refused(
    write: Callable[[Path], Path], read: Callable[[Path], Any], tmp_path: Path
) -> None:
    path = write(tmp_path)
    with (
        at_most(ROOM_BYTES),
        pytest.raises(
            FileFormatError, match=r"claims|fit into|is missing|never uses|other files|links"
        ) as caught,
    ):
        read(path)
    assert "\n" not in str(caught.value)


def test_no_array_is_larger_than_the_memory(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.touch()
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    assert find_array_limit(1 << 60) < memory
    with pytest.raises(FileFormatError, match=r"more than the [0-9]+ that are read"):
        require_bounded_size(path, "a", memory, 1 << 60)


def test_a_bomb_of_zeros_is_refused_unless_the_user_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a"
    path.touch()
    os.truncate(path, 1 << 23)  # takes no room on the disk
    assert find_array_limit() <= MAX_UNPACKED_BYTES
    with pytest.raises(FileFormatError, match=r"set TOFCLIP_MAX_ARRAY_GIB=4$"):
        require_bounded_size(path, "a", 1 << 32, 1 << 23, compressed=True)
    monkeypatch.setenv("TOFCLIP_MAX_ARRAY_GIB", "4")
    require_bounded_size(path, "a", 1 << 32, 1 << 23, compressed=True)
    monkeypatch.setenv("TOFCLIP_MAX_ARRAY_GIB", "all")
    with pytest.raises(InputError, match="must be a positive number"):
        require_bounded_size(path, "a", 1 << 32, 1 << 23, compressed=True)


def test_what_deflate_can_pack_is_believed(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "field.npz", lf=np.zeros((2, 2, 300, 300)), u=[0, 1], v=[0, 1])
    with np.load(tmp_path / "field.npz") as stored:
        assert stored["lf"].nbytes > 500 * (tmp_path / "field.npz").stat().st_size
    with pytest.raises(FileFormatError, match="no field 'scale'"):
        read_light_field(tmp_path / "field.npz")


@pytest.mark.parametrize("read", [load, outline_streak_file, read_photons, read_capture])
def test_a_file_whose_root_holds_itself_is_read_once(
    read: Callable[[Path], Any], tmp_path: Path
) -> None:
    for own in (False, True):
        with h5py.File(tmp_path / "cycle.h5", "w") as file:
            if own:
                file.attrs["format"], file.attrs["format_version"] = "tofclip", 1
                file.attrs["provenance"], file.attrs["kind"] = "{}", "frames"
            for number in range(24):
                file[f"again{number}"] = file["/"]
        with pytest.raises(TofclipError):
            read(tmp_path / "cycle.h5")


@pytest.mark.parametrize("read", [load, read_photons, read_capture, read_streak, PointCloud.load])
def test_a_pipe_is_refused_before_it_is_waited_for(
    read: Callable[[Path], Any], tmp_path: Path
) -> None:
    for name in ("shot.tif", "shot.npy", "shot.ply", "shot.exr", "shot.npz", "shot.csv"):
        os.mkfifo(tmp_path / name)
        with pytest.raises((StorageError, InputError), match=r"is a pipe or a device|must end in"):
            read(tmp_path / name)
