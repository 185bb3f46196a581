"""Objects in the hand: opened by one function, printed in a line, shown in a notebook, sliced."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import nlos
import tofclip
from tofclip.errors import InputError, StorageError


@pytest.fixture
def frames() -> tofclip.Frames:
    camera = tofclip.Camera(np.array([8.0, 24.0]), np.zeros(2), (6, 5), 32, time_zero=-1e-9)
    times = 10e-9 + 1e-10 * np.arange(50)
    values = np.random.default_rng(0).random((50, 6, 5), dtype=np.float32)
    return tofclip.Frames(values, times, camera, {"method": "<tv>"})


@pytest.fixture
def cloud() -> tofclip.PointCloud:
    xyz = np.random.default_rng(1).uniform(1, 2, (40, 3)).astype(np.float32)
    distance = np.linalg.norm(xyz, axis=1)
    one = np.ones(40)
    return tofclip.PointCloud(xyz, one, 0.01 * one, distance, one, 2 * distance / 3e8)


def test_frames_are_sliced_and_selected(frames: tofclip.Frames) -> None:
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
    with pytest.raises(InputError, match="slice"):
        frames[3]  # type: ignore[index]


def test_points_are_selected(cloud: tofclip.PointCloud) -> None:
    near = cloud[cloud.range < 2.5]
    assert 0 < len(near) < len(cloud)
    assert near.range.max() < 2.5
    assert np.array_equal(cloud[:7].xyz, cloud.xyz[:7])
    with pytest.raises(InputError, match="mask"):
        cloud[np.ones(3, bool)]


def test_a_line_and_a_page_say_what_is_held(
    frames: tofclip.Frames, cloud: tofclip.PointCloud
) -> None:
    volume = nlos.Volume(np.ones((4, 5, 6), np.float32), nlos.Grid.box((0, 5), (0, 4), (1, 4), 1.0))
    assert repr(frames) == "Frames(50 frames of 6 x 5 pixels, range 1.5 to 2.23 m)"
    no_zero = replace(frames, camera=frames.camera.replace(time_zero=0.0))
    assert repr(no_zero).endswith("2.23 m up to a constant, no time zero given)")
    assert "no time zero given" in no_zero._repr_html_()
    assert repr(cloud).startswith("PointCloud(40 points, range ")
    assert repr(volume) == "Volume(4 x 5 x 6 voxels (z, y, x), float32)"
    for one in (frames, volume):
        assert "<img" in one._repr_html_()
    assert "&lt;tv&gt;" in frames._repr_html_()
    assert "range" in cloud._repr_html_()


def test_one_function_opens_every_file(
    frames: tofclip.Frames, cloud: tofclip.PointCloud, tmp_path: Path
) -> None:
    volume = nlos.Volume(np.ones((4, 5, 6), np.float32), nlos.Grid.box((0, 5), (0, 4), (1, 4), 1.0))
    for name, one in {
        "frames.h5": frames,
        "camera.h5": frames.camera,
        "cloud.h5": cloud,
        "cloud.ply": cloud,
        "volume.h5": volume,
    }.items():
        one.save(tmp_path / name)
        assert type(tofclip.load(tmp_path / name)) is type(one)
    with pytest.raises(StorageError):
        tofclip.load(tmp_path / "absent.h5")
