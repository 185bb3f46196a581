"""The small parts behind the verbs: reports, progress, names of files, settings, and what the
pictures choose to show.
"""

import io
import json
import signal
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apps.figures.shot import choose_moments, make_preview_figure
from apps.figures.style import make_figure
from apps.options import load_settings, save_settings, settings_to_dict
from apps.progress import show_activity, show_progress
from apps.report import (
    PRINTS_JSON,
    build_provenance,
    holding,
    make_folder,
    report,
    require_writable,
)
from nlos import simulate
from nlos.settings import WALLS, declare_setting
from tofclip import Frames, Streak
from tofclip.errors import FileFormatError, InputError, StorageError
from tofclip.notebook import save_figure


class TestReport:
    def test_json_has_no_nan_and_no_numpy(self, capsys):
        figures = {
            "a": np.float32(0.5),
            "b": np.array([1.0, np.nan]),
            "c": (1, Path("x")),
            "d": {"e": np.int64(3)},
            "f": [np.inf, -np.inf, True, None, "text"],
        }
        with holding(PRINTS_JSON, True):
            report(figures, [Path("out.h5")])
        odd = {"f": [None, None, True, None, "text"]}
        found = json.loads(capsys.readouterr().out)
        assert found == {"a": 0.5, "b": [1.0, None], "c": [1, "x"], "d": {"e": 3}} | odd

    @pytest.mark.parametrize(
        ("figures", "lines"),
        [
            (
                {"range_m": [1.23456, float("inf")], "points": 3, "at": {"x": 0.5, "z": 12345.6}},
                ["range m  1.235, -", "points   3", "at       x 0.5, z 12346"],
            ),
            # what is said of several things stands side by side
            (
                {
                    "seed": 0,
                    "hybrid": {"seconds": 2.2384, "peak_mib": 65.0},
                    "flat": {"seconds": 1.3, "peak_mib": 40.0},
                    "lost": {"device_count": 1, "host_count": 2},
                    "found": {"device_count": 1, "host_count": 2},
                    "stages_s": {
                        "read": {"median": 0.25, "p95": 0.5},
                        "wait": {"median": 1.0, "p95": 2.0},
                    },
                    "targets": [
                        {"distance_m": 0.1, "seen": False},
                        {"distance_m": 0.2, "seen": True},
                    ],
                },
                [
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
                ],
            ),
            # lines too long for a terminal become columns
            (
                {"scenes": {name: dict.fromkeys(("f" * 50, "g" * 50), 1) for name in "ab"}},
                ["scenes", f"{'':52}  a    b", f"{'f' * 50}  1    1", f"{'g' * 50}  1    1"],
            ),
            # units stand behind their figures; what is not known is left out
            ({"wall": {"width_m": 2.0, "gap_mm": None}, "none": {}}, ["wall  width 2 m"]),
            (
                {"why": {"a": "x" * 60, "long_one": "y" * 60}},
                ["why", f"  a         {'x' * 60}", f"  long one  {'y' * 60}"],
            ),
        ],
    )
    def test_table_for_people(self, capsys, figures, lines):
        report(figures, [Path("out.h5")])
        assert capsys.readouterr().out.splitlines() == [*lines, "wrote out.h5"]


class TestProgress:
    def test_after_ctrl_c_every_thread_stops(self):
        stopped = threading.Event()

        def work():
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

    def test_where_there_is_no_terminal_long_work_says_once_what_it_does(self, monkeypatch):
        monkeypatch.setattr("apps.progress.MAX_SILENCE_S", 0.01)
        monkeypatch.setattr("sys.stderr", said := io.StringIO())
        with show_activity("reading wall.npz"), show_progress("a part of it", 1):
            ends = time.monotonic() + 60
            while not said.getvalue().endswith("\n") and time.monotonic() < ends:
                time.sleep(0.01)
        assert said.getvalue() == "tofclip: reading wall.npz ...\n"


class TestFiles:
    def test_places_that_cannot_be_written_to(self, tmp_path, monkeypatch):
        with pytest.raises(StorageError, match="is a folder"):
            require_writable(tmp_path)
        with pytest.raises(StorageError):
            save_figure(make_figure(2, 2), tmp_path / "absent" / "look.png")
        # a test may run as root, whom nothing stops
        monkeypatch.setattr("os.access", lambda *_: False)
        with pytest.raises(StorageError, match="not permitted"):
            require_writable(tmp_path / "a.h5")
        with pytest.raises(StorageError, match="not permitted"):
            make_folder(tmp_path)
        assert list(tmp_path.iterdir()) == []

    def test_history_keeps_the_past(self, tmp_path):
        (tmp_path / "in.txt").write_text("x")
        settings, past = {"verb": "test"}, {"software": "older"}
        reported = build_provenance(settings, tmp_path / "in.txt", earlier=past)
        assert reported["earlier"] == past
        # SHA-256 of the letter x
        digest = "2d711642b726b04401627ca9fbac32f5c8530fb1903cc4db02258717921a4881"
        assert reported["inputs"][0]["sha256"] == digest
        assert "earlier" not in build_provenance({})


