"""Grids and volumes: their axes, files, pictures, and exports that other libraries open."""

import matplotlib.image
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nlos import Capture, Grid, TransientVideo, Volume
from nlos.picture import _draw_figure, map_depths
from tofclip.errors import FileFormatError, InputError, ShapeError
from tofclip.storage import Record

GRID = Grid(x=[0.0, 0.1, 0.2, 0.3], y=[-0.2, -0.1, 0.0], z=[0.5, 0.6])
FINE = Grid(0.1 + 0.02 * np.arange(7), -0.3 + 0.03 * np.arange(6), 0.5 + 0.01 * np.arange(5))
metres = st.floats(-5, 5, allow_nan=False)


def volume_with(value=3 - 4j, dtype=np.complex64):
    values = np.zeros(GRID.shape, dtype)
    values[1, 0, 3], values[0, 2, 1] = value, 1
    return Volume(values, GRID, {"made": "here"})


def ball():
    """A soft ball off the middle, brightest at one voxel, with a complex phase that must not
    matter.
    """
    away = (FINE.points - [0.16, -0.24, 0.52]) / [0.03, 0.04, 0.012]
    values = np.exp(-np.sum(away**2, axis=-1) + 1j * FINE.points[..., 0])
    return Volume(values.astype(np.complex64), FINE)


def dark(grid):
    return Volume(np.zeros(grid.shape), grid)


# --- grids


@given(ends=st.tuples(*[st.tuples(metres, metres)] * 3), voxel=st.floats(0.05, 2))
def test_a_box_holds_evenly_spaced_voxels_of_the_size_asked_for(ends, voxel):
    sides = [tuple(sorted(pair)) for pair in ends]
    grid = Grid.box(*sides, voxel)
    for axis, (first, last) in zip((grid.x, grid.y, grid.z), sides, strict=True):
        # 1e-6 of a voxel is the slack that lets a side of a whole number of voxels keep its last
        # one.
        slack = 1e-5 * voxel
        assert axis[0] >= first - slack
        assert axis[-1] <= last + slack
        assert axis[0] - first < voxel / 2 + slack
        assert np.allclose(np.diff(axis), voxel, rtol=1e-9, atol=1e-12)
        assert np.isclose(axis[0] - first, last - axis[-1], atol=1e-9)


def test_shapes_follow_z_y_x_and_a_side_of_whole_voxels_keeps_both_ends():
    grid = Grid(x=[0, 1, 2], y=[0, 1], z=[1, 2, 3, 4])
    assert (grid.shape, grid.size) == ((4, 2, 3), 24)
    assert grid.find_nearest((1.9, 0.2, 3.4)) == (2, 0, 2)
    grid = Grid.box((-0.3, 0.3), (0.1, 0.1), (0.5, 0.7), (0.006, 1, 0.1))
    assert grid.shape == (3, 1, 101)
    assert grid.x[[0, -1]] == pytest.approx([-0.3, 0.3])
    assert grid.y == pytest.approx([0.1])


UNIT = (0, 1), (0, 1), (0, 1)


@pytest.mark.parametrize(
    ("make", "arguments", "message"),
    [
        *((Grid, ([0], axis, [1]), "grid axis y") for axis in ([], [[0, 1]], 3.0)),
        *(
            (Grid, ([0], [0], axis), "grid axis z must be finite and strictly increasing")
            for axis in ([0, 0], [1, 0], [0, np.nan], [np.inf])
        ),
        *((Grid.box, (*UNIT, v), "voxel size") for v in (0, -1, np.nan, np.inf, (1, 1, 0))),
        *(
            (Grid.box, ((0, 1), s, (0, 1), 0.1), "side y")
            for s in ((1, 0), (np.nan, 1), (0, np.inf))
        ),
        # refused before memory is taken
        (Grid.box, ((0, 0), (0, 0), (0.5, 1), 1e-9), r"side z of the box.* has millions of voxels"),
        (Grid.around, (dark(GRID), 0.1), "dark everywhere"),
    ],
)
def test_what_is_no_grid_is_refused(make, arguments, message):
    with pytest.raises(InputError, match=message):
        make(*arguments)


