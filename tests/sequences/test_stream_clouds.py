"""Shots to clouds while they come, against the same shots one by one; each shot begun at the last; and
histograms that come live: sums of what drifts are true, and so are gates in coarse steps.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Event
from time import monotonic, sleep

import numpy as np
import pytest
from scipy.special import ndtr

from devices.frames import GatedOptions
from devices.transients import _make_gate_response
from tofclip.camera import Camera, SkewSweep
from tofclip.errors import InputError
from tofclip.lidar import Pulse, depth, point_cloud
from tofclip.lidar.photons import PhotonCube
from tofclip.lidar.pulse import TraceBins
from tofclip.recovery import DepthLockedFocus, recover
from tofclip.sequences import make_pipeline
from tofclip.sequences.ranger import RangingPipeline, SurfacePipeline, WarmStartedRecovery
from tofclip.sequences.streaming import stream_clouds
from tofclip.shots import Streak
from tofclip.simulate import Instrument, Scene, StreakDetector, make_plate, simulate_shot
from tofclip.simulate.patterns import make_plain_pattern
from tofclip.solvers import Sparse
from tofclip.units import SPEED_OF_LIGHT

CENTRES = 30.0 + 45 * np.arange(4)


def shots(number):
    """Plates that come nearer from shot to shot."""
    angles, still = np.arctan([0.6, -0.7, 0.3, -0.1]), SkewSweep(CENTRES, np.zeros(4), np.zeros(4))
    times = {"time_zero": -6e-9, "pulse_fwhm": 150e-12}
    camera = Camera(CENTRES, angles, (24, 24), 200, sweep=still, **times)
    made = Instrument(camera, StreakDetector(96, 50e-12, peak_photons=5e4))

    def see(shot):
        at, plain = (0.0, 0.0, 1.4 - 0.05 * shot), make_plain_pattern(0.8)
        return simulate_shot(Scene((make_plate(at, (0.05, 0.05), plain),)), made, shot).streak

    return [see(shot) for shot in range(number)]


def test_a_stream_gives_the_clouds_of_its_shots():
    made = shots(4)
    streamed = list(stream_clouds(made, RangingPipeline.for_shot(made[0])))
    assert [one.shot for one in streamed] == [0, 1, 2, 3]
    for one, shot in zip(streamed, made, strict=True):
        alone = point_cloud(depth(recover(shot, method="linear")))
        assert len(one.cloud) == len(alone) > 100
        # the same inverse, summed in another order: float32 keeps 1e-6 of 1.4 m
        np.testing.assert_allclose(one.cloud.range, alone.range, atol=2e-5)
        np.testing.assert_allclose(one.cloud.intensity, alone.intensity, rtol=1e-3)
        assert one.latency > 0
        assert set(one.seconds) == {"read", "wait", "rectify", "recover", "range", "place"}
        # what was not work was waiting; the source's own time is no latency
        assert sum(one.seconds.values()) == pytest.approx(one.latency + one.seconds["read"])
    medians = [np.median(one.cloud.range) for one in streamed]
    np.testing.assert_allclose(np.diff(medians), -0.05, atol=2e-3)


def test_what_columns_have_at_all_times_changes_no_cloud():
    """Of 5e4 photons at the brightest, ambient light has as many as a fifth, and its noise alone is left."""
    made = shots(2)
    ambient = 5e3 * (1 + np.sin(np.arange(200) / 9))
    random = np.random.default_rng(0)
    lit = [
        replace(one, counts=one.counts + random.poisson(ambient, one.counts.shape)) for one in made
    ]
    for one, other in zip(stream_clouds(made), stream_clouds(lit), strict=True):
        assert len(other.cloud) == pytest.approx(len(one.cloud), rel=0.05)
        assert np.median(other.cloud.range) == pytest.approx(np.median(one.cloud.range), abs=1e-3)


def test_measurements_are_averaged_as_far_as_nothing_changes():
    first, last = shots(2)
    random, dim = np.random.default_rng(0), 3e-3  # 150 photons at the peak
    seen = [
        replace(first, counts=random.poisson(dim * expected + 1.0).astype(np.float32))
        for expected in [first.counts] * 7 + [last.counts]
    ]
    pipeline = make_pipeline(seen[0], average=4)
    made = [pipeline.change(shot).counts for shot in seen]
    moved = dim * abs(last.counts - first.counts)
    lit = dim * first.counts > 5
    noise = [np.mean((one - dim * first.counts - 1)[lit] ** 2) for one in (seen[6].counts, made[6])]
    # three or four shots: two hundred lit measurements know a variance to a tenth
    assert noise[1] == pytest.approx(noise[0] / 3.5, rel=0.3)
    # the plate is seven rows nearer: where it was and where it is, the last shot alone counts
    off, photons = made[7] - dim * last.counts - 1, dim * last.counts + 1
    assert np.mean(off[moved > 10] ** 2) == pytest.approx(np.mean(photons[moved > 10]), rel=0.3)


def test_a_prior_begins_at_the_last_shot_and_leaves_rays_out():
    made = shots(1) * 3
    inverse = RangingPipeline(made[0].camera, made[0].times)
    linear = next(stream_clouds(made, inverse))
    pipelines = [RangingPipeline(made[0].camera, made[0].times, Sparse()) for _ in "12"]
    one, other = (list(stream_clouds(made, pipeline)) for pipeline in pipelines)
    for mine, again in zip(one, other, strict=True):
        np.testing.assert_array_equal(mine.cloud.xyz, again.cloud.xyz)
    # the plate is 0.8 of a picture of 24 x 24 wide; the linear inverse smears it over its rays
    assert 100 < len(one[-1].cloud) < 0.8 * len(linear.cloud)
    # the first shot had forty iterations: twelve more leave it where it was, to a tenth of a percent
    assert len(one[-1].cloud) == pytest.approx(len(one[0].cloud), rel=0.05)
    # of a plate at the focal distance rows of many shears show as much
    optics = {"focal_length_px": 100.0, "lenslet_pitch": 2e-3, "focus_distance": 1.3}
    known = made[0].camera.replace(**optics)
    sheared = RangingPipeline(known, made[0].times, Sparse(), DepthLockedFocus())
    clouds = [made_of.cloud for made_of in stream_clouds(made, sheared)]
    assert len(clouds[-1]) == pytest.approx(len(one[-1].cloud), rel=0.2)


def test_surfaces_follow_those_of_the_last_shot_until_the_scene_changes(streaks, camera, see):
    other = see(camera, side_px=14)
    pipeline = SurfacePipeline.for_shot(streaks[0])
    clouds = [one.cloud for one in stream_clouds([*streaks[:3], other], pipeline)]
    assert pipeline.searches == 2
    alone = recover(streaks[2], method="surfaces").returns
    # plates of 81 pixels: of their rims some pixels more or less
    assert len(clouds[2]) == pytest.approx(len(alone), rel=0.1)
    near = clouds[2].range < 1.3
    expected = alone.range[alone.range < 1.3]
    # a tenth of a bin of 50 ps; the noise of another shot moves a surface by less
    assert np.median(clouds[2].range[near]) == pytest.approx(np.median(expected), abs=7e-4)
    assert np.median(clouds[3].range) == pytest.approx(1.3, abs=5e-3)


def test_a_stream_of_rows_far_shorter_than_the_pulse_shows_what_its_shots_show(camera):
    """A frame of a tenth of a pulse's time holds hardly any light: rows are added up."""
    scene = Scene((make_plate((0.0, 0.0, 1.3), (0.18, 0.18), make_plain_pattern(0.8)),))
    made = Instrument(camera, StreakDetector(420, 15e-12, peak_photons=2e3))
    first, second = (simulate_shot(scene, made, seed).streak for seed in range(2))
    alone = recover(first, method="surfaces").returns
    pipeline = SurfacePipeline.for_shot(first)
    found = follow(pipeline, first)
    # the same surfaces, of which a stream leaves out what is more likely false than there
    assert len(alone) >= len(found) > 0.9 * len(alone) > 100
    own = {(y, x): r for y, x, r in zip(alone.y, alone.x, alone.range, strict=True)}
    assert all(own[y, x] == r for y, x, r in zip(found.y, found.x, found.range, strict=True))
    # a camera's sweep counts the rows of the shots
    assert found.camera.sweep == alone.camera.sweep == camera.sweep
    later = follow(pipeline, second)
    assert pipeline.searches == 1
    assert len(later) == pytest.approx(len(found), rel=0.05)
    assert np.median(later.range) == pytest.approx(np.median(found.range), abs=7e-4)


