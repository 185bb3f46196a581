"""Every kind of source, opened by its name and held against what was written."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from viewer_scenes import (
    BIN_WIDTH,
    FAR,
    FAR_FRAME,
    FRAMES,
    NEAR,
    NEAR_FRAME,
    PlaneSource,
    camera,
    frames,
    plane,
    range_of,
    streak,
    volume,
)

from apps.viewer.look import project_front, render_pictures
from apps.viewer.panels import render_status_html
from apps.viewer.session import (
    DIM_NOTE,
    Filters,
    Session,
)
from apps.viewer.source import Source, View, make_cloud
from apps.viewer.source_factory import FIRST_LOOK_NOTE, ShotOptions, open_source
from apps.viewer.sources import (
    GATE_ALL_TIMES,
    GATE_AROUND_FRAME,
    GATE_UP_TO_FRAME,
    LINEAR_NOTE,
    NO_TIME_ZERO_NOTE,
    PROJECTION_MODE,
    SLICE_MODE,
    SURFACE_MODE,
    LiveShotSource,
    VolumeSource,
    leave_out_rays,
    render_depth,
)
from apps.viewer.still import RasterRenderer, SceneFigure
from apps.viewer.viewpoint import Box, measure_point_spacing, place_viewpoint
from tofclip.camera import registration
from tofclip.errors import FileFormatError, InputError, StorageError
from tofclip.io.streaks import save_stack
from tofclip.sequences.ranger import RangingPipeline, SummedShot
from tofclip.shots import Streak


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a user may want to look at."""
    place = tmp_path_factory.mktemp("looked_at")
    frames().save(place / "frames.h5")
    volume().save(place / "volume.h5")
    camera().save(place / "camera.h5")
    shots = [streak(seed) for seed in range(3)]
    shots[0].save(place / "shot.h5")
    save_stack(shots, place / "stack.h5")
    (place / "clouds").mkdir()
    for number in range(4):
        plane(50, 1 + number).save(place / "clouds" / f"cloud_{number:06d}.ply")
    return place


@pytest.fixture
def transient(folder: Path) -> Source:
    return open_source(str(folder / "frames.h5"))


def test_frames_become_a_cloud_at_the_ranges_of_the_squares(transient: Source) -> None:
    view = transient.view(0)
    assert view.pixels is not None
    inside = np.zeros((32, 32), bool)
    inside[NEAR] = inside[FAR] = True
    assert np.all(inside[tuple(view.pixels.T)])
    near = view.pixels[:, 0] < 16
    # The pulse has no noise: a hundredth of a bin of 3 mm.
    assert np.allclose(view.cloud.range[near], range_of(NEAR_FRAME), atol=3e-5)
    assert np.allclose(view.cloud.range[~near], range_of(FAR_FRAME), atol=3e-5)


def test_time_walks_through_a_transient(transient: Source) -> None:
    session = Session(transient)
    assert transient.gate.value == GATE_UP_TO_FRAME
    whole = len(session.frame_at(0.0).cloud)
    assert whole == 36 + 49  # the pixels of both squares: at its end a transient is complete
    session.clock.jump(NEAR_FRAME + 3)
    assert len(session.frame_at(0.0).cloud) == 36
    session.clock.jump(NEAR_FRAME - 9)
    assert len(session.frame_at(0.0).cloud) == 0
    transient.gate.value = GATE_ALL_TIMES
    assert len(session.frame_at(0.0).cloud) == whole
    transient.gate.value = GATE_AROUND_FRAME
    session.clock.jump(FAR_FRAME)
    shown = session.frame_at(0.0)
    assert len(shown.cloud) == 49
    assert shown.pixels is not None
    assert len(shown.pixels) == 49
    pictures = session.pictures(shown)
    assert np.unravel_index(pictures["intensity"].argmax(), (32, 32))[0] >= 18
    assert pictures["streak"].shape == (FRAMES, 300)
    assert np.nanmax(pictures["depth"]) == pytest.approx(range_of(FAR_FRAME), abs=1e-3)


def test_a_gate_around_a_frame_reaches_as_far_before_it_as_behind(transient: Source) -> None:
    session = Session(transient)
    transient.gate.value, transient.half_gate.value = GATE_AROUND_FRAME, 5
    for away, points in ((-6, 0), (-5, 36), (0, 36), (5, 36), (6, 0)):
        session.clock.jump(NEAR_FRAME + away)
        assert len(session.frame_at(0.0).cloud) == points
    assert transient.find_gate(2) == range(8)


