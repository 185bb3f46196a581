"""Light fields in every format: what was written comes back, view by view, and what is damaged is
refused.
"""

import numpy as np
import OpenEXR
import pytest
from matplotlib.image import imsave
from tifffile import imwrite

from tofclip.errors import FileFormatError, InputError, TofclipError
from tofclip.io.light_fields import read_depth_map, read_light_field, write_light_field
from tofclip.light_field import LightField

VIEWS = np.array([(v, u) for v in (-1.0, 0.0) for u in (-1.0, 0.0, 1.5)])


def light_field():
    return LightField(np.random.default_rng(4).random((6, 9, 14), np.float32), VIEWS)


def write_parts(path, **parts):
    """Write an EXR file of named parts, each with one channel, or with colours."""
    window = np.array([0, 0], np.int32), np.array([3, 3], np.int32)  # the data's may differ
    header, made = {"type": OpenEXR.scanlineimage, "displayWindow": window}, []
    for name, (channel, picture) in parts.items():
        made.append(OpenEXR.Part(dict(header), {channel: picture.astype(np.float32)}, name))
    OpenEXR.File(made).write(str(path))


@pytest.mark.parametrize("name", ["field.h5", "field.exr"])
@pytest.mark.parametrize("turned", [False, True])
def test_what_was_written_comes_back(tmp_path, name, turned):
    """Values are float32 in both formats, so they return exactly; views by their numbers, in
    whatever order. OpenEXR writes wrong pixels of arrays that are not contiguous.
    """
    known = light_field()
    if turned:
        known = LightField(known.pictures.swapaxes(1, 2), VIEWS)
    write_light_field(known, tmp_path / name)
    found = read_light_field(tmp_path / name)
    where = [int(np.flatnonzero((found.views == view).all(axis=1))[0]) for view in known.views]
    np.testing.assert_array_equal(found.pictures[where], known.pictures)


def test_colour_parts_become_luminance(tmp_path):
    rgb = np.random.default_rng(0).random((5, 6, 3), np.float32)
    write_parts(tmp_path / "rgb.exr", **{f"v=0,u={n}": ("RGB", rgb + n) for n in (0, 1)})
    found = read_light_field(tmp_path / "rgb.exr")
    np.testing.assert_allclose(found.pictures[0], rgb @ [0.2125, 0.7154, 0.0721], rtol=1e-5)


def pictures(rows, columns):
    """Each view is known by one bright pixel."""
    made = np.zeros((rows, columns, 8, 10), np.uint8)
    for v, u in np.ndindex(rows, columns):
        made[v, u, v, u] = 255
    return made.reshape(-1, 8, 10)


def test_a_folder_is_read_by_row_and_column(tmp_path):
    for (v, u), picture in zip(np.ndindex(2, 3), pictures(2, 3), strict=True):
        imwrite(tmp_path / f"scene7_{v + 1:02}_{u + 1:02}.tif", picture)
    found = read_light_field(tmp_path)
    np.testing.assert_array_equal(found.views, [(v, u) for v in (-1, 0) for u in (-1, 0, 1)])
    np.testing.assert_array_equal(found.pictures, pictures(2, 3) / np.float32(255))


def test_a_folder_in_raster_order_is_a_square_grid(tmp_path):
    for number, picture in enumerate(pictures(8, 8)):
        imsave(tmp_path / f"input_Cam{number:03}.png", picture, cmap="gray", vmin=0, vmax=255)
    found = read_light_field(tmp_path)
    assert found.views.min() == -4
    assert found.views.max() == 3
    # A grey picture saved in colour has its own luminance, up to rounding of the weights.
    np.testing.assert_allclose(found.pictures, pictures(8, 8) / 255, atol=1e-5)


def write_pictures(*names, side=lambda number: 4):
    def write(folder):
        for number, name in enumerate(names):
            imwrite(folder / name, np.full((4, side(number)), number, np.uint8))
        return folder

    return write