def test_the_space_in_front_of_a_wall_is_as_wide_as_the_wall_and_as_deep_as_light_reaches(
    capture,
):
    grid = Grid.in_front_of(capture, 0.05)
    assert grid.x[[0, -1]] == pytest.approx([-0.6, 0.6])
    assert grid.y[[0, -1]] == pytest.approx([-0.5, 0.5])
    assert grid.z[0] >= 0.05 - 1e-9
    reach = capture.axis.paths[-1] / 2
    assert reach - 0.05 <= grid.z[-1] <= reach
    near = Grid.in_front_of(capture, 0.05, near=0.3, far=0.5)
    assert near.z[[0, -1]] == pytest.approx([0.3, 0.5])
    late, early = (
        Capture(capture.signal, capture.wall, capture.laser, capture.bin_width, start)
        for start in (100.0, -2.0)
    )
    # However long the record: not deeper than two widths of the wall.
    assert Grid.in_front_of(late, 0.05).z[-1] == pytest.approx(2.4, abs=0.05)
    with pytest.raises(InputError, match="no room for a hidden scene"):
        Grid.in_front_of(early, 0.05)


def test_looking_closer_keeps_everything_bright_and_one_voxel_more():
    coarse = Grid.box((-1, 1), (-1, 1), (0.5, 1.5), 0.1)
    values = np.zeros(coarse.shape, np.float32)
    values[4, 7, 12] = 1.0  # z 0.9, y -0.3, x 0.2
    values[5, 20, 3] = 0.5  # z 1.0, y 1.0 (the last), x -0.7
    values[0, 0, 0] = 0.05
    fine = Grid.around(Volume(values, coarse), 0.025, fraction=0.1)
    assert fine.x[[0, -1]] == pytest.approx([-0.8, 0.3])
    assert fine.y[[0, -1]] == pytest.approx([-0.4, 1.0])
    assert fine.z[[0, -1]] == pytest.approx([0.8, 1.1])


# --- volumes


def test_magnitude_brightest_voxel_and_maximum_projection():
    volume = volume_with()
    assert volume.magnitude[1, 0, 3] == pytest.approx(5)
    assert volume.find_brightest() == pytest.approx((0.3, -0.2, 0.6))
    projection = volume.maximum_projection()
    assert projection.brightness.shape == projection.depth.shape == (3, 4)
    assert projection.brightness[0, 3] == pytest.approx(5)
    assert (projection.depth[0, 3], projection.depth[2, 1]) == (0.6, 0.5)


def test_a_threshold_is_relative_to_the_brightest():
    kept = volume_with().threshold(0.5)
    assert np.count_nonzero(kept.values) == 1
    assert kept.values[1, 0, 3] == 3 - 4j
    assert kept.values.dtype == np.complex64
    assert np.count_nonzero(volume_with().threshold(0.2).values) == 2
    assert np.array_equal(volume_with().threshold(0).values, volume_with().values)


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.complex64, np.complex128])
def test_files_give_back_what_was_saved(dtype, tmp_path):
    saved = volume_with(2.5, dtype)
    saved.save(tmp_path / "volume.h5")
    loaded = Volume.load(tmp_path / "volume.h5")
    assert loaded.values.dtype == dtype
    assert np.array_equal(loaded.values, saved.values)
    for axis in "xyz":
        assert np.array_equal(getattr(loaded.grid, axis), getattr(GRID, axis))
    assert loaded.provenance == {"made": "here"}


def test_values_fit_the_grid_and_are_finite():
    with pytest.raises(ShapeError, match="volume"):
        Volume(np.zeros((4, 3, 2)), GRID)
    with pytest.raises(InputError, match="NaN"):
        Volume(np.full(GRID.shape, np.nan), GRID)
    assert Volume(np.ones(GRID.shape, int), GRID).values.dtype == np.float32


