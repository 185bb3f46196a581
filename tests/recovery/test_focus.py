"""Depth-locked refocus: one shot of targets from 0.5 to 5 m, each recovered at the shear of its own
range.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from tofclip import Frames, depth, nmse, point_cloud
from tofclip.camera import Camera, Measurement, SkewSweep, measure
from tofclip.errors import CalibrationError, InputError, ShapeError
from tofclip.recovery import (
    DepthLockedFocus,
    FixedFocus,
    SharpestFocus,
    fit_parallax_to_shot,
    open_shot,
    parse_focus,
    recover,
)
from tofclip.recovery.focus import FrameSegment
from tofclip.recovery.plan import recover_segments
from tofclip.simulate import (
    Instrument,
    Scene,
    StreakDetector,
    make_plate,
    render_true_frames,
    simulate_shot,
)
from tofclip.simulate.bodies import Body
from tofclip.simulate.patterns import cut_pattern, make_letter, make_plain_pattern
from tofclip.solvers import Backprojection, Sparse, TotalVariation
from tofclip.units import SPEED_OF_LIGHT

BIN = 20e-12
FOCAL = 280.0
RANGES = (0.5, 0.9, 1.6, 2.8, 5.0)
PLACES = ((-20, -18), (20, -18), (0, 0), (-20, 18), (20, 18))
TANGENTS = np.array([-0.94, -0.48, -0.22, 0.01, 0.42, 0.77, 1.11])
CENTRES = 60.0 + 90 * np.arange(7)
METHOD = Sparse(iterations=40)


def camera(order: tuple[int, ...] = (3, 0, 5, 1, 6, 2, 4)) -> Camera:
    """Seven views, their angles by default in an order that makes ranges defocus."""
    return Camera(
        CENTRES,
        np.arctan(TANGENTS[list(order)]),
        (64, 64),
        660,
        sweep=SkewSweep(CENTRES, np.zeros(7), np.zeros(7)),
        time_zero=-2 * 0.4 / SPEED_OF_LIGHT,
        focal_length_px=FOCAL,
        lenslet_pitch=5e-3,
        focus_distance=1.6,
    )


def plate(name: str, place: tuple[int, int], distance: float) -> Body:
    pixel = distance / FOCAL
    pattern = cut_pattern(make_letter(name), make_plain_pattern(0.8))
    return make_plate(
        (place[0] * pixel, place[1] * pixel, distance), (18 * pixel, 18 * pixel), pattern
    )


SCENE = Scene(tuple(plate(n, p, d) for n, p, d in zip("UCLAU", PLACES, RANGES, strict=True)))


def instrument(made: Camera) -> Instrument:
    return Instrument(made, StreakDetector(1560, BIN, peak_photons=2e5, full_scale_photons=1e9))


def gate(distance: float, made: Camera) -> slice:
    row = round((2 * distance / SPEED_OF_LIGHT + made.time_zero) / BIN)
    return slice(row - 4, row + 9)


@pytest.fixture(scope="module")
def shot():
    return simulate_shot(SCENE, instrument(camera()), seed=0)


@pytest.fixture(scope="module")
def locked(shot) -> Frames:
    return recover(shot.streak, shot.camera, METHOD, focus=DepthLockedFocus())


def test_every_range_is_as_good_as_alone_and_the_ends_are_better_than_any_fixed_shear(shot, locked):
    made = shot.camera
    truth = render_true_frames(SCENE, instrument(made), shot.exposure).values
    measurements = measure(shot.streak.counts, None, made).values
    shears = np.linspace(-2.0, 0.5, 11)

    def error(frames: np.ndarray, distance: float) -> float:
        return nmse(frames.sum(axis=0), truth[gate(distance, made)].sum(axis=0))

    def alone(distance: float, shear: float) -> float:
        part = np.ascontiguousarray(measurements[:, gate(distance, made)])
        return error(METHOD.recover(made.operator(shear), part).frames, distance)

    found = {d: error(locked.values[gate(d, made)], d) for d in RANGES}
    fixed = np.array([[alone(d, s) for s in shears] for d in RANGES])
    best = fixed[:, fixed.mean(axis=0).argmin()]
    for distance in RANGES:
        assert found[distance] < 1.1 * alone(distance, float(made.shear_at(distance)))
    assert found[0.5] < best[0]
    assert found[5.0] < best[-1]


def test_pieces_cover_all_frames_within_the_tolerance(shot):
    made = shot.camera
    times = shot.streak.times - made.time_zero
    for tolerance in (0.1, 0.5):
        pieces = DepthLockedFocus(tolerance).plan_segments(
            made, times, measure(shot.streak.counts, None, made)
        )
        assert pieces[0].frames.start == 0
        assert pieces[-1].frames.stop == times.size
        assert all(a.frames.stop == b.frames.start for a, b in pairwise(pieces))
        used = np.repeat([p.shear for p in pieces], [p.size for p in pieces])
        # three steps to the outermost view
        wrong = np.abs(used - made.shear_at(SPEED_OF_LIGHT * times / 2)) * 3
        # a piece spans twice the tolerance; its mean may lie off its middle
        assert wrong.max() < 2 * tolerance
        assert np.median(wrong) < tolerance
    assert np.all(np.diff([piece.brightness for piece in pieces]) < 0)


def test_frames_remember_their_shears(locked, shot, tmp_path):
    expected = shot.camera.shear_at(SPEED_OF_LIGHT * locked.times / 2)
    np.testing.assert_allclose(locked.shears, expected, atol=0.17)
    locked.save(tmp_path / "frames.h5")
    stored = Frames.load(tmp_path / "frames.h5")
    np.testing.assert_array_equal(stored.shears, locked.shears)
    assert (stored.camera.lenslet_pitch, stored.camera.focus_distance) == (5e-3, 1.6)
    assert stored.figures["focus"] == "depth-locked"
    with pytest.raises(ShapeError, match="shears"):
        replace(locked, shears=np.zeros(3))


@pytest.mark.parametrize("focus", [FixedFocus(), DepthLockedFocus()])
def test_heights_come_out_true_in_the_depth_of_field_arrangement(focus):
    shot = simulate_shot(SCENE, instrument(camera(order=(0, 1, 2, 3, 4, 5, 6))), seed=0)
    frames = recover(shot.streak, shot.camera, METHOD, focus=focus)
    returns = depth(frames)
    cloud, as_seen = (
        point_cloud(returns),
        point_cloud(depth(frames, shot.camera.replace(lenslet_pitch=0.0))),
    )
    nearest = np.abs(cloud.range - 0.5) < 0.05
    height = np.median(cloud.xyz[nearest, 1]) * FOCAL / 0.5
    seen = np.median(as_seen.xyz[nearest, 1]) * FOCAL / 0.5
    # the median height of the letter U's surface lies 1 px below its middle; noise and defocus cost
    # a pixel
    assert height == pytest.approx(-17, abs=2)
    assert np.abs(seen - height) > 4 if focus == FixedFocus() else np.abs(seen - height) < 0.5


def test_a_stack_finds_the_shears_that_the_ranges_ask_for(shot):
    made = shot.camera.replace(lenslet_pitch=0.0)
    part = replace(
        shot.streak,
        counts=shot.streak.counts[:128],
        row_times=shot.streak.row_times[:128],
        saturated=None,
    )
    frames = recover(part, made, Backprojection(), focus=SharpestFocus(-2.5, 0.5, 7))
    assert frames.figures["focus"] == "stack:-2.5:0.5:7"
    # the target at 0.5 m lies in the first gate; light of the one at 0.9 m arrives later than both
    assert frames.shears[33] == pytest.approx(float(shot.camera.shear_at(0.5)), abs=0.2)


def test_the_parallax_is_found_from_the_shot(shot):
    unknown = shot.camera.replace(lenslet_pitch=0.0, focus_distance=np.inf)
    done = []
    found = fit_parallax_to_shot(open_shot(shot.streak, unknown), 5, (-2.4, 0.9, 6), done.append)
    strength = FOCAL * 5e-3
    assert found.parallax.strength == pytest.approx(strength, rel=0.1)
    for distance in (0.5, 5.0):
        assert float(found.camera.shear_at(distance)) == pytest.approx(
            float(shot.camera.shear_at(distance)), abs=0.2
        )
    assert sum(done) == 6 * 30 * shot.streak.counts.shape[0]


def test_names_of_foci():
    assert parse_focus("depth-locked") == DepthLockedFocus()
    assert parse_focus("fixed:-0.5") == FixedFocus(-0.5)
    assert parse_focus("stack:-2:1:7") == SharpestFocus(-2.0, 1.0, 7)
    for text in (
        "",
        "fixed",
        "fixed:a",
        "fixed:nan",
        "stack:0:1",
        "stack:1:0:3",
        "stack:0:1:1",
        "depth-locked:1",
    ):
        with pytest.raises(InputError, match=r"focus|shear"):
            parse_focus(text)
    with pytest.raises(InputError, match="tolerance"):
        DepthLockedFocus(0.0)


def test_what_the_camera_does_not_know_is_said(shot):
    with pytest.raises(CalibrationError, match="lenslet pitch"):
        recover(shot.streak, shot.camera.replace(lenslet_pitch=0.0), focus=DepthLockedFocus())
    with pytest.raises(CalibrationError, match="time zero"):
        fit_parallax_to_shot(open_shot(shot.streak, shot.camera, time_zero=1e-9), 5, (-1.0, 1.0, 3))
    with pytest.raises(InputError, match="gates"):
        fit_parallax_to_shot(open_shot(shot.streak, shot.camera), 2, (-1.0, 1.0, 3))


@pytest.mark.parametrize("method", [Sparse(1e-2, 30, gap=0.0), TotalVariation(1e-2, 30, gap=0.0)])
def test_pieces_weigh_a_prior_as_the_whole_shot_does(method):
    """A weight is relative to the brightest frame of what a solver is given; a piece has another."""
    camera = Camera([16.0, 40.0, 64.0], [-0.6, 0.1, 0.7], (12, 12), 80)
    pictures = np.random.default_rng(0).random((12, 12, 10)) ** 4
    pictures[..., :5] *= 30
    values = camera.operator(0.3)(pictures.astype(np.float32))
    measurement = Measurement(values, np.ones(values.shape, bool))
    whole, parts = (
        recover_segments(method, camera, measurement, [FrameSegment(one, 0.3) for one in pieces])
        for pieces in ([slice(0, 10)], [slice(0, 5), slice(5, 10)])
    )
    np.testing.assert_allclose(parts.frames, whole.frames, atol=1e-4 * whole.frames.max())
    dim = whole.frames[5:]
    np.testing.assert_allclose(parts.frames[5:], dim, atol=1e-2 * dim.max())
