"""Pictures and films without a screen, and where on them points appear."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.image import imread
from viewer_scenes import PlaneSource, plane, volume

from apps.viewer import still as stills
from apps.viewer.session import Session
from apps.viewer.source import make_cloud
from apps.viewer.sources import SURFACE_MODE, VolumeSource
from apps.viewer.still import (
    BACKGROUND,
    PICTURE_SHAPE_PX,
    PyvistaRenderer,
    RasterRenderer,
    SceneFigure,
    has_working_graphics,
    rasterise_points,
    save_film,
    save_picture,
)
from apps.viewer.viewpoint import MAX_FIELD_OF_VIEW_RAD, Viewpoint, place_viewpoint
from tofclip.errors import InputError, MissingDependencyError

AHEAD = Viewpoint(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.deg2rad(90.0))
"""At the origin, along z: half the picture's height is the depth."""


def test_right_is_right_and_down_is_down() -> None:
    row, column, depth = AHEAD.project(
        np.array([[0.0, 0, 2], [1, 0, 2], [0, 1, 2], [0, 0, -1]]), (101, 201)
    )
    assert row[:3] == pytest.approx([50, 50, 75.25])
    assert column[:3] == pytest.approx([100, 125.25, 100])
    assert depth[:3] == pytest.approx([2, 2, 2])
    assert np.isnan([row[3], column[3], depth[3]]).all()
    with pytest.raises(InputError, match="itself"):
        _ = Viewpoint(np.ones(3), np.ones(3)).axes


@given(
    st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-0.5, 8)),
    st.floats(0.05, 3),
    st.floats(1.0, 2.0),
)
def test_a_cloud_is_seen_whole(
    middle: tuple[float, float, float], size: float, aspect: float
) -> None:
    xyz = (size * np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3)) + middle).astype(np.float32)
    viewpoint = place_viewpoint(xyz, aspect)
    shape = (200, round(200 * aspect))
    row, column, _ = viewpoint.project(xyz, shape)
    with np.errstate(invalid="ignore"):
        seen = (row > 0) & (row < shape[0]) & (column > 0) & (column < shape[1])
    assert seen.mean() > 0.97  # a hundredth at either end is let go
    assert viewpoint.field_of_view <= MAX_FIELD_OF_VIEW_RAD


def test_near_points_hide_far_ones() -> None:
    xyz = np.array([[0.0, 0, 1], [0, 0, 2], [0.5, 0.5, 2]], np.float32)
    colours = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
    for order in ([0, 1, 2], [2, 1, 0]):
        picture = rasterise_points(xyz[order], colours[order], AHEAD, (101, 101), 3)
        assert picture[50, 50].tolist() == [255, 0, 0]
        assert picture[62:65, 62:65].reshape(-1, 3).tolist() == [[0, 0, 255]] * 9
        assert (picture == BACKGROUND).all(axis=-1).sum() == 101 * 101 - 18
    assert (
        rasterise_points(make_cloud(np.empty((0, 3))).xyz, colours[:0], AHEAD, (11, 11), 3)
        == BACKGROUND
    ).all()


def test_both_renderers_put_points_in_the_same_places() -> None:
    if not has_working_graphics():
        pytest.skip("no working graphics library here")
    random = np.random.default_rng(2)
    xyz = np.column_stack([random.uniform(-0.3, 0.3, (300, 2)), random.uniform(1.5, 3, 300)])
    source = PlaneSource()
    source.view = lambda _: type(PlaneSource().view(0))(make_cloud(xyz.astype(np.float32)))  # type: ignore[method-assign]
    shown, viewpoint = Session(source).frame_at(0.0), place_viewpoint(xyz.astype(np.float32))
    pictures = [
        one.draw(shown, viewpoint, (200, 300), 5) for one in (PyvistaRenderer(), RasterRenderer())
    ]
    first, second = ((picture != BACKGROUND).any(axis=-1) for picture in pictures)
    # The two round a square's corner differently, by at most a pixel on each side.
    assert (first & second).sum() / (first | second).sum() > 0.6


@pytest.mark.parametrize(
    ("probe", "works"),
    [("", True), ("import os; os.abort()", False), ("raise SystemExit(1)", False)],
)
def test_a_graphics_library_that_ends_its_process_is_found_out(probe: str, works: bool) -> None:
    assert has_working_graphics(probe) is works


def test_without_graphics_the_picture_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stills, "has_working_graphics", lambda: False)
    renderer = stills.choose_renderer()
    assert renderer.name == "matplotlib"
    shown = Session(PlaneSource()).frame_at(0.0)
    still = SceneFigure("planes", shown, renderer)
    assert "drawn by matplotlib" in still.draw(shown).axes[0].get_title(loc="left")
    save_picture("planes", shown, renderer, tmp_path / "planes.png")
    assert np.std(imread(tmp_path / "planes.png")[..., :3]) > 0.05
    assert list(tmp_path.iterdir()) == [tmp_path / "planes.png"]


def test_a_picture_of_nothing_and_of_a_surface() -> None:
    empty = PlaneSource(points=0)
    assert (
        SceneFigure("empty", Session(empty).frame_at(0.0), RasterRenderer())
        .pixels(Session(empty).frame_at(0.0))
        .std()
        > 0
    )
    if has_working_graphics():
        source = VolumeSource("ball", volume())
        source.mode.value = SURFACE_MODE
        shown = Session(source).frame_at(0.0)
        drawn = PyvistaRenderer().draw(shown, place_viewpoint(shown.cloud.xyz), PICTURE_SHAPE_PX, 3)
        assert (drawn != BACKGROUND).any(axis=-1).mean() > 0.1


def test_a_film_has_all_frames(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2", reason="films need OpenCV: pip install 'tofclip[film]'")
    advanced: list[int] = []
    session = Session(PlaneSource(count=4, points=200))
    assert save_film(session, RasterRenderer(), tmp_path / "planes.mp4", advanced.append) == 200
    film = cv2.VideoCapture(str(tmp_path / "planes.mp4"))
    pictures = []
    while (read := film.read())[0]:
        pictures.append(read[1])
    assert len(pictures) == len(advanced) == 4
    assert all(picture.std() > 5 for picture in pictures)
    assert list(tmp_path.iterdir()) == [tmp_path / "planes.mp4"]


def test_films_need_opencv(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "cv2", None)
    with pytest.raises(MissingDependencyError, match=r"tofclip\[film\]"):
        save_film(Session(PlaneSource()), RasterRenderer(), tmp_path / "planes.mp4", lambda _: None)


def test_a_million_points_are_drawn_at_once() -> None:
    cloud = plane(1_000_000)
    picture = rasterise_points(
        cloud.xyz,
        np.full((len(cloud), 3), 200, np.uint8),
        place_viewpoint(cloud.xyz),
        PICTURE_SHAPE_PX,
        2,
    )
    assert (picture == 200).all(axis=-1).mean() > 0.3
