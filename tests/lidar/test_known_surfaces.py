"""Surfaces of scenes whose every return is known, with frames' returns where no surface is."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from physics_scenes import ellipsoid, make_person, make_shot, plate, sphere

import tofclip
from tofclip.errors import InputError


def recover(scene, photons):
    shot = make_shot(scene, seed=2, photons=photons, size=64)
    return recover_shot(shot, shot.true_camera)


def recover_shot(shot, camera):
    streak = tofclip.Streak(shot.counts, shot.row_times)
    frames = tofclip.recover(streak, camera, "surfaces")
    cloud = tofclip.point_cloud(tofclip.depth(frames))
    place = shot.locate(cloud.xyz)
    return frames, shot.score(*place, cloud.range, cloud.range_sigma, cloud.false_alarm)


# Twice of what seeds 0 and 2 have: 0.002, 0.019 and 0.06 mm; 0.025, 0.0003 and 0.8 mm; seed 2 of the
# table 0.004, 0.001 and 0.5 mm, where a melon and a book that touch its top are surfaces of their own.
@pytest.mark.parametrize(
    ("scene", "missed", "false", "too_small", "too_large"),
    [
        ("wires", 0.03, 0.04, 2.0, 0.13),
        pytest.param("room", 0.05, 0.01, 2.3, 0.33, marks=pytest.mark.nightly),
        pytest.param("table", 0.04, 0.01, 2.7, 0.3, marks=pytest.mark.nightly),
    ],
)
def test_dim_and_small_things_are_seen_beside_bright_ones(
    scene, missed, false, too_small, too_large
):
    """A wall that is hundreds of times darker than a retroreflector, which is too small for a surface and
    holds most of the light; balls of ten pixels before a steep plate.
    """
    frames, score = recover(scene, 2000)
    assert score["miss"] < missed
    assert score["false"] < false
    assert score["median_mm"] < 2.8
    # a pixel of the steep plate spans 27 mm of range; 0.4 mm, and 2.2 if each had one time
    assert score["medians_mm"].get("steep plate", 0) < 0.8
    # a wire is round: 0.2 mm, and 0.4 if its sides were as near as its middle
    assert score["medians_mm"].get("wire", 0) < 0.3
    returns = frames.returns
    # surfaces' points and frames' returns are one list: pixel by pixel, nearest first
    pixel = returns.y.astype(int) * 64 + returns.x
    assert np.array_equal(np.lexsort((returns.range, pixel)), np.arange(len(returns)))
    first = np.diff(pixel, prepend=-1) > 0
    assert np.array_equal(returns.return_number == 1, first)
    # no return of the frames is where a surface has its own
    near = (np.diff(pixel) == 0) & (np.diff(returns.range) < 0.02)
    assert near.mean() < 0.02
    # each surface is about as far off as it says: 0.35 to 1.6 in the room, whose balls had 0.15; twice
    # of what seed 2 has and half of it, but 2.60 of an apple that is 10 px wide, and 2.08 of a ball: there
    # all are off the same way, the nearer the more, as a sweep stretched by 0.2 rows in all views makes them
    assert too_large < min(score["z"].values()), score["z"]
    assert max(score["z"].values()) < too_small, score["z"]
    # none is without a probability of being false, and none that seems sure is: of wires, whose light
    # may lie anywhere in a lens about a level line, it was 0.04 while nothing said that it may
    stated = {low: (true, count) for low, _, _, true, count in score["calibration"]}
    assert sum(count for _, count in stated.values()) == score["counted"].sum()
    assert stated[0.0][0] < 0.005
    assert stated[0.0][1] > 0.8 * score["counted"].sum()


@pytest.mark.nightly
def test_a_wall_that_goes_on_beyond_the_picture_is_not_tilted():
    """Each view's picture ends elsewhere on it: 0.13 mm of tilt, root mean square, if that is not found."""
    wall = plate("wall", (0, 0, 3.8), (4, 4), 0.5, yaw=0.1)
    shot = make_shot([wall], size=96, bend=-0.6)  # a straight delay, which cameras know
    streak = tofclip.Streak(shot.counts, shot.row_times)
    found = tofclip.recover(streak, shot.true_camera, "surfaces").returns
    row, column = shot.truth[:, :2].astype(int).T
    truth = np.full((96, 96), np.nan)
    truth[row, column] = shot.truth[:, 2]
    assert np.nanstd(found.range - truth[found.y, found.x]) < 0.09e-3


