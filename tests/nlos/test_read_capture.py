"""Every format that `nlos.io.read_capture` knows, in files that these tests write, and the ways
such files can fail.
"""

from dataclasses import replace

import h5py
import numpy as np
import pytest
import scipy.io
from numpy.linalg import norm
from scenes import HIDDEN, around, planar_wall, see

from nlos import Backprojection, Capture
from nlos.capture import TimeAxis
from nlos.io import read_capture
from nlos.io.labs import rotate_to_scene
from tofclip.errors import FileFormatError, InputError, StorageError
from tofclip.io.light_fields import write_exr_parts
from tofclip.storage import Record
from tofclip.units import SPEED_OF_LIGHT

AXIS = TimeAxis(bins=220, bin_width=16e-12, start=0.5)
WALL = planar_wall(9, 12)
SPOT = np.array([0.12, 0.05, 0.0])
SOURCE, EYE = np.array([0.3, -0.4, 1.5]), np.array([-0.6, 0.2, 1.8])


def simulated(laser=SPOT, wall=WALL, axis=AXIS):
    return see([HIDDEN], wall, laser, axis)


def with_legs(capture, start=3.6):
    """The same light as a device records it, drawn without any shifting."""
    path = sum(norm(capture.laser - end, axis=-1) for end in (SOURCE, HIDDEN))
    path = path + sum(norm(capture.wall - end, axis=-1) for end in (EYE, HIDDEN))
    paths = start + AXIS.spacing * np.arange(400)
    return np.exp(-0.5 * ((paths.reshape(-1, *[1] * path.ndim) - path) / 0.012) ** 2), start


def same(found, expected):
    assert np.array_equal(found.signal, expected.signal)
    assert found.wall == pytest.approx(expected.wall, nan_ok=True)
    assert found.laser == pytest.approx(expected.laser)
    assert found.bin_width == pytest.approx(expected.bin_width)
    assert found.start == pytest.approx(expected.start, abs=1e-9)


def shows_the_point(capture):
    volume = Backprojection(0.2).reconstruct(capture, around(HIDDEN))
    assert volume.find_brightest() == pytest.approx(HIDDEN)


def refused(path, problem, error=FileFormatError):
    with pytest.raises(error, match=problem):
        read_capture(path)


# --- our own, and NumPy archives


def test_our_own_captures_keep_their_history(tmp_path):
    capture = replace(simulated(), provenance={"shot": 7})
    capture.save(tmp_path / "wall.h5")
    found = read_capture(tmp_path / "wall.h5")
    same(found, capture)
    assert found.provenance == {"shot": 7}


@pytest.mark.parametrize("laser", [SPOT, WALL], ids=["single", "confocal"])
@pytest.mark.parametrize("unit", ["s", "m"])
def test_a_numpy_archive(laser, unit, tmp_path):
    expected, width = simulated(laser), AXIS.bin_width if unit == "s" else AXIS.spacing
    geometry = {"wall_xyz": WALL.astype(np.float32), "laser_xyz": laser.astype(np.float32)}
    times = {f"delta_t_{unit}": width, "t_start_m": AXIS.start}
    np.savez(tmp_path / "a.npz", H=expected.signal, **geometry, **times, confocal=1)
    found = read_capture(tmp_path / "a.npz")
    same(found, expected)
    assert found.provenance["inputs"][0]["name"] == "a.npz"
    lasers = np.array([SPOT, np.add(SPOT, [0.1, 0, 0])])
    several = np.stack([expected.signal, 2 * expected.signal], axis=1)
    np.savez(tmp_path / "b.npz", H=several, wall_xyz=WALL, laser_xyz=lasers, **times)
    assert read_capture(tmp_path / "b.npz").signal.shape == several.shape


