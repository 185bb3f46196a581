"""Every kind of source, opened by its name and held against what was written."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from viewer_scenes import (
    BIN_WIDTH,
    FAR,
    FAR_FRAME,
    FRAMES,
    NEAR,
    NEAR_FRAME,
    camera,
    frames,
    plane,
    range_of,
    streak,
    volume,
)

from apps.viewer.html import render_status_html
from apps.viewer.session import Session
from apps.viewer.shots import LiveShots
from apps.viewer.source import View, make_cloud
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
    VOXEL_MODE,
    StreakSource,
    TransientSource,
    VolumeSource,
    make_look_method,
    render_depth,
)
from tofclip.camera import registration
from tofclip.errors import FileFormatError, InputError
from tofclip.io.streaks import save_stack
from tofclip.lidar import depth, point_cloud
from tofclip.recovery import FixedFocus, open_shot, plan_recovery
from tofclip.sequences import make_pipeline
from tofclip.sequences.ranger import RangingPipeline

INSIDE = np.zeros((32, 32), bool)
INSIDE[NEAR] = INSIDE[FAR] = True


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What a user may want to look at."""
    place = tmp_path_factory.mktemp("looked_at")
    frames().save(place / "frames.h5")
    volume().save(place / "volume.h5")
    camera().save(place / "camera.h5")
    shots = [streak(seed) for seed in range(3)]
    shots[0].save(place / "shot.h5")
    save_stack(shots, place / "stack.h5")
    for name in ("clouds", "shots"):
        (place / name).mkdir()
    camera().save(place / "shots/camera.h5")  # no shot
    for number, shot in enumerate(shots):
        shot.save(place / f"shots/{number}.h5")
    for number in range(4):
        plane(50, 1 + number).save(place / "clouds" / f"cloud_{number:06d}.ply")
    return place


@pytest.fixture
def transient():
    return TransientSource("frames.h5", frames())


def wait_until(met):
    """Wait up to 20 s until something is so; return when that was, s."""
    deadline = time.monotonic() + 20
    while not met() and time.monotonic() < deadline:
        time.sleep(0.01)
    return time.monotonic()


def show_cloud(session, frame):
    """What is shown of a frame."""
    session.clock.jump(frame)
    return session.frame_at(0.0).cloud


def count_close(source, frame):
    """Number of points within a bin of the square whose light comes in a frame."""
    return int(np.sum(np.abs(source.view(0).cloud.range - range_of(frame)) < 3e-3))


def test_frames_become_a_cloud_at_the_ranges_of_the_squares(transient):
    view = transient.view(0)
    assert np.all(INSIDE[tuple(view.pixels.T)])
    near = view.pixels[:, 0] < 16
    # The pulse has no noise: a hundredth of a bin of 3 mm.
    assert np.allclose(view.cloud.range[near], range_of(NEAR_FRAME), atol=3e-5)
    assert np.allclose(view.cloud.range[~near], range_of(FAR_FRAME), atol=3e-5)


def test_time_walks_through_a_transient(transient):
    session = Session(transient)
    assert transient.gate.value == GATE_UP_TO_FRAME
    whole = len(session.frame_at(0.0).cloud)
    assert whole == 36 + 49  # the pixels of both squares: at its end a transient is complete
    assert len(show_cloud(session, NEAR_FRAME + 3)) == 36
    assert len(show_cloud(session, NEAR_FRAME - 9)) == 0
    transient.gate.value = GATE_ALL_TIMES
    assert len(session.frame_at(0.0).cloud) == whole
    transient.gate.value = GATE_AROUND_FRAME
    assert len(show_cloud(session, FAR_FRAME)) == 49
    shown = session.frame_at(0.0)
    assert len(shown.pixels) == 49
    pictures = session.pictures(shown)
    assert np.unravel_index(pictures["intensity"].argmax(), (32, 32))[0] >= 18
    assert pictures["streak"].shape == (FRAMES, 300)
    assert np.nanmax(pictures["depth"]) == pytest.approx(range_of(FAR_FRAME), abs=1e-3)
    transient.half_gate.value = 5  # as far before the frame as behind it
    for away, points in ((-6, 0), (-5, 36), (0, 36), (5, 36), (6, 0)):
        assert len(show_cloud(session, NEAR_FRAME + away)) == points
    assert transient.find_gate(2) == range(8)


