"""`tofclip lidar`: ranging against its limit, depth-locked recovery, sequences and objects."""

import os
from dataclasses import replace
from pathlib import Path

import pytest
from small_instrument import DEEP_CAMERA as CAMERA

from tofclip.io.streaks import save_stack
from tofclip.shots import Frames
from tofclip.simulate import (
    Instrument,
    Scene,
    StreakDetector,
    make_plate,
    render_true_frames,
    simulate_shot,
)
from tofclip.simulate.patterns import make_checkerboard


def scene(*plates):
    """Plates at distances [m] and places [px] along the picture's diagonal."""
    pattern = make_checkerboard(3, 0.1, 0.9)
    lengths = [(distance, place * distance / 100.0) for distance, place in plates]
    return Scene(
        tuple(
            make_plate((place, place, distance), (0.09 * distance, 0.09 * distance), pattern)
            for distance, place in lengths
        )
    )


def instrument(bins=150, photons=2e5):
    return Instrument(CAMERA, StreakDetector(bins, 100e-12, peak_photons=photons))


def test_the_bound_of_accuracy_and_what_a_tail_costs(shell):
    """How near to it returns are: see `tests/lidar/test_photon_limit.py`."""
    plain, tailed = (
        shell.figures(f"lidar accuracy --trials 1 {tail}")["bound_m"]
        for tail in ("", "--decay-ps 200")
    )
    # c/2 * 26.1 ps (pulse and bin) / root 100, and a little background
    assert 3.9e-4 < plain < 4.1e-4
    assert tailed > 1.5 * plain


def test_parallax_makes_the_camera_that_depth_locked_recovery_needs(shell):
    shot = simulate_shot(scene((0.8, -9), (1.3, 0), (4.0, 9)), instrument(360), seed=0)
    replace(shot.streak, camera=CAMERA.replace(lenslet_pitch=0.0)).save("shot.h5")
    locked = "recover shot.h5 --out frames.h5 --method l1 --iterations 5 --focus depth-locked"
    shell.refuses(locked, "lenslet pitch")
    words = "--out camera.h5 --gates 4 --shears -1.5 0.9 9"
    figures = shell.figures(f"lidar parallax shot.h5 {words}")
    assert len(figures["shear_px"]) == len(figures["range_m"]) == 4
    assert abs(figures["strength_px_m"] - 1.0) < 0.3  # 100 px * 10 mm; small pictures of 32 px
    assert shell(f"{locked} --camera camera.h5").status == 0
    assert Frames.load("frames.h5").figures["focus"] == "depth-locked"


def test_clouds_are_tidied_and_become_depth_pictures(shell):
    plate, made = scene((1.3, 0)), instrument()
    exposure = simulate_shot(plate, made, seed=0).exposure
    render_true_frames(plate, made, exposure).save("frames.h5")
    whole = shell.figures("cloud frames.h5 --out a.laz")["points"]
    thin = shell.figures("cloud frames.h5 --out b.ply --voxel-mm 30 --drop-outliers")["points"]
    assert 0 < thin < whole / 2
    assert shell("cloud frames.h5 --out depth.exr").status == 0
    assert Path("depth.exr").read_bytes()[:4] == b"\x76\x2f\x31\x01"
    shell.refuses("cloud frames.h5 --out c.ply --voxel-mm 0")


def test_a_sequence_is_made_and_goes_on(shell):
    Path("shots").mkdir()
    made = instrument(photons=2e4)
    streaks = [simulate_shot(scene((1.3, 0)), made, seed).streak for seed in range(3)]
    for number, streak in enumerate(streaks):
        streak.save(f"shots/{number}.h5")
    line = "lidar sequence shots --out clouds"
    assert shell.figures(f"{line} --focus depth-locked")["shots"] == 3
    assert {"0.ply", "1.ply", "2.ply"} <= {*os.listdir("clouds")}
    Path("clouds/2.ply").unlink()
    again = shell.figures(f"{line} --focus depth-locked")
    assert (again["shots"], again["results"], again["kept_from_before"]) == (1, 1, 2)
    shell.refuses(line)  # another focus
    shell.refuses(f"{line} --focus stack:0:1:3")
    save_stack(streaks, "stack.h5")
    CAMERA.save("camera.h5")
    line = "lidar sequence stack.h5 --out more --average 2 --suffix .npz"
    shell.refuses(line)  # a stack carries no camera
    assert shell(f"{line} --camera camera.h5 --bin-width-ps 100").status == 0
    averaged = {"stack_000000-stack_000001.npz", "stack_000002.npz"}
    assert {path.name for path in Path("more").glob("*.npz")} == averaged


@pytest.fixture
def frames(shell):
    lit = scene((1.1, -9), (1.6, 9))
    frames = render_true_frames(lit, instrument(), 1e4)
    frames.save("frames.h5")
    return frames


SCENE = "lidar scene frames.h5 --out scene.png"


@pytest.mark.usefixtures("frames")
def test_a_scene_is_listed_and_drawn(shell):
    first, second = shell.figures(f"{SCENE} --reach-mm 60")["objects"]
    assert abs(first["range_m"] - 1.12) < 0.02  # beside the axis the way is longer than the depth
    assert abs(second["range_m"] - 1.62) < 0.02
    assert abs(first["width_m"] - 0.09) < 0.03
    assert 0 < first["range_sigma_m"] == first["confidence_m"] < 0.02
    assert Path("scene.png").read_bytes()[:4] == b"\x89PNG"
    shell.refuses(f"{SCENE} --fewest-points 9999")
    assert "\n  2  1.6" in shell(f"{SCENE} --reach-mm 60 --overwrite").out


@pytest.mark.parametrize("time_zero", [0.0, -2e-9])
def test_ranges_without_a_time_zero_are_said_to_be_right_up_to_a_constant(shell, frames, time_zero):
    replace(frames, camera=CAMERA.replace(time_zero=time_zero)).save("frames.h5")
    note = "note: ranges are right up to a constant, no time zero given"
    cloud = "cloud frames.h5 --out cloud.ply"
    for line in (f"{SCENE} --reach-mm 60", cloud):
        assert (note in shell(line).out) == (time_zero == 0)
    assert "note" not in shell.figures(f"{cloud} --overwrite")
