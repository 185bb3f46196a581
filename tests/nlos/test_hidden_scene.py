from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nlos import Backprojection, Capture, Grid
from nlos.capture import TimeAxis
from nlos.simulate import (
    HiddenScene,
    Lambert,
    Retroreflector,
    Surface,
    add_poisson_noise,
    build_relay_wall,
)
from nlos.simulate.kernels import is_occluded
from nlos.simulate.walls import compute_wall_normals
from tofclip.errors import FileFormatError, InputError, ShapeError, StorageError
from tofclip.units import SPEED_OF_LIGHT

AXIS = TimeAxis(bins=420, bin_width=16e-12, start=0.3)
JITTER = 20e-12
WALL = build_relay_wall("planar", 7, 1.0)
SPOT = np.array([0.1, -0.05, 0.0])
CENTRE = np.array([0.12, -0.08, 0.55])


def facet(centre: np.ndarray = CENTRE, material: object = None, side: float = 0.001) -> Surface:
    """A square so small that it is one point for the light."""
    return Surface.rectangle(centre, (side, side), 1.0, material)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def expected_brightness(
    wall: np.ndarray, laser: np.ndarray, normals: np.ndarray, laser_normal: np.ndarray
) -> np.ndarray:
    """The formula of `HiddenScene` for a Lambertian facet of 1 mm, written out with vectors."""
    out, back = CENTRE - laser, wall - CENTRE
    d_out, d_back = np.linalg.norm(out, axis=-1), np.linalg.norm(back, axis=-1)
    cosines = (
        np.sum(laser_normal * unit(out), axis=-1)
        * unit(out)[..., 2]
        * -unit(back)[..., 2]
        * np.sum(normals * -unit(back), axis=-1)
    )
    return 0.001**2 / np.pi * cosines / (d_out * d_back) ** 2


@pytest.mark.parametrize("shape", ["planar", "cylinder"])
@pytest.mark.parametrize("confocal", [False, True])
def test_brightness_arrival_and_width_of_one_facet(shape: str, confocal: bool) -> None:
    wall = build_relay_wall(shape, 7, 1.0)
    laser = wall if confocal else wall[3, 4]
    capture = HiddenScene([facet()]).simulate_capture(wall, laser, AXIS, JITTER)
    normals = compute_wall_normals(wall)
    expected = expected_brightness(wall, laser, normals, normals if confocal else normals[3, 4])
    total = capture.signal.sum(axis=0)
    # Halves of a facet of 1 mm at 0.5 m lie 1e-3 nearer or farther, and nearly even out.
    assert total == pytest.approx(expected, rel=1e-3)
    path = np.linalg.norm(CENTRE - laser, axis=-1) + np.linalg.norm(CENTRE - wall, axis=-1)
    centroid = np.tensordot(AXIS.paths, capture.signal, 1) / total
    assert centroid == pytest.approx(path, abs=0.01 * AXIS.spacing)
    spread = np.sqrt(
        ((AXIS.paths[:, None, None] - centroid) ** 2 * capture.signal).sum(axis=0) / total
    )
    # A bin adds 1/12 of its width squared; the sharing between fine bins up to 1/4 of 1/16.
    assert spread == pytest.approx(
        np.full((7, 7), np.hypot(SPEED_OF_LIGHT * JITTER, AXIS.spacing / np.sqrt(12))), rel=0.02
    )


def test_light_that_arrives_before_or_after_the_record_is_left_out() -> None:
    full = HiddenScene([facet()]).simulate_capture(WALL, SPOT, AXIS, JITTER)
    late = TimeAxis(AXIS.bins, AXIS.bin_width, AXIS.start + 175.5 * AXIS.spacing)
    part = HiddenScene([facet()]).simulate_capture(WALL, SPOT, late, JITTER)
    shifted = (full.signal[175:-1] + full.signal[176:]) / 2
    # Linear interpolation of a Gaussian of 1.3 bins.
    assert np.max(np.abs(part.signal[:244] - shifted)) < 0.1 * full.signal.max()
    assert part.signal[0].max() > 0
    early = TimeAxis(10, AXIS.bin_width, 0.0)
    assert np.all(HiddenScene([facet()]).simulate_capture(WALL, SPOT, early, JITTER).signal == 0)