def test_a_pick_brings_its_pixels_waveform(transient):
    session = Session(transient)
    shown = session.frame_at(0.0).cloud
    far, near = shown.xyz[shown.range.argmax()], shown.xyz[shown.range.argmin()]
    pick = session.pick((0, 0, 0), far)
    times, counts = pick.waveform
    assert times[counts.argmax()] == pytest.approx(pick.point.time[0], abs=BIN_WIDTH)
    assert counts.size == 33  # some pulses on either side
    assert session.distance is None
    session.pick((0, 0, 0), near)
    assert session.distance == pytest.approx(np.linalg.norm(far - near))
    assert session.pick((0, 0, 0), (0, -1, 0.1)) is None  # a miss forgets them
    assert session.picks == []


def test_refocusing_moves_the_squares_along_the_slit_and_back(transient):
    """A refocus by one shear of light seen at shear 0 displaces the picture by the camera's own
    figure.
    """
    session = Session(transient)
    transient.gate.value = GATE_AROUND_FRAME
    assert session.pick((0, 0, 0), show_cloud(session, NEAR_FRAME).xyz[0]) is not None
    show_cloud(session, NEAR_FRAME - 6)  # not shown for a while
    assert len(session.picks) == 1

    def find_pixels(shear):
        transient.refocus.value = shear
        shown = session.frame_at(0.0)
        return shown.pixels, shown.cloud.intensity

    (sharp, _), (again, light) = find_pixels(0.0), find_pixels(1e-9)  # recovered once more
    moved, moved_light = find_pixels(1.0)
    assert session.picks == []  # no longer a point
    bright = again[light > 0.5 * light.max()]
    assert np.allclose(bright.mean(axis=0), sharp.mean(axis=0), atol=0.7)
    shift = np.average(moved, axis=0, weights=moved_light) - np.average(again, 0, light)
    # Only a part of a shear displaces, 3 rows; the rest defocuses, which pulls the mean by some of
    # a pixel.
    assert np.allclose(shift, -np.array(camera().displacement_per_shear), atol=0.7)
    # between the squares there is no light, and none is invented
    assert len(show_cloud(session, 45)) == 0


@pytest.mark.parametrize(("method", "shear"), [("tv", 0.5), ("linear", 0.0)])
def test_points_by_another_method_are_those_that_recover_and_cloud_make(method, shear):
    """They are judged by what this recovery leaves of the shot, not by figures of the frames' own."""
    shot, focus = open_shot(streak()), FixedFocus(shear)
    source = TransientSource("frames.h5", plan_recovery(shot, "wavelet").run())
    source.method_choice.value, source.refocus.value = method, shear
    expected = depth(plan_recovery(shot, make_look_method(method), focus).run())
    shown = source.view(0).cloud
    assert 25 < len(shown) == len(expected.range)
    np.testing.assert_allclose(shown.range, expected.range, rtol=1e-6)
    np.testing.assert_allclose(shown.false_alarm, point_cloud(expected).false_alarm, atol=1e-6)


def test_clouds_follow_one_another(folder):
    source = open_source(str(folder / "clouds"))
    session = Session(source)
    assert len(source) == 4
    assert [float(np.median(source.view(n).cloud.xyz[:, 2])) for n in range(4)] == [1, 2, 3, 4]
    assert set(session.pictures(session.frame_at(0.0))) == {"intensity", "depth"}
    session.clock.step(1)
    assert session.frame_at(0.0).frame == 1
    assert session.frame_at(0.0).text == "cloud_000001.ply"
    assert source.settings == ()  # there is nothing to refocus


def test_a_cloud_of_another_program_needs_positions_only(tmp_path):
    (tmp_path / "other.csv").write_text("x,y,z\n0.3,0.4,1.2\nnan,nan,nan\n")
    cloud = open_source(str(tmp_path / "other.csv")).view(0).cloud
    assert cloud.range == pytest.approx([1.3])
    (tmp_path / "flat.csv").write_text("x,y\n1,2\n")
    with pytest.raises(FileFormatError, match="no column 'z'"):
        open_source(str(tmp_path / "flat.csv"))


def test_a_single_shot_is_recovered_as_a_transient(folder, monkeypatch):
    """Of a camera whose sweep the shot has to tell, the whole search takes longer than the frames."""
    camera().replace(sweep=None).save(folder / "coarse.h5")
    refined = []
    refine = registration._refine_camera
    monkeypatch.setattr(
        registration, "_refine_camera", lambda *known: refined.append(1) or refine(*known)
    )
    for options, refinements in ((None, 0), (ShotOptions(camera=folder / "coarse.h5"), 2)):
        source = open_source(str(folder / "shot.h5"), options)
        assert len(refined) == refinements
        assert min(count_close(source, NEAR_FRAME), count_close(source, FAR_FRAME)) > 25