def test_playing_begins_anew_and_ends_at_the_last_frame(transient: Source) -> None:
    session = Session(transient)
    session.clock.play()
    assert session.frame_at(10.0).frame == 0
    assert 0 < session.frame_at(11.0).frame < FRAMES - 1
    assert session.frame_at(1000.0).frame == FRAMES - 1
    assert not session.clock.playing
    assert session.label == "REPLAY"


def test_a_pick_brings_the_pixels_whole_waveform(transient: Source) -> None:
    session = Session(transient)
    shown = session.frame_at(0.0)
    number = int(np.argmax(shown.cloud.range))
    pick = session.pick((0, 0, 0), shown.cloud.xyz[number])
    assert pick is not None
    assert pick.waveform is not None
    times, counts = pick.waveform
    assert times[counts.argmax()] == pytest.approx(pick.time, abs=BIN_WIDTH)
    assert counts.size == FRAMES
    assert session.distance is None
    other = session.pick_point(int(np.argmin(shown.cloud.range)))
    assert session.distance == pytest.approx(
        np.linalg.norm(np.subtract(pick.position, other.position))
    )
    assert session.pick((0, 0, 0), (0, -1, 0.1)) is None  # a miss forgets them
    assert session.picks == []
    with pytest.raises(InputError, match="no point"):
        session.pick_point(10_000)


def test_refocusing_moves_the_squares_along_the_slit_and_back(transient: Source) -> None:
    """A refocus by one shear of light seen at shear 0 displaces the picture by the camera's own
    figure.
    """
    session = Session(transient)
    transient.gate.value = GATE_AROUND_FRAME
    session.clock.jump(NEAR_FRAME)
    sharp = session.frame_at(0.0)
    transient.refocus.value = 1e-9  # the shear at which it was recovered, once more
    again = session.frame_at(0.0)
    transient.refocus.value = 1.0
    moved = session.frame_at(0.0)
    assert sharp.pixels is not None
    assert again.pixels is not None
    assert moved.pixels is not None
    bright = again.pixels[again.cloud.intensity > 0.5 * again.cloud.intensity.max()]
    assert np.allclose(bright.mean(axis=0), sharp.pixels.mean(axis=0), atol=0.7)
    shift = np.average(moved.pixels, axis=0, weights=moved.cloud.intensity) - np.average(
        again.pixels, axis=0, weights=again.cloud.intensity
    )
    # Only a part of a shear displaces, 3 rows; the rest defocuses, which pulls the mean by some of
    # a pixel.
    assert np.allclose(shift, -np.array(camera().displacement_per_shear), atol=0.7)
    session.clock.jump(45)  # between the squares there is no light, and none is invented
    assert len(session.frame_at(0.0).cloud) == 0


def test_clouds_follow_one_another(folder: Path) -> None:
    source = open_source(str(folder / "clouds"))
    session = Session(source)
    assert len(source) == 4
    assert [float(np.median(source.view(n).cloud.xyz[:, 2])) for n in range(4)] == [1, 2, 3, 4]
    assert set(session.pictures(session.frame_at(0.0))) == {"intensity", "depth"}
    session.clock.step(1)
    assert session.frame_at(0.0).frame == 1
    assert source.settings == ()


def test_a_ray_before_a_brighter_return_of_its_pixel_does_not_hide_it() -> None:
    """Two pixels: a weak return before a strong one, and two that are nearly as bright."""
    light = np.array([10.0, 100.0, 60.0, 80.0], np.float32)
    xyz = np.array([[0, 0, 1], [0, 0, 2], [1, 0, 1], [1, 0, 2]], np.float32)
    pixels = np.array([[3, 4], [3, 4], [3, 5], [3, 5]])
    kept = leave_out_rays(View(make_cloud(xyz, {"intensity": light}), pixels))
    assert kept.cloud.intensity.tolist() == [100.0, 60.0, 80.0]
    assert kept.pixels is not None
    assert kept.pixels.tolist() == pixels[1:].tolist()