@pytest.mark.nightly
def test_a_person_is_round():
    """Head, torso and limbs are of one range, and nothing joins them in the picture. As one surface the head
    was 5.2 mm off and the limbs 3.1; as splines the torso 1.0, since frames' returns are displaced at
    its rims.
    """
    person = make_person((0, 0.05, 2.6), np.random.default_rng(3))
    _, score = recover([*person, plate("wall", (0, 0, 3.9), (4, 4), 0.5)], 2000)
    assert score["medians_mm"]["head"] < 0.8
    assert score["medians_mm"]["torso"] < 0.5
    assert score["medians_mm"]["limb"] < 0.5


def test_a_head_and_a_torso_that_touch_are_two_surfaces():
    """Their returns in frames lie on one surface of second order to a fifth of a bin: it had the head 1.6 mm off
    and the torso 0.6, and 0.03 of the returns were missed. They are 0.25 and 0.14 mm off.
    """
    things = [
        sphere("head", (0.02, -0.36, 2.6), 0.14, 0.55),
        ellipsoid("torso", (0, 0.1, 2.63), (0.24, 0.36, 0.16), 0.4),
        plate("wall", (0, 0, 3.9), (4, 4), 0.5),
    ]
    shot = make_shot(things, seed=1, size=64)
    _, score = recover_shot(shot, shot.camera)
    assert score["medians_mm"]["head"] < 0.5
    assert score["medians_mm"]["torso"] < 0.3
    assert score["miss"] < 0.012


def test_a_melon_that_a_plate_hides_in_part_is_no_part_of_the_table():
    """Its returns in frames were taken for the table's, whose surface then had none of its light: 0.018 was missed,
    0.007 false, and the table 1.3 mm off; now 0.001, 0 and 0.9.
    """
    turned = 0.8
    things = [
        plate("table", (0, 0.35, 2.8), (2.4, 1.4), 0.5, pitch=turned),
        plate("stand", (0, 0.35 + 0.2 / np.tan(turned) - 0.15, 2.6), (0.32, 0.32), 0.8),
        sphere("melon", (-0.2, 0.35 - 0.1 / np.tan(turned) - 0.1, 2.9), 0.12, 0.7),
        plate("wall", (0, 0, 4.2), (4, 4), 0.45, yaw=-0.15),
    ]
    shot = make_shot(things, seed=1, size=64)
    _, score = recover_shot(shot, shot.true_camera)
    assert score["miss"] < 0.008
    assert score["false"] < 0.003
    assert score["medians_mm"]["table"] < 1.1


def test_a_ball_is_round_to_its_limb():
    """A pixel at the limb spans a dozen bins of range, of which the near ones are bright: with a line's course
    and even light in it all of a ball of 11 px gave way. Seeds 1 to 3 were 1.8, 1.3 and 2.2 mm off, root
    mean square, 2.2 to 2.3 times what they said; now 0.7, 0.6 and 1.5 mm, and 0.8 to 0.9.
    """
    things = [
        sphere("ball", (0.1, 0.1, 2.6), 0.1, 0.6),
        plate("wall", (0, 0, 3.9), (4, 4), 0.45),
    ]
    shot = make_shot(things, seed=1, size=64)
    frames, score = recover_shot(shot, shot.camera)
    row, column, distance, number, fill = shot.truth.T
    truth, whole = np.full((64, 64), np.nan), (number == 0) & (fill > 0.99)
    truth[row[whole].astype(int), column[whole].astype(int)] = distance[whole]
    off = frames.returns.range - truth[frames.returns.y, frames.returns.x]
    near = np.abs(off) < 0.03
    assert np.count_nonzero(near) > 75
    assert np.sqrt(np.mean(off[near] ** 2)) < 1.2e-3
    assert 0.5 < score["z"]["ball"] < 1.7