def write_exr(**parts):
    return lambda folder: write_parts(folder / "other.exr", **parts) or folder / "other.exr"


def write_bytes(name, content=b"no picture"):
    return lambda folder: (folder / name).write_bytes(content) and folder / name


ARCHIVE = {
    "lf": np.random.default_rng(0).integers(0, 99, (2, 3, 5, 7)).astype(np.uint16),
    "scale": 0.5,
    "v": [-1, 0],
    "u": [-1, 0, 1],
}


def write_archive(**changes):
    def write(folder):
        np.savez(folder / "field.npz", **{**ARCHIVE, **changes})
        return folder / "field.npz"

    return write


def test_an_archive_is_read_view_by_view(tmp_path):
    found = read_light_field(write_archive()(tmp_path))
    np.testing.assert_array_equal(found.pictures[4], ARCHIVE["lf"][1, 1] * np.float32(0.5))
    np.testing.assert_array_equal(found.views[4], [0, 0])


def write_half(folder):
    write_light_field(light_field(), folder / "cut.exr")
    whole = (folder / "cut.exr").read_bytes()
    (folder / "cut.exr").write_bytes(whole[: len(whole) // 2])
    return folder / "cut.exr"


@pytest.mark.parametrize(
    ("write", "problem"),
    [
        (write_pictures(), "no pictures"),
        (write_pictures("a_0_0.tif", "a_0_1.tif", "a_1_1.tif"), "the first in row 1, column 0"),
        (write_pictures("a_0_0.tif", "b_0_0.tif"), "same view"),
        (write_pictures("a.tif", "b.tif"), "row and column"),
        (write_pictures("a0.tif", "a1.tif", "a2.tif"), "square grid"),
        (write_pictures("a_0_0.tif", "a_0_1.tif", side=lambda number: 4 + number), "first view is"),
        (write_exr(**{f"v=0,u={n}": ("Y", np.eye(4 + n)) for n in (0, 1)}), "differ in size"),
        (write_exr(left=("Y", np.eye(4))), "does not say which view"),
        (write_exr(**{"v=0,u=0": ("Z", np.eye(4))}), "needs a channel Y"),
        (write_exr(**{"v=0,u=0": ("Y", np.full((4, 4), np.nan))}), None),
        (write_exr(**{"v=0,u=0": ("Y", np.zeros((4, 4)))}), None),
        (write_half, "EXR"),
        (write_archive(v=[-1]), "field.npz"),
        (write_archive(lf=np.ones((2, 3, 5, 7))), None),
        (write_bytes("noise.exr"), "EXR"),
        (lambda folder: write_bytes("noise_0_0.png")(folder).parent, "damaged picture"),
        (write_bytes("text.txt"), "is not a light field"),
        (lambda folder: folder / "absent.exr", "no such file"),
    ],
)
def test_what_is_no_light_field_says_why(tmp_path, write, problem, capsys):
    path = write(tmp_path)
    with pytest.raises(TofclipError, match=problem):
        read_light_field(path)
    assert capsys.readouterr().out == ""  # not even by a library: it may be somebody's JSON


def test_a_light_field_is_not_written_as_a_picture(tmp_path):
    with pytest.raises(InputError):
        write_light_field(light_field(), tmp_path / "field.png")


def test_a_map_of_depths_is_numbers_in_rows_and_columns(tmp_path):
    path = tmp_path / "map.npy"
    np.save(path, np.array([[0.5, np.inf], [-1.0, 0.0]], np.float32))
    np.testing.assert_array_equal(read_depth_map(path), [[0.5, np.inf], [-1.0, 0.0]])
    for wrong in (np.zeros(3), np.array([["a"]]), np.array([[None]])):
        np.save(path, wrong, allow_pickle=True)
        with pytest.raises(FileFormatError, match=r"map\.npy"):
            read_depth_map(path)
    path.write_bytes(path.read_bytes()[:20])
    with pytest.raises(FileFormatError, match=r"map\.npy"):
        read_depth_map(path)