class CountingExecutor(ThreadPoolExecutor):
    """One worker, which begins when it is told to; counts what it holds at most."""

    def __init__(self):
        super().__init__(1)
        self.held = self.most = 0
        self.begin = Event()
        super().submit(self.begin.wait)

    def submit(self, *work, **options):  # type: ignore[no-untyped-def]
        self.held += 1
        self.most = max(self.most, self.held)
        future = super().submit(*work, **options)
        future.add_done_callback(self.count_down)
        return future

    def await_most(self, number):
        """Wait until so many were held, five seconds at most."""
        deadline = monotonic() + 5
        while self.most < number and monotonic() < deadline:
            sleep(0.01)

    def count_down(self, _):
        self.held -= 1


@pytest.mark.parametrize(("policy", "most"), [("block", 3), ("drop_oldest", 2)])
def test_no_shot_grows_old_behind_others_where_the_newest_is_wanted(policy, most, monkeypatch):
    monkeypatch.setenv("TOFCLIP_THREADS", "2")
    made = shots(1)
    with CountingExecutor() as executor:

        def source():
            for number in range(6):
                yield made[0]
                if number + 1 == most:
                    executor.await_most(most)
                    if policy == "block":  # the next one waits for room
                        executor.begin.set()
                sleep(0.02)  # the dispatcher takes what it has room for
            executor.begin.set()

        clouds = list(stream_clouds(source(), executor=executor, policy=policy))
    assert executor.most == most
    assert clouds[-1].shot == 5