def test_a_plate_hides_what_stands_behind_it_from_where_it_stands_between() -> None:
    plate = Surface.rectangle([0.3, 0.0, 0.3], (0.2, 2.0), 0.05, Lambert(0.0))
    spot = np.array([-0.4, 0.0, 0.0])
    target = facet(np.array([0.35, 0.0, 0.6]))
    open_view = HiddenScene([target]).simulate_capture(WALL, spot, AXIS, JITTER).signal.sum(axis=0)
    blocked = (
        HiddenScene([target, plate]).simulate_capture(WALL, spot, AXIS, JITTER).signal.sum(axis=0)
    )
    # The way from x = 0.35 at z = 0.6 crosses z = 0.3 midway to the wall point.
    midway = (WALL[..., 0] + 0.35) / 2
    behind = np.abs(midway - 0.3) < 0.1
    assert behind.any()
    assert not behind.all()
    assert np.all(blocked[behind] == 0)
    assert blocked[~behind] == pytest.approx(open_view[~behind])
    # A laser behind the plate lights nothing.
    dark = HiddenScene([target, plate]).simulate_capture(WALL, [0.25, 0, 0], AXIS, JITTER)
    assert np.all(dark.signal == 0)


def test_the_back_of_a_surface_is_dark() -> None:
    corners = CENTRE + 0.002 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0]])
    front = Surface.mesh(corners, [[0, 2, 1]], 1.0)
    back = Surface.mesh(corners, [[0, 1, 2]], 1.0)
    assert front.normals[0] == pytest.approx([0, 0, -1])
    assert HiddenScene([front]).simulate_capture(WALL, SPOT, AXIS, JITTER).signal.any()
    assert not HiddenScene([back]).simulate_capture(WALL, SPOT, AXIS, JITTER).signal.any()


def test_a_retroreflector_shines_back_to_the_laser() -> None:
    spread = 0.2
    lambert, retro = (
        HiddenScene([facet(material=material)])
        .simulate_capture(WALL, SPOT, AXIS, JITTER)
        .signal.sum(axis=0)
        for material in (Lambert(), Retroreflector(1.0, spread))
    )
    towards = unit(WALL - CENTRE) @ unit(SPOT - CENTRE)
    lobe = np.exp(-0.5 * (np.arccos(towards) / spread) ** 2) / (2 * np.pi * spread**2)
    assert retro == pytest.approx(lambert * lobe * np.pi, rel=1e-3)


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(*[st.floats(-1, 1)] * 3),
    st.tuples(*[st.floats(-1, 1)] * 3),
    st.floats(0.05, 0.9),
    st.floats(0.05, 0.9),
)
def test_a_way_through_a_triangle_is_hidden_and_one_beside_it_is_not(
    start: tuple[float, ...], end: tuple[float, ...], u: float, v: float
) -> None:
    triangle = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    if abs(u + v - 1) < 1e-3:
        return
    point = np.array([u, v, 0.0])
    above = point + np.array([start[0], start[1], 1 + start[2] / 2])
    below = point + (point - above) * (1.5 + end[0])
    assert is_occluded(above, below, triangle) == (u + v < 1)
    # The way that ends before the plane is free.
    assert not is_occluded(above, point + 0.01 * (above - point), triangle)


def test_a_mesh_keeps_its_area_and_its_facets_are_small() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0.7, 0.2], [0, 0, 0]])
    surface = Surface.mesh(vertices, [[0, 1, 2], [0, 3, 1]], 0.1)  # the second has no area
    whole = np.linalg.norm(np.cross(vertices[1], vertices[2])) / 2
    assert surface.areas.sum() == pytest.approx(whole)
    assert surface.areas.max() <= 0.1**2 / 2
    assert surface.normals == pytest.approx(
        np.tile(unit(np.cross(vertices[1], vertices[2])), (len(surface.areas), 1))
    )
    mean = (surface.areas[:, None] * surface.positions).sum(axis=0) / whole
    assert mean == pytest.approx(vertices[:3].mean(axis=0))


def test_letters_read_from_left_to_right_and_from_top_to_bottom() -> None:
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
    assert not np.any(np.linalg.norm(hole.positions[:, :2], axis=1) < 0.05)
    with pytest.raises(InputError, match="no ink"):
        Surface.letters(" ", [0, 0, 0.5], 0.4, 0.01)


