"""Surfaces beside frames (ours; the paper has no such figures): the demonstration over seeds, and
three scenes that are harder, at three amounts of light.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from apps.studies.cases import Advance, Library, Outcome, Panel, Row, study
from tofclip.arrays import Float32Array
from tofclip.camera import Camera, SkewSweep
from tofclip.lidar import depth
from tofclip.metrics import nmse
from tofclip.recovery import DepthLockedFocus, Shot, open_shot, plan_recovery
from tofclip.simulate import (
    Instrument,
    Scene,
    StreakDetector,
    make_default_instrument,
    make_default_scene,
    make_nominal_camera,
    render_true_frames,
    score_returns,
    simulate_shot,
)
from tofclip.simulate.bodies import Body, Lambertian, Sphere
from tofclip.simulate.patterns import (
    TEXELS,
    make_checkerboard,
    make_letter,
    make_rings,
    make_stripes,
)
from tofclip.simulate.streak import ANGLES_DEG, GAINS, LENSLET_PITCH_M, place_plate
from tofclip.units import MILLIMETRE

METHODS = ("l1", "tv", "surfaces")
PHOTONS = (2000, 200, 50)  # of the brightest streak pixel
BORDER_FRACTION = 12 / 128  # of the picture's side, not scored: views leave the slit there
FOCAL_LENGTH_PX = 280.0
FIGURES = {  # what a row says: key, unit's factor
    "picture NMSE, %": ("image_nmse", 100.0),
    "the same without its rim, %": ("image_nmse_inner", 100.0),
    "median range error, mm": ("median_depth_error_m", 1 / MILLIMETRE),
    "within one bin, % of target pixels": ("share_within_one_bin", 100.0),
    "false returns, %": ("false_return_share", 100.0),
    "range error over stated deviation": ("range_z", 1.0),
    "processor time over that of tv": ("seconds_over_tv", 1.0),
}


class Scored(NamedTuple):
    """One shot by one method."""

    # those of `tofclip.simulate.score_returns`, ``image_nmse``, ``image_nmse_inner`` and
    # ``seconds`` of processor time
    figures: dict[str, float]
    picture: Float32Array  # (rows, columns), light of all instants


def make_small_instrument(photons: float, rays_per_pixel_side: int = 4) -> Instrument:
    """Return an instrument like the demonstration's with pictures of half its side. `photons`:
    expected signal of the brightest streak pixel; `rays_per_pixel_side`: rays of the simulation;
    they have to be closer than the finest pattern.
    """
    centres = np.arange(60.0, 600.0, 86.0)
    camera = Camera(
        centres,
        np.radians(ANGLES_DEG),
        (64, 64),
        636,
        gains=np.array(GAINS),
        sweep=SkewSweep(centres, np.linspace(-9.0, 7.0, 7), np.linspace(6e-3, -4e-3, 7)),
        time_zero=-10.2e-9,
        focal_length_px=FOCAL_LENGTH_PX,
        lenslet_pitch=LENSLET_PITCH_M,
        focus_distance=2.0,
    )
    return Instrument(camera, StreakDetector(400, peak_photons=photons), rays_per_pixel_side)


_place = partial(place_plate, focal_length_px=FOCAL_LENGTH_PX)


def make_slanted_scene() -> Scene:
    """Return two plates that are turned far, and a ball, before a wall."""
    ball_px, distance = 9.0, 1.75
    pixel = distance / FOCAL_LENGTH_PX
    ball = Body(
        Sphere(ball_px * pixel),
        Lambertian(make_checkerboard(8, 0.4, 0.9)),
        np.array([-14 * pixel, 13 * pixel, distance]),
    )
    return Scene(
        (
            _place(make_checkerboard(4, 0.3, 0.9), (-12, -13), 26, 1.95, yaw=0.8),
            _place(make_rings(3, 0.3, 0.9), (14, 2), 26, 2.1, pitch=-0.9),
            ball,
            _place(make_stripes(4, 0.3, 0.9), (0, 0), 56, 2.5),
        )
    )


def make_wire_scene() -> Scene:
    """Return upright, level and slanted wires of 1.4 pixels before a wall."""
    y, x = np.indices((TEXELS, TEXELS))
    width = TEXELS / 50 * 1.4  # texels; the plate is 50 pixels wide
    wires = [np.abs(x - place) < width / 2 for place in (30, 96, 160)]
    wires += [np.abs(y - place) < width / 2 for place in (50, 140)]
    wires.append(np.abs(x - y) < width / np.sqrt(2))
    drawn = np.where(np.any(wires, axis=0), 0.9, np.nan).astype(np.float32)
    wall = _place(make_stripes(4, 0.3, 0.9), (0, 0), 56, 2.4)
    return Scene((_place(drawn, (0, 0), 50, 1.9), wall))


def make_gauze_scene() -> Scene:
    """Return a gauze that hides 5/9 of a letter and a wall behind it."""
    y, x = np.indices((TEXELS, TEXELS))
    gauze = np.where((x % 3 == 0) | (y % 3 == 0), 0.8, np.nan).astype(np.float32)
    letter = make_letter("A", 0.8)
    return Scene(
        (
            _place(gauze, (-6, 4), 38, 1.85),
            _place(letter, (6, -6), 26, 2.1),
            _place(make_stripes(4, 0.3, 0.9), (0, 0), 56, 2.45),
        )
    )


# A mesh of 0.2 pixels: of the usual rays, 0.25 pixels apart, each view would see another share of it.
GAUZE_RAYS_PER_PIXEL_SIDE = 9

SCENES: dict[str, Callable[[], Scene]] = {
    "slanted and curved": make_slanted_scene,
    "wires": make_wire_scene,
    "gauze": make_gauze_scene,
}


def make_scene_instrument(name: str, photons: float) -> Instrument:
    """Return the instrument for a scene of `SCENES`; `photons` of the brightest streak pixel."""
    if name == "gauze":
        return make_small_instrument(photons, GAUZE_RAYS_PER_PIXEL_SIDE)
    return make_small_instrument(photons)


def score_methods(scene: Scene, instrument: Instrument, seed: int, fit: bool) -> dict[str, Scored]:
    """Recover one shot by every method, with the same camera. `seed`: of the photon noise; `fit`:
    whether sweep, gains and centres are found from the shot; else the true ones are known.
    """
    shot = simulate_shot(scene, instrument, seed)
    streak = shot.streak
    if fit:
        streak = replace(streak, camera=make_nominal_camera(shot.camera))
    # fitted once; its time counts for none of the methods
    opened: Shot = open_shot(streak).fit_camera()
    truth = render_true_frames(scene, instrument, shot.exposure).values.sum(axis=0)
    border = round(BORDER_FRACTION * truth.shape[0])
    found = {}
    for method in METHODS:
        plan = plan_recovery(opened, method, DepthLockedFocus())
        began = time.process_time()
        frames = plan.run()
        seconds = time.process_time() - began
        picture = frames.values.sum(axis=0)
        returns = depth(frames)
        figures = {
            **score_returns(returns, shot.truth),
            "image_nmse": nmse(picture, truth),
            "image_nmse_inner": nmse(picture, truth, border),
            "seconds": seconds,
        }
        found[method] = Scored(figures, picture)
    for one in found.values():
        one.figures["seconds_over_tv"] = one.figures["seconds"] / found["tv"].figures["seconds"]
    return found


def _score_seeds(
    title: str,
    labels: tuple[str, ...],
    scene: Scene,
    instrument: Instrument,
    seeds: int,
    advance: Advance,
    fit: bool,
) -> tuple[list[Row], list[Panel]]:
    """Rows and pictures of a scene; pictures are the first seed's."""
    scored = []
    for seed in range(seeds):
        scored.append(score_methods(scene, instrument, seed, fit))
        advance(1)
    rows = [
        Row((*labels, name, method), tuple(factor * one[method].figures[key] for one in scored))
        for name, (key, factor) in FIGURES.items()
        for method in METHODS
    ]
    truth = render_true_frames(scene, instrument).values.sum(axis=0)
    panels = [Panel(f"{title}\ntruth", truth)]
    for method, one in scored[0].items():
        panels.append(Panel(f"{method}\n{100 * one.figures['image_nmse']:.1f} %", one.picture))
    return rows, panels


