"""Pictures, films and the window, and `tofclip view` as users type it."""

import json
import os
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.image import imread
from viewer_scenes import PlaneSource, frames, plane, streak, volume

import tofclip
from apps.cli import main
from apps.viewer import still
from apps.viewer.page import Page
from apps.viewer.session import Session
from apps.viewer.source import View, make_cloud
from apps.viewer.sources import SURFACE_MODE, TransientSource, VolumeSource
from apps.viewer.still import (
    BACKGROUND,
    PICTURE_SHAPE_PX,
    DesktopWindow,
    PyvistaRenderer,
    RasterRenderer,
    SceneFigure,
    has_working_graphics,
    open_window,
    save_film,
)
from apps.viewer.viewpoint import Viewpoint, measure_point_spacing, place_viewpoint
from tofclip.errors import InputError, MissingDependencyError
from tofclip.recovery import Shot

ROOT = Path(tofclip.__file__).parents[1]


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    path = tmp_path_factory.mktemp("view") / "cloud.ply"
    plane(500).save(path)
    return path


@pytest.fixture
def without_graphics(monkeypatch):
    monkeypatch.setattr(still, "has_working_graphics", lambda: False)


class CloudsSource(PlaneSource):
    """One frame, of these points."""

    def __init__(self, xyz):
        super().__init__(1)
        self._xyz = np.asarray(xyz, np.float32)

    def view(self, number):
        return View(make_cloud(self._xyz, {"intensity": np.ones(len(self._xyz))}))


def test_near_points_hide_far_ones_however_many_there_are():
    def draw(xyz, colours, *how):
        shown = SimpleNamespace(cloud=SimpleNamespace(xyz=xyz), colours=colours)
        return RasterRenderer().draw(shown, *how)

    ahead = Viewpoint(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.deg2rad(90.0))
    xyz = np.array([[0.0, 0, 1], [0, 0, 2], [0.5, 0.5, 2]], np.float32)
    colours = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
    for order in ([0, 1, 2], [2, 1, 0]):
        picture = draw(xyz[order], colours[order], ahead, (101, 101), 3)
        assert picture[50, 50].tolist() == [255, 0, 0]
        assert picture[62:65, 62:65].reshape(-1, 3).tolist() == [[0, 0, 255]] * 9
        assert (picture == BACKGROUND).all(axis=-1).sum() == 101 * 101 - 18
    assert (draw(xyz[:0], colours[:0], ahead, (11, 11), 3) == BACKGROUND).all()
    xyz = plane(1_000_000).xyz
    grey = np.full((len(xyz), 3), 200, np.uint8)
    picture = draw(xyz, grey, place_viewpoint(xyz), PICTURE_SHAPE_PX, 2)
    assert (picture == 200).all(axis=-1).mean() > 0.3


def test_points_of_a_picture_touch_however_few_they_are():
    """A surface of 41 x 41 points is drawn without seams."""
    x, y = (side.ravel() for side in np.meshgrid(*[np.linspace(-0.5, 0.5, 41)] * 2))
    xyz = np.column_stack([x, y, np.full(x.size, 2.0)]).astype(np.float32)
    assert measure_point_spacing(xyz) == pytest.approx(0.025, rel=1e-3)
    shown = Session(CloudsSource(xyz)).frame_at(0.0)
    drawn = SceneFigure("plane", shown, RasterRenderer()).draw(shown).axes[0].images[0].get_array()
    rows, columns, _ = place_viewpoint(xyz, 1.5).project(xyz, (640, 960))
    inside = np.s_[
        int(rows.min()) + 12 : int(rows.max()) - 12,
        int(columns.min()) + 12 : int(columns.max()) - 12,
    ]
    # the dark ground adds up to 87, the darkest point to 153
    assert (np.asarray(drawn)[inside].sum(axis=-1) > 120).mean() > 0.97


def test_both_renderers_put_points_in_the_same_places():
    if not has_working_graphics():
        pytest.skip("no working graphics library here")
    random = np.random.default_rng(2)
    xyz = np.column_stack([random.uniform(-0.3, 0.3, (300, 2)), random.uniform(1.5, 3, 300)])
    shown, viewpoint = Session(CloudsSource(xyz)).frame_at(0.0), place_viewpoint(xyz)
    pictures = [
        one.draw(shown, viewpoint, (200, 300), 5) for one in (PyvistaRenderer(), RasterRenderer())
    ]
    first, second = ((picture != BACKGROUND).any(axis=-1) for picture in pictures)
    # The two round a square's corner differently, by at most a pixel on each side.
    assert (first & second).sum() / (first | second).sum() > 0.6
    source = VolumeSource("ball", volume())
    source.mode.value = SURFACE_MODE
    shown = Session(source).frame_at(0.0)
    viewpoint = place_viewpoint(shown.cloud.xyz)
    drawn = PyvistaRenderer().draw(shown, viewpoint, PICTURE_SHAPE_PX, 3)
    assert (drawn != BACKGROUND).any(axis=-1).mean() > 0.1


@pytest.mark.parametrize(
    ("probe", "works"),
    [("", True), ("import os; os.abort()", False), ("raise SystemExit(1)", False)],
)
def test_a_graphics_library_that_ends_its_process_is_found_out(probe, works):
    assert has_working_graphics(probe) is works


