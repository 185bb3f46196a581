"""Small files that claim to be large: every reader refuses them before it takes memory.

Each file is of a few kilobytes, or compressed as far as deflate goes, and claims at least half a
gibibyte.
"""

import io
import os
import struct
import tracemalloc
import zipfile
import zlib
from functools import partial

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
from tofclip.lidar.photons.files import describe_photons, read_photons

HUGE = 1 << 29
ROOM_BYTES = 16 << 20


def make_npy_header(shape):
    buffer = io.BytesIO()
    layout = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(buffer, layout)
    return buffer.getvalue()


def write_npz(path, compression=zipfile.ZIP_DEFLATED, **shapes):
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, shape in shapes.items():
            archive.writestr(f"{name}.npy", make_npy_header(shape))
    return path


NPZ_BOMBS = {
    "lift": {"streak_raw": (HUGE, 8), "resample_flag": (), "image_inverted_flag": ()},
    "light field": {"lf": (8, 8, HUGE, 8), "u": (8,), "v": (8,), "scale": ()},
    "capture": {"H": (HUGE, 8), **dict.fromkeys(("wall_xyz", "laser_xyz", "delta_t_s"), (3,))},
    "cloud": {"x_m": (HUGE,)},
    "photons": {"counts": (1 << 14, 1 << 14, 1 << 12)},
}


def write_lzma_bomb(folder):
    # LZMA packs ten thousand bytes into one: no size that such an archive states means anything.
    return write_npz(folder / "shot.npz", zipfile.ZIP_LZMA, streak_raw=(8, 8))


def write_tiff_bomb(folder):
    path = folder / "shot.tif"
    tifffile.imwrite(path, np.ones((64, 64), np.uint16), compression="zlib")
    with tifffile.TiffFile(path, mode="r+") as tiff:
        for name in ("ImageLength", "ImageWidth", "RowsPerStrip"):
            tiff.pages.first.tags[name].overwrite(1 << 14)
    return path


def write_circle(folder):
    """Pages of which the last one says that the first comes next: readers were busy for ever."""
    path = folder / "circle.tif"
    tifffile.imwrite(path, np.ones((3, 4, 5), np.uint8), photometric="minisblack", metadata=None)
    with tifffile.TiffFile(path) as tiff:
        first, last = tiff.pages[0].offset, tiff.pages[-1]
        link = last.offset + 2 + 12 * len(last.aspage().tags)
    content = bytearray(path.read_bytes())
    content[link : link + 4] = first.to_bytes(4, "little")
    path.write_bytes(content)
    return path


def write_table_bomb(folder):
    """An HPD-TA picture whose time axis is said to have almost 10^9 entries."""
    text = (
        '[Application],Date="x"[Scaling],ScalingYUnit="ns",ScalingYType=2,'
        'ScalingYScalingFile="#0000100,999999999"[Acquisition],areSource="0,0,9,9"'
    )
    options = {"description": text, "metadata": None}
    tifffile.imwrite(folder / "shot.tif", np.ones((9, 9), np.uint16), **options)
    return folder / "shot.tif"


def write_tal_bomb(folder, external=False):
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


def write_mat_bomb(folder):
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


def write_exr_bomb(folder):
    import OpenEXR

    path = folder / "field.exr"
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    part = OpenEXR.Part(header, {"Y": np.ones((4, 4), np.float32)}, "v=0,u=0")
    OpenEXR.File([part]).write(str(path))
    small, large = struct.pack("<4i", 0, 0, 3, 3), struct.pack("<4i", 0, 0, (1 << 27) - 1, 3)
    path.write_bytes(path.read_bytes().replace(small, large))
    return path


def write_png_bomb(folder):
    Image.new("L", (1 << 14, 1 << 13)).save(folder / "view_0_0.png", compress_level=9)
    content = bytearray((folder / "view_0_0.png").read_bytes())
    content[16:24] = struct.pack(">2I", 1 << 15, 1 << 14)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    (folder / "view_0_0.png").write_bytes(content)
    return folder


def write_stack_bomb(folder):
    with h5py.File(folder / "stack.h5", "w") as file:
        options = {"chunks": (1, 64, 8), "compression": "gzip"}
        file.create_dataset("counts", (4, HUGE, 8), "f4", **options)
    return folder / "stack.h5"


def write_cube_bomb(folder, rows):
    with h5py.File(folder / "a.h5", "w") as file:
        file.create_dataset("counts", (rows, rows, 4096), "u2", chunks=(64, 64, 64))
    return folder / "a.h5"


def write_npy_bomb(folder):
    (folder / "a.npy").write_bytes(make_npy_header((1 << 14, 1 << 14, 1 << 12)))
    return folder / "a.npy"


def write_linked_stack(folder):
    with h5py.File(folder / "other.h5", "w") as file:
        file["counts"] = np.ones((2, 3, 4), np.float32)
    with h5py.File(folder / "stack.h5", "w") as file:
        file["counts"] = h5py.ExternalLink("other.h5", "counts")
    return folder / "stack.h5"


