"""Objects in the hand: opened by one function, printed in a line, shown in a notebook, sliced."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

import nlos
import tofclip
from tofclip.errors import InputError, MissingDependencyError


@pytest.fixture
def frames():
    camera = tofclip.Camera(np.array([8.0, 24.0]), np.zeros(2), (6, 5), 32, time_zero=-1e-9)
    times = 10e-9 + 1e-10 * np.arange(50)
    values = np.random.default_rng(0).random((50, 6, 5), dtype=np.float32)
    return tofclip.Frames(values, times, camera, {"method": "<tv>"})


@pytest.fixture
def cloud():
    xyz = np.random.default_rng(1).uniform(1, 2, (40, 3)).astype(np.float32)
    distance = np.linalg.norm(xyz, axis=1)
    one = np.ones(40)
    return tofclip.PointCloud(xyz, one, 0.01 * one, distance, one, 2 * distance / 3e8)


GRID = nlos.Grid.box((0, 5), (0, 4), (1, 4), 1.0)
VOLUME = nlos.Volume(np.ones((4, 5, 6), np.float32), GRID)


def test_frames_are_sliced_and_selected(frames):
    some = frames[10:20]
    assert len(some) == 10
    assert np.array_equal(np.asarray(some), frames.values[10:20])
    assert np.array_equal(some.times, frames.times[10:20])
    near = frames.sel(range=(1.7, 2.0))
    distance = 299792458 * near.times / 2
    assert distance.min() >= 1.7
    assert distance.max() <= 2.0
    assert len(near) == np.count_nonzero(np.abs(299792458 * frames.times / 2 - 1.85) <= 0.15)
    assert len(frames.sel(time=(10e-9, 11e-9))) in (10, 11)
    for wrong in ({}, {"range": (5, 6)}, {"range": (1, 2), "time": (0, 1)}):
        with pytest.raises(InputError):
            frames.sel(**wrong)
    assert frames.shape == frames.values.shape
    assert np.array_equal(frames.ranges, 299792458 * frames.times / 2)
    assert np.array_equal(frames.max(axis=0), np.max(frames.values, axis=0))
    assert np.max(frames) == frames.values.max()
    for place in (3, (slice(None), slice(1, 4)), (..., 2, 1), frames.times > 12e-9):
        assert np.array_equal(frames[place], frames.values[place])
    assert np.array_equal(VOLUME[2], VOLUME.values[2])


def test_points_are_selected(cloud):
    near = cloud[cloud.range < 2.5]
    assert 0 < len(near) < len(cloud)
    assert near.range.max() < 2.5
    assert np.array_equal(cloud[:7].xyz, cloud.xyz[:7])
    with pytest.raises(InputError, match="mask"):
        cloud[np.ones(3, bool)]


def test_a_line_and_a_page_say_what_is_held(frames, cloud):
    assert repr(frames) == "Frames(50 frames of 6 x 5 pixels, range 1.5 to 2.23 m)"
    no_zero = replace(frames, camera=frames.camera.replace(time_zero=0.0))
    assert repr(no_zero).endswith("2.23 m up to a constant, no time zero given)")
    assert "no time zero given" in no_zero._repr_html_()
    assert repr(cloud).startswith("PointCloud(40 points, range ")
    assert repr(VOLUME) == "Volume(4 x 5 x 6 voxels (z, y, x), float32)"
    streak = tofclip.Streak(np.ones((9, 7)), np.arange(9) * 1e-9, camera=frames.camera)
    assert repr(streak) == "Streak(9 x 7 counts (time, column), 0.000 to 8.000 ns, with its camera)"
    assert repr(frames.camera).startswith("Camera(2 views, pictures of 6 x 5 pixels, time zero")
    wall = np.stack([*np.meshgrid([0.0, 0.1, 0.2], [0.0, 0.1]), np.zeros((2, 3))], axis=-1)
    capture = nlos.Capture(np.ones((50, 2, 3)), wall, np.zeros(3), 8e-12)
    assert repr(capture) == "Capture(2 x 3 wall points, one laser spot, 50 bins of 8 ps)"
    assert "0.200 x 0.100 x 0.000 m" in capture._repr_html_()
    assert "line angles" in frames.camera._repr_html_()
    assert repr(tofclip.depth(frames)[:0]) == "Returns(none)"
    noise = np.random.default_rng(0).poisson(9, (1016, 1344))
    assert len(tofclip.Streak(noise)._repr_html_()) < 60_000  # of each cell of a notebook
    for one in (frames, VOLUME, cloud, streak, capture):
        assert "<img" in one._repr_html_()
    assert "<img" not in cloud[:0]._repr_html_()
    assert "&lt;tv&gt;" in frames._repr_html_()
    assert "range" in cloud._repr_html_()


def test_objects_become_those_of_other_libraries(frames, cloud):
    streak = tofclip.Streak(np.ones((9, 7)))
    assert np.array_equal(np.asarray(frames), frames.values)
    assert np.array_equal(np.asarray(cloud), cloud.xyz)
    assert np.array_equal(np.asarray(VOLUME), VOLUME.values)
    assert np.array_equal(np.asarray(streak), streak.counts)
    pytest.importorskip("torch", reason="pip install torch")
    for one, array in ((frames, frames.values), (cloud, cloud.xyz), (VOLUME, VOLUME.values)):
        assert np.array_equal(one.to_torch().numpy(), array)


def test_labelled_arrays_carry_times_and_places(frames):
    pytest.importorskip("xarray", reason="pip install 'tofclip[notebook]'")
    labelled = frames.to_xarray()
    assert labelled.dims == ("time", "y", "x")
    assert labelled.attrs["units"] == "counts"
    assert labelled.time.attrs["units"] == "s"
    assert labelled.range.attrs["units"] == "m"
    assert np.array_equal(labelled.range, frames.ranges)
    streak = tofclip.Streak(np.ones((9, 7)), np.arange(9) * 1e-9)
    assert streak.to_xarray().dims == ("time", "column")
    assert tofclip.Streak(np.ones((9, 7))).to_xarray().dims == ("row", "column")
    near = labelled.sel(time=slice(11e-9, 12e-9))
    assert np.array_equal(near.values, frames.sel(time=(11e-9, 12e-9)).values)
    assert np.array_equal(VOLUME.to_xarray().z.values, VOLUME.grid.z)


def test_points_become_a_table(cloud):
    pytest.importorskip("pandas", reason="pip install 'tofclip[notebook]'")
    table = cloud.to_pandas()
    assert list(table.columns[:4]) == ["x", "y", "z", "intensity"]
    assert np.array_equal(table[["x", "y", "z"]].to_numpy(), cloud.xyz)


def test_points_become_open3ds_and_come_back(cloud, open3d):
    known = replace(cloud, false_alarm=np.linspace(0, 1, len(cloud), dtype=np.float32))
    back = tofclip.PointCloud.from_open3d(known.to_open3d_tensor())
    for column, again in zip(known.columns, back.columns, strict=True):
        assert np.array_equal(column.values, again.values)
    legacy = known.to_open3d()
    assert legacy.has_colors()
    back = tofclip.PointCloud.from_open3d(legacy)
    assert np.allclose(back.xyz, cloud.xyz)
    assert np.allclose(back.range, cloud.range)
    assert np.isnan(back.range_sigma).all()
    assert len(tofclip.PointCloud.from_open3d(open3d.geometry.PointCloud())) == 0
    with pytest.raises(InputError, match="not a Volume"):
        tofclip.PointCloud.from_open3d(VOLUME)


def test_a_volume_becomes_pyvistas():
    pytest.importorskip("pyvista", reason="pip install pyvista")
    bright = np.zeros(GRID.shape, np.float32)
    bright[1, 2, 3] = 5
    shown = nlos.Volume(bright, GRID).to_pyvista()
    place = shown.points[np.argmax(shown["brightness"])]
    assert np.allclose(place, (GRID.x[3], GRID.y[2], GRID.z[1]))


def test_pictures_are_drawn_where_asked(frames, cloud):
    figure = Figure()
    axes = figure.subplots(1, 3)
    for one, ax in zip((frames, cloud, VOLUME), axes, strict=True):
        assert one.plot(ax) is ax
    assert np.array_equal(axes[0].images[0].get_array(), frames.values.sum(axis=0))
    assert "1.5 to 2.23 m" in axes[0].get_title()
    assert len(axes[1].collections[0].get_offsets()) == len(cloud)
    assert axes[1].yaxis_inverted()  # y points down


@pytest.mark.parametrize(
    ("package", "export"),
    [
        ("xarray", lambda frames, cloud: frames.to_xarray()),
        ("pandas", lambda frames, cloud: cloud.to_pandas()),
        ("open3d", lambda frames, cloud: cloud.to_open3d()),
        ("torch", lambda frames, cloud: frames.to_torch()),
    ],
)
def test_a_missing_library_is_named_in_a_line(monkeypatch, frames, cloud, package, export):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingDependencyError, match=f"pip install {package}") as fault:
        export(frames, cloud)
    assert "\n" not in str(fault.value)


def test_wrong_types_and_names_are_refused_by_our_own_errors(frames, cloud, tmp_path):
    values, times, camera = frames.values, frames.times, frames.camera
    calls = {
        lambda: frames.save(tmp_path / "frames.npz"): r"must end in \.h5 or \.hdf5",
        lambda: cloud.save(tmp_path / "cloud.xyz"): r"\.xyz",
        lambda: tofclip.recover("shot.tif"): r"see tofclip\.read_streak, not a str",
        lambda: tofclip.depth(values): "not a ndarray",
        lambda: tofclip.point_cloud(frames): "not a Frames",
        lambda: tofclip.Frames([1.0], times, camera): "not a list",
        lambda: tofclip.Frames(values, times, "camera.h5"): "not a str",
        lambda: tofclip.Frames("a", "b", "c"): "belong to a Camera",
        lambda: frames.sel(range="near"): "limits",
        lambda: frames.sel(range=2): "limits",
        lambda: frames.sel(range=(1, 2, 3)): "limits",
        lambda: cloud["near"]: "slice, a mask or numbers",
        lambda: frames[60]: r"frames are \(time, y, x\) = \(50, 6, 5\)",
        lambda: VOLUME["near"]: r"a volume is \(z, y, x\) = \(4, 5, 6\)",
        lambda: cloud[3]: r"one point is cloud\[3:4\]",
        lambda: frames[60:70]: "no frame is selected of 50",
        lambda: frames[::-1]: "step cannot be negative",
        lambda: nlos.Capture.from_frames(3): "not a",
        lambda: nlos.Grid.in_front_of(frames, voxel=0.01): "not a",
        lambda: nlos.Hybrid(wavelength="long"): "not a",
        lambda: nlos.Hybrid(wavelength=0.05).reconstruct(frames, GRID): "not a",
    }
    for call, problem in calls.items():
        with pytest.raises(InputError, match=problem):
            call()
    assert list(tmp_path.iterdir()) == []


def test_a_number_is_not_taken_for_a_file_that_is_open(tmp_path):
    """Python's `open` takes a number for one of the process's files, and closes it afterwards."""
    with open(tmp_path / "mine.txt", "w") as mine:
        for read in (tofclip.load, tofclip.read_streak, tofclip.Camera.load):
            with pytest.raises(InputError, match="a file is given by its name, not a int"):
                read(mine.fileno())
        mine.write("still open")
    assert (tmp_path / "mine.txt").read_text() == "still open"
