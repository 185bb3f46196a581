"""Simulated walls, hidden points and surfaces, and the noise of photons, against formulas."""

import numpy as np
import pytest
from numpy.linalg import norm

from nlos import Capture
from nlos.capture import TimeAxis
from nlos.simulate import (
    WALLS,
    HiddenScene,
    Lambert,
    PointScene,
    Retroreflector,
    Surface,
    add_poisson_noise,
    build_relay_wall,
)
from nlos.simulate.walls import compute_wall_normals
from tofclip.errors import FileFormatError, InputError, StorageError
from tofclip.units import SPEED_OF_LIGHT

AXIS = TimeAxis(bins=420, bin_width=16e-12, start=0.3)
JITTER = 20e-12
WALL, SPOT = build_relay_wall("planar", 7, 1.0), np.array([0.1, -0.05, 0.0])
CENTRE = np.array([0.12, -0.08, 0.55])


def measure(capture):
    """Brightness of every wall point, and mean and standard deviation of the path, m."""
    total = capture.signal.sum(axis=0)
    paths = capture.axis.paths.reshape(-1, *[1] * total.ndim)
    centroid = (paths * capture.signal).sum(axis=0) / total
    return total, centroid, np.sqrt(((paths - centroid) ** 2 * capture.signal).sum(axis=0) / total)


# --- walls


@pytest.mark.parametrize("name", WALLS)
def test_walls_are_as_wide_as_asked_for(name):
    wall = build_relay_wall(name, 33, 1.6)
    assert wall.shape == (33, 33, 3)
    known = np.isfinite(wall).all(axis=-1)
    assert np.ptp(wall[known], axis=0)[:2] == pytest.approx([1.6, 1.6])
    # Columns go to the right, rows down.
    assert np.all(np.diff(wall[:, 0, 1]) > 0)
    assert np.nanmax(wall[..., 0]) == wall[0, -1, 0]
    assert known.all() == (name != "plates")


def test_the_five_shapes():
    assert np.all(build_relay_wall("planar")[..., 2] == 0)
    cylinder = build_relay_wall("cylinder", 65)
    radius = np.hypot(cylinder[..., 0], cylinder[..., 2] + 2.5)
    assert radius == pytest.approx(np.full((65, 65), 2.5))
    assert cylinder[..., 2].max() == pytest.approx(0)
    wavy = build_relay_wall("wavy", 201)[..., 2]
    assert (wavy.min(), wavy.max()) == pytest.approx((-0.1, 0.1), abs=1e-3)
    assert np.ptp(build_relay_wall("relief")[..., 2]) == pytest.approx(0.3)
    plates = build_relay_wall("plates")
    left, right = plates[plates[..., 0] < 0], plates[plates[..., 0] > 0]
    assert np.all(left[:, 2] == 0)
    assert right[:, 2].max() < -0.1
    assert right[:, 0].min() - left[:, 0].max() > 0.19


def test_normals_stand_on_the_wall_and_point_to_the_scene():
    wall = build_relay_wall("cylinder", 41)
    expected = (wall + np.array([0, 0, 2.5])) * [1, 0, 1] / 2.5
    # Central differences of a circle; the edges are one-sided.
    assert compute_wall_normals(wall)[1:-1, 1:-1] == pytest.approx(expected[1:-1, 1:-1], abs=1e-3)
    plates = compute_wall_normals(build_relay_wall("plates"))
    assert np.all(np.isfinite(plates))
    assert np.all(plates[..., 2] > 0)
    assert compute_wall_normals(np.zeros((5, 3))).tolist() == [[0, 0, 1]] * 5


# --- points

THREE = np.array([[0.0, 0.0, 0.0], [0.3, -0.1, 0.05], [-0.2, 0.2, 0.0]])
POINT = np.array([0.05, 0.1, 0.4])
FINE = TimeAxis(bins=300, bin_width=10e-12, start=0.3)


