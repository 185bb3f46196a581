"""Imaging around corners, against bare Fourier transforms, bare copies, and y-tal."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial

import numpy as np
import pyfftw
import scipy.fft

from apps.benchmarks.harness import Action, Case, PreparedCase, time_ytal
from nlos import Backprojection, Capture, FKMigration, Grid, Hybrid, LightCone, PlanarRSD, propagate
from nlos.band import Band, VirtualPulse
from nlos.capture import TimeAxis
from nlos.illumination import AliasingWarning
from nlos.method import Method
from nlos.plane import Plane
from nlos.simulate import PointScene, build_relay_wall
from tofclip.threads import run_blocks, thread_count

CYCLES = 4.24
BINS, BIN_WIDTH_S = 512, 32e-12
LASER_M = np.array([0.1, 0.05, 0.02])
HIDDEN_POINTS_M = np.array([[0.3, -0.2, 1.0], [-0.5, 0.4, 0.9], [0.1, 0.6, 1.4]])
RELIEF_M = 0.3
WALL_SIDES = (64, 128)
COPY_BYTES = 1 << 25

warnings.simplefilter("ignore", AliasingWarning)  # what is imaged does not matter here


def make_scene(count: int, relief: float) -> tuple[Capture, Grid, float]:
    """A capture of ``count ** 2`` points, a grid of ``count ** 3`` voxels, and a wavelength of four
    wall points.

    `count`: points along a side; `relief`: depth of the wall's shape, m; 0: a plane. Returns
    `wavelength`: metres.
    """
    axis = np.linspace(-1, 1, count)
    x, y = np.meshgrid(axis, axis)
    wall = np.stack([x, y, relief / 2 * (1 + np.sin(3 * x + 1) * np.cos(2 * y))], axis=-1)
    capture = PointScene(HIDDEN_POINTS_M).simulate_capture(
        wall, LASER_M * [1, 1, relief > 0], TimeAxis(BINS, BIN_WIDTH_S), 60e-12
    )
    return capture, Grid(axis, axis, np.linspace(0.6, 1.6, count)), 8 / count


def make_transforms(side: int, number: int) -> tuple[Action, float]:
    """Inverse transforms of the doubled plane, a hundredth of `number` or more, and which fraction
    of it that is.

    `side`: points along a side of the plane; `number`: transforms that the method needs.
    """
    threads = thread_count()
    each = max(1, number // (100 * threads))
    plans = []
    for _ in range(threads):
        source, target = (
            pyfftw.zeros_aligned((2 * side, 2 * side), np.complex64) for _ in range(2)
        )
        plans.append(
            pyfftw.FFTW(
                source, target, axes=(0, 1), direction="FFTW_BACKWARD", flags=("FFTW_MEASURE",)
            )
        )

    def work(piece: slice) -> None:
        for _ in range(piece.start, piece.stop):
            plans[piece.start // each].execute()

    return (lambda: run_blocks(work, each * threads, each)), each * threads / number


def prepare_planar(count: int) -> PreparedCase:
    """A planar wall to as many depths as it has points a side."""
    capture, grid, wavelength = make_scene(count, 0.0)
    method = PlanarRSD(wavelength, CYCLES)
    floor, share = make_transforms(count, count * Band(method.pulse, capture.axis).wavenumbers.size)
    peers = {"y-tal": partial(time_ytal, capture, grid, wavelength, CYCLES)}
    return PreparedCase(lambda: method.reconstruct(capture, grid), floor, 1, peers, share)


def prepare_hybrid(count: int) -> PreparedCase:
    """A curved wall, by way of a virtual plane."""
    capture, grid, wavelength = make_scene(count, RELIEF_M)
    method = Hybrid(wavelength, CYCLES)
    floor, share = make_transforms(
        count, count * Band(VirtualPulse(wavelength, CYCLES), capture.axis).wavenumbers.size
    )
    return PreparedCase(lambda: method.reconstruct(capture, grid), floor, 1, floor_fraction=share)


def prepare_propagation(count: int) -> PreparedCase:
    """A curved wall's field onto a plane of as many points."""
    capture, grid, wavelength = make_scene(count, RELIEF_M)
    pulse = VirtualPulse(wavelength, CYCLES)
    plane = Plane(grid.x, grid.y, RELIEF_M + 0.1)
    floor, share = make_transforms(count, Band(pulse, capture.axis).wavenumbers.size)
    return PreparedCase(lambda: propagate(capture, plane, pulse), floor, 1, floor_fraction=share)


