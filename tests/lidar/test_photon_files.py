"""Counted photons in every layout that is read, and files that claim more than they hold."""

import h5py
import numpy as np
import pytest
import scipy.io
import tifffile

from tofclip.camera import Camera
from tofclip.errors import FileFormatError, InputError, StorageError
from tofclip.lidar.photons.files import describe_photons, read_photons

BIN = 80e-12
ROWS, COLUMNS, BINS = 6, 8, 40


@pytest.fixture(scope="module")
def counts():
    """A wall at bin 20 of a picture, on a weak background."""
    noise = np.random.default_rng(0)
    cube = noise.poisson(0.05, (ROWS, COLUMNS, BINS))
    cube[..., 19:22] += noise.poisson(2, (ROWS, COLUMNS, 3))
    return cube.astype(np.uint16)


def write_cells(cube):
    cells = np.empty(cube.shape[:2], dtype=object)
    for y, x in np.ndindex(cells.shape):
        cells[y, x] = np.repeat(np.arange(BINS), cube[y, x]).astype(np.uint16)[:, np.newaxis]
    return cells


def write_events(path, cube):
    y, x, t = (np.repeat(part, cube[cube > 0]) for part in np.nonzero(cube))
    np.savez(path, y=y, x=x, time=t * BIN, bin_width_s=BIN)


def write_mat73_cells(path, cube):
    with h5py.File(path, "w", userblock_size=512) as file:
        cells = write_cells(cube).T
        references = np.empty(cells.shape, dtype=h5py.ref_dtype)
        for place in np.ndindex(cells.shape):
            made = file.create_dataset(f"#refs#/{place[0]}_{place[1]}", data=cells[place].T)
            references[place] = made.ref
        table = file.create_dataset("Ts", data=references, dtype=h5py.ref_dtype)
        table.attrs["MATLAB_class"] = np.bytes_("cell")
    with open(path, "r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file")


def write_hdf5(path, cube):
    with h5py.File(path, "w") as file:
        made = file.create_dataset("shot/histogram", data=cube, compression="gzip")
        made.attrs["bin_width_s"] = BIN


def write_tiff(path, cube):
    tifffile.imwrite(path, np.moveaxis(cube, 2, 0), photometric="minisblack")


WRITERS = {
    "a.npy": np.save,
    "a.npz": lambda path, cube: np.savez_compressed(path, counts=cube, bin_width_ps=80.0),
    "events.npz": write_events,
    "a.mat": lambda path, cube: scipy.io.savemat(path, {"cube": cube}, do_compression=True),
    "cells.mat": lambda path, cube: scipy.io.savemat(path, {"Ts": write_cells(cube)}),
    "cells73.mat": write_mat73_cells,
    "a.h5": write_hdf5,
    "a.tif": write_tiff,
}
SAY_THEIR_BIN_WIDTH = {"a.npz", "a.h5", "events.npz"}


def all_histograms(photons):
    return photons.histograms(slice(0, np.prod(photons.image_shape)))


def list_events(cube):
    """(n, 3) columns x, y, t of single photons, in no order."""
    y, x, t = np.repeat(np.nonzero(cube), cube[cube > 0], axis=1)
    return np.random.default_rng(0).permutation(np.stack([x, y, t], axis=1))


def save_rows(folder, cube):
    folder.mkdir()
    for number, row in enumerate(cube):
        np.save(folder / f"row{number}.npy", row)


