from __future__ import annotations

from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from nlos import Grid, Volume
from nlos.picture import _draw_figure
from tofclip.errors import FileFormatError, InputError, ShapeError
from tofclip.storage import Record

GRID = Grid(x=[0.0, 0.1, 0.2, 0.3], y=[-0.2, -0.1, 0.0], z=[0.5, 0.6])


def volume_with(value: complex = 3 - 4j, dtype: type = np.complex64) -> Volume:
    values = np.zeros(GRID.shape, dtype)
    values[1, 0, 3] = value
    values[0, 2, 1] = 1
    return Volume(values, GRID, {"made": "here"})


def test_magnitude_and_brightest_voxel() -> None:
    volume = volume_with()
    assert volume.magnitude[1, 0, 3] == pytest.approx(5)
    assert volume.find_brightest() == pytest.approx((0.3, -0.2, 0.6))


@pytest.mark.parametrize("suffix", [".nii", ".ply", ".h5x"])
def test_a_volume_is_not_called_what_it_is_not(suffix: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"must end in \.h5 or \.hdf5"):
        volume_with().save(tmp_path / f"volume{suffix}")
    assert not list(tmp_path.iterdir())


def test_the_maximum_projection_keeps_the_depth() -> None:
    projection = volume_with().maximum_projection()
    assert projection.brightness.shape == projection.depth.shape == (3, 4)
    assert projection.brightness[0, 3] == pytest.approx(5)
    assert projection.depth[0, 3] == 0.6
    assert projection.depth[2, 1] == 0.5


def test_a_threshold_is_relative_to_the_brightest() -> None:
    kept = volume_with().threshold(0.5)
    assert np.count_nonzero(kept.values) == 1
    assert kept.values[1, 0, 3] == 3 - 4j
    assert kept.values.dtype == np.complex64
    assert np.count_nonzero(volume_with().threshold(0.2).values) == 2
    assert np.array_equal(volume_with().threshold(0).values, volume_with().values)
    for wrong in (-0.1, 1.1, np.nan):
        with pytest.raises(InputError, match="between 0 and 1"):
            volume_with().threshold(wrong)


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.complex64, np.complex128])
def test_files_give_back_what_was_saved(dtype: type, tmp_path: Path) -> None:
    saved = volume_with(2.5, dtype)
    saved.save(tmp_path / "volume.h5")
    loaded = Volume.load(tmp_path / "volume.h5")
    assert loaded.values.dtype == dtype
    assert np.array_equal(loaded.values, saved.values)
    for axis in "xyz":
        assert np.array_equal(getattr(loaded.grid, axis), getattr(GRID, axis))
    assert loaded.provenance == {"made": "here"}


def test_a_damaged_file_names_the_field(tmp_path: Path) -> None:
    record = volume_with().to_record()
    del record.fields["values"]
    record.save(tmp_path / "broken.h5")
    with pytest.raises(FileFormatError, match="no field 'values'"):
        Volume.load(tmp_path / "broken.h5")
    Record("capture").save(tmp_path / "other.h5")
    with pytest.raises(FileFormatError, match="expected volume"):
        Volume.load(tmp_path / "other.h5")


def test_values_fit_the_grid_and_are_finite() -> None:
    with pytest.raises(ShapeError, match="volume"):
        Volume(np.zeros((4, 3, 2)), GRID)
    with pytest.raises(InputError, match="NaN"):
        Volume(np.full(GRID.shape, np.nan), GRID)
    assert Volume(np.ones(GRID.shape, int), GRID).values.dtype == np.float32


@pytest.mark.parametrize("name", ["mip.png", "mip.pdf", "mip.SVG"])
def test_a_picture_is_written(name: str, tmp_path: Path) -> None:
    volume_with().save_picture(tmp_path / name)
    assert (tmp_path / name).stat().st_size > 5000
    assert len(list(tmp_path.iterdir())) == 1


def test_the_picture_has_x_to_the_right_and_y_down_in_metres(tmp_path: Path) -> None:
    figure = _draw_figure(volume_with())
    panels = {
        axes.get_title().split(":")[0].split(" ")[0]: axes
        for axes in figure.axes
        if axes.get_title()
    }
    assert set(panels) == {"front", "side", "top", "depth"}
    front, side, top = (panels[name].images[0] for name in ("front", "side", "top"))
    # Pixel edges: half a voxel beyond the outer centres; rows run down the picture with y, or with
    # z from above.
    assert front.get_extent() == pytest.approx([-0.05, 0.35, 0.05, -0.25])
    assert side.get_extent() == pytest.approx([0.45, 0.65, 0.05, -0.25])
    assert top.get_extent() == pytest.approx([-0.05, 0.35, 0.65, 0.45])
    assert all(image.origin == "upper" for image in (front, side, top))
    assert np.unravel_index(np.argmax(front.get_array()), (3, 4)) == (0, 3)
    assert np.unravel_index(np.argmax(side.get_array()), (3, 2)) == (0, 1)
    assert np.unravel_index(np.argmax(top.get_array()), (2, 4)) == (1, 3)
    depth = panels["depth"].images[0].get_array()
    assert depth[0, 3] == pytest.approx(0.6)
    assert np.ma.count(np.ma.masked_invalid(depth)) == 1


def test_the_brightest_spot_of_the_png_lies_where_the_axes_say(tmp_path: Path) -> None:
    path = tmp_path / "mip.png"
    volume_with().save_picture(path)
    pixels = matplotlib.image.imread(path)[..., :3]
    figure = _draw_figure(volume_with())
    figure.canvas.draw()
    front = next(axes for axes in figure.axes if axes.get_title().startswith("front"))
    column, height = front.transData.transform((0.3, -0.2))
    # Brightest colour of the map: pale yellow; the image counts rows from the top.
    assert pixels[pixels.shape[0] - int(height), int(column)].min() > 0.6


def test_flat_dark_and_single_voxel_volumes_can_be_drawn(tmp_path: Path) -> None:
    for grid in (Grid([0.1], [0.2], [0.3]), Grid(np.linspace(-1, 1, 50), [0.0], [1.0]), GRID):
        Volume(np.zeros(grid.shape), grid).save_picture(tmp_path / "dark.png")


def test_depths_one_voxel_apart_have_nearly_one_colour() -> None:
    values = np.zeros((3, 3, 4))
    values[1, :, :2] = values[2, :, 2:] = 1
    figure = _draw_figure(Volume(values, Grid(GRID.x, GRID.y, [0.5, 0.6, 0.7])))
    drawn = next(axes for axes in figure.axes if axes.get_title().startswith("depth")).images[0]
    assert drawn.get_clim() == pytest.approx((0.25, 1.05))  # 8 voxels around 0.6 and 0.7 m


def test_unknown_picture_formats_are_refused_before_drawing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"must end in \.png"):
        volume_with().save_picture(tmp_path / "mip.gif")
    assert not list(tmp_path.iterdir())