@pytest.mark.parametrize("name", ["t_s", "t_m"])
def test_time_bins_that_are_named_one_by_one(name, tmp_path):
    unit = SPEED_OF_LIGHT if name == "t_s" else 1.0
    file, fields = tmp_path / "a.npz", {"wall_xyz": WALL, "laser_xyz": SPOT}
    np.savez(file, H=simulated().signal, **fields, **{name: AXIS.paths / unit})
    same(read_capture(file), simulated())
    # The same light in bins that are by turns wider and narrower, by up to 45 %.
    number = np.arange(400)
    uneven = 0.5 + AXIS.spacing * (number + 3 * np.sin(0.15 * number))
    direct = norm(SPOT - HIDDEN) + norm(WALL - HIDDEN, axis=-1)
    light = np.exp(-0.5 * ((uneven.reshape(-1, 1, 1) - direct) / 0.02) ** 2)
    light *= np.gradient(uneven).reshape(-1, 1, 1) / AXIS.spacing
    np.savez(file, H=light, **fields, **{name: uneven / unit}, delta_t_s=1.0)
    found = read_capture(file)
    assert found.signal.sum(axis=0) == pytest.approx(light.sum(axis=0), rel=1e-5)
    arrival = np.tensordot(found.axis.paths, found.signal, (0, 0)) / found.signal.sum(axis=0)
    # A fiftieth of a bin; as they came the middles err by up to three bins.
    assert np.abs(arrival - direct).max() < 0.02 * AXIS.spacing
    for times, problem in (
        (uneven[::-1], "do not grow from bin to bin"),
        (np.append(uneven[:-1], uneven[-1] + 1e3), "so uneven"),
    ):
        np.savez(file, H=light, **fields, **{name: times / unit})
        refused(file, problem)


def test_the_recorded_archives(shared_data):
    capture = read_capture(shared_data / "nlos" / "otoole2018_diffuse_s.npz")
    assert capture.signal.shape == (2048, 64, 64)
    assert np.array_equal(capture.laser, capture.wall)
    letter = read_capture(shared_data / "lift" / "nlos_LetterN.npz")
    assert letter.signal.shape == (1016, 125, 125)
    assert letter.bin_width == pytest.approx(4.6e-12)
    refused(shared_data / "lift" / "lif_dof_LinearFiber_vertical.npz", "a shot of no relay wall")


# --- y-tal and Zaragoza


def write_tal(path, capture, laser, signal=None, **more):
    with h5py.File(path, "w") as file:
        file["H"] = capture.signal if signal is None else signal
        file["H_format"], file["scene_info"] = np.array([1], "i4"), "a: 1"
        file["sensor_grid_xyz"], file["laser_grid_xyz"] = WALL, laser
        file["delta_t"], file["t_start"] = capture.axis.spacing, capture.start
        file["laser_grid_normals"] = h5py.Empty(float)
        for name, value in {"t_accounts_first_and_last_bounces": False, **more}.items():
            file[name] = value


def test_tal_of_one_spot_of_confocal_ones_of_a_grid_and_with_legs(tmp_path):
    lasers = WALL[::4, ::5] + [0.01, 0, 0]
    each = np.stack([simulated(spot).signal for spot in lasers.reshape(-1, 3)], axis=1)
    signal = each.reshape(AXIS.bins, *lasers.shape[:2], *WALL.shape[:2])
    every = Capture.exhaustive(signal, WALL, lasers, AXIS.bin_width, AXIS.start)
    for laser, expected, stored in (
        (SPOT.reshape(1, 1, 3), simulated(), None),
        (WALL, simulated(WALL), None),
        (lasers, every, signal),
    ):
        write_tal(tmp_path / "tal.hdf5", expected, laser, stored)
        same(read_capture(tmp_path / "tal.hdf5"), expected)
    raw, start = with_legs(simulated())
    positions = {"laser_xyz": SOURCE, "sensor_xyz": EYE, "t_accounts_first_and_last_bounces": True}
    legs = Capture(raw, WALL, SPOT, AXIS.bin_width, start)
    write_tal(tmp_path / "legs.hdf5", legs, SPOT.reshape(1, 3), **positions)
    shows_the_point(read_capture(tmp_path / "legs.hdf5"))


