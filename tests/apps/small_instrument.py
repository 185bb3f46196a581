"""The program as one types it, and a small instrument: seven views of 32 x 32 pixels, two bright
squares at two ranges.
"""

import contextlib
import io
import json
import shlex
from dataclasses import dataclass
from typing import Any
from unittest import mock

import numpy as np

from apps.cli import main
from tofclip.camera import Camera, SkewSweep
from tofclip.io.light_fields import write_light_field
from tofclip.lidar import compute_ray_directions
from tofclip.light_field import LightField
from tofclip.light_field.views import CameraSetup, measure
from tofclip.shots import Streak
from tofclip.storage import Field, Record
from tofclip.units import SPEED_OF_LIGHT

CENTRES_PX = np.array([30.4, 70.0, 110.7, 150.0, 190.2, 230.0, 269.6])
ANGLES = np.deg2rad([-43.0, -26.0, -13.0, 0.5, 23.0, 37.0, 48.0])
SLIT_WIDTH_PX = 300
IMAGE_SHAPE = (32, 32)
ROWS = 96
BIN_WIDTH = 20e-12
SQUARE_ROWS = (30, 62)  # instants at which the two squares send their light back
SQUARES = (np.s_[8:14, 9:15], np.s_[18:25, 17:24])  # at the upper left, and at the lower right
BACKGROUND = 20.0
HIDDEN_POINT = (0.1, -0.05, 0.6)
HIDDEN_SCENE = "--points 0.1,-0.05,0.6 --wall-width-m 0.8 --bin-width-ps 16 --jitter-ps 15"


DEEP_CENTRES_PX = 40.0 + 60 * np.arange(5)
DEEP_CAMERA = Camera(
    DEEP_CENTRES_PX,
    np.arctan([0.5, -0.8, 0.9, -0.4, 0.1]),
    (32, 32),
    320,
    sweep=SkewSweep(DEEP_CENTRES_PX, np.zeros(5), np.zeros(5)),
    time_zero=-2e-9,
    pulse_fwhm=300e-12,
    focal_length_px=100.0,
    lenslet_pitch=10e-3,
    focus_distance=1.3,
)
"""Its views move apart with range, which they are known to."""


def make_camera(time_zero=0.0):
    """Camera without skew, for which light of range 0 arrives at a time, s."""
    at_rest, known = SkewSweep(CENTRES_PX, np.zeros(7), np.zeros(7)), {"time_zero": time_zero}
    shapes = IMAGE_SHAPE, SLIT_WIDTH_PX
    return Camera(CENTRES_PX, ANGLES, *shapes, sweep=at_rest, focal_length_px=140.0, **known)


def draw_squares():
    """Frames (time, y, x) of both squares, each as long as a pulse."""
    frames = np.zeros((ROWS, *IMAGE_SHAPE), np.float32)
    sigma_bins = 60e-12 / BIN_WIDTH / 2.355
    for row, place in zip(SQUARE_ROWS, SQUARES, strict=True):
        pulse = np.exp(-(((np.arange(ROWS) - row) / sigma_bins) ** 2) / 2)
        frames[:, place[0], place[1]] += 100 * pulse[:, np.newaxis, np.newaxis].astype(np.float32)
    return frames


def take_shot(camera, frames, seed=3):
    """The shot of frames, with Poisson noise."""
    expected = camera.operator()(np.moveaxis(frames, 0, -1)).T + BACKGROUND
    counts = np.random.default_rng(seed).poisson(expected).astype(np.float32)
    return Streak(counts, camera=camera).with_bin_width(BIN_WIDTH)


@dataclass(frozen=True)
class Outcome:
    """What a run of the program left behind."""

    status: int
    out: str
    err: str


class Names(dict[str, Any]):
    """What stands in braces: what a test names, or else a fixture's value."""

    def __init__(self, request, names):
        super().__init__(names)
        self.request = request

    def __missing__(self, name):
        return self.request.getfixturevalue(name)


