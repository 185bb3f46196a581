"""`tofclip view` as users type it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest
from viewer_scenes import frames, plane, streak

import tofclip
from apps.cli import main
from apps.viewer import still
from apps.viewer.page import Page
from apps.viewer.session import Session
from apps.viewer.sources import TransientSource
from apps.viewer.still import DesktopWindow, open_window
from tofclip.errors import InputError, MissingDependencyError
from tofclip.recovery import Shot

ROOT = Path(tofclip.__file__).parents[1]
PROGRAM = [sys.executable, "-m", "tofclip", "view"]


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("view") / "cloud.ply"
    plane(500).save(path)
    return path


def test_a_picture_and_its_figures(
    cloud: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(still, "has_working_graphics", lambda: False)
    assert main(["view", str(cloud), "--png", str(tmp_path / "cloud.png"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["points"], found["backend"]) == (500, "matplotlib")
    assert found["seconds"] > 0
    assert (tmp_path / "cloud.png").stat().st_size > 5000


@pytest.mark.parametrize(
    "words",
    [
        ["--png", "picture.jpg"],
        ["--png", "a.png", "--mp4", "a.mp4"],
        ["--host", "example.org"],
        ["--png", "missing/a.png"],
    ],
)
def test_what_cannot_be_is_said_in_a_line(
    words: list[str],
    cloud: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["view", str(cloud), *words]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_window_without_a_display_says_what_is_missing(
    cloud: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    assert main(["view", str(cloud), "--desktop"]) == 2
    assert "DISPLAY" in capsys.readouterr().err
    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setattr("apps.viewer.still.has_working_graphics", lambda: False)
    with pytest.raises(MissingDependencyError, match="OpenGL"):
        open_window(Session(TransientSource("frames", frames())))


def test_the_page_of_a_raw_shot_opens_before_it_is_recovered(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is wrong with the inputs is said without a page; after that, the address comes first."""
    shot = tmp_path / "shot.h5"
    streak().save(shot)
    order: list[str] = []
    fit = Shot.fit_camera
    monkeypatch.setattr(
        Shot, "fit_camera", lambda *words, **more: order.append("recovered") or fit(*words, **more)
    )
    monkeypatch.setattr("webbrowser.open", lambda _: order.append("page"))
    monkeypatch.setattr(Page, "run", lambda page: order.append(page.address))
    assert main(["view", str(shot), "--camera", str(tmp_path / "none.h5")]) == 2
    assert order == []
    capsys.readouterr()
    assert main(["view", str(shot), "--json"]) == 0
    address = json.loads(capsys.readouterr().out)["address"]
    assert order == ["page", "recovered", address]
    monkeypatch.setattr(Shot, "fit_camera", lambda *_, **__: raise_input_error())
    assert main(["view", str(shot), "--json"]) == 2
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(json.loads(capsys.readouterr().out)["address"])


def test_a_page_that_other_computers_reach_is_said_to_be_one(
    cloud: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Page, "run", lambda page: None)
    for host, lines in (("127.0.0.1", 0), ("0.0.0.0", 1)):
        assert main(["view", str(cloud), "--no-browser", "--json", "--host", host]) == 0
        said = capsys.readouterr()
        assert "?token=" in json.loads(said.out)["address"]
        assert said.err.count("other computers can reach this page") == lines
        assert said.err.count("\n") == lines


def raise_input_error() -> None:
    raise InputError("no light")


def test_the_window_follows_its_keys() -> None:
    if not still.has_working_graphics():
        pytest.skip("no working graphics library here")
    import pyvista

    session = Session(TransientSource("frames", frames()))
    window = DesktopWindow(session, pyvista.Plotter(off_screen=True, window_size=(320, 240)))
    assert window.plotter.screenshot(return_img=True).std() > 1
    keys = window.keys
    keys["Home"]()
    window.update()
    assert session.latest is not None
    assert session.latest.frame == 0
    keys["Right"]()
    keys["space"]()
    assert session.clock.playing
    keys["End"]()
    keys["Left"]()
    window.update()
    assert session.latest.frame == 94
    window.plotter.close()


def test_the_page_is_served_without_graphics_display_or_open3d(cloud: Path, tmp_path: Path) -> None:
    """Libraries that cannot be imported stand for a machine that does not have them."""
    for name in ("open3d", "pyvista", "vtk"):
        (tmp_path / f"{name}.py").write_text("raise ImportError('not on this machine')\n")
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}:{ROOT}", "DISPLAY": ""}
    picture = [*PROGRAM, str(cloud), "--png", str(tmp_path / "cloud.png"), "--json"]
    done = subprocess.run(
        picture, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, json.loads(done.stdout)["backend"]) == (0, "matplotlib")
    page = subprocess.Popen(
        [*PROGRAM, str(cloud), "--no-browser", "--json"],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert page.stdout is not None
        address = json.loads(page.stdout.readline())["address"]
        assert address.startswith("http://127.0.0.1:")
        time.sleep(0.2)
        assert page.poll() is None
    finally:
        page.terminate()
        page.wait(20)