# In that data set the wall is upright in x and z, and the scene lies at smaller y.
TO_ZARAGOZA = np.array([[-1.0, 0, 0], [0, 0, -1], [0, -1, 0]])


def write_zaragoza(path, signal, laser, start, columns_first):
    """Split the signal over 2 colours and 3 bounces; `signal` is (t, [lasers...,] points...)."""
    parts = np.array([0.5, 0.3, 0.2])[:, None] * np.array([0.25, 0.75])
    split = np.multiply.outer(parts, signal)  # (bounce, colour, t, ...)
    if columns_first:
        order = split.transpose(1, 2, 0, *range(3, split.ndim))
        if split.ndim == 7:
            order = order.transpose(0, 1, 2, 5, 6, 3, 4)  # cameras before lasers
    else:
        order = split.transpose(*range(3, split.ndim), 0, 2, 1)
    wall, spots = WALL @ TO_ZARAGOZA.T, laser @ TO_ZARAGOZA.T
    with h5py.File(path, "w") as file:
        file["data"] = order.astype(np.float32)
        for name, points in (("camera", wall), ("laser", spots)):
            file[f"{name}GridPositions"] = np.moveaxis(points, -1, 0) if columns_first else points
        normals = np.broadcast_to(TO_ZARAGOZA @ [0, 0, 1.0], wall.shape)
        file["cameraGridNormals"] = np.moveaxis(normals, -1, 0) if columns_first else normals
        file["hiddenVolumePosition"] = (TO_ZARAGOZA @ HIDDEN).reshape(3, 1)
        file["cameraPosition"], file["laserPosition"] = TO_ZARAGOZA @ EYE, TO_ZARAGOZA @ SOURCE
        file["deltaT"], file["t0"] = np.array([[AXIS.spacing]]), start


@pytest.mark.parametrize("columns_first", [True, False])
@pytest.mark.parametrize("kind", ["confocal", "single", "exhaustive"])
def test_zaragoza(kind, columns_first, tmp_path):
    if kind == "confocal":
        laser = WALL
        signal, start = with_legs(simulated(WALL), 3.6)
    else:
        laser = SPOT.reshape(1, 1, 3) if kind == "single" else WALL[::4, ::5]
        each = [with_legs(simulated(spot), 3.6) for spot in laser.reshape(-1, 3)]
        start = each[0][1]
        signal = np.stack([one for one, _ in each], axis=1).reshape(
            400, *laser.shape[:2], *WALL.shape[:2]
        )
    write_zaragoza(tmp_path / "z.hdf5", signal, laser, start, columns_first)
    found = read_capture(tmp_path / "z.hdf5")
    assert found.points[:, 2] == pytest.approx(np.zeros(len(found.points)), abs=1e-12)
    shows_the_point(found)


@pytest.mark.parametrize(
    "direction", [(0, 0, 2.0), (0, 0, -1), (0, -1, 0), (1, 0, 0), (0.6, 0, 0.8)]
)
def test_turning_makes_a_direction_z_and_keeps_distances(
    direction,
):
    towards = np.array(direction) / norm(direction)
    # The scene stays in front: a hidden point at 0.5 along the direction has z = 0.5 afterwards.
    turned = rotate_to_scene(
        Capture(np.ones((3, 2)), [0.5 * towards, [0, 0, 0]], 0.5 * towards, 1e-11), towards
    )
    assert turned.wall[0] == pytest.approx([0, 0, 0.5])
    basis = rotate_to_scene(Capture(np.ones((3, 3)), np.eye(3), np.eye(3), 1e-11), towards).wall
    assert basis.T @ basis == pytest.approx(np.eye(3))
    assert np.linalg.det(basis) == pytest.approx(1)
    with pytest.raises(InputError, match="direction"):
        rotate_to_scene(turned, np.zeros(3))