def prepare_confocal(method: Method, count: int) -> PreparedCase:
    """A confocal scan of a planar wall; the floor is a transform of its doubled box, there and
    back.

    `count`: points along a side.
    """
    wall = build_relay_wall("planar", count)
    capture = Capture(
        np.random.default_rng(0).random((BINS, count, count), np.float32), wall, wall, BIN_WIDTH_S
    )
    axis = np.linspace(-1, 1, count)
    grid = Grid(axis, axis, np.linspace(0.4, 2.2, count))
    box = np.ones((2 * BINS, 2 * count, 2 * count), np.float32)

    def there_and_back() -> None:
        spectrum = scipy.fft.rfftn(box, workers=thread_count())
        scipy.fft.irfftn(spectrum, s=box.shape, workers=thread_count(), overwrite_x=True)

    return PreparedCase(lambda: method.reconstruct(capture, grid), there_and_back, 1)


def make_exhaustive_capture(count: int) -> Capture:
    """A grid of 3 x 3 laser spots, each with all wall points."""
    random = np.random.default_rng(0)
    axis = np.linspace(-1, 1, count)
    wall, spots = (
        np.stack([*np.meshgrid(part, part), np.zeros((part.size, part.size))], -1)
        for part in (axis, axis[:3])
    )
    signal = random.random((BINS, 9, count, count), np.float32)
    return Capture.exhaustive(signal, wall, spots.reshape(9, 3), BIN_WIDTH_S)


def prepare_backprojection(capture_of: Callable[[int], Capture], count: int) -> PreparedCase:
    """Point by point; the floor copies a complex number for each look-up.

    `capture_of`: from the number of points along a side to a capture.
    """
    capture, axis = capture_of(count), np.linspace(-1, 1, count)
    grid = Grid(axis, axis, np.linspace(0.6, 1.6, count // 4))
    method = Backprojection(0.6, CYCLES)
    lookups = method.plan(capture, grid).cost
    source = np.ones(min(COPY_BYTES // 8, lookups), np.complex64)
    target = np.empty_like(source)

    def copies() -> None:
        run_blocks(
            lambda piece: np.copyto(target[piece], source[piece]), source.size, source.size // 64
        )

    work = partial(method.reconstruct, capture, grid)
    return PreparedCase(work, copies, lookups / 1e6, floor_fraction=source.size / lookups)


FLOOR_TEXT = "the inverse transforms of a plane for each frequency and depth alone"
SIZE_TEXT = "wall points a side"
COPY_FLOOR_TEXT = "a copied complex number for each look-up"

CASES = (
    Case(
        "rsd-planar",
        "planar wall to a cube (N x N points, N^3 voxels)",
        SIZE_TEXT,
        WALL_SIDES,
        "volumes",
        FLOOR_TEXT,
        prepare_planar,
    ),
    Case(
        "rsd-hybrid",
        "curved wall to a cube (N x N points, N^3 voxels)",
        SIZE_TEXT,
        WALL_SIDES,
        "volumes",
        FLOOR_TEXT,
        prepare_hybrid,
    ),
    Case(
        "propagation-spectral",
        "curved wall's field onto a plane",
        SIZE_TEXT,
        WALL_SIDES,
        "fields",
        "a transform of a plane for each frequency alone",
        prepare_propagation,
    ),
    Case(
        "confocal-lct",
        f"light-cone transform, {BINS} bins",
        SIZE_TEXT,
        (32, 64),
        "volumes",
        "a transform of the doubled box, there and back",
        partial(prepare_confocal, LightCone()),
    ),
    Case(
        "confocal-fk",
        f"f-k migration, {BINS} bins",
        SIZE_TEXT,
        (32, 64),
        "volumes",
        "a transform of the doubled box, there and back",
        partial(prepare_confocal, FKMigration()),
    ),
    Case(
        "backprojection-single",
        "single laser, N x N points to N x N x N/4 voxels",
        SIZE_TEXT,
        (32, 64),
        "million look-ups",
        COPY_FLOOR_TEXT,
        partial(prepare_backprojection, lambda count: make_scene(count, 0.0)[0]),
    ),
    Case(
        "backprojection-exhaustive",
        "9 laser spots, N x N points each to N x N x N/4 voxels",
        SIZE_TEXT,
        (16, 32),
        "million look-ups",
        COPY_FLOOR_TEXT,
        partial(prepare_backprojection, make_exhaustive_capture),
    ),
)
