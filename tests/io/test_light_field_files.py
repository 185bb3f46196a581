"""Light fields in every format: what was written comes back, view by view, and what is damaged is
refused.
"""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.image import imsave
from tifffile import imwrite

from tofclip.errors import FileFormatError, InputError, StorageError, TofclipError
from tofclip.io.light_fields import read_depth_map, read_light_field, write_light_field
from tofclip.light_field import LightField

VIEWS = np.array([(v, u) for v in (-1.0, 0.0) for u in (-1.0, 0.0, 1.5)])


def light_field() -> LightField:
    return LightField(np.random.default_rng(4).random((6, 9, 14), np.float32), VIEWS)


@pytest.mark.parametrize("name", ["field.h5", "field.exr"])
def test_what_was_written_comes_back(tmp_path, name):
    """Values are float32 in both formats, so they return exactly; views by their numbers, in
    whatever order.
    """
    known = light_field()
    write_light_field(known, tmp_path / name)
    found = read_light_field(tmp_path / name)
    where = [int(np.flatnonzero((found.views == view).all(axis=1))[0]) for view in known.views]
    np.testing.assert_array_equal(found.pictures[where], known.pictures)


def test_a_transposed_light_field_is_written_with_its_own_pixels(tmp_path):
    """OpenEXR writes wrong pixels of arrays that are not contiguous."""
    turned = LightField(light_field().pictures.swapaxes(1, 2), VIEWS)
    write_light_field(turned, tmp_path / "turned.exr")
    np.testing.assert_array_equal(
        read_light_field(tmp_path / "turned.exr").pictures[0], turned.pictures[0]
    )


def test_colour_parts_become_luminance(tmp_path):
    import OpenEXR

    rgb = np.random.default_rng(0).random((5, 6, 3), np.float32)
    parts = [
        OpenEXR.Part({"type": OpenEXR.scanlineimage}, {"RGB": rgb + n}, f"v=0,u={n}")
        for n in (0, 1)
    ]
    OpenEXR.File(parts).write(str(tmp_path / "rgb.exr"))
    found = read_light_field(tmp_path / "rgb.exr")
    np.testing.assert_allclose(found.pictures[0], rgb @ [0.2125, 0.7154, 0.0721], rtol=1e-5)


def pictures(rows: int, columns: int) -> np.ndarray:
    """Each view is known by one bright pixel."""
    made = np.zeros((rows, columns, 8, 10), np.uint8)
    for v in range(rows):
        for u in range(columns):
            made[v, u, v, u] = 255
    return made


def test_a_folder_is_read_by_row_and_column(tmp_path):
    for (v, u), picture in zip(np.ndindex(2, 3), pictures(2, 3).reshape(6, 8, 10), strict=True):
        imwrite(tmp_path / f"scene7_{v + 1:02}_{u + 1:02}.tif", picture)
    found = read_light_field(tmp_path)
    np.testing.assert_array_equal(found.views, [(v, u) for v in (-1, 0) for u in (-1, 0, 1)])
    np.testing.assert_array_equal(
        found.pictures, pictures(2, 3).reshape(6, 8, 10) / np.float32(255)
    )


def test_a_folder_in_raster_order_is_a_square_grid(tmp_path):
    for number, picture in enumerate(pictures(8, 8).reshape(64, 8, 10)):
        imsave(tmp_path / f"input_Cam{number:03}.png", picture, cmap="gray", vmin=0, vmax=255)
    found = read_light_field(tmp_path)
    assert found.views.min() == -4
    assert found.views.max() == 3
    # A grey picture saved in colour has its own luminance, up to rounding of the weights.
    np.testing.assert_allclose(found.pictures, pictures(8, 8).reshape(64, 8, 10) / 255, atol=1e-5)


def folder_of(tmp_path, names, shape=(4, 5)):
    for number, name in enumerate(names):
        imwrite(tmp_path / name, np.full(shape, number, np.uint8))
    return tmp_path


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ([], "no pictures"),
        (["a_0_0.tif", "a_0_1.tif", "a_1_1.tif"], "missing, the first in row 1, column 0"),
        (["a_0_0.tif", "b_0_0.tif"], "same view"),
        (["a.tif", "b.tif"], "row and column"),
        (["a0.tif", "a1.tif", "a2.tif"], "square grid"),
    ],
)
def test_a_folder_that_is_no_light_field_says_why(tmp_path, names, words):
    with pytest.raises(FileFormatError, match=words):
        read_light_field(folder_of(tmp_path, names))


def test_views_of_unequal_size_are_refused(tmp_path):
    import OpenEXR

    imwrite(tmp_path / "a_0_0.tif", np.eye(4, dtype=np.uint8))
    imwrite(tmp_path / "a_0_1.tif", np.eye(5, dtype=np.uint8))
    with pytest.raises(FileFormatError, match="first view is"):
        read_light_field(tmp_path)
    window = (
        np.array([0, 0], np.int32),
        np.array([3, 3], np.int32),
    )  # the display's; the data's may differ
    header = {"type": OpenEXR.scanlineimage, "displayWindow": window}
    parts = [
        OpenEXR.Part(dict(header), {"Y": np.eye(4 + n, dtype=np.float32)}, f"v=0,u={n}")
        for n in (0, 1)
    ]
    OpenEXR.File(parts).write(str(tmp_path / "unequal.exr"))
    with pytest.raises(FileFormatError, match="differ in size"):
        read_light_field(tmp_path / "unequal.exr")


def test_exr_parts_must_say_what_they_are(tmp_path):
    import OpenEXR

    header = {"type": OpenEXR.scanlineimage}
    for name, channel in (("left", "Y"), ("v=0,u=0", "Z")):
        OpenEXR.File([OpenEXR.Part(header, {channel: np.eye(4, dtype=np.float32)}, name)]).write(
            str(tmp_path / "other.exr")
        )
        with pytest.raises(FileFormatError):
            read_light_field(tmp_path / "other.exr")


def test_damaged_and_unknown_files_are_refused(tmp_path):
    write_light_field(light_field(), tmp_path / "whole.exr")
    whole = (tmp_path / "whole.exr").read_bytes()
    (tmp_path / "cut.exr").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "noise.exr").write_bytes(b"no picture")
    (tmp_path / "noise_0_0.png").write_bytes(b"no picture")
    (tmp_path / "text.txt").write_text("no light field")
    for name in ("cut.exr", "noise.exr", "text.txt", "."):
        with pytest.raises(FileFormatError):
            read_light_field(tmp_path / name)
    with pytest.raises(StorageError):
        read_light_field(tmp_path / "absent.exr")
    with pytest.raises(InputError):
        write_light_field(light_field(), tmp_path / "field.png")


@pytest.mark.parametrize("fault", [np.nan, 0.0])
def test_nan_and_constant_pictures_are_refused(tmp_path, fault):
    import OpenEXR

    part = OpenEXR.Part(
        {"type": OpenEXR.scanlineimage}, {"Y": np.full((4, 4), fault, np.float32)}, "v=0,u=0"
    )
    OpenEXR.File([part]).write(str(tmp_path / "field.exr"))
    with pytest.raises(TofclipError):
        read_light_field(tmp_path / "field.exr")


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