def test_no_shot_is_no_cloud_and_faults_come_through():
    assert list(stream_clouds([])) == []
    made = shots(1)
    dark = Streak(np.full((96, 200), 3.0), made[0].times)
    with pytest.raises(InputError, match="above the dark level"):
        list(stream_clouds([made[0], dark], RangingPipeline.for_shot(made[0])))


def follow(pipeline, shot):
    return pipeline.search(pipeline.recover(pipeline.rectify(shot)))


def test_light_that_is_clipped_in_a_later_shot_alone_changes_nothing(streaks):
    """Each shot says itself which of its measurements are to be trusted."""
    limit = 0.2 * streaks[1].counts.max()
    saturated = streaks[1].counts > limit
    assert 0.005 < saturated.mean() < 0.1
    clipped = replace(streaks[1], counts=np.minimum(streaks[1].counts, limit), saturated=saturated)
    found = []
    for shot in (streaks[1], clipped):
        pipeline = SurfacePipeline.for_shot(streaks[0])
        follow(pipeline, streaks[0])
        found.append(follow(pipeline, shot))
        assert pipeline.searches == 1
    (whole, range_), (light, clipped_light) = (
        [one.image(name) for one in found] for name in ("range", "intensity")
    )
    both = np.isfinite(whole) & np.isfinite(range_)
    assert both.sum() >= np.isfinite(whole).sum() - 1 > 100  # one is at the limit
    # A tenth of a bin of 50 ps, and 1.3 mm at a surface's rim, of which more is kept by evidence than by
    # brightness: 0.14 of its light; taken for measurements, clipped light lacks up to a half.
    off = np.abs(range_[both] - whole[both])
    assert np.quantile(off, 0.95) < 7e-4
    assert off.max() < 1.5e-3
    less = np.abs(clipped_light[both] / light[both] - 1)
    assert np.quantile(less, 0.95) < 0.16
    assert less.max() < 0.25


def test_a_scene_that_changes_slowly_is_searched_anew(streaks, camera, see):
    """A plate that comes up brighter from shot to shot: what the surfaces leave unexplained is
    compared with what they left when they were found, or it would never have grown by much.
    """
    coming = see(camera, side_px=9)
    pipeline = SurfacePipeline.for_shot(streaks[0])
    for brightness, searches in ((0.0, 1), (0.02, 1), (0.04, 2)):
        counts = streaks[0].counts + np.float32(brightness) * coming.counts
        follow(pipeline, replace(streaks[0], counts=counts))
        assert pipeline.searches == searches


