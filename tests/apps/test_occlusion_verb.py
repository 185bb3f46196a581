"""`tofclip occlusion`, its live demonstration, and the studies of seeing through occluders."""

import contextlib
import os
import time
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from PIL import Image
from small_instrument import Shell

from apps.occlusion.experiment import (
    SCENES,
    Experiment,
    ExperimentSettings,
    ProbeResult,
    make_occlusion_scene,
    make_walking_scene,
)
from apps.occlusion.live import (
    CLIP_GATED,
    ONE_CAMERA,
    TRUTH,
    GatedSource,
    WalkSource,
    look_behind,
)
from apps.studies import occlusion
from apps.studies.cases import Library, read_cases
from apps.verbs.occlusion import SCENE_NAMES
from apps.viewer.page import PageDoor
from apps.viewer.session import Session
from apps.viewer.source_factory import open_source
from tofclip.errors import InputError
from tofclip.lidar import PointCloud
from tofclip.metrics import correlation_coefficient
from tofclip.simulate.light_fields import CameraArray

SETTINGS = ExperimentSettings(side_px=32, sampling_ratio=1.0)


class TestRegion:
    def test_the_inactive_length_of_the_papers_experiment(self, shell):
        words = "--baseline-mm 15 --width-mm 6 --distance-mm 50 --out region.png"
        found = shell.figures(f"occlusion region {words}")
        assert found["inactive_length_m"] == pytest.approx(0.1 / 3)
        assert matplotlib.image.imread("region.png").std() > 0.05
        assert "region" in shell("occlusion").out

    def test_a_wide_occluder_promises_nothing_and_says_so(self, shell):
        reported = shell.figures("occlusion region --width-mm 15")
        assert reported["inactive_length_m"] is None
        assert "nothing" in reported["promised"]


class TestDemonstration:
    @pytest.fixture(scope="class")
    @classmethod
    def folder(cls, tmp_path_factory):
        return tmp_path_factory.mktemp("occlusion") / "made"

    @pytest.fixture(scope="class")
    @classmethod
    def reported(cls, request, folder):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("apps.occlusion.experiment.WALK_PLACES_M", [-18e-3, 0.0, 18e-3])
            words = "--scene plate --side-px 40 --sampling-ratio 1 --moving --out {folder}"
            return Shell(request).figures(f"occlusion demo {words}")

    @pytest.mark.usefixtures("reported")
    def test_it_leaves_a_picture_and_films(self, folder):
        # three steps to the right and one on the way back; the flash has some six bright instants
        # at each return
        films = {"occlusion_moving.gif": range(4, 5), "occlusion.gif": range(10, 21)}
        assert {*os.listdir(folder)} == {"occlusion.png", *films}
        assert matplotlib.image.imread(folder / "occlusion.png").std() > 0.05
        for name, lengths in films.items():
            with Image.open(folder / name) as film:
                assert film.n_frames in lengths
                assert film.info["loop"] == 0

    def test_behind_a_board_nothing_is_promised(self, shell):
        reported = shell.figures("occlusion demo --scene board --side-px 32 --out made")
        assert reported["inactive_length_m"] is None
        nothing = {"correlation": 0.0, "expected_visible": False}
        assert reported["targets"] == [{"distance_m": pytest.approx(0.12), **nothing}]

    def test_scenes(self):
        """Their names are those of the help; the target moves from left to right in the film, and
        the occluder stays.
        """
        assert tuple(SCENES) == SCENE_NAMES
        scene = make_occlusion_scene("plate")
        moved = scene.move_target(0.01)
        assert moved.target[0].centre[0] == pytest.approx(scene.target[0].centre[0] + 0.01)
        assert moved.occluder is scene.occluder
        bush = make_walking_scene("bush")
        assert bush.title == "a person behind a bush"
        assert len(bush.occluder) == len(make_occlusion_scene("bush").occluder)
        assert len(bush.target) == len(make_occlusion_scene("person").target)
        twice = bush.widen_occluder(2 * bush.region.width)
        for before, after in zip(bush.occluder, twice.occluder, strict=True):
            assert after.centre == pytest.approx(before.centre * (2, 2, 1))