DEFAULT_WEIGHTS = "as each method has it, for all scenes"


@study(
    "surfaces",
    title="Surfaces beside frames: the demonstration",
    note="The paper has no such figures; all methods have the same camera, found from the shot.",
    weight=DEFAULT_WEIGHTS,
    seconds=100,
    steps=1,
)
def run_demo(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Recover the demonstration's shot by every method."""
    shot = (make_default_scene(), make_default_instrument())
    rows, panels = _score_seeds("demonstration", (), *shot, seeds, advance, fit=True)
    return Outcome(("figure", "method"), "see the rows", rows, [panels])


@study(
    "surface-scenes",
    title="Surfaces beside frames: slanted, thin and semi-transparent, at three amounts of light",
    note="The paper has no such figures; the camera is known, and the light is the photons of the brightest "
    "streak pixel.",
    weight=DEFAULT_WEIGHTS,
    seconds=120,
    steps=len(SCENES) * len(PHOTONS),
)
def run_scenes(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Recover every scene at every amount of light by every method; the camera is known."""
    rows, panels = [], []
    for name, make_scene in SCENES.items():
        scene = make_scene()
        for count in PHOTONS:
            labels = (name, str(count))
            instrument = make_scene_instrument(name, count)
            more, line = _score_seeds(
                ", ".join(labels), labels, scene, instrument, seeds, advance, fit=False
            )
            rows += more
            panels.append(line)
    columns = ("scene", "photons", "figure", "method")
    return Outcome(columns, "see the rows", rows, panels)
