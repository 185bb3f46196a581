"""Sequences of shots whose jitter, noise and interruptions are known."""

import tracemalloc
from functools import partial
from itertools import pairwise

import h5py
import numpy as np
import pytest

from tofclip import Streak
from tofclip.errors import FileFormatError, InputError, ShapeError, StorageError
from tofclip.io.streaks import StreakStack, save_stack
from tofclip.recovery import DepthLockedFocus
from tofclip.sequences.ranger import RangingPipeline
from tofclip.sequences.recovering import (
    JitterEstimator,
    compute_light_curve,
    make_average_cloud,
)
from tofclip.threads import map_parallel
from tofclip.units import SPEED_OF_LIGHT

BIN, ROWS = 50e-12, 128
BIN_M = SPEED_OF_LIGHT * BIN / 2


@pytest.fixture(scope="module")
def shot(camera, see):
    """Make a shot that comes some rows late."""

    def make(late_bin=0.0, seed=0, peak=5e4):
        return see(camera.replace(time_zero=-6e-9 + late_bin * BIN), seed, peak)

    return make


@pytest.fixture(scope="module")
def pipeline(camera):
    return RangingPipeline(camera, np.arange(ROWS) * BIN, focus=DepthLockedFocus())


def make_clouds(shots, pipeline, average=1, steady=True, first=0):
    """Clouds of successive shots and their delays, as the jobs of `RangingSettings` make them."""
    jitter = JitterEstimator(compute_light_curve(shots[0](), pipeline.camera)) if steady else None
    starts = range(first * average, len(shots), average)
    yield from map_parallel(
        lambda start: make_average_cloud(shots[start : start + average], pipeline, jitter), starts
    )


def nearest(cloud):
    return cloud.range[cloud.range < 1.3]


def test_jitter_is_found_and_taken_off(shot, pipeline):
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


def test_averaging_lowers_the_noise_and_a_sequence_goes_on_where_it_stopped(shot, pipeline):
    shots = [partial(shot, 0.0, seed, 60.0) for seed in range(10)]

    def change(*clouds):
        """Median over the pixels that see something near in both."""
        ranges = []
        for cloud in clouds:
            near = cloud.xyz[cloud.range < 1.3]
            seen = np.round(100 * near[:, :2] / near[:, 2:]).astype(int)
            ranges.append(dict(zip(map(tuple, seen.tolist()), nearest(cloud), strict=True)))
        one, other = ranges
        return float(np.median([abs(one[pixel] - other[pixel]) for pixel in one.keys() & other]))

    alone = [cloud for cloud, _ in make_clouds(shots, pipeline)]
    averaged = list(make_clouds(shots, pipeline, average=4))
    assert [len(delays) for _, delays in averaged] == [4, 4, 2]
    usual = np.mean([change(one, other) for one, other in pairwise(alone)])
    # noise changes half as much; how late a shot is found to be is averaged as well
    assert change(averaged[0][0], averaged[1][0]) < 0.7 * usual
    ((resumed, _),) = make_clouds(shots, pipeline, average=4, first=2)
    np.testing.assert_array_equal(resumed.xyz, averaged[2][0].xyz)


def test_memory_does_not_grow_with_the_sequence(shot, pipeline, tmp_path):
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


def test_jitter_beyond_reach_stays_at_its_end(shot, camera):
    light = np.zeros(200)
    light[50:60] = 1
    assert JitterEstimator(light).late_bin(np.roll(light, 32)) == 32
    assert JitterEstimator(light).late_bin(light) == pytest.approx(0, abs=1e-6)
    assert compute_light_curve(shot(), camera).shape == (ROWS,)


def test_stacks_hold_their_shots(shot, tmp_path):
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
        save_stack([made[0], Streak(made[1].counts[:5])], path)
    assert len(StreakStack(path)) == 2  # what was there stays
    with pytest.raises(InputError, match="no shot"):
        save_stack([], tmp_path / "none.h5")
    with pytest.raises(StorageError):
        StreakStack(tmp_path / "absent.h5")


def test_other_files_are_no_stacks(tmp_path):
    (tmp_path / "text.h5").write_text("no HDF5")
    for name in ("bare", "flat"):
        with h5py.File(tmp_path / f"{name}.h5", "w") as file:
            file["counts" if name == "flat" else "other"] = np.zeros((3, 4))
    for name in ("text", "bare", "flat"):
        with pytest.raises(FileFormatError):
            StreakStack(tmp_path / f"{name}.h5")


def test_unusable_sequences_are_refused(pipeline):
    with pytest.raises(InputError, match="at least one"):
        make_average_cloud([], pipeline, None)
    with pytest.raises(ShapeError):
        pipeline.cloud(np.zeros((3, 3), np.float32))
