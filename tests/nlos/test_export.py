"""Every format is opened by a library that shares no code with the writer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nlos import Grid, Volume
from nlos.export import Mesh
from tofclip.errors import InputError

GRID = Grid(0.1 + 0.02 * np.arange(7), -0.3 + 0.03 * np.arange(6), 0.5 + 0.01 * np.arange(5))


def ball() -> Volume:
    """A soft ball off the middle, brightest at one voxel, with a complex phase that must not
    matter.
    """
    z, y, x = np.meshgrid(GRID.z, GRID.y, GRID.x, indexing="ij")
    values = np.exp(
        -(((x - 0.16) / 0.03) ** 2 + ((y + 0.24) / 0.04) ** 2 + ((z - 0.52) / 0.012) ** 2)
    )
    return Volume((values * np.exp(1j * x)).astype(np.complex64), GRID)


def test_vti_opens_in_vtk(tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista")
    volume = ball()
    volume.export(tmp_path / "a.vti")
    image = pyvista.read(tmp_path / "a.vti")
    assert image.dimensions == (7, 6, 5)
    assert image.origin == pytest.approx((0.1, -0.3, 0.5))
    assert image.spacing == pytest.approx((0.02, 0.03, 0.01))
    assert np.array_equal(image["brightness"].reshape(5, 6, 7), volume.magnitude)
    brightest = image.points[np.argmax(image["brightness"])]
    assert brightest == pytest.approx(volume.find_brightest())


def test_a_flat_or_uneven_volume_as_vti(tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista")
    Volume(np.ones((1, 6, 7)), Grid(GRID.x, GRID.y, [0.5])).export(tmp_path / "flat.vti")
    assert pyvista.read(tmp_path / "flat.vti").dimensions == (7, 6, 1)
    uneven = Volume(np.ones((2, 6, 7)), Grid(GRID.x, [-3, -2, -1.5, -1, 0, 1], [0.5, 0.6]))
    with pytest.raises(InputError, match="evenly spaced voxels along y"):
        uneven.export(tmp_path / "uneven.vti")
    assert not (tmp_path / "uneven.vti").exists()


def test_ply_points_open_in_vtk(tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista")
    ball().export(tmp_path / "a.ply", fraction=0.5)
    cloud = pyvista.read(tmp_path / "a.ply")
    xyz, brightness = ball().points(0.5)
    assert np.asarray(cloud.points) == pytest.approx(xyz)
    assert len(xyz) == np.count_nonzero(ball().magnitude >= 0.5)
    assert brightness.min() >= 0.5
    strongest = xyz[np.argmax(brightness)]
    assert strongest == pytest.approx(ball().find_brightest())


def test_exr_opens_in_opencv_or_openexr(tmp_path: Path) -> None:
    OpenEXR = pytest.importorskip("OpenEXR")
    volume = ball()
    volume.export(tmp_path / "a.exr")
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    projection = volume.maximum_projection()
    assert np.array_equal(channels["Y"], projection.brightness)
    assert channels["Z"] == pytest.approx(projection.depth)


def test_npz_opens_in_numpy(tmp_path: Path) -> None:
    ball().export(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as stored:
        assert np.array_equal(stored["values"], ball().values)
        assert np.array_equal(stored["y_m"], GRID.y)
        assert set(stored) == {"values", "x_m", "y_m", "z_m"}


def test_csv_has_a_row_per_bright_voxel(tmp_path: Path) -> None:
    ball().export(tmp_path / "a.csv", fraction=0.9)
    rows = np.genfromtxt(tmp_path / "a.csv", delimiter=",", names=True)
    assert rows["x_m"] == pytest.approx(ball().find_brightest()[0])


def test_the_surface_encloses_the_ball(tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista")
    fine = Grid(*(np.linspace(-0.2, 0.2, n) for n in (31, 35, 33)))
    z, y, x = np.meshgrid(fine.z, fine.y, fine.x, indexing="ij")
    centre = np.array([0.03, -0.02, 0.01])
    radius = np.linalg.norm(np.stack([x, y, z], axis=-1) - centre, axis=-1)
    mesh = Volume(np.clip(1 - radius / 0.2, 0, None), fine).surface(0.5)
    peak = 1 - radius.min() / 0.2
    # Half of the brightest voxel lies at this radius; marching cubes interpolate a cone linearly
    # along edges.
    assert np.linalg.norm(mesh.vertices - centre, axis=1) == pytest.approx(
        0.2 * (1 - peak / 2), abs=2e-3
    )
    mesh.save(tmp_path / "ball.ply")
    read = pyvista.read(tmp_path / "ball.ply")
    assert read.n_points == len(mesh.vertices)
    assert read.n_cells == len(mesh.faces)
    assert read.volume == pytest.approx(4 / 3 * np.pi * (0.2 * (1 - peak / 2)) ** 3, rel=0.03)
    with pytest.raises(InputError, match=r"must end in \.ply"):
        mesh.save(tmp_path / "ball.obj")


def test_impossible_exports_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"must end in \.vti"):
        ball().export(tmp_path / "a.docx")
    for fraction in (0, 1, np.nan):
        with pytest.raises(InputError, match="fraction between 0 and 1"):
            ball().surface(fraction)
    with pytest.raises(InputError, match="at least 2 voxels"):
        Volume(np.zeros(GRID.shape), GRID).surface(0.5)
    assert isinstance(ball().surface(), Mesh)
