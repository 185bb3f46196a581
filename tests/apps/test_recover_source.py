"""From an emulated instrument to a point cloud in one command."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from small_instrument import Run

from devices.emulation.scenes import LineLight, simulate_line_light
from tofclip.lidar import PointCloud, depth
from tofclip.shots import Frames
from tofclip.simulate import score_returns


@pytest.fixture(scope="module")
def light() -> LineLight:
    return simulate_line_light()


@pytest.mark.parametrize(
    "address",
    ["sim+linospad2://?seed=1&bins=576", "sim+remoteex://?seed=1&scene=small&frame_rate=50"],
)
def test_a_point_cloud_from_a_source(
    run: Run, tmp_path: Path, light: LineLight, address: str
) -> None:
    out, cloud = tmp_path / "frames.h5", tmp_path / "cloud.ply"
    outcome = run("recover", address, "--out", out, "--cloud", cloud, "--json")
    assert (outcome.status, outcome.err) == (0, "")
    assert json.loads(outcome.out)["frames"] == 576
    frames = Frames.load(out)
    figures = score_returns(depth(frames), light.truth)
    # The demonstration's own is 0.37 mm, with 97 % within one bin of 3 mm.
    assert figures["median_depth_error_m"] < 0.6e-3
    assert figures["share_within_one_bin"] > 0.93
    points = PointCloud.load(cloud)
    assert len(points) == len(depth(frames))
    assert 1.5 < points.range.min() < points.range.max() < 3.5
    assert frames.provenance["earlier"]["source"]["instrument"]


def test_addresses_that_lead_nowhere(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "frames.h5"
    for address in (
        "nothing://x",
        "sim+linospad2://?speed=1",
        f"linospad2://{tmp_path}/absent.dat",
    ):
        outcome = run("recover", address, "--out", out)
        assert (outcome.status, outcome.err.count("\n")) == (2, 1)
    assert (
        run("recover", "sim+linospad2://", "--out", out, "--cloud", tmp_path / "cloud.txt").status
        == 2
    )
    assert not list(tmp_path.iterdir())
