"""Which shots are shots of surfaces, and which stay with frames: smoke, light in flight, relay walls."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tofclip import recover
from tofclip.camera import Camera, SkewSweep
from tofclip.errors import InputError
from tofclip.recovery import (
    FixedFocus,
    SurfaceRecovery,
    make_method,
    open_shot,
    plan_recovery,
)
from tofclip.recovery.surfaces.start import measure_slopes
from tofclip.shots import Streak
from tofclip.solvers import Sparse
from tofclip.units import SPEED_OF_LIGHT

SHAPE, ROWS, BIN = (40, 40), 200, 20e-12
PULSE_ROWS = 60e-12 / BIN / np.sqrt(8 * np.log(2))
FOCAL_PX, WALL_M, FIRST_S = 180.0, 1.2, 7e-9
CENTRES = 40.0 + 54 * np.arange(7)
CAMERA = Camera(
    CENTRES,
    np.radians([-43.3, -25.7, -12.7, 0.6, 22.9, 37.5, 48.0]),
    SHAPE,
    400,
    sweep=SkewSweep(CENTRES, np.zeros(7), np.zeros(7)),
    time_zero=-FIRST_S,
    focal_length_px=FOCAL_PX,
)
Y, X = np.indices(SHAPE) - np.array(SHAPE)[:, None, None] // 2
SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in range(1, 10))]
METHOD = SurfaceRecovery(iterations=3, start=Sparse(iterations=15))


def expose(arrivals: list, photons: float, seed: int) -> Streak:
    """A streak image of light that reaches pixels at some times, s, with some brightnesses."""
    frames = np.zeros((ROWS, *SHAPE))
    rows = np.arange(ROWS)[:, None, None]
    for time, light in arrivals:
        place = (time - FIRST_S) / BIN
        frames += light * np.exp(-(((rows - place) / PULSE_ROWS) ** 2) / 2)
    pictures = np.ascontiguousarray(np.moveaxis(frames, 0, -1).astype(np.float32))
    slit = CAMERA.operator()(pictures).T
    counts = np.random.default_rng(seed).poisson(photons * slit / slit.max() + 1.0)
    return Streak(counts.astype(np.float32), np.arange(ROWS) * BIN, camera=CAMERA)


def relay_wall(seed: int) -> list:
    """A bright letter and a plate beside it, hidden, as a wall shows them by their third bounce."""
    random = np.random.default_rng(100 + seed)
    wall = np.stack([X, Y, np.full(SHAPE, FOCAL_PX)], -1) * WALL_M / FOCAL_PX
    there = np.linalg.norm(wall, axis=-1)
    far = 0.25 + 0.15 * random.random()
    letter = [(0.5 * t, 0.25 * side, far) for t in np.linspace(-0.5, 0.5, 24) for side in (-1, 1)]
    bar = [(0.5 * t, 0.5 * t, far) for t in np.linspace(-0.5, 0.5, 24)]
    plate = [(0.4 + 0.2 * u, 0.3 * v, far + 0.2) for u, v in random.random((60, 2)) - 0.5]
    arrivals = []
    for x, y, depth_m in (*letter, *bar, *plate):
        hidden = np.array([x, y, WALL_M - depth_m])
        first = np.linalg.norm(hidden - [0.0, 0.0, WALL_M])
        second = np.linalg.norm(wall - hidden, axis=-1)
        arrivals.append(((first + second + there + WALL_M) / SPEED_OF_LIGHT, 1 / second**2))
    return arrivals


def smoke(seed: int) -> list:
    """A cloud from which light comes back from half a metre of depth."""
    random = np.random.default_rng(200 + seed)
    middle = random.uniform(-8, 8, 2)
    thick = np.exp(-((X - middle[0]) ** 2 + (Y - middle[1]) ** 2) / 150)
    starts = np.linspace(8e-9, 8e-9 + random.uniform(2e-9, 3e-9), 120)
    return [(start, thick * np.exp(-k / 60)) for k, start in enumerate(starts)]


def light_in_flight(seed: int) -> list:
    """A flash that crosses a scattering liquid, which goes on glowing for a while behind it."""
    random = np.random.default_rng(300 + seed)
    slope = random.uniform(-0.3, 0.3)
    front = 8.3e-9 + (X + slope * Y) * 30e-12
    delays = np.arange(60) * 15e-12
    beam = np.exp(-((Y / 12) ** 2))
    return [(front + late, beam * np.exp(-late / random.uniform(2e-10, 4e-10))) for late in delays]


def plates(seed: int, slant: float = 0.0) -> list:
    random = np.random.default_rng(seed)
    wall = 1.5 + slant * X / 40
    y, x = random.integers(-12, 8, 2)
    plate = (np.abs(X - x) < 7) & (np.abs(Y - y) < 8)
    distance = np.where(plate, 1.25, wall)
    bright = np.where((X // 5 + Y // 5) % 2 == 0, 1.0, 0.5) * np.where(plate, 1.5, 1.0)
    return [(2 * distance / SPEED_OF_LIGHT, bright)]


def gauze(seed: int) -> list:
    """Two layers: both are seen by every pixel."""
    bright = 0.6 + 0.4 * ((X // 6 + seed) % 2)
    return [
        (2 * np.full(SHAPE, 1.25) / SPEED_OF_LIGHT, 0.5 * (np.abs(X) < 14) * (np.abs(Y) < 14)),
        (2 * np.full(SHAPE, 1.6) / SPEED_OF_LIGHT, bright),
    ]


def test_slopes_are_those_of_planes_and_steps_are_none() -> None:
    y, x = np.indices((30, 40))
    distance = 1.5 + 0.02 * x - 0.01 * y
    distance[:, 20:] += 0.5
    distance[4:6, 4:9] = np.nan
    slope, scatter = measure_slopes(distance.astype(np.float32))
    np.testing.assert_allclose(slope[5:25, 5:15], np.hypot(0.02, 0.01), rtol=1e-4)
    assert scatter[5:25, 5:15].max() < 1e-4
    # half a metre within a window of 7 pixels: three windows beside the step look like a slope
    assert np.mean((slope > 0.03)[15] & (scatter < slope)[15]) <= 4 / 40


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("make", [relay_wall, smoke, light_in_flight])
def test_light_that_is_not_on_surfaces_is_refused(make, seed: int) -> None:
    plan = plan_recovery(open_shot(expose(make(seed), 300, seed)), METHOD)
    with pytest.raises(InputError, match=r'not on surfaces.*choose `method="tv"`'):
        plan.run()


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    ("make", "photons"),
    [
        (plates, 300),
        (plates, 50),
        (lambda seed: plates(seed, 0.15), 50),
        (gauze, 300),
        pytest.param(gauze, 50, marks=pytest.mark.nightly),
    ],
    ids=["plates", "few photons", "slanted", "gauze", "gauze, few photons"],
)
def test_surfaces_are_not_refused(make, seed: int, photons: float) -> None:
    frames = plan_recovery(open_shot(expose(make(seed), photons, seed)), METHOD).run()
    assert frames.figures["surfaces"] >= 2
    assert len(frames.returns) > 1000


def test_a_gauze_that_is_nowhere_the_brightest_is_found() -> None:
    frames = plan_recovery(open_shot(expose(gauze(0), 300, 0)), METHOD).run()
    near = np.abs(frames.returns.range - 1.25) < 5e-3
    inside = (np.abs(X) < 12) & (np.abs(Y) < 12)
    seen = np.zeros(SHAPE, bool)
    seen[frames.returns.y[near], frames.returns.x[near]] = True
    assert seen[inside].mean() > 0.95
    behind = np.zeros(SHAPE, bool)
    behind[frames.returns.y[~near], frames.returns.x[~near]] = True
    assert behind[inside].mean() > 0.95


def test_a_pulse_with_a_tail_is_measured_and_explained() -> None:
    """A phosphor's afterglow: a tenth of the light comes half a nanosecond later and fades."""
    (time, bright), *_ = plates(0)
    decay = 3e-10
    delays = np.arange(100) * 15e-12
    tail = [(time + late, 0.012 * bright * np.exp(-late / decay)) for late in delays]
    frames = plan_recovery(open_shot(expose([(time, bright), *tail], 2_000, 0)), METHOD).run()
    light = frames.values.sum(axis=0)
    row = frames.returns.image("time") / BIN - frames.times[0] / BIN
    behind = np.arange(len(frames.values))[:, np.newaxis, np.newaxis] - row > 4
    late = np.nansum(np.where(behind, frames.values, 0)) / light[np.isfinite(row)].sum()
    expected = 0.012 * np.exp(-delays[delays > 4.5 * BIN] / decay).sum()
    expected /= 1 + 0.012 * np.exp(-delays / decay).sum()
    assert late == pytest.approx(expected, rel=0.3)
    assert frames.figures["relative_residual"] < 0.1
    error = frames.returns.image("range") - time * SPEED_OF_LIGHT / 2
    assert abs(np.nanmedian(error)) < 1e-3


