"""Where returns are placed in space, and the files that hold them, read back by us and by others."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofclip.camera import Camera
from tofclip.camera.model import distort_directions
from tofclip.errors import (
    CalibrationError,
    FileFormatError,
    InputError,
    MissingDependencyError,
    ShapeError,
    StorageError,
)
from tofclip.lidar import (
    PointCloud,
    Returns,
    compute_ray_directions,
    point_cloud,
    save_depth,
)
from tofclip.lidar.cloud import save_organised
from tofclip.units import SPEED_OF_LIGHT

PLAIN = (".ply", ".pcd", ".csv", ".npz", ".h5")
SUFFIXES = (*PLAIN, ".las", ".laz", ".e57")
LIBRARIES = {".las": "laspy", ".laz": "lazrs", ".e57": "pye57"}
PROPERTIES = ("intensity", "range_sigma", "range", "return_number", "time")
OPTIONAL = ("false_alarm", "reflectance")


def make_camera(rows=128, columns=96, focal=560.0, **others):
    return Camera([60.0], [0.0], (rows, columns), 200, focal_length_px=focal, **others)


def make_cloud(points, seed, known=False):
    random = np.random.default_rng(seed)
    column = random.uniform(0.1, 5, (6, points)).astype(np.float32)
    optional = {"false_alarm": column[4], "reflectance": column[5]} if known else {}
    return PointCloud(
        random.normal(size=(points, 3)),
        *column[:3],
        random.integers(1, 5, points).astype(np.uint8),
        1e-8 * column[3],
        {"seed": seed, "said": 40 * " in long  comments, π\n"},
        **optional,
    )


def make_returns(y, x, distance, bright, number, camera):
    bright, distance = np.asarray(bright, np.float32), np.asarray(distance, np.float64)
    y, x = np.asarray(y, np.int32), np.asarray(x, np.int32)
    time, number = 2 * distance / SPEED_OF_LIGHT, np.asarray(number, np.uint8)
    return Returns(y, x, distance, bright, 1e-3 * bright, number, time, camera, {"of": "a test"})


@pytest.fixture(scope="module")
def cloud():
    return make_cloud(40, 1)


def test_a_wall_across_the_axis_comes_out_flat_with_all_that_was_known():
    wall, camera = 2.5, make_camera()
    rows, columns = np.indices(camera.image_shape).reshape(2, -1)
    right, down = (columns - 48) / 560.0, (rows - 64) / 560.0
    distance = wall * np.sqrt(1 + right**2 + down**2)
    ones = np.ones(rows.size)
    cloud = point_cloud(make_returns(rows, columns, distance, 3 * ones, ones, camera))
    # float32 positions are rounded to 0.12 um at 2.5 m
    expected = np.stack([wall * right, wall * down, wall * ones], axis=1)
    np.testing.assert_allclose(cloud.xyz, expected, atol=0.5e-6)
    np.testing.assert_allclose(np.linalg.norm(cloud.xyz, axis=1), cloud.range, rtol=1e-6)
    np.testing.assert_allclose(cloud.range, distance, rtol=1e-6)
    np.testing.assert_allclose(cloud.time, 2 * distance / SPEED_OF_LIGHT, rtol=1e-6)
    assert cloud.range_sigma[0] == pytest.approx(3e-3)
    assert (cloud.return_number == 1).all()
    assert cloud.provenance == {"of": "a test"}


@given(
    k=st.tuples(*[st.floats(-0.2, 0.2)] * 2, *[st.floats(-0.01, 0.01)] * 2, st.floats(-0.05, 0.05)),
    row=st.floats(0, 127),
    column=st.floats(0, 95),
)
def test_the_lens_is_undone(k, row, column):
    camera = make_camera(focal=200.0, distortion=np.array(k))
    (direction,) = compute_ray_directions(camera, [row], [column])
    assert np.linalg.norm(direction) == pytest.approx(1, rel=1e-12)
    x, y, z = direction
    right, down = distort_directions(np.array([x / z]), np.array([y / z]), np.array(k))
    assert right[0] * 200 + 48 == pytest.approx(column, abs=1e-6)
    assert down[0] * 200 + 64 == pytest.approx(row, abs=1e-6)


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        # OpenCV's order k1, k2, p1, p2, k3; by hand, at x = 0.3, y = -0.2, r^2 = 0.13
        (0, (0.3 * 1.13, -0.2 * 1.13)),
        (1, (0.3 * (1 + 0.13**2), -0.2 * (1 + 0.13**2))),
        (2, (0.3 - 0.12, -0.2 + 0.13 + 0.08)),
        (3, (0.3 + 0.13 + 0.18, -0.2 - 0.12)),
        (4, (0.3 * (1 + 0.13**3), -0.2 * (1 + 0.13**3))),
    ],
)
def test_each_coefficient_of_the_lens_bends_as_published(place, expected):
    found = distort_directions(np.array([0.3]), np.array([-0.2]), np.eye(5)[place])
    assert np.ravel(found) == pytest.approx(expected, abs=1e-12)


def test_impossible_lenses_are_refused(tmp_path):
    camera = make_camera(distortion=np.array([-9.0, 0, 0, 0, 0]))
    with pytest.raises(CalibrationError, match="too strong"):
        compute_ray_directions(camera, [0], [0])
    camera.save(tmp_path / "camera.h5")
    assert Camera.load(tmp_path / "camera.h5").distortion.tolist() == [-9, 0, 0, 0, 0]
    for wrong in (np.zeros(4), np.full(5, np.nan)):
        with pytest.raises(CalibrationError, match="5 finite numbers"):
            camera.replace(distortion=wrong)


def test_columns_that_do_not_fit_are_refused():
    columns = [getattr(make_cloud(3, 0), name) for name in PROPERTIES]
    for positions, error, words in (
        (np.zeros((3, 2)), ShapeError, r"positions of a point cloud must have shape \(points, 3\)"),
        (np.zeros((4, 3)), ShapeError, "intensity of a point cloud"),
        (np.full((3, 3), np.nan), InputError, "must be finite"),
    ):
        with pytest.raises(error, match=words):
            PointCloud(positions, *columns)


@settings(max_examples=8)
@given(points=st.integers(0, 40), seed=st.integers(0, 2**32 - 1), known=st.booleans())
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_brings_every_bit_back(tmp_path_factory, suffix, points, seed, known):
    """LAS to a micrometre; doubt and reflectance only where they are known."""
    pytest.importorskip(LIBRARIES.get(suffix, "h5py"))
    cloud = make_cloud(points, seed, known)
    path = tmp_path_factory.mktemp("cloud") / f"scene{suffix}"
    cloud.save(path)
    back = PointCloud.load(path)
    np.testing.assert_allclose(back.xyz, cloud.xyz, atol=0.7e-6 if "la" in suffix else 0, rtol=0)
    for name in (*PROPERTIES, *OPTIONAL):
        np.testing.assert_array_equal(getattr(back, name), getattr(cloud, name))
        assert getattr(back, name).dtype == getattr(cloud, name).dtype
    kept = suffix in (".h5", ".ply", ".pcd")
    assert back.provenance == (cloud.provenance if kept else {})
    listed = set(PointCloud.read_outline(path).fields)
    assert (set(OPTIONAL) <= listed) if known and points else not set(OPTIONAL) & listed


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_damaged_and_foreign_files_are_refused_in_one_line(cloud, tmp_path, suffix):
    pytest.importorskip(LIBRARIES.get(suffix, "h5py"))
    path = tmp_path / f"scene{suffix}"
    cloud.save(path)
    content = path.read_bytes()
    # a CSV row without its last column
    cut = content.rsplit(b",", 1)[0] if suffix == ".csv" else content[:-7]
    damaged = [b"", b"\x00GIF89a" * 9]
    damaged += [cut] if suffix in PLAIN else [content[: len(content) // 2], content[:300]]
    damaged += {".e57": [b"ASTM-E57" + 200 * b"\0"], ".las": [content[:-60]]}.get(suffix, [])
    for wrong in damaged:
        path.write_bytes(wrong)
        with pytest.raises(FileFormatError, match=path.name) as caught:
            PointCloud.load(path)
        assert "\n" not in str(caught.value)


HEADERS = {
    "ascii.ply": b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n",
    "faces.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nelement face 0\nend_header\n",
    "integers.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty int x\nend_header\n",
    "bare.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nend_header\n",
    "twice.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 0\n"
    + 2 * b"property float x\n"
    + b"end_header\n",
    "endless.ply": b"ply\n" + b"comment x\n" * 9000,
    "ascii.pcd": b"# .PCD v0.7\nFIELDS x\nSIZE 4\nTYPE F\nCOUNT 1\nPOINTS 0\nDATA ascii\n",
    "nameless.pcd": b"# .PCD v0.7\nSIZE 4\nTYPE F\nPOINTS 0\nDATA binary\n",
    "uneven.pcd": b"# .PCD v0.7\nFIELDS x y\nSIZE 4\nTYPE F\nPOINTS 0\nDATA binary\n",
    "twice.pcd": b"# .PCD v0.7\nFIELDS x x\nSIZE 4 4\nTYPE F F\nPOINTS 0\nDATA binary\n",
    "words.csv": b"x_m,y_m\none,two\n",
    "narrow.csv": b"x_m,y_m\n1,2,3\n",
}


@pytest.mark.parametrize("name", HEADERS)
def test_tables_of_another_kind_are_refused(tmp_path, name):
    (tmp_path / name).write_bytes(HEADERS[name])
    words = "two columns of one name" if "twice" in name else name
    with pytest.raises(FileFormatError, match=words):
        PointCloud.load(tmp_path / name)


def test_unknown_formats_and_places_are_refused(cloud, tmp_path, monkeypatch):
    listed = r"\.ply or \.pcd or \.csv or \.npz or \.las or \.laz or \.e57 or \.h5"
    with pytest.raises(InputError, match=f"must end in {listed}"):
        cloud.save(tmp_path / "scene.xyz")
    with pytest.raises(InputError, match="must end in"):
        PointCloud.load(tmp_path / "scene")
    with pytest.raises(StorageError, match="folder does not exist"):
        cloud.save(tmp_path / "nowhere" / "scene.ply")
    for suffix in PLAIN:
        with pytest.raises(StorageError, match="no such file"):
            PointCloud.load(tmp_path / f"absent{suffix}")
    with pytest.raises(InputError, match="2147 m"):
        replace(cloud, xyz=np.full((40, 3), 3000.0)).save(tmp_path / "far.las")
    for module, suffix, extra in (("laspy", ".las", "las"), ("pye57", ".e57", "exchange")):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(MissingDependencyError, match=rf"tofclip\[{extra}\]"):
            cloud.save(tmp_path / f"absent{suffix}")


def test_files_say_their_units_and_numpy_reads_them(cloud, tmp_path):
    for suffix, end in ((".ply", b"element"), (".pcd", b"0 0 0 1")):
        cloud.save(tmp_path / f"scene{suffix}")
        header = (tmp_path / f"scene{suffix}").read_bytes().split(end)[0]
        assert b"units: x m, y m, z m, intensity count, range_sigma m, range m, time s\n" in header
    cloud.save(tmp_path / "scene.csv")
    names = "x_m,y_m,z_m,intensity_count,range_sigma_m,range_m,return_number,time_s"
    assert (tmp_path / "scene.csv").read_text().splitlines()[0] == names
    table = np.genfromtxt(tmp_path / "scene.csv", delimiter=",", names=True, dtype=np.float64)
    seen = np.stack([table["x_m"], table["y_m"], table["z_m"]], axis=1)
    np.testing.assert_allclose(seen, cloud.xyz, rtol=1e-6)
    np.testing.assert_allclose(table["range_m"], cloud.range, rtol=1e-6)
    cloud.save(tmp_path / "scene.npz")
    with np.load(tmp_path / "scene.npz") as arrays:
        np.testing.assert_array_equal(arrays["z_m"], cloud.xyz[:, 2])


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_open3d_reads_the_same_points(open3d, tmp_path, suffix):
    cloud = make_cloud(200, 1, known=True)
    path = str(tmp_path / f"scene{suffix}")
    cloud.save(path)
    seen = open3d.t.io.read_point_cloud(path).point
    np.testing.assert_array_equal(seen.positions.numpy(), cloud.xyz)
    for name in ("intensity", "range_sigma", *OPTIONAL):
        np.testing.assert_array_equal(seen[name].numpy().ravel(), getattr(cloud, name))
    plain, ours = open3d.io.read_point_cloud(path), cloud.to_open3d()
    np.testing.assert_allclose(np.asarray(plain.points), cloud.xyz, rtol=1e-7)
    assert plain.has_colors()
    np.testing.assert_allclose(np.asarray(plain.colors), np.asarray(ours.colors))
    # brighter points are never darker to the eye
    seen = np.asarray(plain.colors)[np.argsort(cloud.intensity)] @ (0.2126, 0.7152, 0.0722)
    assert np.all(np.diff(seen) >= -0.01)
    assert np.ptp(seen) > 0.5


def test_pye57_reads_e57_and_failed_files_are_closed(cloud, tmp_path):
    pye57 = pytest.importorskip("pye57")
    path = tmp_path / "scene.e57"
    cloud.save(path)
    file = pye57.E57(str(path))
    seen = file.read_scan_raw(0)
    xyz = np.stack([seen[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
    np.testing.assert_array_equal(xyz, cloud.xyz)
    np.testing.assert_array_equal(seen["intensity"], cloud.intensity)
    file.close()
    pye57.E57(str(path), mode="w").close()
    with pytest.raises(FileFormatError) as kept:  # with all that the failed frames hold
        PointCloud.load(path)
    assert str(path) not in {os.path.realpath(one) for one in Path("/proc/self/fd").iterdir()}
    assert "scene.e57" in str(kept.value)


def test_a_las_column_of_several_numbers_for_a_point_is_refused(tmp_path):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.add_extra_dim(laspy.ExtraBytesParams("tofclip_range", "2u2"))
    table = laspy.LasData(header)
    table.x = table.y = table.z = np.arange(3.0)
    table.write(tmp_path / "pairs.las")
    with pytest.raises(FileFormatError, match="'tofclip_range' has 2 numbers for a point"):
        PointCloud.load(tmp_path / "pairs.las")


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_laspy_reads_micrometres_and_all_columns_with_their_units(cloud, tmp_path, suffix):
    laspy = pytest.importorskip("laspy")
    cloud.save(tmp_path / f"scene{suffix}")
    seen = laspy.read(tmp_path / f"scene{suffix}")
    xyz = np.stack([seen.x, seen.y, seen.z], axis=-1)
    np.testing.assert_allclose(xyz, cloud.xyz, atol=0.51e-6)
    extra = seen.point_format.extra_dimensions
    units = {one.name: bytes(one.description.encode()).rstrip(b"\0") for one in extra}
    assert [*units] == [f"tofclip_{name}" for name in PROPERTIES]
    assert (units["tofclip_range"], units["tofclip_time"]) == (b"m", b"s")
    for name in PROPERTIES:
        np.testing.assert_array_equal(seen[f"tofclip_{name}"], getattr(cloud, name))
    assert seen.header.are_points_compressed == (suffix == ".laz")
    assert seen.intensity.max() == 65535


def make_two_walls():
    """Pixels of a picture of 4 x 6: a wall at 2 m with a window, one at 3 m, both in one pixel."""
    y, x, distance = [0, 1, 2, 2, 3], [5, 2, 3, 3, 0], [2, 3, 2, 3, 2]
    camera = make_camera(4, 6, focal=10.0)
    return make_returns(y, x, distance, [1, 2, 1, 4, 3], [1, 1, 1, 2, 1], camera)


def test_one_return_of_each_pixel_is_chosen():
    returns = make_two_walls()
    assert returns.select("all") is returns
    assert returns.select("first").range.tolist() == [2, 3, 2, 2]
    assert returns.select("last").range.tolist() == [2, 3, 3, 2]
    strongest = returns.select("strongest")
    assert strongest.intensity.tolist() == [1, 2, 4, 3]
    assert strongest.return_number.tolist() == [1, 1, 2, 1]
    with pytest.raises(InputError, match="first, strongest, last, all"):
        returns.select("second")


def test_returns_that_were_apart_are_merged_pixel_by_pixel():
    returns = make_two_walls()
    far = returns.range == 3
    alone = replace(returns[far], return_number=np.ones(far.sum(), np.uint8))
    whole = alone.merge(returns[~far])
    for name in ("y", "x", "range", "intensity", "confidence", "return_number", "time"):
        found, expected = getattr(whole, name), getattr(returns, name)
        assert (found.tolist(), found.dtype) == (expected.tolist(), expected.dtype)


@pytest.mark.parametrize("suffix", [".pcd", ".ply", ".npz", ".csv"])
def test_organised_clouds_have_a_place_for_every_pixel(open3d, tmp_path, suffix):
    returns, path = make_two_walls().select("first"), tmp_path / f"scene{suffix}"
    assert save_organised(returns, path) == 4
    there = point_cloud(returns)
    if suffix == ".pcd":
        assert b"\nWIDTH 6\nHEIGHT 4\n" in path.read_bytes()
        seen = open3d.t.io.read_point_cloud(str(path)).point.positions.numpy()
        assert seen.shape == (24, 3)
        assert np.isfinite(seen).all(axis=1).sum() == 4
        np.testing.assert_array_equal(seen.reshape(4, 6, 3)[3, 0], there.xyz[3])
    if suffix == ".npz":
        with np.load(path) as pictures:
            assert pictures["z_m"].shape == (4, 6)
            assert pictures["range_m"][1, 2] == 3
            assert np.isnan(pictures["range_sigma_m"][1, 3])
    back = PointCloud.load(path)
    np.testing.assert_allclose(back.xyz, there.xyz)
    np.testing.assert_allclose(back.range_sigma, there.range_sigma)


def test_what_cannot_be_organised_is_refused(tmp_path):
    with pytest.raises(InputError, match="one point for a pixel"):
        save_organised(make_two_walls(), tmp_path / "scene.pcd")
    with pytest.raises(InputError, match=r"\.pcd, \.ply, \.npz, \.csv"):
        save_organised(make_two_walls().select("last"), tmp_path / "scene.las")


def test_depth_pictures_hold_metres_along_the_axis(tmp_path):
    y, x, bright = [0, 2, 2, 5], [8, 4, 4, 1], [5, 1, 7, 2]
    camera = make_camera(6, 9, focal=10.0)
    returns = make_returns(y, x, [2.0, 1.5, 3.0, 2.5], bright, [1, 1, 2, 1], camera)
    save_depth(returns, tmp_path / "depth.exr")
    with OpenEXR.File(str(tmp_path / "depth.exr")) as file:
        seen = {name: channel.pixels.copy() for name, channel in file.channels().items()}
    assert sorted(seen) == ["Y", "Z"]
    assert seen["Z"].dtype == np.float32
    assert seen["Z"][0, 8] == pytest.approx(point_cloud(returns).xyz[0, 2])
    # one row above the axis; the brighter return
    assert seen["Z"][2, 4] == pytest.approx(3.0 * 10 / np.hypot(10, 1))
    assert (seen["Y"][2, 4], seen["Y"][5, 1], seen["Y"][3, 3]) == (7, 2, 0)
    assert np.isinf(seen["Z"]).sum() == 6 * 9 - 3