@pytest.mark.parametrize("laser", [np.array([0.1, 0.0, 0.0]), THREE])
def test_light_arrives_after_its_path_with_inverse_squares(laser):
    capture = PointScene([POINT], [2.0]).simulate_capture(THREE, laser, FINE, 15e-12)
    outward, back = (norm(end - POINT, axis=-1) for end in (laser, THREE))
    total, centroid, spread = measure(capture)
    # float32 signals.
    assert total == pytest.approx(2.0 / (outward * back) ** 2, rel=1e-5)
    assert centroid == pytest.approx(outward + back, rel=1e-5)
    # A bin's own width adds its variance, spacing^2 / 12.
    expected = np.hypot(SPEED_OF_LIGHT * 15e-12, FINE.spacing / np.sqrt(12))
    assert spread == pytest.approx(np.full(3, expected), rel=1e-4)


def test_points_add_up_and_masked_wall_points_are_dark():
    points, albedo = np.array([POINT, POINT + 0.1]), [1.0, 3.0]
    both, *parts = (
        PointScene(points[some], albedo[some]).simulate_capture(THREE, THREE[0], FINE, 15e-12)
        for some in (slice(None), slice(1), slice(1, None))
    )
    assert both.signal == pytest.approx(sum(one.signal for one in parts), rel=1e-6)
    wall = THREE.copy()
    wall[1] = np.nan
    capture = PointScene([POINT]).simulate_capture(wall, THREE[0], FINE, 15e-12)
    assert np.all(capture.signal[:, 1] == 0)
    assert capture.valid.tolist() == [True, False, True]


# --- surfaces


def facet(centre=CENTRE, material=None, side=0.001):
    """A square so small that it is one point for the light."""
    return Surface.rectangle(centre, (side, side), 1.0, material)


def look(*surfaces, laser=SPOT, axis=AXIS, wall=WALL):
    return HiddenScene(surfaces).simulate_capture(wall, laser, axis, JITTER)


def unit(vectors):
    return vectors / norm(vectors, axis=-1, keepdims=True)


@pytest.mark.parametrize("shape", ["planar", "cylinder"])
@pytest.mark.parametrize("confocal", [False, True])
def test_brightness_arrival_and_width_of_one_facet(shape, confocal):
    """The formula of `HiddenScene` for a Lambertian facet of 1 mm, written out with vectors."""
    wall = build_relay_wall(shape, 7, 1.0)
    normals = compute_wall_normals(wall)
    laser, at_laser = (wall, normals) if confocal else (wall[3, 4], normals[3, 4])
    out, back = CENTRE - laser, wall - CENTRE
    lengths = norm(out, axis=-1), norm(back, axis=-1)
    at_facet = unit(out)[..., 2] * -unit(back)[..., 2]
    cosines = (
        np.sum(at_laser * unit(out), axis=-1) * at_facet * np.sum(normals * -unit(back), axis=-1)
    )
    total, centroid, spread = measure(look(facet(), laser=laser, wall=wall))
    # Halves of a facet of 1 mm at 0.5 m lie 1e-3 nearer or farther, and nearly even out.
    expected = 0.001**2 / np.pi * cosines / (lengths[0] * lengths[1]) ** 2
    assert total == pytest.approx(expected, rel=1e-3)
    assert centroid == pytest.approx(sum(lengths), abs=0.01 * AXIS.spacing)
    # A bin adds 1/12 of its width squared; the sharing between fine bins up to 1/4 of 1/16.
    width = np.hypot(SPEED_OF_LIGHT * JITTER, AXIS.spacing / np.sqrt(12))
    assert spread == pytest.approx(np.full((7, 7), width), rel=0.02)


