"""`tofclip occlusion demo --live`: what the sliders do, and the same with a recording."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_instrument import Run

from apps.occlusion.experiment import Experiment, ExperimentSettings
from apps.occlusion.live import (
    CLIP_GATED,
    ONE_CAMERA,
    TRUTH,
    GatedSource,
    WalkSource,
    look_behind,
)
from apps.occlusion.scenes import make_occlusion_scene, make_walking_scene
from apps.verbs.view import PageDoor
from apps.viewer.session import Session
from apps.viewer.source_factory import open_source
from tofclip.errors import InputError
from tofclip.lidar import PointCloud
from tofclip.metrics import correlation_coefficient

SETTINGS = ExperimentSettings(side_px=32, sampling_ratio=1.0)


def test_the_gate_and_the_occluders_width_decide_what_is_seen() -> None:
    scene = make_walking_scene("person")
    between = look_behind(Experiment(scene, SETTINGS), 0.085)
    truth = between.pictures[TRUTH]
    # as the demonstration's own measure: 0.8 is seen
    assert correlation_coefficient(between.pictures[CLIP_GATED], truth) > 0.8
    assert correlation_coefficient(between.pictures[ONE_CAMERA], truth) < 0.7
    depths = between.view.cloud.xyz[:, 2]
    # the occluder and the person, each to a bin of 3 mm
    assert abs(depths[depths < 0.085] - 0.05).max() < 3e-3
    assert abs(depths[depths > 0.085] - 0.12).max() < 3e-3
    assert between.description == "hides 33 mm behind it; person at 70 mm: seen"
    # open before the occluder: its light is in the picture too; open after the person: no light is
    early = look_behind(Experiment(scene, SETTINGS), 0.036)
    assert correlation_coefficient(early.pictures[CLIP_GATED], truth) < 0.7
    late = look_behind(Experiment(scene, SETTINGS), 0.134)
    assert not late.pictures[CLIP_GATED].any()
    # as wide as the views are apart
    wide = scene.widen_occluder(15e-3)
    assert wide.region.width == 15e-3
    assert wide.occluder[0].shape.half_extent[0] == pytest.approx(7.5e-3)
    hidden = look_behind(Experiment(wide, SETTINGS), 0.085)
    assert "nothing is promised" in hidden.description
    # What passes beside the occluder is light, far above its noise; it shows no person.
    seen, gated = between.pictures[CLIP_GATED], hidden.pictures[CLIP_GATED]
    assert gated.sum() < 0.25 * seen.sum()
    assert correlation_coefficient(gated, truth) < 0.5


def test_every_occluder_has_a_person_behind_it() -> None:
    bush = make_walking_scene("bush")
    assert bush.title == "a person behind a bush"
    assert len(bush.occluder) == len(make_occlusion_scene("bush").occluder)
    twice = bush.widen_occluder(2 * bush.region.width)
    for before, after in zip(bush.occluder, twice.occluder, strict=True):
        assert after.centre == pytest.approx(before.centre * (2, 2, 1))
    assert len(bush.target) == len(make_occlusion_scene("person").target)


def test_a_person_walks_while_one_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    def slowly(experiment: Experiment, opens: float) -> Any:
        time.sleep(0.05)
        return look_behind(experiment, opens)

    monkeypatch.setattr("apps.occlusion.live.look_behind", slowly)
    settings = ExperimentSettings(side_px=24, sampling_ratio=1.0)
    began = time.monotonic()
    with contextlib.closing(WalkSource(make_walking_scene("person"), settings)) as source:
        session = Session(source)
        assert session.label == "LIVE"
        beside, below = session.pictures(session.frame_at(0.0))
        assert beside == f"{ONE_CAMERA} | {CLIP_GATED}"
        first = source.pictures(0)[below]
        width, _ = source.settings
        width.value = 15.0
        until = time.monotonic() + 20
        while len(source) < 4 and time.monotonic() < until:
            time.sleep(0.02)
        assert "nothing is promised" in source.view(len(source) - 1).text
        assert not np.allclose(source.pictures(3)[below], first)
        # Steps come one after the other, each after its wait.
        assert 0.05 <= source.inflow.latency < time.monotonic() - began - 3 * 0.05
    assert not source.inflow.is_live
    assert source.inflow.failure_text == ""


def test_a_recording_behind_a_gate(files: Path) -> None:
    shots = open_source(str(files / "streak.h5"))
    source = GatedSource(shots)
    session = Session(source)
    whole = session.frame_at(0.0)
    (gate,) = source.settings
    middle = float(np.mean([whole.cloud.range.min(), whole.cloud.range.max()]))
    gate.value = middle
    behind = session.frame_at(0.0)
    assert 0 < len(behind.cloud) < len(whole.cloud)
    assert behind.cloud.range.min() >= middle
    (pair,) = session.pictures(behind).values()
    left, right = pair[:, : pair.shape[0]], pair[:, -pair.shape[0] :]
    assert left.std() > 0.05
    assert right.std() > 0.05
    assert abs(left - right).mean() > 0.01


def test_a_cloud_has_no_light_over_time(tmp_path: Path) -> None:
    one = np.ones(5)
    PointCloud(np.ones((5, 3)), one, one, one, one, one).save(tmp_path / "cloud.ply")
    with pytest.raises(InputError, match="light over time"):
        GatedSource(open_source(str(tmp_path / "cloud.ply")))


def test_the_verb_serves_either(
    run: Run, files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    served: list[Any] = []
    monkeypatch.setattr(PageDoor, "serve", lambda _, session: served.append(session))
    words = ("occlusion", "demo", "--live", "--no-browser")
    assert run(*words, "--scene", "bush", "--side-px", 24).status == 0
    assert run(*words, "--recording", files / "streak.h5").status == 0
    walk, recorded = served
    assert walk.source.title == "a person behind a bush, live"
    assert not walk.source.inflow.is_live  # closed when the page is
    assert recorded.source.title.endswith("behind a gate")
    for wrong in (
        ("--live", "--out", tmp_path / "made"),
        (),
        ("--recording", files / "streak.h5", "--out", tmp_path / "made"),
    ):
        refused = run("occlusion", "demo", *wrong)
        assert (refused.status, refused.err.count("\n")) == (2, 1)
    assert not (tmp_path / "made").exists()
