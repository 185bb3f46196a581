"""Surfaces with normals: depth, albedo and direction of what is seen from the wall."""

from functools import cache

import numpy as np
import pytest
from numpy.linalg import norm
from scenes import planar_wall

from nlos import Grid, PlanarRSD, Volume
from nlos.capture import TimeAxis
from nlos.normals import DirectionalLightCone, find_front_surface
from nlos.simulate import HiddenScene, Surface
from tofclip.errors import InputError

WALL = planar_wall(32, 32)
CENTRE = np.array([0.05, -0.05, 0.7])
GRID = Grid.box((-0.25, 0.35), (-0.35, 0.25), (0.5, 0.9), 0.02)


@cache
def tilted(turn, confocal):
    """A matte square of 0.4 m, turned about y by so many degrees."""
    angle = np.radians(turn)
    u, v = 0.2 * np.array([np.cos(angle), 0, np.sin(angle)]), np.array([0, 0.2, 0])
    corners = CENTRE + np.array([-u - v, u - v, u + v, -u + v])
    # Counter-clockwise as seen from the wall.
    square = Surface.mesh(corners, [[0, 2, 1], [0, 3, 2]], 0.02)
    laser = WALL if confocal else [0.0, 0.0, 0.0]
    return HiddenScene([square]).simulate_capture(WALL, laser, TimeAxis(200, 50e-12), 60e-12)


def find_surface(turn, confocal):
    capture = tilted(turn, confocal)
    if confocal:
        return DirectionalLightCone().find_front_surface(capture, GRID, 0.4)
    return find_front_surface(PlanarRSD(0.12).reconstruct(capture, GRID), 0.2)


@pytest.mark.parametrize("confocal", [True, False])
@pytest.mark.parametrize("turn", [0.0, 30.0, -30.0])
def test_a_tilted_square_has_its_depth_and_direction(turn, confocal):
    found, angle = find_surface(turn, confocal), np.radians(turn)
    x, y, z = found.points.T
    inner = (np.abs(x - CENTRE[0]) < 0.1) & (np.abs(y - CENTRE[1]) < 0.1)
    assert inner.sum() > 60
    plane = CENTRE[2] + (x[inner] - CENTRE[0]) * np.tan(angle)
    # a bin, or a quarter of the wavelength
    assert np.median(np.abs(z[inner] - plane)) < (0.005 if confocal else 0.03)
    normals = found.normals[found.seen][inner]
    assert np.allclose(norm(normals, axis=1), 1, atol=1e-5)
    true = [np.sin(angle), 0, -np.cos(angle)]
    errors = np.degrees(np.arccos(np.clip(normals @ true, -1, 1)))
    assert np.median(errors) < 12


def test_a_surface_is_written_with_normals(tmp_path):
    import pyvista

    found = find_surface(30.0, True)
    found.save(tmp_path / "surface.ply")
    read = pyvista.read(tmp_path / "surface.ply")
    assert np.allclose(read.points, found.points, atol=1e-6)
    assert read.n_cells == len(found.faces) > 60
    # Faces look at the wall, as normals do.
    corners = found.points[found.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.all(across[:, 2] < 0)
    with pytest.raises(InputError, match=r"must end in \.ply"):
        found.save(tmp_path / "surface.vti")


DARK, FLAT = Volume(np.zeros(GRID.shape), GRID), Grid(GRID.x, GRID.y, GRID.z[:2])


@pytest.mark.parametrize(
    ("volume", "fraction", "reason"),
    [
        (DARK, 0.3, "and light"),
        (Volume(np.ones(FLAT.shape), FLAT), 0.3, "3 voxels along every axis"),
        (DARK, 1.5, "a fraction between 0 and 1"),
    ],
)
def test_what_shows_no_surface_is_refused(volume, fraction, reason):
    with pytest.raises(InputError, match=reason):
        find_front_surface(volume, fraction)


def test_a_sphere_has_its_normals():
    """A bright shell about a centre: brightness changes most towards it."""
    centre, radius = CENTRE + np.array([0, 0, 0.15]), 0.3
    away = GRID.points - centre
    shell = np.exp(-(((norm(away, axis=-1) - radius) / 0.03) ** 2))
    # Only its front half is seen.
    found = find_front_surface(Volume(shell * (away[..., 2] < 0), GRID), 0.5)
    outward = found.points - centre
    inner = norm(outward[:, :2], axis=1) < 0.2
    assert inner.sum() > 200
    distance = norm(outward, axis=1)
    # A tenth of a voxel, where the shell is steep it is brightest a little behind.
    assert np.median(np.abs(distance[inner] - radius)) < 0.005
    cosines = np.sum(found.normals[found.seen] * outward / distance[:, None], axis=1)[inner]
    assert np.percentile(np.degrees(np.arccos(np.clip(cosines, -1, 1))), 90) < 8