class Shell:
    """Runs the program in this process by lines as they are typed, with names in braces."""

    def __init__(self, request):
        self.request = request

    def __call__(self, line, **names):
        known = Names(self.request, names)
        words = [word.format_map(known) for word in shlex.split(line)]
        out, err = io.StringIO(), io.StringIO()
        # What it says does not depend on how slow this machine is.
        patient = mock.patch("apps.progress.MAX_SILENCE_S", 3600.0)
        with patient, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = main(words)
        return Outcome(status, out.getvalue(), err.getvalue())

    def figures(self, line, status=0, said="", **names):
        """The object of `--json`: nothing else is printed, and nothing said but what is expected."""
        outcome = self(f"{line} --json", **names)
        assert outcome.status == status, outcome
        assert said in outcome.err if said else not outcome.err, outcome
        assert not status or all(line.startswith("tofclip: ") for line in outcome.err.splitlines())
        return json.loads(outcome.out)

    def refuses(self, line, said="", **names):
        """Whether the line is unusable and one line says why; return it."""
        outcome = self(line, **names)
        assert (outcome.status, outcome.out, outcome.err.count("\n")) == (2, "", 1), outcome
        assert outcome.err.startswith("tofclip: error: ")
        assert said in outcome.err
        return outcome.err


def save_plate(path, distance, photons, seed, late):
    """Save the photon cube, (5, 6, 80) with bins of 80 ps, of a plate [m] so many seconds late."""
    noise = np.random.default_rng(seed)
    y, x = np.indices((5, 6)).reshape(2, -1)
    cosine = compute_ray_directions(Camera.pinhole((5, 6), 20.0, 400e-12), y, x)[:, 2]
    time = 2 * distance / cosine / SPEED_OF_LIGHT + late
    cube = noise.poisson(0.02, (y.size, 80))
    pixel = np.repeat(np.arange(y.size), noise.poisson(photons * cosine))
    arrival = np.rint((time[pixel] + noise.normal(0, 400e-12 / 2.355, pixel.size)) / 80e-12)
    np.add.at(cube, (pixel, arrival.astype(int)), 1)
    np.save(path, cube.reshape(5, 6, 80).astype(np.uint16))


def wall_shot(streak):
    """The same light, taken for what a relay wall of 12 x 12 points sent back."""
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 12), np.linspace(-0.3, 0.3, 12))
    wall = Record(
        "relay_wall",
        {
            "wall": Field(np.stack([x, y, 0 * x], axis=-1), "m", ("y", "x", "xyz")),
            "camera": Field(np.array([0.5, 0.0, -1.0]), "m", ("xyz",)),
            "laser": Field(np.zeros(3), "m", ("xyz",)),
        },
        {"row_offset": 10, "column_offset": 10, "receive_delay_bins": 0.0},
    )
    return Streak(
        streak.counts, streak.row_times, camera=streak.camera, attachments={"relay_wall": wall}
    )


def focus_pictures():
    """A point source through the slit open and closed, with backgrounds, in counts."""
    noise = np.random.default_rng(5)
    row, column = np.mgrid[:120, :SLIT_WIDTH_PX].astype(float)
    slit_row = 60.0
    lines = dots = np.zeros(row.shape)
    for centre, angle in zip(CENTRES_PX, ANGLES, strict=True):
        across = (column - centre - (row - slit_row) * np.tan(angle)) * np.cos(angle)
        along = (column - centre) * np.sin(angle) + (row - slit_row) * np.cos(angle)
        lines = lines + 900 * np.exp(-((across / 1.5) ** 2) / 2) * (np.abs(along) < 22)
        dots = dots + 900 * np.exp(
            -(((column - centre) / 1.5) ** 2 + ((row - slit_row) / 1.5) ** 2) / 2
        )
    light = {"line": lines, "line_background": 0 * lines, "dot": dots, "dot_background": 0 * dots}
    return {name: noise.poisson(picture + 100).astype(np.uint16) for name, picture in light.items()}


def write_views(path, views, picture):
    """Save the light field whose picture at a view (v, u) a function returns."""
    pictures = np.stack([picture(*view) for view in views]).astype(np.float32)
    field = LightField(pictures, np.array(views, float))
    write_light_field(field, path)
    return field


def two_cards(folder):
    """A near card before a far one, 48 pixels and 4 x 4 views, what a camera measures of it, and a
    map of its depths.
    """
    y, x = np.mgrid[:48, :48].astype(float)

    def look(v, u):
        near = (abs(x + u - 24) < 8) & (abs(y + v - 24) < 8)
        far = 0.2 + 0.4 * (np.floor((x - u) / 5) % 2)
        chequers = 0.4 + 0.6 * ((np.floor((x + u) / 3) + np.floor((y + v) / 3)) % 2)
        return np.where(near, chequers, far)

    views = [(v, u) for v in range(-2, 2) for u in range(-2, 2)]
    field = write_views(folder / "field.h5", views, look)
    measure(field, CameraSetup("line-even", 2.0, 0)).save(folder / "meas.h5")
    near = (abs(x - 24) < 8) & (abs(y - 24) < 8)
    np.save(folder / "map.npy", np.where(near, -1.0, 1.0))