def test_what_is_not_of_surfaces_is_recovered_as_frames_unless_asked_otherwise() -> None:
    """By default: the same frames as by tv, and the reason; a surface's frames are its rendering."""
    dark = expose(relay_wall(0), 200, 0)
    found, frames = recover(dark), recover(dark, method="tv")
    assert (found.figures["method"], found.returns) == ("tv", None)
    assert str(found.figures["why_no_surfaces"]).endswith("long after its peak")
    assert np.array_equal(found.values, frames.values)
    focused = recover(dark, focus=FixedFocus(0.5))
    assert "focus" in str(focused.figures["why_no_surfaces"])
    assert make_method("auto", iterations=7) == make_method("tv", iterations=7)
    plate = recover(expose([(8.2e-9, np.ones(SHAPE))], 500, 0))
    assert plate.figures["method"] == "surfaces"
    assert "why_no_surfaces" not in plate.figures


def test_recorded_relay_walls_stay_frames(shared_data: Path) -> None:
    """Their records say that they are walls, so that nothing is tried on them."""
    plan = plan_recovery(open_shot(shared_data / "lift" / "nlos_LetterN.npz"))
    few = replace(plan, method=replace(plan.method, otherwise=Sparse(iterations=2)))
    assert few.run().figures["why_no_surfaces"] == "the light is that of a relay wall"


LATE_LIGHT = "0.16 of its light comes late, where an instrument's afterglow may have 0.18"


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("LetterN", marks=pytest.mark.xfail(reason=LATE_LIGHT, strict=True)),
        "LetterVI",
        "Circle_Square",
    ],
)
@pytest.mark.nightly
def test_recorded_relay_walls_are_refused(shared_data: Path, name: str) -> None:
    """By their light alone, without the record that they are walls."""
    shot = open_shot(shared_data / "lift" / f"nlos_{name}.npz")
    plan = plan_recovery(shot, SurfaceRecovery(start=Sparse(iterations=15)))
    with pytest.raises(InputError, match="not on surfaces"):
        plan.run()