def test_a_row_begins_at_its_own_picture_whatever_rows_were_lit_before():
    """Nothing moves and there is no noise: a row that goes on from its own picture stays there,
    whichever rows have come and gone around it.
    """
    camera = Camera([16.0, 40.0, 64.0], [-0.6, 0.1, 0.7], (12, 12), 80)
    random = np.random.default_rng(0)
    scene = np.where(random.random((12, 12, 9)) < 0.1, 1.0, 0.0).astype(np.float32)
    operator = camera.operator()
    seen = operator(scene)
    method = Sparse(iterations=600, gap=0.0)
    recovery = WarmStartedRecovery(method, [(slice(0, 999), operator)], ~camera.dead_columns)

    def recover(*rows):
        bins = TraceBins(np.array(rows), np.ones(len(rows), bool), np.ones(len(rows), np.float32))
        traces = recovery.recover(seen[:, rows], bins)
        pictures = np.empty((traces.pixels.size, len(rows)), np.float32)
        traces.fill(slice(None), pictures)
        return dict(zip(rows, pictures.T, strict=True))

    last = recover(0, 1, 2, 4, 5, 6)
    # another number of rows, then as many others
    for rows, new in (((1, 3, 5, 6, 8), 3), ((3, 5, 6, 7, 8), 7)):
        found = recover(*rows)
        last = {row: picture for row, picture in last.items() if row in rows}
        for row, picture in last.items():
            assert np.linalg.norm(found[row] - picture) < 0.01 * np.linalg.norm(picture)
        # twelve iterations from darkness, or from another row's picture, are far from it
        truth = scene[..., new].ravel()
        assert np.linalg.norm(found[new] - truth) > 0.3 * np.linalg.norm(truth)


ROWS, COLUMNS = np.indices((32, 32))
BIN, SIGMA = 250e-12, 300e-12  # s


def take_shot(ranges, signal, seed):
    edges = BIN * np.arange(129)[:, np.newaxis, np.newaxis]
    light = signal * np.diff(ndtr((edges - 2 * ranges / SPEED_OF_LIGHT) / SIGMA), axis=0) + 0.02
    times = BIN * (np.arange(128) + 0.5)
    counts = np.random.default_rng(seed).poisson(light)
    return PhotonCube(counts, times, pulse=Pulse.gaussian(SIGMA * np.sqrt(8 * np.log(2))))


def compute_z(found, truth):
    ratio = (found.range - truth[found.y, found.x]) / found.confidence
    return float(np.sqrt(np.mean(np.clip(ratio, -6, 6) ** 2)))


@pytest.mark.parametrize(
    ("signal", "speed_mm"), [(200.0, 0.0), (20.0, 1.0), (200.0, 1.0), (20.0, 10.0), (200.0, 10.0)]
)
def test_what_drifts_is_where_it_is_now(signal, speed_mm):
    """Sums of 16 shots were late by 2 to 17 deviations. 16 clouds of 1000 pixels, which share what
    they say of the speed: z scatters by 0.05.
    """
    pipeline, z, sigma = None, [], []
    for number in range(24):
        ranges = 2 + 0.01 * COLUMNS + 0.005 * ROWS + 1e-3 * speed_mm * number
        shot = take_shot(ranges, signal, [number, 5])
        pipeline = pipeline or make_pipeline(shot)
        found = follow(pipeline, shot)
        assert len(found.range) > 1000
        z.append(compute_z(found, ranges))
        sigma.append(np.median(found.confidence))
    assert 0.85 < np.mean(z[8:]) < 1.2
    assert speed_mm > 1 or np.mean(sigma[8:]) < 0.35 * sigma[0]


@pytest.mark.parametrize(("step_ps", "width_ns"), [(100, 3), (640, 3), (1500, 5)])
@pytest.mark.parametrize("photons", [20.0, 2000.0])
def test_gates_in_coarse_steps_say_what_they_do_not_see(step_ps, width_ns, photons):
    """At steps of 96 mm a millimetre was said of errors of 14; and light that every pixel sees long
    was taken for background.
    """
    scan = {"gate_steps": int(20e3 // step_ps), "gate_step_ps": step_ps, "gate_width_ns": width_ns}
    gate = GatedOptions(mode="gated", gate_offset_ps=3000.0, **scan)
    delays = 6e-9 + 137e-12 * COLUMNS + 83e-12 * ROWS
    late = (delays - gate.opening_times[:, np.newaxis, np.newaxis]) / 1e-10
    light = photons * (ndtr(late) - ndtr(late - width_ns * 10)) + 0.004 * photons * width_ns
    counts = np.random.default_rng(0).poisson(light)
    pulse = _make_gate_response(gate.gate_record, gate.opening_times)
    shot = PhotonCube(counts, gate.opening_times, pulse=pulse, sampled=True)
    found = follow(make_pipeline(shot), shot)
    assert len(found.range) > 1000
    assert 0.7 < compute_z(found, delays * SPEED_OF_LIGHT / 2) < 1.3
