"""`tofclip nlos reconstruct --surface`: a known surface and its normals, as written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from small_instrument import Run

from nlos.capture import TimeAxis
from nlos.simulate import HiddenScene, Surface

CENTRE, TURN = np.array([0.05, -0.05, 0.7]), np.radians(25.0)
BOX = ("--x-m", -0.2, 0.3, "--y-m", -0.3, 0.2, "--near-m", 0.5, "--far-m", 0.9, "--voxel-mm", 20)


def read_vertices(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Places and normals of a PLY file."""
    header, _, data = path.read_bytes().partition(b"end_header\n")
    count = int(header.split(b"element vertex ")[1].split()[0])
    rows = np.frombuffer(data, "<f4", 7 * count).reshape(-1, 7)
    return rows[:, :3], rows[:, 3:6]


@pytest.mark.parametrize("confocal", [True, False])
def test_a_tilted_square_has_its_depth_and_normals(
    run: Run, tmp_path: Path, confocal: bool
) -> None:
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 32), np.linspace(-0.6, 0.6, 32))
    wall = np.stack([x, y, 0 * x], axis=-1)
    # A matte square of 0.4 m, turned about y; counter-clockwise as seen from the wall.
    u, v = 0.2 * np.array([np.cos(TURN), 0, np.sin(TURN)]), np.array([0, 0.2, 0])
    corners = CENTRE + np.array([-u - v, u - v, u + v, -u + v])
    scene = HiddenScene([Surface.mesh(corners, [[0, 2, 1], [0, 3, 2]], 0.04)])
    laser = wall if confocal else [0.0, 0.0, 0.0]
    scene.simulate_capture(wall, laser, TimeAxis(200, 50e-12), 60e-12).save(tmp_path / "c.h5")
    words = ["reconstruct", tmp_path / "c.h5", "--out", tmp_path / "v.h5", *BOX, "--everywhere"]
    wave = ["--wavelength-mm", 120, "--point-fraction", 0.3, "--surface", tmp_path / "mesh.ply"]
    outcome = run("nlos", *words, *wave, "--json")
    assert outcome.status == 0
    found = json.loads(outcome.out)
    source = "directional light-cone transform" if confocal else "gradient of the volume"
    assert found["surface_source"] == source
    places, normals = read_vertices(tmp_path / "mesh.ply")
    assert len(places) == found["surface_points"]
    inner = np.linalg.norm(places[:, :2] - CENTRE[:2], axis=1) < 0.12
    assert inner.sum() > 40
    away, normals = places[inner] - CENTRE, normals[inner]
    # a bin of path, or a quarter of the wavelength
    errors = np.abs(away[:, 2] - away[:, 0] * np.tan(TURN))
    assert np.median(errors) < (0.015 if confocal else 0.03)
    cosines = normals @ [np.sin(TURN), 0, -np.cos(TURN)]
    assert np.median(np.degrees(np.arccos(np.clip(cosines, -1, 1)))) < 12