# --- MATLAB


def write_matlab(path, version, **variables):
    """Write MATLAB's own layout: version 5 by SciPy, 7.3 as HDF5 with reversed axes behind a header
    of 512 bytes.
    """
    if version == "5":
        scipy.io.savemat(path, variables)
        return
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in variables.items():
            parts = value if isinstance(value, dict) else {"": value}
            for part, array in parts.items():
                file[f"{name}/{part}".rstrip("/")] = np.atleast_2d(array).T
    with open(path, "r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


versions = pytest.mark.parametrize("version", ["5", "7.3"])


def plane_wall(x, y):
    x, y = np.meshgrid(x, y)
    return np.stack([x, y, np.zeros_like(x)], axis=-1)


def light_cone():
    # x falls along the first axis, as the authors' own script shows it.
    wall = np.swapaxes(plane_wall(np.linspace(0.5, -0.5, 11), np.linspace(-0.5, 0.5, 11)), 0, 1)
    expected = simulated(wall, wall, TimeAxis(1800, 4e-12))
    return {"rect_data": np.moveaxis(expected.signal, 0, 2), "width": 0.5}, expected


def rectified(column=7):
    wall = plane_wall((np.arange(12) - 6) * 0.1, (np.arange(10) - 5) * 0.1)
    expected = simulated(wall[4, 7], wall, TimeAxis(300, 16e-12))
    counts = {"rect_data": np.moveaxis(expected.signal, 0, 2), "SPAD_index": [column, 4]}
    return {**counts, "ts": 16e-12, "sampling_spacing": 0.1}, expected


def surface_optimisation():
    points = WALL.reshape(-1, 3)
    expected = simulated(points, points, TimeAxis(1500, 1.2e-3 / SPEED_OF_LIGHT))
    return {"transient": expected.signal.T, "lighting": points}, expected


@versions
@pytest.mark.parametrize("make", [light_cone, rectified, surface_optimisation])
def test_matlab_files_that_hold_everything(make, version, tmp_path):
    variables, expected = make()
    write_matlab(tmp_path / "a.mat", version, **variables)
    same(read_capture(tmp_path / "a.mat"), expected)


@versions
@pytest.mark.parametrize("beside", [True, False])
def test_migration_data(version, beside, tmp_path):
    wall = plane_wall(np.linspace(-1, 1, 14), np.linspace(-1, 1, 13))
    expected = simulated(wall, wall, TimeAxis(300, 32e-12))
    delay_bins = np.random.default_rng(1).integers(3, 20, wall.shape[:2])
    meas = np.zeros((13, 14, 330), np.float32)
    for i, j in np.ndindex(13, 14):
        meas[i, j, delay_bins[i, j] : delay_bins[i, j] + 300] = expected.signal[:, i, j]
    path, tofgrid = tmp_path / "meas_10min.mat", {"tofgrid": delay_bins * 32.0}
    write_matlab(path, version, meas=meas, **({} if beside else tofgrid))
    if beside:
        write_matlab(tmp_path / "tof.mat", version, **tofgrid)
    found = read_capture(path)
    assert found.signal[:300] == pytest.approx(expected.signal, rel=1e-4, abs=1e-6)
    assert found.wall == pytest.approx(wall)
    assert np.array_equal(found.laser, found.wall)


def test_pairs_with_their_points_beside(tmp_path):
    points = WALL.reshape(-1, 3)
    lasers = points[::-1]
    expected = simulated(lasers, points, TimeAxis(300, 32e-12))
    write_matlab(tmp_path / "sub_Sig.mat", "5", sub_Sig=expected.signal.T)
    refused(tmp_path / "sub_Sig.mat", r"sub_Sig.*C_d\.mat.*docs/own_wall\.md")
    write_matlab(tmp_path / "C_i.mat", "5", C_i=lasers)
    write_matlab(tmp_path / "C_d.mat", "5", C_d=points)
    same(read_capture(tmp_path / "sub_Sig.mat"), expected)
    # A first coordinate that stays is the depth; the others run to the left and up.
    for name, spots in (("C_i", lasers), ("C_d", points)):
        x, y, z = spots.T
        write_matlab(tmp_path / f"{name}.mat", "5", **{name: np.stack([z, -x, -y], axis=-1)})
    same(read_capture(tmp_path / "sub_Sig.mat"), expected)


SETUP_SCRIPT = """%% Part I
c = 3E8; % speed
delta_t = 32E-12;
% bx = 7;
bx = c * delta_t; by = 1.2/12; bz = 0.1;
xb = 0.9; yb = 0;
grid_hor_f = 63:-1:0;
"""


def test_pairs_numbered_on_a_lattice(tmp_path):
    """Their second number grows to the left and their third upwards, seen from the wall."""
    left, up = (grid.ravel() for grid in np.meshgrid(np.arange(12), np.arange(9)))
    numbers = np.stack([0 * left, left, up], axis=-1)
    wall = 0.1 * np.stack([-left, -up, 0 * left], axis=-1)
    expected = simulated(wall, wall, TimeAxis(300, 32e-12))
    folder = tmp_path / "full"
    folder.mkdir()
    write_matlab(folder / "sub_Sig.mat", "5", sub_Sig=expected.signal.T)
    for name in ("C_i", "C_d"):
        write_matlab(folder / f"{name}.mat", "5", **{name: numbers.astype(float)})
    with pytest.raises(
        FileFormatError, match=r"steps of a lattice; it needs experimental_setup\.m"
    ):
        read_capture(folder / "sub_Sig.mat")
    script = tmp_path / "experimental_setup.m"
    script.write_text(SETUP_SCRIPT)
    same(read_capture(folder / "sub_Sig.mat"), expected)
    script.write_text(SETUP_SCRIPT.replace("3E8", "1").replace("32E-12", "0.0096"))
    assert read_capture(folder / "sub_Sig.mat").axis.spacing == pytest.approx(0.0096)
    for broken in ("by = zeros(3);", "by = 0;", ""):
        script.write_text(SETUP_SCRIPT.replace("by = 1.2/12;", broken))
        with pytest.raises(FileFormatError, match="does not set by to a positive number"):
            read_capture(folder / "sub_Sig.mat")


def test_general_pairs(tmp_path):
    lasers = WALL[::-1]
    expected = simulated(lasers, WALL, TimeAxis(300, 32e-12))
    write_matlab(tmp_path / "data_one.mat", "5", data=np.moveaxis(expected.signal, 0, 2))
    refused(tmp_path / "data_one.mat", r"setup\.mat.*docs/own_wall\.md")
    # Theirs run to the left and up.
    turned = {"laserpoints": lasers * [-1, -1, 1], "detectpoints": WALL * [-1, -1, 1]}
    write_matlab(tmp_path / "setup.mat", "5", **turned)
    refused(tmp_path / "data_one.mat", "states no bin width; add it in seconds as timeRes")
    write_matlab(tmp_path / "setup.mat", "5", **turned, timeRes=32e-12)
    same(read_capture(tmp_path / "data_one.mat"), expected)
    write_matlab(tmp_path / "setup.mat", "5", **turned, timeRes=8.33e-12)
    assert read_capture(tmp_path / "data_one.mat").bin_width == pytest.approx(8.33e-12)


@versions
def test_phasor_field_data(version, tmp_path):
    points = WALL.reshape(-1, 3)
    listed = simulated(SPOT, points)
    # Their laser scans our wall points; our laser spot is where their camera looks.
    legs = norm(SPOT - SOURCE) + norm(points - EYE, axis=-1)
    path = norm(SPOT - HIDDEN) + norm(points - HIDDEN, axis=-1) + legs
    signal = np.exp(-0.5 * ((3.6 + AXIS.spacing * np.arange(400) - path[:, None]) / 0.012) ** 2)
    dataset = {
        "data": signal[:, None, :],
        "t": 400,
        "deltat": AXIS.spacing,
        "t0": 3.6,
        "laserPos": points @ TO_ZARAGOZA.T,
        "cameraPos": (TO_ZARAGOZA @ SPOT)[None],
        "laserOrigin": TO_ZARAGOZA @ EYE,
        "cameraOrigin": TO_ZARAGOZA @ SOURCE,
        "laserNorm": np.broadcast_to(TO_ZARAGOZA @ [0, 0, 1.0], points.shape),
    }
    write_matlab(tmp_path / "office.mat", version, dataset=dataset)
    found = read_capture(tmp_path / "office.mat")
    assert found.wall == pytest.approx(listed.wall, abs=1e-12)
    assert found.laser == pytest.approx(SPOT, abs=1e-12)
    shows_the_point(found)
    dataset["t"] = 399
    write_matlab(tmp_path / "cut.mat", version, dataset=dataset)
    refused(tmp_path / "cut.mat", "must end with 399 bins")


# --- EXR

GEOMETRY = """
bin_width_ps = 16.0
start_m = 0.5
wall_corners_m = [[-0.6, -0.5, 0], [0.6, -0.5, 0], [-0.6, 0.5, 0]]
laser_m = [0.12, 0.05, 0.0]
"""


def write_streaks(folder, capture, geometry=GEOMETRY):
    for row in range(capture.signal.shape[1]):
        brightness = capture.signal[:, row].T  # (column, t)
        # No leading zeros, as renderers number them: 10 comes after 9.
        colours = {"R": 0.5 * brightness, "G": brightness, "B": 1.5 * brightness}
        write_exr_parts({"": colours}, folder / f"streak_{row}.exr")
    (folder / "geometry.toml").write_text(geometry)


def test_exr_streaks(tmp_path):
    expected = simulated(wall=planar_wall(12, 9))
    write_streaks(tmp_path, expected)
    found = read_capture(tmp_path)
    assert found.signal == pytest.approx(expected.signal, rel=1e-6)
    assert found.wall == pytest.approx(expected.wall, abs=1e-12)
    shows_the_point(found)
    (tmp_path / "geometry.toml").write_text(GEOMETRY.replace("[0.12, 0.05, 0.0]", '"confocal"'))
    assert np.array_equal(read_capture(tmp_path).laser, read_capture(tmp_path).wall)


@pytest.mark.parametrize(
    ("geometry", "problem"),
    [
        (GEOMETRY.replace("start_m", "begin_m"), "lacking or unknown: begin_m, start_m"),
        (GEOMETRY.replace("16.0", '"fast"'), "bin_width_ps must be numbers"),
        (GEOMETRY.replace("0.12, 0.05, 0.0", "0.12"), "laser_m must be numbers of shape"),
        (GEOMETRY.replace(", [-0.6, 0.5, 0]", ""), "wall_corners_m must be numbers"),
        ("bin_width_ps = ", "is not a TOML file"),
    ],
)
def test_exr_geometry_is_checked(geometry, problem, tmp_path):
    write_streaks(tmp_path, simulated(wall=planar_wall(2, 3)), geometry)
    with pytest.raises(FileFormatError, match=problem):
        read_capture(tmp_path)


def test_exr_folders_that_are_no_capture(tmp_path):
    refused(tmp_path, "without EXR files")
    write_streaks(tmp_path, simulated(wall=planar_wall(3, 4)))
    (tmp_path / "geometry.toml").unlink()
    refused(tmp_path, r"no geometry\.toml")
    (tmp_path / "geometry.toml").write_text(GEOMETRY)
    write_exr_parts({"": {"Y": np.ones((4, 5))}}, tmp_path / "streak_1.exr")
    refused(tmp_path, r"streak_1\.exr: is \(4, 5\) pixels")
    write_exr_parts({"": {"Z": np.ones((4, 5))}}, tmp_path / "streak_1.exr")
    refused(tmp_path, "none of which is R, G, B or Y")
    whole = (tmp_path / "streak_0.exr").read_bytes()
    (tmp_path / "streak_1.exr").write_bytes(whole[: len(whole) // 2])
    refused(tmp_path, "truncated or damaged EXR")


# --- damage


def write_odd_zaragoza(path):
    write_zaragoza(path, with_legs(simulated(WALL), 3.6)[0], WALL, 3.6, True)
    with h5py.File(path, "a") as file:
        del file["data"]
        file["data"] = np.ones((3, 4))


def write(path, content):
    """Write bytes or named arrays, in the format of the name, or call what writes them."""
    if callable(content):
        content(path)
    elif isinstance(content, bytes):
        path.write_bytes(content)
    elif path.suffix == ".npz":
        np.savez(path, **content)
    elif path.suffix == ".mat":
        write_matlab(path, "7.3" if "seven" in path.stem else "5", **content)
    else:
        with h5py.File(path, "w") as file:
            file.update(content)
    return path


TIME_FIRST, FOREIGN = np.ones((50, 8, 8)), {"holiday": np.ones(3)}
RECTIFIED = {"rect_data": TIME_FIRST, "ts": 4e-12, "sampling_spacing": 0.1, "SPAD_index": [1, 1]}
TIME_LAST = {"H": np.ones((9, 12, 50)), "wall_xyz": WALL, "laser_xyz": SPOT, "delta_t_s": 1e-11}
DISAGREEING = lambda path: write_tal(path, simulated(), WALL[:2])  # noqa: E731


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("empty", b"", "is empty"),
        ("text", b"once upon a time", "not a capture of a known format"),
        ("camera.h5", Record("camera").save, "holds a camera record, expected capture or frames"),
        ("foreign.h5", FOREIGN, "holds holiday, but a capture needs"),
        ("foreign.npz", {"H": np.ones((3, 2)), **FOREIGN}, "holds H, holiday, but a capture needs"),
        ("five.mat", FOREIGN, "holds holiday, but a capture needs"),
        ("seven.mat", FOREIGN, "holds holiday, but a capture needs"),
        ("tal.hdf5", DISAGREEING, "belongs neither to"),
        ("zaragoza.hdf5", write_odd_zaragoza, "5 or 7 axes"),
        ("last.npz", TIME_LAST, "ends with time; put time first"),
        (
            "cone.mat",
            {"rect_data": TIME_FIRST, "width": 0.5},
            "begins with time; put time last: perm",
        ),
        ("rectified.mat", RECTIFIED, "begins with time; put time last: permute"),
        ("off.mat", rectified(12)[0], "SPAD_index"),
        ("meas_10min.mat", {"meas": np.ones((3, 4, 5))}, r"no tof\.mat beside it"),
    ],
)
def test_what_is_no_capture_says_so(name, content, problem, tmp_path):
    refused(write(tmp_path / name, content), problem)
    refused(tmp_path / "absent.h5", "no such file", StorageError)


RECORD = simulated()
LIGHT_CONE = {"rect_data": np.moveaxis(RECORD.signal, 0, 2), "width": 0.5}
ARCHIVE = {**TIME_LAST, "H": RECORD.signal, "t_start_m": 0}
TAL = lambda path: write_tal(path, RECORD, SPOT)  # noqa: E731


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("own.h5", RECORD.save),
        ("a.npz", ARCHIVE),
        ("tal.hdf5", TAL),
        ("five.mat", LIGHT_CONE),
        ("seven.mat", LIGHT_CONE),
    ],
)
def test_truncated_files_are_refused(name, content, tmp_path):
    path = write(tmp_path / name, content)
    whole = path.read_bytes()
    for fraction in (0.3, 0.9):
        path.write_bytes(whole[: int(fraction * len(whole))])
        refused(path, r"truncated|damaged")