def write_las_bomb(folder):
    laspy = pytest.importorskip("laspy")
    table = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    table.write(folder / "cloud.las")
    content = bytearray((folder / "cloud.las").read_bytes())
    content[247:255] = struct.pack("<Q", HUGE)  # number of points, of version 1.4
    (folder / "cloud.las").write_bytes(content)
    return folder / "cloud.las"


BOMBS = {
    **{
        f"npz {name} {read.__qualname__}": (
            lambda folder, name=name: write_npz(folder / "a.npz", **NPZ_BOMBS[name]),
            read,
        )
        for name, read in [
            ("lift", read_streak),
            ("lift", outline_streak_file),
            ("light field", read_light_field),
            ("capture", read_capture),
            ("cloud", PointCloud.load),
            ("cloud", load),
            ("photons", read_photons),
        ]
    },
    "lzma": (write_lzma_bomb, read_streak),
    "tiff": (write_tiff_bomb, read_streak),
    "tiff outline": (write_tiff_bomb, outline_streak_file),
    "circle": (write_circle, read_streak),
    "circle of photons": (write_circle, describe_photons),
    "table": (write_table_bomb, read_streak),
    "tal": (write_tal_bomb, read_capture),
    "external data": (partial(write_tal_bomb, external=True), read_capture),
    "mat": (write_mat_bomb, read_capture),
    "exr": (write_exr_bomb, read_light_field),
    "exr folder": (lambda folder: write_exr_bomb(folder).parent, read_capture),
    "png": (write_png_bomb, read_light_field),
    "stack": (write_stack_bomb, StreakStack),
    "linked stack": (write_linked_stack, StreakStack),
    "photons": (write_npy_bomb, read_photons),
    "photons, sparse": (partial(write_cube_bomb, rows=64), read_photons),
    "photons, sparse and large": (partial(write_cube_bomb, rows=1 << 14), read_photons),
    "las": (write_las_bomb, PointCloud.load),
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_file_that_claims_more_than_it_can_hold_is_refused(name, tmp_path):
    write, read = BOMBS[name]
    path = write(tmp_path)
    told = r"^[^\n]*(claims|circle|fit into|is missing|never uses|other files|links)[^\n]*$"
    tracemalloc.start()
    try:
        with pytest.raises(FileFormatError, match=told):
            read(path)
        assert tracemalloc.get_traced_memory()[1] < ROOM_BYTES
    finally:
        tracemalloc.stop()


def test_no_array_is_larger_than_the_memory_or_than_the_user_says(tmp_path, monkeypatch):
    path = tmp_path / "a"
    path.touch()
    os.truncate(path, 1 << 23)  # takes no room on the disk
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    assert find_array_limit(1 << 60) < memory
    assert find_array_limit() <= MAX_UNPACKED_BYTES
    with pytest.raises(FileFormatError, match=r"more than the [0-9]+ that are read"):
        require_bounded_size(path, "a", memory, 1 << 60)
    zeros = {"claimed": 1 << 32, "stored": 1 << 23, "compressed": True}
    with pytest.raises(FileFormatError, match=r"set TOFCLIP_MAX_ARRAY_GIB=4$"):
        require_bounded_size(path, "a", **zeros)
    monkeypatch.setenv("TOFCLIP_MAX_ARRAY_GIB", "4")
    require_bounded_size(path, "a", **zeros)
    monkeypatch.setenv("TOFCLIP_MAX_ARRAY_GIB", "all")
    with pytest.raises(InputError, match="must be a positive number"):
        require_bounded_size(path, "a", **zeros)


def test_what_deflate_can_pack_is_believed(tmp_path):
    np.savez_compressed(tmp_path / "field.npz", lf=np.zeros((2, 2, 300, 300)), u=[0, 1], v=[0, 1])
    with np.load(tmp_path / "field.npz") as stored:
        assert stored["lf"].nbytes > 500 * (tmp_path / "field.npz").stat().st_size
    with pytest.raises(FileFormatError, match="no field 'scale'"):
        read_light_field(tmp_path / "field.npz")


@pytest.mark.parametrize("read", [load, outline_streak_file, read_photons, read_capture])
@pytest.mark.parametrize("own", [False, True])
def test_a_file_whose_root_holds_itself_is_read_once(read, own, tmp_path):
    with h5py.File(tmp_path / "cycle.h5", "w") as file:
        if own:
            file.attrs["format"], file.attrs["format_version"] = "tofclip", 1
            file.attrs["provenance"], file.attrs["kind"] = "{}", "frames"
        for number in range(24):
            file[f"again{number}"] = file["/"]
    with pytest.raises(TofclipError):
        read(tmp_path / "cycle.h5")


@pytest.mark.parametrize("read", [load, read_photons, read_capture, read_streak, PointCloud.load])
def test_a_pipe_is_refused_before_it_is_waited_for(read, tmp_path):
    for suffix in ("tif", "npy", "ply", "exr", "npz", "csv"):
        os.mkfifo(tmp_path / f"shot.{suffix}")
        with pytest.raises((StorageError, InputError), match=r"is a pipe or a device|must end in"):
            read(tmp_path / f"shot.{suffix}")