def test_a_quick_look_is_called_one_and_another_method_can_be_asked_for(folder):
    """A single shot is recovered by iterations; what is linear says so, as does a missing time zero."""
    shot, stack = str(folder / "shot.h5"), str(folder / "stack.h5")
    with_camera = ShotOptions(camera=folder / "camera.h5")
    assert open_source(shot).notes == (FIRST_LOOK_NOTE,)
    expected = "quick look (l1, 25 iterations); for measurements run tofclip recover"
    assert expected == FIRST_LOOK_NOTE
    assert open_source(shot, ShotOptions(method="linear")).view(0).notes == (LINEAR_NOTE,)
    sharp = open_source(stack, with_camera)
    quick = open_source(stack, replace(with_camera, method="linear"))
    assert (sharp.view(0).notes, quick.view(0).notes) == ((), (LINEAR_NOTE,))
    # nearly all light is inside the squares, where the linear inverse draws rays around them
    fractions = []
    for source in (sharp, quick):
        light = np.maximum(source.recover_frames(0).values, 0).sum(axis=0)
        fractions.append(light[INSIDE].sum() / light.sum())
    assert fractions[0] > 2 * fractions[1]  # 0.78 and 0.2: far from noise of a per cent
    assert count_close(sharp, NEAR_FRAME) > 25
    no_zero = open_source(shot, ShotOptions(time_zero=0.0))
    assert no_zero.notes == (FIRST_LOOK_NOTE, NO_TIME_ZERO_NOTE)
    # frames are refocused by their own method until another is chosen on the page
    session = Session(open_source(str(folder / "frames.h5")))
    session.source.refocus.value = 0.5
    for method, notes in (("l1", ()), ("linear", (LINEAR_NOTE,))):
        assert session.source.method_choice.value == "l1"
        session.source.method_choice.value = method
        session.frame_at(0.0)
        assert session.notes == notes
    for method in ("surfaces", "best"):
        with pytest.raises(InputError, match=r"choose one of .*tv, l1, linear, adjoint"):
            open_source(stack, replace(with_camera, method=method))


def test_a_single_shot_can_be_looked_at_by_its_surfaces(folder):
    source = open_source(str(folder / "shot.h5"), ShotOptions(method="surfaces"))
    view = source.view(0)
    near = view.pixels[:, 0] < 16
    for side, frame in ((near, NEAR_FRAME), (~near, FAR_FRAME)):
        assert side.sum() > 25
        assert np.median(view.cloud.range[side]) == pytest.approx(range_of(frame), abs=3e-3)
    # what is shown are the surfaces' own points that a cloud keeps, not what a search of frames would find
    returns = source.frames.returns
    expected = np.sort(returns.range[returns.false_alarm <= 0.1])
    np.testing.assert_allclose(np.sort(view.cloud.range), expected, rtol=1e-6)


@pytest.mark.parametrize("shots", ["stack.h5", "shots"])
def test_many_shots_are_recovered_shot_by_shot(folder, shots):
    options = ShotOptions(camera=folder / "camera.h5", time_zero=-20e-9)
    source = open_source(str(folder / shots), options)
    assert len(source) == 3
    session = Session(source)
    shown = session.frame_at(0.0)
    # the other time zero moves everything by 1.5 m
    nearest = range_of(NEAR_FRAME) + 10e-9 * 0.149896
    assert np.sum(np.abs(shown.cloud.range - nearest - 1.498) < 0.02) > 25
    assert set(session.pictures(shown)) == {"streak", "intensity", "depth"}
    pick = session.pick((0, 0, 0), shown.cloud.xyz[0])
    assert pick.waveform.shape[1] < FRAMES / 2  # about its return
    source.refocus.value = 0.5
    assert len(session.frame_at(0.0).cloud) > 0


def test_a_volume_as_voxels_surface_projection_and_slices(folder):
    source = open_source(str(folder / "volume.h5"))
    session, middle = Session(source), [0.05, -0.05, 0.5]
    front = session.frame_at(0.0).cloud.xyz[:, :2].round(3).tolist()
    assert len({tuple(line_of_sight) for line_of_sight in front}) == len(front)
    source.mode.value = VOXEL_MODE
    voxels = session.frame_at(0.0).cloud
    assert np.allclose(voxels.xyz.mean(axis=0), middle, atol=0.01)
    radius = 0.04 * np.sqrt(2 * np.log(1 / 0.3))
    assert np.all(np.linalg.norm(voxels.xyz - middle, axis=1) < radius + 1e-3)
    source.threshold.value = 0.8
    assert 0 < len(session.frame_at(0.0).cloud) < len(voxels)
    source.mode.value = SLICE_MODE
    assert np.unique(show_cloud(session, 3).xyz[:, 2]).size == 1
    assert session.pictures(session.frame_at(0.0))["intensity"].shape == volume().grid.shape[1:]
    source.mode.value, source.threshold.value = SURFACE_MODE, np.exp(-0.5)
    shown = session.frame_at(0.0)
    radius = np.linalg.norm(shown.surface.vertices - middle, axis=1)
    # one standard deviation, by linear interpolation over 2 cm voxels
    assert np.allclose(radius, 0.04, atol=0.004)