@pytest.mark.nightly
def test_a_table_is_one_surface_whatever_stands_on_it():
    """Frames' returns are bent about a melon and below a book: of three surfaces in one place, 0.024 was
    missed and 0.021 false; here 0.002 and 0.
    """
    shot = make_shot("table", seed=28, size=64)
    _, score = recover_shot(shot, shot.camera)
    assert score["miss"] < 0.008
    assert score["false"] < 0.005
    assert score["medians_mm"]["table top"] < 0.6


@pytest.mark.nightly
def test_leaves_are_kept_in_little_light():
    """Those too small for a surface are the frames' returns, which the whole shot shows to be there."""
    _, score = recover("bush", 200)
    # 0.09 and 0.009; 0.16 missed where each had to stand ten deviations out of the noise
    assert score["miss"] < 0.12
    assert score["false"] < 0.015


@pytest.mark.nightly
def test_a_blur_along_the_slit_hardly_displaces_a_ball():
    """As of a streak tube: each place has light of other ranges, and before they are known a part of the blur is
    taken for a pulse that is longer. 0.11 was missed, and the ball 8.1 mm off; 0 and 1.0 mm, 0.7 times what it says.
    """
    things = [
        sphere("ball", (0.1, 0.1, 2.6), 0.2, 0.6),
        plate("wall", (0, 0, 3.9), (4, 4), 0.45),
    ]
    shot = make_shot(things, seed=2, size=48, blur=1.5)
    _, score = recover_shot(shot, shot.true_camera)
    assert score["miss"] < 0.01
    assert score["false"] < 0.005
    assert score["medians_mm"]["ball"] < 2
    assert score["z"]["ball"] < 1.5


def test_light_of_a_floor_that_is_not_found_is_told():
    """Of which a pixel spans 50 to 300 mm: in each frame it is a thin dim line."""
    wall = plate("wall", (0, -0.82, 4.2), (5, 2.36), 0.5)  # ends where the floor does
    floor = plate("floor", (0, 0.36, 3.0), (6, 5), 0.5, 0.0, np.pi / 2)
    light = []
    for things in ([wall], [wall, floor]):
        shot = make_shot(things, seed=1, size=48)
        light.append(float((shot.counts - 2).sum()))
        frames, score = recover_shot(shot, shot.true_camera)
        told = frames.figures.get("unexplained_light")
        assert score["false"] < 0.005
        if floor not in things:
            assert told is None
    assert told == pytest.approx(1 - light[0] / light[1], abs=0.02)


def test_a_pulse_is_as_short_as_the_shot_shows_it():
    """A camera that was told no pulse has 60 ps, five times as long as some instruments': surfaces left
    41 % unexplained, and the shot was called smoke.
    """
    shot = make_shot("room", seed=2, size=48)
    _, score = recover_shot(shot, shot.true_camera.replace(pulse_fwhm=300e-12))
    assert score["miss"] < 0.015  # 0.005
    assert score["false"] < 0.005
    assert score["median_mm"] < 0.5


def test_a_pulse_that_is_a_third_longer_than_said_turns_no_ball():
    """Surfaces that were begun with the camera's width did not come back: the small ball was 13.8 mm off."""
    shot = make_shot("room", seed=7, size=64)
    said = shot.true_camera.pulse_fwhm / 1.3
    _, score = recover_shot(shot, shot.true_camera.replace(pulse_fwhm=said))
    assert score["miss"] < 0.015  # 0.001
    assert max(score["medians_mm"].values()) < 0.5  # 0.28


def test_a_table_in_little_light_is_found_as_far_as_it_reaches():
    """Of one that is turned far frames in 200 photons show the near part: 0.27 of the returns were missed and
    0.055 of the points false. Tables of five seeds have 0.002 to 0.010, and none.
    """
    shot = make_shot("table", seed=9, photons=200, size=64)
    _, score = recover_shot(shot, shot.camera)
    assert score["miss"] < 0.03
    assert score["false"] < 0.005