def test_light_that_arrives_before_or_after_the_record_is_left_out():
    full = look(facet()).signal
    late = TimeAxis(AXIS.bins, AXIS.bin_width, AXIS.start + 175.5 * AXIS.spacing)
    part = look(facet(), axis=late).signal
    # Linear interpolation of a Gaussian of 1.3 bins.
    assert np.max(np.abs(part[:244] - (full[175:-1] + full[176:]) / 2)) < 0.1 * full.max()
    assert part[0].max() > 0
    assert not look(facet(), axis=TimeAxis(10, AXIS.bin_width, 0.0)).signal.any()


def test_a_plate_hides_what_stands_behind_it_from_where_it_stands_between():
    plate = Surface.rectangle([0.3, 0.0, 0.3], (0.2, 2.0), 0.05, Lambert(0.0))
    target, spot = facet(np.array([0.35, 0.0, 0.6])), np.array([-0.4, 0.0, 0.0])
    seen, blocked = (
        look(*surfaces, laser=spot).signal.sum(axis=0) for surfaces in ([target], [target, plate])
    )
    # The path from x = 0.35 at z = 0.6 crosses z = 0.3 midway to the wall point.
    behind = np.abs((WALL[..., 0] + 0.35) / 2 - 0.3) < 0.1
    assert 0 < behind.sum() < behind.size
    assert np.all(blocked[behind] == 0)
    assert blocked[~behind] == pytest.approx(seen[~behind])
    # What stands behind the wall hides nothing, though far away it comes before it.
    corners = [[-3, -3, -0.1], [3, -3, -0.1], [0, 30, 0.2]]
    behind_wall = Surface.mesh(corners, [[0, 1, 2]], 50.0, Lambert(0.0))
    assert look(target, behind_wall, laser=spot).signal.sum(axis=0) == pytest.approx(seen)
    # A laser behind the plate lights nothing.
    assert not look(target, plate, laser=[0.25, 0, 0]).signal.any()


def test_the_back_of_a_surface_is_dark():
    corners = CENTRE + 0.002 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0]])
    front, back = (Surface.mesh(corners, [face], 1.0) for face in ([0, 2, 1], [0, 1, 2]))
    assert front.normals[0] == pytest.approx([0, 0, -1])
    assert look(front).signal.any()
    assert not look(back).signal.any()


def test_a_retroreflector_shines_back_to_the_laser():
    spread = 0.2
    lambert, retro = (
        look(facet(material=material)).signal.sum(axis=0)
        for material in (Lambert(), Retroreflector(1.0, spread))
    )
    towards = unit(WALL - CENTRE) @ unit(SPOT - CENTRE)
    lobe = np.exp(-0.5 * (np.arccos(towards) / spread) ** 2) / (2 * np.pi * spread**2)
    assert retro == pytest.approx(lambert * lobe * np.pi, rel=1e-3)


def test_a_mesh_keeps_its_area_and_its_facets_are_small():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0.7, 0.2], [0, 0, 0]])
    surface = Surface.mesh(vertices, [[0, 1, 2], [0, 3, 1]], 0.1)  # the second has no area
    across = np.cross(vertices[1], vertices[2])
    whole = norm(across) / 2
    assert surface.areas.sum() == pytest.approx(whole)
    assert surface.areas.max() <= 0.1**2 / 2
    assert surface.normals == pytest.approx(np.tile(unit(across), (len(surface.areas), 1)))
    mean = (surface.areas[:, None] * surface.positions).sum(axis=0) / whole
    assert mean == pytest.approx(vertices[:3].mean(axis=0))


def test_letters_read_from_left_to_right_and_from_top_to_bottom():
    surface = Surface.letters("F", [0.1, 0.2, 0.5], 0.4, 0.01)
    x, y, z = (surface.positions - [0.1, 0.2, 0.5]).T
    assert np.all(z == 0)
    assert np.ptp(y) == pytest.approx(0.4, abs=0.011)
    # The stem is at the left (small x), the bars at the top (small y), and nothing at the lower
    # right.
    assert np.sum(x < -0.05) > 2 * np.sum(x > 0.05)
    assert np.sum((x > 0.05) & (y < 0)) > 10
    assert not np.any((x > 0.05) & (y > 0.1))
    hole = Surface.letters("O", [0, 0, 0.5], 0.4, 0.01)
    assert not np.any(norm(hole.positions[:, :2], axis=1) < 0.05)


