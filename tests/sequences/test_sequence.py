"""Sequences of shots whose jitter, noise and interruptions are known."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
import pytest

from tofclip import Streak
from tofclip.camera import Camera, Rectifier, SkewSweep, measure
from tofclip.errors import FileFormatError, InputError, ShapeError, StorageError
from tofclip.io.streaks import StreakStack, save_stack
from tofclip.recovery import DepthLockedFocus
from tofclip.sequences.ranger import RangingPipeline
from tofclip.sequences.ranging import (
    JitterEstimator,
    RangingSettings,
    compute_light_curve,
    make_average_cloud,
)
from tofclip.simulate import Instrument, Scene, StreakDetector, make_plate, simulate_shot
from tofclip.simulate.bodies import Body
from tofclip.simulate.patterns import make_checkerboard
from tofclip.threads import map_parallel
from tofclip.units import SPEED_OF_LIGHT

CENTRES = 40.0 + 60 * np.arange(5)
BIN = 50e-12
ROWS = 128
BIN_M = SPEED_OF_LIGHT * BIN / 2


def camera(time_zero: float = -6e-9) -> Camera:
    angles = np.arctan([0.5, -0.8, 0.9, -0.4, 0.1])
    sweep = SkewSweep(CENTRES, np.array([-2.0, 1.0, 0.0, 0.5, 3.0]), np.zeros(5))
    optics = {"focal_length_px": 100.0, "lenslet_pitch": 5e-3, "focus_distance": 1.3}
    return Camera(
        CENTRES,
        angles,
        (32, 32),
        320,
        sweep=sweep,
        time_zero=time_zero,
        pulse_fwhm=150e-12,
        **optics,
    )


def plate(distance: float, place_px: float) -> Body:
    pixel = distance / 100.0
    return make_plate(
        (place_px * pixel, place_px * pixel, distance),
        (9 * pixel, 9 * pixel),
        make_checkerboard(3, 0.3, 0.9),
    )


SCENE = Scene((plate(1.1, -8), plate(1.5, 8)))


def shot(late_bin: float = 0.0, seed: int = 0, peak: float = 5e4) -> Streak:
    """A shot that comes some rows late."""
    made = camera(-6e-9 + late_bin * BIN)
    return simulate_shot(
        SCENE, Instrument(made, StreakDetector(ROWS, BIN, peak_photons=peak)), seed
    ).streak


@pytest.fixture(scope="module")
def pipeline() -> RangingPipeline:
    return RangingPipeline(camera(), np.arange(ROWS) * BIN, focus=DepthLockedFocus())


def make_clouds(shots, pipeline, average=1, steady=True, first=0):
    """Clouds of successive shots and their delays, as the jobs of `RangingSettings` make them."""
    jitter = JitterEstimator(compute_light_curve(shots[0](), pipeline.camera)) if steady else None
    starts = range(first * average, len(shots), average)
    yield from map_parallel(
        lambda start: make_average_cloud(shots[start : start + average], pipeline, jitter), starts
    )


def nearest(cloud) -> np.ndarray:
    return cloud.range[cloud.range < 1.3]


def test_jitter_is_found_and_taken_off(pipeline):
    late = [0.0, 2.0, -3.4, 0.7]
    shots = [partial(shot, one, seed) for seed, one in enumerate(late)]
    steps = list(make_clouds(shots, pipeline))
    # the light curve's rises are two rows wide; a tenth of a row is half a millimetre here
    np.testing.assert_allclose([delays[0] for _, delays in steps], late, atol=0.15)
    first = np.median(nearest(steps[0][0]))
    for cloud, _ in steps[1:]:
        assert np.median(nearest(cloud)) == pytest.approx(first, abs=0.2 * BIN_M)
    shaken = list(make_clouds(shots, pipeline, steady=False))
    assert np.median(nearest(shaken[1][0])) - first == pytest.approx(2 * BIN_M, abs=0.2 * BIN_M)


def test_averaging_lowers_the_noise_and_a_sequence_goes_on_where_it_stopped(pipeline):
    shots = [partial(shot, 0.0, seed, 60.0) for seed in range(10)]

    def change(one, other) -> float:
        """Median over the pixels that see something near in both."""
        ranges = []
        for cloud in (one, other):
            seen = np.round(100 * cloud.xyz[:, :2] / cloud.xyz[:, 2:]).astype(int)[
                cloud.range < 1.3
            ]
            ranges.append(dict(zip(map(tuple, seen.tolist()), nearest(cloud), strict=True)))
        return float(
            np.median(
                [abs(ranges[0][pixel] - ranges[1][pixel]) for pixel in ranges[0].keys() & ranges[1]]
            )
        )

    alone = [cloud for cloud, _ in make_clouds(shots, pipeline)]
    averaged = list(make_clouds(shots, pipeline, average=4))
    assert [len(delays) for _, delays in averaged] == [4, 4, 2]
    usual = np.mean([change(one, other) for one, other in pairwise(alone)])
    # noise changes half as much; how late a shot is found to be is averaged as well
    assert change(averaged[0][0], averaged[1][0]) < 0.7 * usual
    ((resumed, _),) = make_clouds(shots, pipeline, average=4, first=2)
    np.testing.assert_array_equal(resumed.xyz, averaged[2][0].xyz)


def test_memory_does_not_grow_with_the_sequence(pipeline, tmp_path):
    save_stack((shot(0.0, seed) for seed in range(3)), tmp_path / "shots.h5")
    stack = StreakStack(tmp_path / "shots.h5")
    peaks = []
    for number in (2, 12, 40):  # the first run fills caches, the second all threads
        shots = [partial(stack.read_shot, k % 3) for k in range(number)]
        tracemalloc.start()
        for _ in make_clouds(shots, pipeline):
            pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # 28 shots more; threads overlap differently from run to run, which moves the peak by the size
    # of a shot or two
    assert peaks[2] - peaks[1] < 5 * shot().counts.nbytes


def test_a_rectifier_does_what_interpolation_does():
    streak = shot(0.0, 3)
    rectifier = Rectifier(camera(), ROWS)
    found = rectifier.measure(streak.counts, streak.saturated, dark=0.0, delay=0.25)
    row = camera().sweep.raw_position(*np.ogrid[:ROWS, :320])[0] + 0.25
    inside = (row >= 0) & (row <= ROWS - 1)
    top = np.clip(np.floor(row).astype(int), 0, ROWS - 2)
    share = row - top
    columns = np.broadcast_to(np.arange(320), row.shape)
    expected = (1 - share) * streak.counts[top, columns] + share * streak.counts[top + 1, columns]
    # positions are float32: 1e-5 rows at the end of the picture, times the steepest slope
    np.testing.assert_allclose(
        found.values.T, np.where(inside, expected, 0), atol=2e-5 * streak.counts.max()
    )
    np.testing.assert_array_equal(found.valid.T, inside)
    with pytest.raises(ShapeError):
        rectifier.measure(streak.counts[:-1])
    marked = np.zeros(streak.counts.shape, bool)
    marked[50, 160] = True
    bad = ~measure(streak.counts, marked, camera().replace(sweep=None)).valid
    assert bad.sum() == 1
    assert bad[160, 50]


def test_jitter_beyond_reach_stays_at_its_end():
    light = np.zeros(200)
    light[50:60] = 1
    assert JitterEstimator(light).late_bin(np.roll(light, 32)) == 32
    assert JitterEstimator(light).late_bin(light) == pytest.approx(0, abs=1e-6)
    assert compute_light_curve(shot(), camera()).shape == (ROWS,)


def test_stacks_hold_their_shots(tmp_path):
    path = tmp_path / "shots.h5"
    made = [shot(0.0, seed) for seed in range(2)]
    assert save_stack(made, path) == 2
    stack = StreakStack(path)
    assert len(stack) == 2
    for before, after in zip(made, stack, strict=True):
        np.testing.assert_array_equal(after.counts, before.counts)
        np.testing.assert_array_equal(after.times, before.times)
    with pytest.raises(InputError, match=r"0\.\.1"):
        stack.read_shot(2)
    with pytest.raises(ShapeError, match="shot 1"):
        save_stack(
            [made[0], replace(made[1], counts=made[1].counts[:5], row_times=None, saturated=None)],
            path,
        )
    assert len(StreakStack(path)) == 2  # what was there stays
    with pytest.raises(InputError, match="no shot"):
        save_stack([], tmp_path / "none.h5")
    with pytest.raises(StorageError):
        StreakStack(tmp_path / "absent.h5")


@pytest.mark.parametrize("content", ["text", "bare", "flat"])
def test_other_files_are_no_stacks(tmp_path, content):
    path = tmp_path / "shots.h5"
    if content == "text":
        Path(path).write_text("no HDF5")
    else:
        with h5py.File(path, "w") as file:
            if content == "flat":
                file["counts"] = np.zeros((3, 4))
    with pytest.raises(FileFormatError):
        StreakStack(path)


def test_unusable_sequences_are_refused(pipeline):
    with pytest.raises(InputError, match="at least one"):
        make_average_cloud([], pipeline, None)
    with pytest.raises(InputError, match="at least one"):
        RangingSettings(average=0)
    with pytest.raises(ShapeError):
        pipeline.cloud(np.zeros((3, 3), np.float32))
