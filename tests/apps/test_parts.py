"""The small parts behind the verbs: reports, progress, names of files, and what the pictures choose
to show.
"""

from __future__ import annotations

import io
import json
import signal
import sys
import threading
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from apps.figures.shot import MAX_MOMENTS, choose_moments, make_preview_figure
from apps.figures.style import make_figure, save_figure
from apps.progress import show_activity, show_progress
from apps.report import build_provenance, make_folder, report, require_writable, to_json_value
from tofclip import Camera, Frames, Streak
from tofclip.errors import StorageError
from tofclip.storage import Record


class TestReport:
    def test_json_has_no_nan_and_no_numpy(self, capsys: pytest.CaptureFixture[str]) -> None:
        figures = {
            "a": np.float32(0.5),
            "b": np.array([1.0, np.nan]),
            "c": (1, Path("x")),
            "d": {"e": np.int64(3)},
        }
        report(figures, as_json=True, written=[Path("out.h5")])
        found = json.loads(capsys.readouterr().out)
        assert found == {"a": 0.5, "b": [1.0, None], "c": [1, "x"], "d": {"e": 3}}

    def test_table_for_people(self, capsys: pytest.CaptureFixture[str]) -> None:
        figures = {"range_m": [1.23456, float("inf")], "points": 3, "at": {"x": 0.5, "z": 12345.6}}
        report(figures, as_json=False, written=[Path("out.h5")])
        lines = ["range m  1.235, unknown", "points   3", "at       x 0.5, z 12346", "wrote out.h5"]
        assert capsys.readouterr().out.splitlines() == lines

    def test_what_is_said_of_several_things_stands_side_by_side(
        self, capsys: pytest.CaptureFixture[str]
    ) -> None:
        figures = {
            "seed": 0,
            "hybrid": {"seconds": 2.2384, "peak_mib": 65.0},
            "flat": {"seconds": 1.3, "peak_mib": 40.0},
            "lost": {"device_count": 1, "host_count": 2},
            "found": {"device_count": 1, "host_count": 2},
            "stages_s": {"read": {"median": 0.25, "p95": 0.5}, "wait": {"median": 1.0, "p95": 2.0}},
            "targets": [{"distance_m": 0.1, "seen": False}, {"distance_m": 0.2, "seen": True}],
        }
        report(figures, as_json=False)
        assert capsys.readouterr().out.splitlines() == [
            "seed      0",
            "          hybrid  flat",
            "seconds   2.238   1.3",
            "peak mib  65      40",
            "lost      device count 1, host count 2",
            "found     device count 1, host count 2",
            "stages s",
            "        median  p95",
            "  read  0.25    0.5",
            "  wait  1       2",
            "targets",
            "     distance m  seen",
            "  1  0.1         no",
            "  2  0.2         yes",
        ]

    def test_many_things_stand_below_each_other_and_units_behind_their_figures(
        self, capsys: pytest.CaptureFixture[str]
    ) -> None:
        found = {f"object_{number}": {"range_m": 1.5, "points": 7} for number in range(12)}
        report(found, as_json=False)
        lines = capsys.readouterr().out.splitlines()
        assert lines[0].split() == ["range", "m", "points"]
        assert lines[12].split() == ["object", "11", "1.5", "7"]
        report({"wall": {"width_m": 2.0, "gap_mm": None}}, as_json=False)
        assert capsys.readouterr().out == "wall  width 2 m, gap unknown\n"
        report({"why": {"a": "x" * 60, "long_one": "y" * 60}}, as_json=False)
        assert capsys.readouterr().out == f"why\n  a         {'x' * 60}\n  long one  {'y' * 60}\n"

    def test_infinity_is_unknown(self) -> None:
        assert to_json_value([np.inf, -np.inf, True, None, "text"]) == [
            None,
            None,
            True,
            None,
            "text",
        ]


class TestProgress:
    def test_silent_where_nobody_watches(self, capsys: pytest.CaptureFixture[str]) -> None:
        with show_progress("working", 10) as advance:
            advance(10)
        with show_activity("working"):
            pass
        assert capsys.readouterr() == ("", "")

    def test_elapsed_and_left_are_on_a_terminal(self, monkeypatch: pytest.MonkeyPatch) -> None:
        terminal = io.StringIO()
        terminal.isatty = lambda: True  # type: ignore[method-assign]
        monkeypatch.setattr(sys, "stderr", terminal)
        monkeypatch.setenv("TERM", "xterm")
        with show_progress("working", 10) as advance:
            advance(5)
        with show_activity("waiting"):
            pass
        shown = terminal.getvalue()
        assert "working" in shown
        assert "0:00:00" in shown
        assert "left" in shown
        assert "waiting" in shown

    def test_after_ctrl_c_every_thread_stops(self) -> None:
        stopped = threading.Event()

        def work() -> None:
            try:
                while True:
                    advance(1)
            except KeyboardInterrupt:
                stopped.set()

        before = signal.getsignal(signal.SIGINT)
        with show_progress("working", 10) as advance:
            worker = threading.Thread(target=work)
            worker.start()
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
            worker.join(timeout=10)
            assert stopped.is_set()
        assert signal.getsignal(signal.SIGINT) is before

    def test_other_threads_may_use_it(self) -> None:
        amounts: list[int] = []

        def work() -> None:
            with show_progress("working", 1) as advance:
                advance(1)
                amounts.append(1)

        worker = threading.Thread(target=work)
        worker.start()
        worker.join(timeout=10)
        assert amounts == [1]


