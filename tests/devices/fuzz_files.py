"""Files of every format that is read: what the readers do with damaged ones."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.io
import tcspc_files
import tifffile
from PIL import Image

from devices.transients import read_transient
from nlos import Capture
from nlos.io import read_capture
from tofclip import PointCloud
from tofclip.io import read_streak
from tofclip.io.light_fields import read_light_field, write_light_field
from tofclip.io.streaks import outline_streak_file
from tofclip.lidar.photons.files import describe_photons, read_photons
from tofclip.light_field import LightField
from tofclip.storage import Field, Record, read_outline

sys.path.append(str(Path(__file__).parents[1]))  # where this is no test but a script
from itex_files import encode_itex

BIN_WIDTH_S = 50e-12
COUNTS = np.random.default_rng(0).integers(0, 60, (12, 16)).astype(np.uint16)
CUBE = np.random.default_rng(1).poisson(0.3, (4, 5, 24)).astype(np.uint16)


@dataclass(frozen=True)
class FileFormat:
    """A format, with files that are sound and what reads them.

    Parameters
    ----------
    name : str
        A file's name, with the suffix that the readers expect.
    write : sequence of callables
        Each writes a sound file.
    read : sequence of callables
        Each takes a path. All are tried; what the first raises is raised.
    notices_all : bool
        Every byte has a checksum.
    """

    name: str
    write: tuple[Callable[[Path], Any], ...]
    read: tuple[Callable[[Path], Any], ...]
    notices_all: bool = False

    def seeds(self) -> tuple[bytes, ...]:
        """Contents of the sound files."""
        found = []
        with tempfile.TemporaryDirectory() as folder:
            for write in self.write:
                write(Path(folder, self.name))
                found.append(Path(folder, self.name).read_bytes())
        return tuple(found)

    def decode(self, folder: Path, data: bytes) -> None:
        """Read a file with that content by every reader."""
        path = folder / self.name
        path.write_bytes(data)
        faults: list[Exception] = []
        for read in self.read:
            try:
                with silence():
                    read(path)
            except Exception as fault:
                faults.append(fault)
        if faults:
            raise faults[0]


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """OpenEXR's library prints what it thinks of a file, past Python's streams."""
    kept = [os.dup(1), os.dup(2)]
    with open(os.devnull, "w") as nowhere:
        try:
            for number in (1, 2):
                os.dup2(nowhere.fileno(), number)
            yield
        finally:
            for number, copy in zip((1, 2), kept, strict=True):
                os.dup2(copy, number)
                os.close(copy)


def _capture() -> Capture:
    wall = np.stack([*np.meshgrid(np.arange(3.0), np.arange(2.0)), np.zeros((2, 3))], axis=-1)
    return Capture(np.ones((8, 2, 3), np.float32), wall, np.zeros(3), 1e-11)


def _light_field() -> LightField:
    pictures = np.random.default_rng(2).random((4, 6, 5)).astype(np.float32)
    return LightField(pictures, np.array([(v, u) for v in (0.0, 1.0) for u in (0.0, 1.0)]))


def _write_lift(path: Path) -> None:
    turn = {name: np.eye(3) for name in ("rectify_norm_xy", "rectify_norm_uv")}
    np.savez_compressed(
        path,
        streak_raw=COUNTS,
        resample_flag=1,
        image_inverted_flag=0,
        lens_centre_px=np.linspace(4, 12, 3),
        lens_angle_deg=np.linspace(80, 100, 3),
        region_size_px=4.0,
        rectify_kind="polynomial2",
        rectify_poly_u=np.ones(6),
        rectify_poly_v=np.ones(6),
        dt_s=1e-12,
        **turn,
    )


def _write_tal(path: Path) -> None:
    capture = _capture()
    with h5py.File(path, "w", libver="v110") as file:
        file["H"], file["H_format"] = capture.signal, np.array([1])
        file["sensor_grid_xyz"], file["laser_grid_xyz"] = capture.wall, np.zeros((1, 1, 3))
        file["delta_t"] = 0.003


def _write_mat_struct(path: Path) -> None:
    points = np.random.default_rng(3).random((6, 3))
    scene = {"data": np.ones((6, 1, 8)), "laserPos": points, "cameraPos": points[:1], "deltat": 0.1}
    scene |= {"laserOrigin": np.ones(3), "cameraOrigin": np.ones(3)}
    scipy.io.savemat(path, {"dataset": scene})


def _write_mat_cells(path: Path) -> None:
    cells = np.empty((2, 3), dtype=object)
    for place in np.ndindex(2, 3):
        cells[place] = np.arange(4.0)
    scipy.io.savemat(path, {"spad": cells, "bin_width_ps": 50.0}, do_compression=True)


def _write_npz_capture(path: Path) -> None:
    capture = _capture()
    np.savez(path, H=capture.signal, wall_xyz=capture.wall, laser_xyz=np.zeros(3), delta_t_s=1e-11)


def _write_npz_light_field(path: Path) -> None:
    pictures = (255 * _light_field().pictures.reshape(2, 2, 6, 5)).astype(np.uint8)
    np.savez_compressed(path, lf=pictures, scale=1 / 255, u=np.arange(2), v=np.arange(2))


def _write_hpdta(path: Path) -> None:
    text = '[Application],Date="x"[Scaling],ScalingYUnit="ns",ScalingYType=1,ScalingYScale=0.3'
    tifffile.imwrite(path, COUNTS, description=text, metadata=None)


def _write_itex(path: Path) -> None:
    text = '[Scaling],ScalingYUnit="ns",ScalingYScalingFile=""'
    times = {"Y": np.arange(12, dtype=np.float32)}
    path.write_bytes(encode_itex(COUNTS, text, times))


def _write_record(path: Path) -> None:
    field = Field(COUNTS.astype(np.float32), "count", ("time", "column"))
    Record("streak", {"counts": field}, {"gain": 2.5, "name": "a"}).save(path)


def _write_pages(path: Path) -> None:
    pages = np.moveaxis(CUBE, 2, 0)
    tifffile.imwrite(path, pages, compression="zlib", photometric="minisblack")


def _write_png(path: Path) -> None:
    Image.fromarray((255 * _light_field().pictures[0]).astype(np.uint8)).save(path)


def _cloud() -> PointCloud:
    points = np.random.default_rng(4).random((9, 3)).astype(np.float32)
    ones = np.ones(9, np.float32)
    return PointCloud(points, ones, ones, ones, np.ones(9, np.uint8), ones)


def _read_photons(path: Path) -> None:
    describe_photons(path)
    read_photons(path, BIN_WIDTH_S, "yxt")


def _read_folder(path: Path) -> None:
    read_light_field(path.parent)


def _photon_writer(save: Callable[..., Any]) -> Callable[[Path], None]:
    return lambda path: save(path, CUBE)


def _count_writer(write: Callable[..., None]) -> Callable[[Path], None]:
    return lambda path: write(path, tcspc_files.make_decays())


def _read_counts(path: Path) -> None:
    read_transient(f"file://{path}?bins=50")


STREAKS = (read_streak, outline_streak_file)
CLOUDS = (PointCloud.load, PointCloud.read_outline)
FORMATS = {
    "own HDF5": FileFormat("a.h5", (_write_record,), (Record.load, read_outline), notices_all=True),
    "y-tal HDF5": FileFormat("a.hdf5", (_write_tal,), (read_capture,)),
    "TIFF shots": FileFormat(
        "a.tif",
        (_write_hpdta, lambda path: tifffile.imwrite(path, COUNTS, compression="zlib")),
        STREAKS,
    ),
    "ITEX shots": FileFormat("a.img", (_write_itex,), STREAKS),
    "LIFT archives": FileFormat("a.npz", (_write_lift,), STREAKS),
    "NPZ captures": FileFormat("b.npz", (_write_npz_capture,), (read_capture,)),
    "NPZ light fields": FileFormat("c.npz", (_write_npz_light_field,), (read_light_field,)),
    "MAT captures": FileFormat("a.mat", (_write_mat_struct,), (read_capture,)),
    "MAT photons": FileFormat("b.mat", (_write_mat_cells,), (_read_photons,)),
    "NPY photons": FileFormat("a.npy", (_photon_writer(np.save),), (_read_photons,)),
    "TIFF photons": FileFormat("b.tif", (_write_pages,), (_read_photons,)),
    "EXR light fields": FileFormat(
        "a.exr", (lambda path: write_light_field(_light_field(), path),), (read_light_field,)
    ),
    "PNG light fields": FileFormat("v_0_0.png", (_write_png,), (_read_folder,)),
    **{
        f"{suffix[1:].upper()} clouds": FileFormat(
            f"a{suffix}",
            (lambda path: _cloud().save(path),),
            CLOUDS,
            notices_all=suffix == ".e57",  # pages of 1024 bytes, each with its CRC-32C
        )
        for suffix in (".ply", ".pcd", ".csv", ".las", ".e57")
    },
    **{
        f"{suffix[1:].upper()} counts": FileFormat(
            f"a{suffix}", (_count_writer(write),), (_read_counts,)
        )
        for suffix, write in (
            (".ptu", tcspc_files.write_ptu),
            (".phu", tcspc_files.write_phu),
            (".sdt", tcspc_files.write_sdt),
        )
    },
}