# Layouts that need a word about their axes, or hold a part of the picture: how they are written, the word,
# and which part.
LAYOUTS = {
    **{name: (write, None, np.s_[:]) for name, write in WRITERS.items()},
    "line.npy": (lambda path, cube: np.save(path, cube[3].T), "tx", np.s_[3:4]),
    "column.npy": (lambda path, cube: np.save(path, cube[:, 2]), "yt", np.s_[:, 2:3]),
    "histogram.npy": (lambda path, cube: np.save(path, cube[3, 2]), "t", np.s_[3:4, 2:3]),
    "one.npz": (
        lambda path, cube: np.savez(path, s_TDC=np.repeat(np.arange(BINS), cube[3, 2])[None]),
        None,
        np.s_[3:4, 2:3],
    ),
    "xyt.npy": (lambda path, cube: np.save(path, list_events(cube)), None, np.s_[:]),
    "tyx.npy": (lambda path, cube: np.save(path, list_events(cube).T[::-1]), "tyx", np.s_[:]),
    "rows": (save_rows, None, np.s_[:]),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_gives_the_same_photons(name, counts, tmp_path):
    (write, axes, part), path = LAYOUTS[name], tmp_path / name
    write(path, counts)
    photons, expected = read_photons(path, BIN, axes), counts[part]
    assert photons.image_shape == expected.shape[:2]
    assert photons.bin_width == BIN
    assert photons.photons == expected.sum()
    expected = expected.reshape(-1, BINS)[:, : photons.bins]
    np.testing.assert_array_equal(all_histograms(photons), expected)
    if axes and len(axes) < 3:
        like = f"give `axes`, e.g. {axes[-1] if axes == 't' else 'xt'}"
        with pytest.raises(FileFormatError, match=like):
            read_photons(path, BIN)
    described = describe_photons(path)
    assert described["kind"] == "photons"
    if name in SAY_THEIR_BIN_WIDTH:
        assert read_photons(path).bin_width == pytest.approx(BIN)
    else:
        with pytest.raises(InputError, match="`bin_width`"):
            read_photons(path)


@pytest.mark.parametrize("name", WRITERS)
def test_damaged_files_are_refused_in_one_line(name, counts, tmp_path):
    path = tmp_path / name
    WRITERS[name](path, counts)
    whole, noise = path.read_bytes(), np.random.default_rng(1)
    lines: list[str] = []
    for trial in range(60):
        damaged = bytearray(whole)
        if trial % 3:
            for place in noise.integers(0, len(whole), 8):
                damaged[place] = noise.integers(0, 256)
        else:
            del damaged[int(noise.integers(0, len(whole))) :]
        path.write_bytes(damaged)
        try:
            read_photons(path, BIN, "yxt")
        except (FileFormatError, InputError, StorageError) as fault:
            lines.append(str(fault))
    assert len(lines) > 10
    assert not any("\n" in line for line in lines)


def draw_ball(shape, seed):
    """A ball before a slanted wall, 5 signal photons a pixel and 0.02 of background a bin."""
    rows, columns, bins = shape
    noise = np.random.default_rng(seed)
    y, x = np.mgrid[:rows, :columns]
    near = np.hypot(y - 0.5 * rows, x - 0.4 * columns) < 0.3 * min(rows, columns)
    surface = np.where(near, 0.3 * bins, 0.6 * bins + 0.2 * bins * x / columns)
    cube = noise.poisson(0.02, shape)
    pixel = np.repeat(np.arange(surface.size), noise.poisson(5, surface.size))
    time = np.rint(surface.ravel()[pixel] + noise.normal(0, 1.3, pixel.size)).astype(int)
    np.add.at(cube.reshape(-1, bins), (pixel, time.clip(0, bins - 1)), 1)
    return cube


@pytest.mark.parametrize("shape", [(80, 80, 512), (64, 64, 64)])
@pytest.mark.parametrize("hot", [0.0, 0.5, 5.0, 50.0])
def test_hot_pixels_do_not_say_which_axis_is_time(shape, hot, tmp_path):
    """2 % of the pixels are hot in all bins; a picture axis was taken from 5 counts a bin on."""
    cube, noise = draw_ball(shape, 1), np.random.default_rng(2)
    pixels = noise.random(shape[:2]) < 0.02
    cube[pixels] += noise.poisson(hot, cube[pixels].shape)
    for order in ("yxt", "tyx", "ytx"):
        path = tmp_path / f"{order}.npy"
        np.save(path, cube.transpose(["yxt".index(axis) for axis in order]).astype(np.uint16))
        image = read_photons(path, BIN)
        assert (*image.image_shape, image.bins) == shape
        assert image.axes.startswith(f"{order}, ahead of the next axis by a factor of ")
        # asked for where it is less than 2
        assert float(image.axes.split()[-1]) > 4


def test_axes_that_light_and_length_disagree_on_are_asked_for(tmp_path):
    """A wide picture of few bins is read rightly or not at all; a flat cube is not."""
    noise = np.random.default_rng(3)
    flat = noise.poisson(0.2, (64, 64, 64))
    wide = draw_ball((20, 1000, 100), 4) + noise.poisson(0.2, (20, 1000, 100))
    hot = draw_ball((20, 1000, 100), 0)
    hot[noise.random(hot.shape[:2]) < 0.02] += 50
    for cube in (flat, wide, hot):
        np.save(tmp_path / "a.npy", cube.astype(np.uint8))
        with pytest.raises(InputError, match=r"which axis is time .* by a factor of .*give `axes`"):
            read_photons(tmp_path / "a.npy", BIN)
        assert read_photons(tmp_path / "a.npy", BIN, "yxt").axes == ""


@pytest.mark.parametrize("axes", ["yxt", "tyx", "xyt", "ytx", "txy", "xty"])
def test_axes_in_any_order(axes, counts, tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.transpose(counts, ["yxt".index(axis) for axis in axes]))
    found = all_histograms(read_photons(path, BIN, axes))
    np.testing.assert_array_equal(found, counts.reshape(-1, BINS))
    if axes.index("y") < axes.index("x"):  # a mirrored picture cannot be recognised
        assert read_photons(path, BIN).image_shape == (ROWS, COLUMNS)
    with pytest.raises((InputError, FileFormatError), match="yxt"):
        read_photons(path, BIN, axes[:2])


@pytest.mark.parametrize("shape", [(1, 8), (6, 1), (1, 1)])
def test_one_row_or_one_pixel_where_axes_are_told(shape, counts, tmp_path):
    path = tmp_path / "a.npy"
    some = counts[: shape[0], : shape[1]]
    np.save(path, np.moveaxis(some, 2, 0))
    photons = read_photons(path, BIN, "tyx")
    assert (photons.image_shape, photons.bins) == (shape, BINS)
    np.testing.assert_array_equal(all_histograms(photons), some.reshape(-1, BINS))
    with pytest.raises(FileFormatError, match="give `axes`"):
        read_photons(path, BIN)
    described = describe_photons(path)
    assert described["arrays"] == {"array": f"{BINS} x {shape[0]} x {shape[1]} uint16"}
    assert "lidar photons takes --axes" in described["axes"]
    assert Camera.pinhole(shape, 10.0, BIN).image_shape == shape


def test_time_is_recognised_by_its_peak_where_it_is_not_the_longest(tmp_path):
    cube = np.full((30, 50, 20), 1)
    cube[..., 7] = 50
    np.save(tmp_path / "a.npy", np.moveaxis(cube, 2, 0))
    assert read_photons(tmp_path / "a.npy", BIN).image_shape == (30, 50)


def refuse(path, match, read=lambda path: read_photons(path, BIN)):
    with pytest.raises((FileFormatError, InputError, StorageError), match=match):
        read(path)


def test_what_has_no_suitable_layout_is_told_which_would_do(tmp_path):
    np.save(tmp_path / "line.npy", np.ones(7))
    np.save(tmp_path / "flat.npy", np.zeros((3, 4)))
    np.savez(tmp_path / "two.npz", a=np.ones((2, 3, 4)), b=np.ones((2, 3, 4)))
    np.save(tmp_path / "objects.npy", np.array([None, 1], dtype=object), allow_pickle=True)
    (tmp_path / "text.txt").write_text("no photons")
    (tmp_path / "empty.npy").touch()
    for name, problem in {
        "line.npy": "holds no photons",
        "flat.npy": "give `axes`, e.g. xyt of events",
        "two.npz": "several cubes",
        "objects.npy": "cube of counts",
        "text.txt": "cube of counts",
        "empty.npy": "empty",
        "absent.npy": "no such file",
    }.items():
        refuse(tmp_path / name, problem)
        if name not in ("line.npy", "flat.npy"):
            refuse(tmp_path / name, problem, describe_photons)
    # who asks what a file holds is told its arrays
    assert describe_photons(tmp_path / "flat.npy")["arrays"] == {"array": "3 x 4 float64"}


def test_a_chunk_that_is_larger_than_its_cube_is_refused(tmp_path):
    """A file of a megabyte had a gigabyte unpacked for a few bins."""
    path, chunk = tmp_path / "chunk.h5", (1, 1, 1 << 25)
    with h5py.File(path, "w") as file:
        cube = file.create_dataset("counts", (4, 5, 64), "u4", maxshape=(None,) * 3, chunks=chunk)
        cube.id.write_direct_chunk((0, 0, 0), bytes(64))
    refuse(path, "a chunk of 'counts' claims 134217728 bytes")


def test_links_out_of_a_file_are_not_followed(counts, tmp_path):
    write_hdf5(tmp_path / "a.h5", counts)
    with h5py.File(tmp_path / "link.h5", "w") as file:
        file["counts"] = h5py.ExternalLink("a.h5", "shot/histogram")
        file["again"] = h5py.SoftLink("/counts")
    refuse(tmp_path / "link.h5", "no photons")