class TestFiles:
    def test_folder_without_permission(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(
            "os.access", lambda *_: False
        )  # a test may run as root, whom nothing stops
        with pytest.raises(StorageError, match="not permitted"):
            require_writable(tmp_path / "a.h5")
        with pytest.raises(StorageError, match="not permitted"):
            make_folder(tmp_path)

    def test_a_folder_is_no_file(self, tmp_path: Path) -> None:
        with pytest.raises(StorageError, match="is a folder"):
            require_writable(tmp_path)

    def test_history_keeps_the_past(self, tmp_path: Path) -> None:
        (tmp_path / "in.txt").write_text("x")
        reported = build_provenance(
            {"verb": "test"}, tmp_path / "in.txt", earlier={"software": "older"}
        )
        assert reported["earlier"] == {"software": "older"}
        # SHA-256 of the letter x
        assert (
            reported["inputs"][0]["sha256"]
            == "2d711642b726b04401627ca9fbac32f5c8530fb1903cc4db02258717921a4881"
        )
        assert "earlier" not in build_provenance({})


def frames_with(
    camera: Camera, energy: np.ndarray, attachments: dict[str, Record] | None = None
) -> Frames:
    """Frames whose only bright pixel has the given brightness over time, at ranges around 3 m."""
    camera = camera.replace(time_zero=-10e-9)
    values = np.zeros((energy.size, *camera.image_shape), np.float32)
    values[:, 5, 6] = energy
    times = 20e-9 + np.arange(energy.size) * 20e-12
    return Frames(values, times, camera, attachments=attachments or {})


class TestMoments:
    def test_separate_objects_make_separate_peaks(self, camera: Camera) -> None:
        rows, bins = np.array([20, 60, 110, 170, 199]), np.arange(200)
        energy = np.exp(-(((bins[:, np.newaxis] - rows) / 2.5) ** 2) / 2) @ np.array(
            [5.0, 1, 3, 2, 4]
        )
        found = choose_moments(frames_with(camera, energy))
        assert [moment.frame for moment in found] == pytest.approx(rows, abs=1)
        # Half height of a Gaussian of 2.5 bins, smoothed by 1.5, is 3.4 bins away from its peak.
        assert [moment.last - moment.first for moment in found[:4]] == pytest.approx([7] * 4, abs=1)

    def test_only_the_strongest_are_shown(self, camera: Camera) -> None:
        energy = np.zeros(600)
        energy[10::30] = np.arange(1, 21)
        found = [moment.frame for moment in choose_moments(frames_with(camera, energy))]
        assert found == list(range(250, 600, 30))
        assert len(found) == MAX_MOMENTS

    def test_light_without_a_pause_is_cut_into_even_shares(self, camera: Camera) -> None:
        energy = np.exp(-(((np.arange(300) - 150) / 40) ** 2) / 2)
        moments = choose_moments(frames_with(camera, energy, {"relay_wall": Record("relay_wall")}))
        assert len(moments) == MAX_MOMENTS
        shares = [energy[moment.first : moment.last + 1].sum() / energy.sum() for moment in moments]
        # A twelfth each, up to the frame that a cut falls on (at most 1 % of the light).
        np.testing.assert_allclose(shares, 0.98 / MAX_MOMENTS, atol=0.011)

    def test_overlapping_peaks_are_cut_into_even_shares(self, camera: Camera) -> None:
        bins = np.arange(300)
        bumps = np.exp(-(((bins[:, np.newaxis] - [90, 120, 150, 180, 210]) / 3) ** 2) / 2).sum(
            axis=1
        )
        energy = (
            np.exp(-(((bins - 150) / 60) ** 2) / 2) + 0.2 * bumps
        )  # the middle one stands on all of the others
        moments = choose_moments(frames_with(camera, energy))
        assert all(earlier.last < later.first for earlier, later in pairwise(moments))
        assert len(moments) == MAX_MOMENTS

    def test_brightness_is_compensated_only_where_time_tells_the_range(
        self, camera: Camera
    ) -> None:
        """A far peak is below the limit as measured, and above it once the fall-off with range is
        undone.
        """
        energy = np.zeros(1000)
        energy[[20, 500, 980]] = [1.0, 0.3, 0.008]
        energy[[100, 200, 300, 400]] = 0.5
        wall = {"relay_wall": Record("relay_wall")}
        assert 980 in [moment.frame for moment in choose_moments(frames_with(camera, energy))]
        assert 980 not in [
            moment.frame for moment in choose_moments(frames_with(camera, energy, wall))
        ]

    def test_few_frames_are_shown_one_by_one(self, camera: Camera) -> None:
        moments = choose_moments(frames_with(camera, np.ones(5)))
        assert [(moment.first, moment.last) for moment in moments] == [
            (frame, frame) for frame in range(5)
        ]

    @pytest.mark.parametrize("energy", [np.ones(1), np.zeros(5), np.zeros(50)])
    def test_the_picture_can_always_be_drawn(
        self, camera: Camera, tmp_path: Path, energy: np.ndarray
    ) -> None:
        streak = Streak(np.ones((energy.size, camera.slit_width_px)), camera=camera).with_bin_width(
            20e-12
        )
        save_figure(make_preview_figure(streak, frames_with(camera, energy)), tmp_path / "look.png")
        assert (tmp_path / "look.png").stat().st_size > 10_000


def test_a_picture_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    with pytest.raises(StorageError):
        save_figure(make_figure(2, 2), tmp_path / "absent" / "look.png")
    assert list(tmp_path.iterdir()) == []