@pytest.mark.parametrize(
    ("attempt", "message"),
    [
        *((lambda v, _, f=f: v.threshold(f), "between 0 and 1") for f in (-0.1, 1.1, np.nan)),
        *(
            (lambda v, to, s=s: v.save(to / f"volume{s}"), r"must end in \.h5 or \.hdf5")
            for s in (".nii", ".ply", ".h5x")
        ),
        (lambda v, to: v.save_picture(to / "mip.gif"), r"must end in \.png"),
        (lambda v, to: v.export(to / "a.docx"), r"must end in \.vti"),
        *(
            (lambda _, __, f=f: ball().surface(f), "fraction between 0 and 1")
            for f in (0, 1, np.nan)
        ),
        (lambda v, _: dark(FINE).surface(0.5), "at least 2 voxels"),
        (lambda v, to: ball().surface().save(to / "ball.obj"), r"must end in \.ply"),
        (
            lambda v, to: dark(Grid(FINE.x, [-3, -2, -1.5], [0.5, 0.6])).export(to / "uneven.vti"),
            "evenly spaced voxels along y",
        ),
    ],
)
def test_what_a_volume_cannot_do_is_refused_before_a_file_is_made(attempt, message, tmp_path):
    with pytest.raises(InputError, match=message):
        attempt(volume_with(), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", [Volume, Capture, TransientVideo])
def test_files_of_something_else_are_refused(kind, tmp_path):
    Record("camera").save(tmp_path / "camera.h5")
    with pytest.raises(FileFormatError, match="holds a camera record, expected"):
        kind.load(tmp_path / "camera.h5")


# --- pictures


@pytest.mark.parametrize("name", ["mip.png", "mip.pdf", "mip.SVG"])
def test_a_picture_is_written(name, tmp_path):
    volume_with().save_picture(tmp_path / name)
    assert (tmp_path / name).stat().st_size > 5000
    assert len(list(tmp_path.iterdir())) == 1


def test_the_picture_has_x_to_the_right_and_y_down_in_metres(tmp_path):
    figure = _draw_figure(volume_with())
    titled = [axes for axes in figure.axes if axes.get_title()]
    panels = {axes.get_title().split()[1].strip(":"): axes for axes in titled}
    assert set(panels) == {"front", "side", "top", "depth"}
    # Pixel edges: half a voxel beyond the outer centres; rows run down the picture with y, or with
    # z from above.
    for name, extent, shape, brightest in (
        ("front", [-0.05, 0.35, 0.05, -0.25], (3, 4), (0, 3)),
        ("side", [0.45, 0.65, 0.05, -0.25], (3, 2), (0, 1)),
        ("top", [-0.05, 0.35, 0.65, 0.45], (2, 4), (1, 3)),
    ):
        image = panels[name].images[0]
        assert image.get_extent() == pytest.approx(extent)
        assert image.origin == "upper"
        assert np.unravel_index(np.argmax(image.get_array()), shape) == brightest
    depth = panels["depth"].images[0].get_array()
    assert depth[0, 3] == pytest.approx(0.6)
    assert np.ma.count(np.ma.masked_invalid(depth)) == 1
    volume_with().save_picture(tmp_path / "mip.png")
    pixels = matplotlib.image.imread(tmp_path / "mip.png")[..., :3]
    figure.dpi = 300
    figure.canvas.draw()
    column, height = panels["front"].transData.transform((0.3, -0.2))
    # Brightest colour of the map: pale yellow; the image counts rows from the top.
    assert pixels[pixels.shape[0] - int(height), int(column)].min() > 0.6


def test_flat_dark_and_single_voxel_volumes_can_be_drawn(tmp_path):
    for grid in (Grid([0.1], [0.2], [0.3]), Grid(np.linspace(-1, 1, 50), [0.0], [1.0]), GRID):
        dark(grid).save_picture(tmp_path / "dark.png")


# --- exports, opened by libraries that share no code with the writers


def test_vti_opens_in_vtk(tmp_path):
    pyvista, volume = pytest.importorskip("pyvista"), ball()
    volume.export(tmp_path / "a.vti")
    image = pyvista.read(tmp_path / "a.vti")
    assert image.dimensions == (7, 6, 5)
    assert image.origin == pytest.approx((0.1, -0.3, 0.5))
    assert image.spacing == pytest.approx((0.02, 0.03, 0.01))
    assert np.array_equal(image["brightness"].reshape(5, 6, 7), volume.magnitude)
    brightest = image.points[np.argmax(image["brightness"])]
    assert brightest == pytest.approx(volume.find_brightest())
    Volume(np.ones((1, 6, 7)), Grid(FINE.x, FINE.y, [0.5])).export(tmp_path / "flat.vti")
    assert pyvista.read(tmp_path / "flat.vti").dimensions == (7, 6, 1)


def test_ply_points_open_in_vtk(tmp_path):
    pyvista = pytest.importorskip("pyvista")
    ball().export(tmp_path / "a.ply", fraction=0.5)
    xyz, brightness = ball().points(0.5)
    assert np.asarray(pyvista.read(tmp_path / "a.ply").points) == pytest.approx(xyz)
    assert len(xyz) == np.count_nonzero(ball().magnitude >= 0.5)
    assert brightness.min() >= 0.5
    assert xyz[np.argmax(brightness)] == pytest.approx(ball().find_brightest())


def test_exr_npz_and_csv_open(tmp_path):
    OpenEXR, volume = pytest.importorskip("OpenEXR"), ball()
    for suffix in ("exr", "npz", "csv"):
        volume.export(tmp_path / f"a.{suffix}", fraction=0.9)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    projection = volume.maximum_projection()
    assert np.array_equal(channels["Y"], projection.brightness)
    assert channels["Z"] == pytest.approx(projection.depth)
    with np.load(tmp_path / "a.npz", allow_pickle=False) as stored:
        assert np.array_equal(stored["values"], volume.values)
        assert np.array_equal(stored["y_m"], FINE.y)
        assert set(stored) == {"values", "x_m", "y_m", "z_m"}
    rows = np.genfromtxt(tmp_path / "a.csv", delimiter=",", names=True)
    assert rows["x_m"] == pytest.approx(volume.find_brightest()[0])


def test_the_surface_encloses_the_ball(tmp_path):
    pyvista = pytest.importorskip("pyvista")
    fine = Grid(*(np.linspace(-0.2, 0.2, n) for n in (31, 35, 33)))
    centre = np.array([0.03, -0.02, 0.01])
    radius = np.linalg.norm(fine.points - centre, axis=-1)
    mesh = Volume(np.clip(1 - radius / 0.2, 0, None), fine).surface(0.5)
    # Half of the brightest voxel lies at this radius; marching cubes interpolate a cone linearly
    # along edges.
    half = 0.2 * (1 - (1 - radius.min() / 0.2) / 2)
    assert np.linalg.norm(mesh.vertices - centre, axis=1) == pytest.approx(half, abs=2e-3)
    mesh.save(tmp_path / "ball.ply")
    read = pyvista.read(tmp_path / "ball.ply")
    assert (read.n_points, read.n_cells) == (len(mesh.vertices), len(mesh.faces))
    assert read.volume == pytest.approx(4 / 3 * np.pi * half**3, rel=0.03)


def test_the_depth_map_shows_a_weak_thing_behind_a_bright_one_and_no_noise():
    axis = 0.01 * np.arange(60)
    values = 0.05 * np.random.default_rng(1).random((60, 30, 30))
    values[15, 5:25, 5:10], values[45, 5:25, 20:25] = 1.0, 0.3
    depth = map_depths(Volume(values, Grid(axis[:30], axis[:30], axis + 0.2)))
    assert np.all(depth[5:25, 5:10] == pytest.approx(0.35))
    assert np.all(depth[5:25, 20:25] == pytest.approx(0.65))
    assert np.isfinite(depth).sum() == 200