class TestLive:
    def test_the_gate_and_the_occluders_width_decide_what_is_seen(self):
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
        light = between.view.cloud.intensity[depths > 0.085]
        assert np.isin(light, between.pictures[CLIP_GATED].astype(light.dtype)).all()
        assert between.view.text == "hides 33 mm behind it; person at 70 mm: seen"
        # open before the occluder: its light is in the picture too; open after the person: no light
        # is
        early = look_behind(Experiment(scene, SETTINGS), 0.036)
        assert correlation_coefficient(early.pictures[CLIP_GATED], truth) < 0.7
        late = look_behind(Experiment(scene, SETTINGS), 0.134)
        assert not late.pictures[CLIP_GATED].any()
        # as wide as the views are apart
        wide = scene.widen_occluder(15e-3)
        assert wide.region.width == 15e-3
        assert wide.occluder[0].shape.half_extent[0] == pytest.approx(7.5e-3)
        hidden = look_behind(Experiment(wide, SETTINGS), 0.085)
        assert "nothing is promised" in hidden.view.text
        # What passes beside the occluder is light, far above its noise; it shows no person.
        seen, gated = between.pictures[CLIP_GATED], hidden.pictures[CLIP_GATED]
        assert gated.sum() < 0.25 * seen.sum()
        assert correlation_coefficient(gated, truth) < 0.5

    def test_a_person_walks_while_one_looks(self, monkeypatch):
        def slowly(experiment, opens):
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

    def test_a_recording_behind_a_gate(self, files):
        source = GatedSource(open_source(str(files / "streak.h5")))
        session = Session(source)
        whole = session.frame_at(0.0)
        (gate,) = source.settings
        gate.value = float(np.mean([whole.cloud.range.min(), whole.cloud.range.max()]))
        behind = session.frame_at(0.0)
        assert 0 < len(behind.cloud) < len(whole.cloud)
        assert behind.cloud.range.min() >= gate.value
        (pair,) = session.pictures(behind).values()
        left, right = pair[:, : pair.shape[0]], pair[:, -pair.shape[0] :]
        assert min(left.std(), right.std()) > 0.05
        assert abs(left - right).mean() > 0.01

    def test_a_cloud_has_no_light_over_time(self, tmp_path):
        one = np.ones(5)
        PointCloud(np.ones((5, 3)), one, one, one, one, one).save(tmp_path / "cloud.ply")
        with pytest.raises(InputError, match="light over time"):
            GatedSource(open_source(str(tmp_path / "cloud.ply")))

    def test_the_verb_serves_either(self, shell, monkeypatch):
        served = []
        monkeypatch.setattr(PageDoor, "serve", lambda _, session: served.append(session))
        live = "occlusion demo --live --no-browser --scene bush --side-px 24"
        recorded = "occlusion demo --recording {files}/streak.h5"
        for line in (live, f"{recorded} --live --no-browser"):
            assert shell(line).status == 0
        walk, gated = served
        assert walk.source.title == "a person behind a bush, live"
        assert not walk.source.inflow.is_live  # closed when the page is
        assert gated.source.title.endswith("behind a gate")
        shell.refuses(f"{recorded} --out made")
        assert not Path("made").exists()


class TestStudies:
    @pytest.fixture
    def sweep(self, monkeypatch):
        """Run the sweep of the inactive region over a part of it."""

        def run(**parts):
            for name, value in parts.items():
                monkeypatch.setattr(occlusion, name, value)
            steps = []
            outcome = occlusion.run_inactive_region(Library(), 1, steps.append)
            assert sum(steps) == len(outcome.rows)
            return outcome

        return run

    def test_the_sweep_recovers_what_the_formula_promises_and_nothing_else(self, sweep):
        """The hardest corners: the return nearest to its occluder's, and the occluder nearly as
        wide as the baseline.
        """
        outcome = sweep(WIDTHS_MM=(2.0, 14.0), DISTANCES_MM=(30.0,), DISPLAYED_BAR_MM=(2.0, 30.0))
        assert all(len(row.labels) == len(outcome.columns) for row in outcome.rows)
        seen = [row.labels[-1] for row in outcome.rows]
        assert seen == ["hidden", "visible", "visible"] * 2
        assert ["visible" if row.mean >= 0.8 else "hidden" for row in outcome.rows] == seen
        assert len(outcome.panels[0]) == 4

    def test_a_fixed_camera_finds_its_own_gates_and_sees_what_the_formula_promises(
        self, sweep, monkeypatch
    ):
        """A part of its picture: 16 cells of the strip, which correlate by chance with a standard
        deviation of a quarter.
        """
        small = {"FIXED_PICTURE_PX": 64, "FIELD_OF_VIEW_RAD": 0.225, "BOARD_ROWS": 16}
        for name, value in small.items():
            monkeypatch.setattr(f"apps.occlusion.experiment.{name}", value)
        fitted = ProbeResult(0.1, 1.2, 0.9, 7, np.zeros((4, 4)), np.zeros((4, 4)))
        outcome = sweep(
            WIDTHS_MM=(6.0,),
            DISTANCES_MM=(50.0,),
            DISTANCE_FACTORS=(0.8, 1.2),
            probe_target=lambda *_: fitted,
        )
        assert len(outcome.rows) == 4
        hidden, visible = (row for row in outcome.rows if row.labels[-2] == occlusion.FIXED_CAMERA)
        assert hidden.labels[-1] == "hidden"
        assert hidden.mean < 0.25
        assert visible.mean > 0.5

    def test_knowing_the_occluder_is_what_makes_the_target_bright(self, monkeypatch):
        plates = [one for one in read_cases("table7-flash") if one.scene == "plate"][::2]
        monkeypatch.setattr(occlusion, "read_cases", lambda _: plates)
        steps = []
        small = Library(array=CameraArray((48, 48)))
        knowing, ignorant = occlusion.run_flash_occlusion(small, 1, steps.append).rows[:2]
        assert sum(steps) == 2
        assert knowing.mean < 0.5 * ignorant.mean
        assert knowing.paper is not None
        assert ignorant.paper is None