def frames_with(camera, energy, attachments=None):
    """Frames whose only bright pixel has the given brightness over time, at ranges around 3 m."""
    values = np.zeros((energy.size, *camera.image_shape), np.float32)
    values[:, 5, 6] = energy
    times = 20e-9 + np.arange(energy.size) * 20e-12
    camera = camera.replace(time_zero=-10e-9)
    return Frames(values, times, camera, attachments=attachments or {})


def bumps(places, sigma, size=300):
    return np.exp(-(((np.arange(size)[:, np.newaxis] - places) / sigma) ** 2) / 2)


class TestMoments:
    def test_separate_objects_make_separate_peaks(self, camera):
        rows = np.array([20, 60, 110, 170, 199])
        energy = bumps(rows, 2.5, 200) @ np.array([5.0, 1, 3, 2, 4])
        found = choose_moments(frames_with(camera, energy))
        assert [moment.frame for moment in found] == pytest.approx(rows, abs=1)
        # Half height of a Gaussian of 2.5 bins, smoothed by 1.5, is 3.4 bins away from its peak.
        assert [moment.last - moment.first for moment in found[:4]] == pytest.approx([7] * 4, abs=1)

    @pytest.mark.parametrize("energy", [np.ones(1), np.zeros(5), np.zeros(50)])
    def test_the_picture_can_always_be_drawn(self, camera, tmp_path, energy):
        counts = np.ones((energy.size, camera.slit_width_px))
        streak = Streak(counts, camera=camera).with_bin_width(20e-12)
        save_figure(make_preview_figure(streak, frames_with(camera, energy)), tmp_path / "look.png")
        assert (tmp_path / "look.png").stat().st_size > 10_000


@dataclass(frozen=True)
class Sample:
    """One setting of every type."""

    name: str | None = declare_setting("", "A text.")
    length: float | None = declare_setting("m", "A length.")
    facet: float | None = declare_setting("m", "A short one.", written="mm")
    count: int = declare_setting("", "A number.", 2)
    whole: bool = declare_setting("", "A choice.", False)
    ends: tuple[float, float] | None = declare_setting("m", "A pair.")
    words: list[str] | None = declare_setting("", "Texts.")  # noqa: RUF009 - declares a field


NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
TEXTS = st.text(st.characters(exclude_categories=["Cs"]))
SAMPLES = st.builds(
    Sample,
    name=st.none() | TEXTS,
    length=st.none() | NUMBERS,
    count=st.integers(-(2**63), 2**63 - 1),
    whole=st.booleans(),
    ends=st.none() | st.tuples(NUMBERS, NUMBERS),
    words=st.none() | st.lists(TEXTS),
)


@given(sample=SAMPLES)
def test_what_is_written_is_read_back_to_the_last_bit(sample, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "sample.toml"
    save_settings(sample, path, "a sample")
    assert repr(load_settings(Sample, path, {})) == repr(sample)  # as text, for -0.0 equals 0.0


def test_flags_win_over_the_file_and_the_file_over_the_defaults(tmp_path):
    path = tmp_path / "settings.toml"
    path.write_text("length_m = 3\ncount = 5\nends_m = [1, 2.5]\n")
    found = load_settings(Sample, path, {"count": 7, "name": None, "whole": False})
    assert found == Sample(length=3.0, count=7, ends=(1.0, 2.5))
    assert isinstance(found.length, float)
    assert load_settings(Sample, None, {}) == Sample()
    assert settings_to_dict(Sample(count=3)) == {"count": 3, "whole": False}


@given(st.decimals(1, 9999, places=4).map(float))
def test_lengths_in_mm_are_metres_inside_and_come_back_as_they_were(facet_mm):
    found = load_settings(Sample, None, {"facet_mm": facet_mm})
    assert found.facet == facet_mm * 1e-3
    assert settings_to_dict(found)["facet_mm"] == facet_mm


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("lenght_m = 1", "did you mean 'length_m'"),
        ("zzz = 1", "known are name, length_m, facet_mm, count, whole, ends_m, words"),
        ("length_m = 'one'", "length_m should be a valid number, got 'one'"),
        ("length_m = true", "length_m should be a valid number"),
        ("length_m = nan", "length_m should be a finite number"),
        ("count = 1.5", "count should be a valid integer"),
        ("whole = 1", "whole should be a valid boolean"),
        ("name = 1", "name should be a valid string"),
        ("ends_m = [1, 2, 3]", "at most 2 items"),
        ("ends_m = 1", "ends_m should be a valid array"),
        ("[table]\na = 1", "no setting is called 'table'"),
    ],
)
def test_what_makes_no_sense_is_refused(text, complaint, tmp_path):
    path = tmp_path / "settings.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"settings\.toml") as caught:
        load_settings(Sample, path, {})
    assert complaint in str(caught.value)


@pytest.mark.parametrize("content", [b"length_m = = 1", b"name = '\xff'"])
def test_files_that_are_no_toml(content, tmp_path):
    path = tmp_path / "settings.toml"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match="is not a TOML file of settings"):
        load_settings(Sample, path, {})
    with pytest.raises(StorageError, match="no such file"):
        load_settings(Sample, tmp_path / "absent.toml", {})


def test_walls_are_those_of_the_simulation():
    assert tuple(simulate.WALLS) == WALLS
