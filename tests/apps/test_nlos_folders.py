"""`tofclip nlos reconstruct FOLDER`: many captures, some broken, some done already."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hidden_point import object_of
from small_instrument import Run

from apps.settings import load_settings, save_settings
from apps.verbs.nlos import ReconstructSettings, ResultFiles, note_content
from nlos import Volume
from tofclip.storage import HDF5_SIGNATURE


@pytest.fixture
def folder(curved: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "captures"
    folder.mkdir()
    for name in ("a.h5", "c.h5"):
        shutil.copy(curved, folder / name)
    (folder / "b.h5").write_bytes(HDF5_SIGNATURE + b"and nothing more")
    (folder / "notes.txt").write_text("no capture")
    return folder


def words(folder: Path) -> list[object]:
    return ["reconstruct", folder, "--out", folder.parent / "out", "--voxel-mm", 60]


@pytest.fixture
def _imaging_is_quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which captures are imaged is what matters here, not what comes out."""
    from apps.verbs import nlos as verbs

    def pretended(_: Path, results: ResultFiles, *_others: object) -> dict[str, Any]:
        for path in results.paths:
            path.write_text("a result")
        return {}

    monkeypatch.setattr(verbs, "reconstruct_single", pretended)


def test_the_broken_one_is_listed_and_the_others_are_whole(run: Run, folder: Path) -> None:
    outcome = run("nlos", *words(folder), "--suffix", ".h5", "--suffix", ".vti", "--json")
    assert outcome.status == 1
    assert outcome.err.startswith("tofclip: failed: b.h5: ")
    found = json.loads(outcome.out)
    assert [one["capture"] for one in found["imaged"]] == ["a.h5", "c.h5"]
    assert list(found["failed"]) == ["b.h5"]
    expected = {f"{name}{suffix}" for name in "ac" for suffix in (".h5", ".vti", ".png", ".toml")}
    assert {path.name for path in (folder.parent / "out").iterdir()} == expected | {
        ".settings.toml"
    }
    assert Volume.load(folder.parent / "out" / "a.h5").provenance["inputs"][0]["name"] == "a.h5"


@pytest.mark.usefixtures("_imaging_is_quick")
def test_what_is_finished_is_skipped(run: Run, folder: Path) -> None:
    run("nlos", *words(folder))
    out = folder.parent / "out"
    before = (out / "a.h5").stat().st_mtime_ns
    (out / "b.png").unlink()
    (out / "c.toml").unlink()  # as if interrupted before it was finished
    found = object_of(run, *words(folder))
    assert (found["skipped"], [one["capture"] for one in found["imaged"]]) == (
        ["a.h5"],
        ["b.h5", "c.h5"],
    )
    assert (out / "a.h5").stat().st_mtime_ns == before
    later = (out / "a.toml").stat().st_mtime + 10
    os.utime(folder / "a.h5", (later, later))  # the capture was written anew
    assert [one["capture"] for one in object_of(run, *words(folder))["imaged"]] == ["a.h5"]


def test_a_result_belongs_to_the_capture_s_content_not_to_its_age(tmp_path: Path) -> None:
    source, settings = tmp_path / "a.h5", tmp_path / "out.toml"
    source.write_bytes(b"one capture")
    results = ResultFiles([tmp_path / "out.h5"], None, settings)
    results.volumes[0].write_text("a result")
    save_settings(ReconstructSettings(), settings, f"a heading\n{note_content(source)}")
    assert load_settings(ReconstructSettings, settings, {}) == ReconstructSettings()
    later, earlier = (settings.stat().st_mtime + sign * 100 for sign in (1, -1))
    os.utime(source, (later, later))  # copied, or touched
    assert results.is_up_to_date(source)
    source.write_bytes(b"another one")
    os.utime(source, (earlier, earlier))  # put in its place with its own, older time
    assert not results.is_up_to_date(source)
    settings.write_text("# of a version that noted no content\n")
    assert results.is_up_to_date(source)


def test_a_folder_of_renderings_is_known_by_all_that_is_in_it(tmp_path: Path) -> None:
    for name in ("geometry.toml", "views/one.exr"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    before = note_content(tmp_path)
    assert note_content(tmp_path) == before
    (tmp_path / "views" / "one.exr").write_text("another")
    assert note_content(tmp_path) != before


@pytest.mark.usefixtures("_imaging_is_quick")
def test_results_of_other_settings_are_not_mixed_in(run: Run, folder: Path) -> None:
    object_of(run, *words(folder))
    refused = run("nlos", *words(folder), "--cycles", 4)
    assert refused.status == 2
    assert "made with cycles = 3.0, now it is 4.0" in refused.err


def test_an_interruption_leaves_whole_results(
    run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from apps.verbs import nlos as verbs

    original: Callable[..., dict[str, Any]] = verbs.reconstruct_single

    def interrupted(source: Path, *others: Any) -> dict[str, Any]:
        if source.name == "c.h5":
            raise KeyboardInterrupt
        return original(source, *others)

    monkeypatch.setattr(verbs, "reconstruct_single", interrupted)
    outcome = run("nlos", *words(folder))
    assert (outcome.status, outcome.out) == (130, "")
    assert {path.name for path in (folder.parent / "out").iterdir()} == {
        ".settings.toml",
        "a.h5",
        "a.png",
        "a.toml",
    }