def test_what_is_shown_is_called_what_it_is(transient):
    """Every slice's projection is not slice 0, and all frames are not the last one."""
    of_volume, of_frames = Session(VolumeSource("ball", volume())), Session(transient)
    assert of_volume.frame_at(0.0).caption == "maximum projection of all 21 slices"
    status = render_status_html(of_volume, of_volume.frame_at(0.0), 0.0)
    assert "<span id='what'>maximum projection</span>" in status
    of_volume.source.mode.value = SLICE_MODE
    show_cloud(of_volume, 4)
    assert of_volume.frame_at(0.0).caption == "slice 5"
    assert of_frames.frame_at(0.0).caption == f"all {FRAMES} frames"
    show_cloud(of_frames, 5)
    assert of_frames.frame_at(0.0).caption == "frames 1 to 6"
    assert PROJECTION_MODE in of_volume.source.mode.options


def follow(shots):
    return LiveShots("test", shots, make_pipeline(streak(0)))


def test_live_shots_are_followed_and_can_be_looked_at_again():
    opened = threading.Event()

    def shots():
        yield streak(0)
        opened.wait(20)
        yield streak(1)
        wait_until(lambda: len(live) >= 2)  # or it may be dropped for the next
        yield streak(2)
        raise ZeroDivisionError("nothing came")  # of no kind that is foreseen

    live = follow(shots())
    opened.set()
    source = StreakSource("test", live, camera(), streak(0).times)
    session = Session(source)
    wait_until(lambda: not source.inflow.is_live)
    assert (len(source), source.inflow.oldest, source.inflow.failure_text) == (3, 0, "nothing came")
    assert session.frame_at(0.0).frame == 2
    session.clock.step(-1)
    assert (session.frame_at(0.0).frame, session.clock.following) == (1, False)
    session.clock.follow()
    assert session.frame_at(0.0).frame == 2
    assert session.label == "REPLAY"  # nothing comes any more
    source.close()


def test_live_shots_that_come_too_fast_are_dropped(monkeypatch):
    opened, busy, came, go_on = (threading.Event() for _ in range(4))
    handed_over = 0.0

    def shots():
        nonlocal handed_over
        yield streak(0)
        opened.wait(20)
        for seed in range(12):
            handed_over = time.monotonic()
            yield streak(seed)
            busy.wait(20)
        came.set()

    def slowly(self, shot):
        if opened.is_set():
            busy.set()
            go_on.wait(20)
        return rectify(self, shot)

    rectify = RangingPipeline.rectify
    monkeypatch.setattr(RangingPipeline, "rectify", slowly)
    source = follow(shots())
    opened.set()
    assert came.wait(20)
    taken = time.monotonic()
    time.sleep(0.1)
    released = time.monotonic()
    go_on.set()
    ended = wait_until(lambda: not source.inflow.is_live)
    # One was being rectified, and one more could wait; on a busy computer that one replaces the
    # other, which is finished and not yet taken.
    assert len(source) in (2, 3)
    assert len(source) + source.inflow.lost == 13
    # Of the last one, which could not be made before `go_on` and was before the end, since it came.
    assert released - taken <= source.inflow.latency <= ended - handed_over
    source.close()


def test_an_instruments_address():
    source = open_source("sim+remoteex://?seed=1&scene=small&frame_rate=20")
    assert source.inflow.is_live
    assert Session(source).label == "LIVE"
    wait_until(lambda: len(source) >= 3)
    assert len(source.view(2).cloud) > 100
    assert source.inflow.data_rate > 0
    source.close()
    assert not source.inflow.is_live


@pytest.mark.parametrize("brightest", [0, 1, 2])
def test_a_pixels_depth_is_that_of_its_brightest_return(brightest):
    """Of a leaf, a branch and a wall in one pixel, whichever sends most light back."""
    xyz = np.array([[0, 0, 2.0], [0, 0, 3.0], [0, 0, 5.0], [0, 0, 4.0]], np.float32)
    light = np.array([10, 20, 15, 1], np.float32)
    light[brightest] = 100
    pixels = np.array([[1, 2], [1, 2], [1, 2], [0, 0]], np.int32)
    depth = render_depth(View(make_cloud(xyz, {"intensity": light}), pixels), (2, 3))
    assert depth[1, 2] == xyz[brightest, 2]
    assert depth[0, 0] == 4.0
    assert np.isnan(depth).sum() == 4