def test_dim_rays_of_a_cloud_of_ours_are_left_out_at_first(tmp_path: Path) -> None:
    """A hundred points that are a hundredth as bright as the others stand before them."""
    bright, dim = plane(100, 2.0), plane(100, 1.0, seed=1)
    light = np.concatenate([bright.intensity, 0.01 * dim.intensity])
    xyz = np.concatenate([bright.xyz, dim.xyz])
    ours = {"intensity": light, "range_sigma": np.full(200, 2e-3, np.float32)}
    make_cloud(xyz, ours).save(tmp_path / "ours.ply")
    make_cloud(xyz, {"intensity": light}).save(tmp_path / "others.ply")
    session = Session(open_source(str(tmp_path / "ours.ply")))
    shown = session.frame_at(0.0)
    assert len(shown.cloud) == 100
    assert shown.cloud.range.min() > 1.9
    assert session.notes == (DIM_NOTE,)
    # lit as if the dim ones were not there: 15 % of the others in full light, as of any cloud
    assert np.ptp(shown.colours.sum(axis=1, dtype=int)) > 100
    session.filters = Filters()
    assert len(session.frame_at(0.0).cloud) == 200
    assert session.notes == ()
    # what brightness means to another program is not known
    assert len(Session(open_source(str(tmp_path / "others.ply"))).frame_at(0.0).cloud) == 200


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".csv", ".npz", ".h5"])
def test_a_single_cloud_of_every_format(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cloud{suffix}"
    plane(30).save(path)
    assert np.allclose(open_source(str(path)).view(0).cloud.xyz, plane(30).xyz)


def test_a_cloud_of_another_program_needs_positions_only(tmp_path: Path) -> None:
    (tmp_path / "other.csv").write_text("x,y,z\n0.3,0.4,1.2\n")
    cloud = open_source(str(tmp_path / "other.csv")).view(0).cloud
    assert cloud.range == pytest.approx([1.3])
    (tmp_path / "flat.csv").write_text("x,y\n1,2\n")
    with pytest.raises(FileFormatError, match="no column 'z'"):
        open_source(str(tmp_path / "flat.csv")).view(0)


def test_a_single_shot_is_recovered_as_a_transient(folder: Path) -> None:
    source = open_source(str(folder / "shot.h5"))
    assert source.times is not None
    ranges = source.view(0).cloud.range
    for frame in (NEAR_FRAME, FAR_FRAME):
        close = np.abs(ranges - range_of(frame)) < 3e-3  # a bin
        assert close.sum() > 25


def test_a_first_look_refines_the_camera_twice(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a camera whose sweep the shot has to tell, the whole search takes longer than the frames."""
    camera().replace(sweep=None).save(folder / "coarse.h5")
    refined = []
    refine = registration._refine_camera
    monkeypatch.setattr(
        registration, "_refine_camera", lambda *known: refined.append(1) or refine(*known)
    )
    source = open_source(str(folder / "shot.h5"), ShotOptions(camera=folder / "coarse.h5"))
    assert len(refined) == 2
    ranges = source.view(0).cloud.range
    for frame in (NEAR_FRAME, FAR_FRAME):
        assert np.sum(np.abs(ranges - range_of(frame)) < 3e-3) > 25  # a bin


def test_a_quick_look_is_called_one_and_another_method_can_be_asked_for(folder: Path) -> None:
    """A single shot is recovered by iterations; what is linear says so, as does a missing time zero."""
    shot, stack = str(folder / "shot.h5"), str(folder / "stack.h5")
    with_camera = ShotOptions(camera=folder / "camera.h5")
    assert open_source(shot).notes == (FIRST_LOOK_NOTE,)
    expected = "quick look (l1, 25 iterations); for measurements run tofclip recover"
    assert expected == FIRST_LOOK_NOTE
    assert open_source(shot, ShotOptions(method="linear")).notes == (LINEAR_NOTE,)
    assert open_source(stack, with_camera).notes == (LINEAR_NOTE,)
    sharp = open_source(stack, replace(with_camera, method="l1"))
    quick = open_source(stack, with_camera)
    assert sharp.notes == ()
    # nearly all light is inside the squares, where the linear inverse draws rays around them
    inside = np.zeros((32, 32), bool)
    inside[NEAR] = inside[FAR] = True
    fractions = []
    for source in (sharp, quick):
        values = source.recover_frames(0).values
        light = np.maximum(values, 0).sum(axis=0)
        fractions.append(light[inside].sum() / light.sum())
    assert fractions[0] > 2 * fractions[1]  # 0.78 and 0.2: far from noise of a per cent
    assert sharp.view(0).cloud.range.min() == pytest.approx(range_of(NEAR_FRAME), abs=3e-3)
    no_zero = open_source(shot, ShotOptions(time_zero=0.0))
    assert no_zero.notes == (FIRST_LOOK_NOTE, NO_TIME_ZERO_NOTE)
    session = Session(open_source(str(folder / "frames.h5")))
    assert session.notes == ()
    session.source.refocus.value = 0.5
    session.frame_at(0.0)
    assert session.notes == (LINEAR_NOTE,)
    with pytest.raises(InputError, match="choose one of tv, l1, linear, adjoint"):
        open_source(stack, replace(with_camera, method="surfaces"))


def test_a_single_shot_can_be_looked_at_by_its_surfaces(folder: Path) -> None:
    source = open_source(str(folder / "shot.h5"), ShotOptions(method="surfaces"))
    view = source.view(0)
    assert view.pixels is not None
    near = view.pixels[:, 0] < 16
    for side, frame in ((near, NEAR_FRAME), (~near, FAR_FRAME)):
        assert side.sum() > 25
        assert np.median(view.cloud.range[side]) == pytest.approx(range_of(frame), abs=3e-3)
    # what is shown are the surfaces' own points, not what a search of frames would find
    np.testing.assert_allclose(
        np.sort(view.cloud.range), np.sort(source.frames.returns.range), rtol=1e-6
    )


def test_a_stack_of_shots_is_recovered_shot_by_shot(folder: Path) -> None:
    source = open_source(
        str(folder / "stack.h5"), ShotOptions(camera=folder / "camera.h5", time_zero=-20e-9)
    )
    assert len(source) == 3
    session = Session(source)
    shown = session.frame_at(0.0)
    nearest = (
        range_of(NEAR_FRAME) + 10e-9 * 0.149896
    )  # the other time zero moves everything by 1.5 m
    later = shown.cloud.range.min()
    assert later == pytest.approx(nearest + 1.498, abs=0.02)
    assert set(session.pictures(shown)) == {"streak", "intensity", "depth"}
    waveform = session.pick_point(0).waveform
    assert waveform is not None
    assert waveform.shape == (2, FRAMES)
    source.refocus.value = 0.5
    assert len(session.frame_at(0.0).cloud) > 0


def test_a_volume_as_voxels_surface_projection_and_slices(folder: Path) -> None:
    source = open_source(str(folder / "volume.h5"))
    session = Session(source)
    voxels = session.frame_at(0.0).cloud
    assert np.allclose(voxels.xyz.mean(axis=0), (0.05, -0.05, 0.5), atol=0.01)
    assert np.all(
        np.linalg.norm(voxels.xyz - [0.05, -0.05, 0.5], axis=1)
        < 0.04 * np.sqrt(2 * np.log(1 / 0.3)) + 1e-3
    )
    source.threshold.value = 0.8
    assert 0 < len(session.frame_at(0.0).cloud) < len(voxels)
    source.mode.value = PROJECTION_MODE
    columns = session.frame_at(0.0).cloud.xyz[:, :2].round(3).tolist()
    assert len({tuple(column) for column in columns}) == len(columns)
    source.mode.value = SLICE_MODE
    session.clock.jump(3)
    assert np.unique(session.frame_at(0.0).cloud.xyz[:, 2]).size == 1
    assert session.pictures(session.frame_at(0.0))["intensity"].shape == volume().grid.shape[1:]
    source.mode.value, source.threshold.value = SURFACE_MODE, np.exp(-0.5)
    shown = session.frame_at(0.0)
    assert shown.surface is not None
    radius = np.linalg.norm(shown.surface.vertices - [0.05, -0.05, 0.5], axis=1)
    assert np.allclose(
        radius, 0.04, atol=0.004
    )  # one standard deviation, by linear interpolation over 2 cm voxels


def test_what_is_shown_is_called_what_it_is(transient: Source) -> None:
    """Every slice's projection is not slice 0, and all frames are not the last one."""
    of_volume = Session(VolumeSource("ball", volume()))
    assert of_volume.frame_at(0.0).caption == "maximum projection of all 21 slices"
    of_volume.source.mode.value = SLICE_MODE
    of_volume.clock.jump(4)
    assert of_volume.frame_at(0.0).caption == "slice 4"
    of_frames = Session(transient)
    last = len(transient) - 1
    assert of_frames.frame_at(0.0).caption == f"all {last + 1} frames"
    of_frames.clock.jump(5)
    assert of_frames.frame_at(0.0).caption == "frames 0 to 5"
    of_volume.source.mode.value = PROJECTION_MODE
    status = render_status_html(of_volume, of_volume.frame_at(0.0), 0.0)
    assert "<span id='what'>maximum projection</span>" in status


def test_live_shots_are_followed_and_can_be_looked_at_again() -> None:
    def shots():  # type: ignore[no-untyped-def]
        yield streak(1)
        deadline = time.monotonic() + 20
        while len(source) < 2 and time.monotonic() < deadline:  # or it may be dropped for the next
            time.sleep(0.01)
        yield streak(2)
        raise ZeroDivisionError("nothing came")  # of no kind that is foreseen

    source = LiveShotSource("test", chain([streak(0)], shots()), camera())
    session = Session(source)
    deadline = time.monotonic() + 20
    while source.inflow.is_live and time.monotonic() < deadline:
        time.sleep(0.01)
    assert (len(source), source.inflow.oldest, source.inflow.failure_text) == (3, 0, "nothing came")
    assert session.frame_at(0.0).frame == 2
    session.clock.step(-1)
    assert (session.frame_at(0.0).frame, session.clock.following) == (1, False)
    session.clock.follow()
    assert session.frame_at(0.0).frame == 2
    assert session.label == "REPLAY"  # nothing comes any more
    source.close()


def test_live_shots_that_come_too_fast_are_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    busy, came, go_on = threading.Event(), threading.Event(), threading.Event()
    handed_over = 0.0

    def shots() -> Iterator[Streak]:
        nonlocal handed_over
        for seed in range(12):
            handed_over = time.monotonic()
            yield streak(seed)
            busy.wait(20)
        came.set()

    def slowly(self: RangingPipeline, shot: Streak) -> SummedShot:
        if threading.current_thread() is not threading.main_thread():
            busy.set()
            go_on.wait(20)
        return rectify(self, shot)

    rectify = RangingPipeline.rectify
    monkeypatch.setattr(RangingPipeline, "rectify", slowly)
    source = LiveShotSource("test", chain([streak(0)], shots()), camera())
    assert came.wait(20)
    taken = time.monotonic()
    time.sleep(0.1)
    released = time.monotonic()
    go_on.set()
    deadline = released + 20
    while source.inflow.is_live and time.monotonic() < deadline:
        time.sleep(0.01)
    ended = time.monotonic()
    # One was being rectified, and one more could wait; on a busy computer that one replaces the
    # other, which is finished and not yet taken.
    assert len(source) in (2, 3)
    assert len(source) + source.inflow.lost == 13
    # Of the last one, which could not be made before `go_on` and was before the end, since it came.
    assert released - taken <= source.inflow.latency <= ended - handed_over
    source.close()


def test_an_instruments_address() -> None:
    source = open_source("sim+remoteex://?seed=1&scene=small&frame_rate=20")
    assert source.inflow.is_live
    assert Session(source).label == "LIVE"
    deadline = time.monotonic() + 20
    while len(source) < 3 and time.monotonic() < deadline:
        time.sleep(0.02)
    assert len(source.view(2).cloud) > 100
    assert source.inflow.data_rate > 0
    source.close()
    assert not source.inflow.is_live


def test_what_cannot_be_looked_at(tmp_path: Path, folder: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.txt").write_text("hello")
    for name, fault in (
        (tmp_path / "absent.h5", StorageError),
        (tmp_path / "empty", InputError),
        (tmp_path / "text.txt", FileFormatError),
        (folder / "camera.h5", FileFormatError),
        ("nothing://x", InputError),
    ):
        with pytest.raises(fault):
            open_source(str(name))


def test_panes_have_a_handy_size_and_dark_holes() -> None:
    scale = Session(PlaneSource()).frame_at(0.0).scale
    made = render_pictures(project_front(plane(4000)), scale)
    assert made["depth"].dtype == np.uint8
    assert (
        all(200 <= max(image.shape) <= 420 for image in made.values())
        or made["depth"].shape[0] == 128
    )
    empty = render_pictures(
        project_front(PlaneSource().view(0).cloud), replace(scale, quantity="height")
    )["depth"]
    assert (empty == (32, 36, 44)).all(axis=-1).mean() > 0.9
    tall = render_pictures({"streak": np.ones((1016, 1344), np.float32)}, scale)["streak"]
    assert max(tall.shape) <= 420


@pytest.mark.parametrize("brightest", [0, 1, 2])
def test_a_pixels_depth_is_that_of_its_brightest_return(brightest: int) -> None:
    """Of a leaf, a branch and a wall in one pixel, whichever sends most light back."""
    xyz = np.array([[0, 0, 2.0], [0, 0, 3.0], [0, 0, 5.0], [0, 0, 4.0]], np.float32)
    light = np.array([10, 20, 15, 1], np.float32)
    light[brightest] = 100
    cloud = make_cloud(xyz, {"intensity": light})
    pixels = np.array([[1, 2], [1, 2], [1, 2], [0, 0]], np.int32)
    depth = render_depth(View(cloud, pixels), (2, 3))
    assert depth[1, 2] == xyz[brightest, 2]
    assert depth[0, 0] == 4.0
    assert np.isnan(depth).sum() == 4


def test_a_camera_with_few_pixels_leaves_no_seams_in_the_panes() -> None:
    """A surface of 90 x 90 points in a picture of 128 x 128 pixels, but for a hole in it."""
    across = np.linspace(-0.5, 0.5, 90)
    x, y = (side.ravel() for side in np.meshgrid(across, across))
    whole = np.hypot(x, y) > 0.15
    xyz = np.column_stack([x, y, np.full(x.size, 2.0)])[whole].astype(np.float32)
    made = project_front(make_cloud(xyz, {"intensity": np.ones(len(xyz), np.float32)}))
    side = (np.arange(128) / 127 - 0.5) * 1.0
    radius = np.hypot(*np.meshgrid(side, side))
    inside = np.s_[2:-2, 2:-2]  # the outermost points lie outside of the percentiles
    assert np.isfinite(made["depth"])[inside][radius[inside] > 0.17].all()
    assert np.isnan(made["depth"])[radius < 0.12].all()
    assert (made["intensity"][np.isfinite(made["depth"])] == 1).all()


@pytest.mark.parametrize("direction", [0, 1, 2])
def test_lengths_of_the_box_are_written_apart_from_the_scale_bar(direction: int) -> None:
    """Seen along any axis, no two words stand within a twentieth of the box."""
    box = Box(np.array([-1.0, -0.5, 1.5]), np.array([1.0, 0.7, 4.0]))
    places = np.vstack([box.length_marks, box.scale_bar.mean(axis=0)])
    seen = np.delete((places - box.low) / (box.high - box.low), direction, axis=1)
    apart = np.linalg.norm(seen[:, np.newaxis] - seen, axis=-1)
    assert apart[np.triu_indices(4, 1)].min() > 0.05


def test_points_of_a_picture_touch_however_few_they_are() -> None:
    """A surface of 41 x 41 points is drawn without seams."""
    across = np.linspace(-0.5, 0.5, 41)
    x, y = (side.ravel() for side in np.meshgrid(across, across))
    xyz = np.column_stack([x, y, np.full(x.size, 2.0)]).astype(np.float32)
    assert measure_point_spacing(xyz) == pytest.approx(0.025, rel=1e-3)
    cloud = make_cloud(xyz, {"intensity": np.ones(len(xyz), np.float32)})

    class OnePlane(PlaneSource):
        def view(self, number: int) -> View:
            return View(cloud)

    shown = Session(OnePlane(1)).frame_at(0.0)
    drawn = SceneFigure("plane", shown, RasterRenderer()).draw(shown).axes[0].images[0]
    rows, columns, _ = place_viewpoint(xyz, 1.5).project(xyz, (640, 960))
    inside = np.asarray(drawn.get_array())[
        int(rows.min()) + 12 : int(rows.max()) - 12,
        int(columns.min()) + 12 : int(columns.max()) - 12,
    ]
    assert (inside.sum(axis=-1) > 200).mean() > 0.97  # the dark ground adds up to 87