@pytest.mark.usefixtures("without_graphics")
def test_a_picture_and_its_figures(cloud, tmp_path, capsys):
    assert main(["view", str(cloud), "--png", str(tmp_path / "cloud.png"), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert (figures["points"], figures["backend"]) == (500, "matplotlib")
    assert figures["seconds"] > 0
    assert np.std(imread(tmp_path / "cloud.png")[..., :3]) > 0.05
    assert list(tmp_path.iterdir()) == [tmp_path / "cloud.png"]
    for points in (0, 40):
        shown = Session(PlaneSource(points=points)).frame_at(0.0)
        figure = SceneFigure("planes", shown, still.choose_renderer())
        assert figure.pixels(shown).std() > 0
        title = figure.draw(shown).axes[0].get_title(loc="left")
        assert title.endswith("drawn by matplotlib: no working graphics library here")


def test_a_film_has_all_frames(tmp_path, monkeypatch):
    cv2 = pytest.importorskip("cv2", reason="films need OpenCV: pip install 'tofclip[film]'")
    advanced = []
    session = Session(PlaneSource(count=4, points=200))
    out = tmp_path / "planes.mp4"
    assert save_film(session, RasterRenderer(), out, advanced.append) == 200
    film = cv2.VideoCapture(str(out))
    pictures = []
    while (read := film.read())[0]:
        pictures.append(read[1])
    assert len(pictures) == len(advanced) == 4
    assert all(picture.std() > 5 for picture in pictures)
    assert list(tmp_path.iterdir()) == [out]
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingDependencyError, match=r"tofclip\[film\]"):
        save_film(session, RasterRenderer(), out, advanced.append)


def test_the_window_follows_its_keys():
    if not has_working_graphics():
        pytest.skip("no working graphics library here")
    import pyvista

    session = Session(TransientSource("frames", frames()))
    window = DesktopWindow(session, pyvista.Plotter(off_screen=True, window_size=(320, 240)))
    assert window.plotter.screenshot(return_img=True).std() > 1
    window.keys["Home"]()
    assert window.update().frame == 0
    window.keys["Right"]()
    window.keys["space"]()
    assert session.clock.playing
    window.keys["End"]()
    window.keys["Left"]()
    assert window.update().frame == 94
    window.plotter.close()


@pytest.mark.usefixtures("without_graphics")
def test_a_window_without_a_display_says_what_is_missing(cloud, capsys, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    assert main(["view", str(cloud), "--desktop"]) == 2
    assert "DISPLAY" in capsys.readouterr().err
    monkeypatch.setenv("DISPLAY", ":99")
    with pytest.raises(MissingDependencyError, match="OpenGL"):
        open_window(Session(PlaneSource()))


def test_the_page_of_a_raw_shot_opens_before_it_is_recovered(tmp_path, capsys, monkeypatch):
    """What is wrong with the inputs is said without a page; after that, the address comes first."""
    shot = tmp_path / "shot.h5"
    streak().save(shot)
    order = []
    fit = Shot.fit_camera

    def note(name, act=lambda *_, **__: None):
        return lambda *words, **more: order.append(name) or act(*words, **more)

    def refuse(*_, **__):
        raise InputError("no light")

    monkeypatch.setattr(Shot, "fit_camera", note("recovered", fit))
    monkeypatch.setattr("webbrowser.open", note("page"))
    monkeypatch.setattr(Page, "run", lambda page: order.append(page.address))
    assert main(["view", str(shot), "--camera", str(tmp_path / "none.h5")]) == 2
    assert order == []
    capsys.readouterr()
    assert main(["view", str(shot), "--json"]) == 0
    address = json.loads(capsys.readouterr().out)["address"]
    assert (order[:2], order[-1]) == (["page", "recovered"], address)
    monkeypatch.setattr(Shot, "fit_camera", refuse)
    assert main(["view", str(shot), "--json"]) == 2
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(json.loads(capsys.readouterr().out)["address"])


def test_a_page_that_other_computers_reach_is_said_to_be_one(cloud, capsys, monkeypatch):
    monkeypatch.setattr(Page, "run", lambda page: None)
    for host, lines in (("127.0.0.1", 0), ("0.0.0.0", 1)):
        assert main(["view", str(cloud), "--no-browser", "--json", "--host", host]) == 0
        said = capsys.readouterr()
        assert "?token=" in json.loads(said.out)["address"]
        assert said.err.count("other computers can reach this page") == lines
        assert said.err.count("\n") == lines


def test_the_page_is_served_without_graphics_display_or_open3d(cloud, tmp_path):
    """Libraries that cannot be imported stand for a machine that does not have them."""
    for name in ("open3d", "pyvista", "vtk"):
        (tmp_path / f"{name}.py").write_text("raise ImportError('not on this machine')\n")
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}:{ROOT}", "DISPLAY": ""}
    words = [sys.executable, "-m", "tofclip", "view", str(cloud), "--no-browser", "--json"]
    there = {"cwd": ROOT, "env": environment, "text": True, "stdout": subprocess.PIPE}
    with subprocess.Popen(words, **there) as page:
        try:
            address = json.loads(page.stdout.readline())["address"]
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(address.partition("?")[0])
            assert page.poll() is None
        finally:
            page.terminate()