@pytest.mark.filterwarnings("ignore::nlos.illumination.AliasingWarning")
def test_a_letter_comes_back_the_right_way_round() -> None:
    wall = build_relay_wall("planar", 24, 1.2)
    scene = HiddenScene([Surface.letters("L", [0, 0, 0.6], 0.5, 0.02)])
    capture = scene.simulate_capture(wall, [0.0, 0.0, 0.0], TimeAxis(260, 32e-12), 20e-12)
    volume = Backprojection(0.14).reconstruct(
        capture, Grid.box((-0.3, 0.3), (-0.35, 0.35), (0.5, 0.7), 0.02)
    )
    picture = volume.maximum_projection().brightness
    y, x = np.meshgrid(volume.grid.y, volume.grid.x, indexing="ij")
    stem, foot = (
        picture[(x < -0.08) & (abs(y) < 0.15)].mean(),
        picture[(x > 0.04) & (x < 0.15) & (y > 0.15)].mean(),
    )
    elsewhere = picture[(x > 0.08) & (y < 0)].mean()
    assert min(stem, foot) > 1.8 * elsewhere


def test_meshes_are_read_from_files(tmp_path: Path) -> None:
    (tmp_path / "one.obj").write_text("v 0 0 0.5\nv 0 0.2 0.5\nv 0.2 0 0.5\nf 1 2 3\n")
    surface = Surface.load(tmp_path / "one.obj", 0.05)
    assert surface.areas.sum() == pytest.approx(0.02)
    assert surface.normals[0] == pytest.approx([0, 0, -1])
    (tmp_path / "none.obj").write_text("v 0 0 0\n")
    (tmp_path / "holiday.txt").write_text("sea")
    with pytest.raises(FileFormatError, match="is not a triangle mesh"):
        Surface.load(tmp_path / "holiday.txt", 0.05)
    with pytest.raises(FileFormatError, match="no triangles"):
        Surface.load(tmp_path / "none.obj", 0.05)
    with pytest.raises(StorageError, match="no such file"):
        Surface.load(tmp_path / "absent.obj", 0.05)


def test_counts_have_the_noise_of_photons() -> None:
    flat = Capture(
        np.full((200, 50), 0.25), np.zeros((50, 3)), [0, 0, 0], 1e-12, provenance={"shot": 7}
    )
    seen = add_poisson_noise(flat, 20.0, 5.0, seed=3)
    assert seen.signal.mean() == pytest.approx(25, abs=4 * np.sqrt(25 / 1e4))
    # The variance of 10 000 Poisson variables of mean 25 is known to 1.4 %.
    assert seen.signal.var() == pytest.approx(25, rel=0.06)
    assert np.array_equal(seen.signal, add_poisson_noise(flat, 20.0, 5.0, seed=3).signal)
    assert not np.array_equal(seen.signal, add_poisson_noise(flat, 20.0, 5.0, seed=4).signal)
    assert seen.provenance == {
        "shot": 7,
        "noise": {"peak_counts": 20.0, "background": 5.0, "seed": 3},
    }
    with pytest.raises(InputError, match="positive peak"):
        add_poisson_noise(flat, 0)
    with pytest.raises(InputError, match="not all dark"):
        add_poisson_noise(Capture(np.zeros((2, 50)), flat.wall, [0, 0, 0], 1e-12), 5)


@pytest.mark.parametrize(
    ("build", "error", "message"),
    [
        (lambda: Surface.mesh([[0, 0]], [[0, 1, 2]], 0.1), ShapeError, "vertices and faces"),
        (lambda: Surface.mesh(np.eye(3), [[0, 1, 3]], 0.1), InputError, "by their index"),
        (lambda: Surface.mesh(np.eye(3), [[0, 1, 2]], 0), InputError, "positive spacing"),
        (lambda: Surface.mesh(np.eye(3), [[0, 1, 2]], 1e-4), InputError, "more than 200000 facets"),
        (lambda: Lambert(1.5), InputError, "albedo"),
        (lambda: Retroreflector(0.5, 0), InputError, "spread"),
        (lambda: HiddenScene([]), InputError, "needs a surface"),
        (
            lambda: HiddenScene([facet()]).simulate_capture(WALL, SPOT, AXIS, 0),
            InputError,
            "jitter",
        ),
    ],
)
def test_nonsense_is_refused(build: object, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        build()