def test_meshes_are_read_from_files(tmp_path):
    (tmp_path / "one.obj").write_text("v 0 0 0.5\nv 0 0.2 0.5\nv 0.2 0 0.5\nf 1 2 3\n")
    surface = Surface.load(tmp_path / "one.obj", 0.05)
    assert surface.areas.sum() == pytest.approx(0.02)
    assert surface.normals[0] == pytest.approx([0, 0, -1])
    (tmp_path / "none.obj").write_text("v 0 0 0\n")
    (tmp_path / "holiday.txt").write_text("sea")
    for name, error, message in (
        ("holiday.txt", FileFormatError, "is not a triangle mesh"),
        ("none.obj", FileFormatError, "no triangles"),
        ("absent.obj", StorageError, "no such file"),
    ):
        with pytest.raises(error, match=message):
            Surface.load(tmp_path / name, 0.05)


# --- photons


def flat(value=0.25):
    wall = np.zeros((50, 3))
    return Capture(np.full((200, 50), value), wall, [0, 0, 0], 1e-12, provenance={"shot": 7})


def test_counts_have_the_noise_of_photons():
    counts = add_poisson_noise(flat(), 20.0, 5.0, seed=3)
    assert counts.signal.mean() == pytest.approx(25, abs=4 * np.sqrt(25 / 1e4))
    # The variance of 10 000 Poisson variables of mean 25 is known to 1.4 %.
    assert counts.signal.var() == pytest.approx(25, rel=0.06)
    assert np.array_equal(counts.signal, add_poisson_noise(flat(), 20.0, 5.0, seed=3).signal)
    assert not np.array_equal(counts.signal, add_poisson_noise(flat(), 20.0, 5.0, seed=4).signal)
    noise = {"peak_counts": 20.0, "background": 5.0, "seed": 3}
    assert counts.provenance == {"shot": 7, "noise": noise}


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: build_relay_wall("chinese", 5), "choose one of planar, cylinder"),
        (lambda: build_relay_wall("planar", 1), "at least 2 x 2"),
        (lambda: build_relay_wall("planar", 5, -1.0), "positive width"),
        (lambda: build_relay_wall("cylinder", 5, 6.0), "narrower than 6 m"),
        (lambda: PointScene([[1, 2]]), "hidden points"),
        (lambda: PointScene([POINT], [1, 2]), "albedo"),
        (lambda: PointScene([POINT]).simulate_capture(THREE, SPOT, AXIS, 0), "jitter"),
        (lambda: HiddenScene([facet()]).simulate_capture(WALL, SPOT, AXIS, 0), "jitter"),
        (lambda: HiddenScene([]), "needs a surface"),
        (lambda: Surface.letters(" ", [0, 0, 0.5], 0.4, 0.01), "no ink"),
        (lambda: Surface.mesh([[0, 0]], [[0, 1, 2]], 0.1), "vertices and faces"),
        (lambda: Surface.mesh(np.eye(3), [[0, 1, 3]], 0.1), "by their index"),
        (lambda: Surface.mesh(np.eye(3), [[0, 1, 2]], 0), "positive spacing"),
        (lambda: Surface.mesh(np.eye(3), [[0, 1, 2]], 1e-4), "more than 200000 facets"),
        (lambda: Lambert(1.5), "albedo"),
        (lambda: Retroreflector(0.5, 0), "spread"),
        (lambda: add_poisson_noise(flat(), 0), "positive peak"),
        (lambda: add_poisson_noise(flat(0.0), 5), "not all dark"),
    ],
)
def test_nonsense_is_refused(build, message):
    with pytest.raises(InputError, match=message):
        build()