def test_a_plate_whose_pixels_show_nothing_alone_is_found_in_fifty_photons():
    """Frames, and means over a few pixels, show six of its 366 returns, means over more a tenth: 0.19 of the
    room's returns were missed. Rooms of two seeds have 0.017 and 0.024.
    """
    shot = make_shot("room", seed=9, photons=50, size=64)
    _, score = recover_shot(shot, shot.camera)
    assert score["miss"] < 0.04
    assert score["false"] < 0.005


def test_a_steep_surface_that_ends_within_pixels_shows_neither_pulse_nor_place_wrong():
    """A table of which a pixel spans 27 mm was 6 to 16 mm off, two to four times what it said: its slope was
    taken for the pulse, and the light of its borders for that of whole pixels; its far edge was missed. Seeds 0
    to 3 are now 0.8, 1.6, 1.8 and 1.0 mm off.
    """
    table = plate("table", (0, 0.3, 2.8), (2.4, 1.1), 0.5, 0.1, 0.8)
    wall = plate("wall", (0, 0, 4.2), (4, 4), 0.45, -0.15)
    shot = make_shot([table, wall], seed=1, size=48)
    _, score = recover_shot(shot, shot.true_camera)
    assert score["miss"] < 0.01  # 0
    assert score["false"] < 0.005
    assert score["medians_mm"]["table"] < 2.5
    assert score["z"]["table"] < 2.2  # 1.7


@pytest.mark.nightly
def test_what_a_camera_adds_or_multiplies_by_makes_no_point():
    """Eight counts a photon and a thousand in the dark: 0.067 of the points were false, and 0.041 of those
    that were said to be sure.
    """
    shot = make_shot("wires", seed=2, photons=150, size=48)
    shot = replace(shot, counts=8 * shot.counts + 1000)
    _, score = recover_shot(shot, shot.true_camera)
    assert score["miss"] < 0.06
    assert score["false"] < 0.015


@pytest.mark.nightly
def test_rows_far_shorter_than_the_pulse_say_no_less():
    """In frames of 5 ps a table is lines that hardly touch: it was said to be turned too far. Of 48 pixels
    a side seeds decide: 0.05 to 0.27 are missed.
    """
    shot = make_shot("table", seed=2, size=72, row_s=5e-12)
    frames, score = recover_shot(shot, shot.true_camera)
    assert score["miss"] < 0.03  # 0.014
    assert score["false"] < 0.01
    assert score["median_mm"] < 0.4  # 0.2
    # the camera may be used for other shots of such rows
    kept, sweep = frames.camera.sweep, shot.true_camera.sweep
    assert kept.offsets_bin == pytest.approx(sweep.offsets_bin)


def test_a_dark_shot_is_called_dark():
    with pytest.raises(InputError, match="too dark for surfaces"):
        recover("bush", 5)


# the peak of this program alone: what `getrusage` says includes the process that started it
GROWTH = """
import re, sys
from pathlib import Path
from tofclip.recovery import open_shot, plan_recovery

def find_peak():
    return 1024 * int(re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1])

folder, method = sys.argv[1:]
plan = plan_recovery(open_shot(f"{folder}/shot.h5", f"{folder}/camera.h5"), method)
before = find_peak()
plan.run()
print(find_peak() - before, plan.memory_bytes)
"""


@pytest.mark.nightly
@pytest.mark.parametrize("method", ["surfaces", "tv"])
def test_a_plan_says_how_much_memory_it_takes(method, tmp_path):
    """Within a third; three sizes of shots took 0.7 to 1.2 of it."""
    shot = make_shot("room", seed=2, size=64)
    tofclip.Streak(shot.counts, shot.row_times).save(tmp_path / "shot.h5")
    shot.camera.save(tmp_path / "camera.h5")
    run = [sys.executable, "-c", GROWTH, tmp_path, method]
    made = subprocess.run(run, capture_output=True, check=True)
    grown, said = map(int, made.stdout.split())
    assert grown == pytest.approx(said, rel=1 / 3)
