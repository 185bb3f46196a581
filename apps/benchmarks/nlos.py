"""Imaging around corners, against bare Fourier transforms, bare copies, and y-tal; and walls beyond the
page's: propagation in time, scattered wall points, and one large capture.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial

import numpy as np
import pyfftw
import scipy.fft

from apps.benchmarks.harness import YTAL_SCRIPT, Action, Prepare, PreparedCase, ask_peer
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
COPY_BYTES = 1 << 25

warnings.simplefilter("ignore", AliasingWarning)  # what is imaged does not matter here


def make_scene(count: int, relief: float, confocal: bool = False) -> tuple[Capture, Grid, float]:
    """A capture of ``count ** 2`` points, a grid of ``count ** 3`` voxels, and a wavelength of four
    wall points, m. `relief`: depth of the wall's shape, m; 0: a plane.
    """
    axis = np.linspace(-1, 1, count)
    x, y = np.meshgrid(axis, axis)
    wall = np.stack([x, y, relief / 2 * (1 + np.sin(3 * x + 1) * np.cos(2 * y))], axis=-1)
    laser = wall if confocal else LASER_M * [1, 1, relief > 0]
    time_axis = TimeAxis(BINS, BIN_WIDTH_S)
    capture = PointScene(HIDDEN_POINTS_M).simulate_capture(wall, laser, time_axis, 60e-12)
    return capture, Grid(axis, axis, np.linspace(0.6, 1.6, count)), 8 / count


def make_transforms(side: int, number: int) -> tuple[Action, float]:
    """Some inverse transforms of the doubled plane, and which fraction of `number` they are."""
    threads = thread_count()
    each = max(1, number // (100 * threads))
    how = {"axes": (0, 1), "direction": "FFTW_BACKWARD", "flags": ("FFTW_MEASURE",)}
    plans = []
    for _ in range(threads):
        arrays = (pyfftw.zeros_aligned((2 * side, 2 * side), np.complex64) for _ in range(2))
        plans.append(pyfftw.FFTW(*arrays, **how))

    def work(piece: slice) -> None:
        for _ in range(piece.start, piece.stop):
            plans[piece.start // each].execute()

    return (lambda: run_blocks(work, each * threads, each)), each * threads / number


def prepare_planar(count: int) -> PreparedCase:
    """A planar wall to as many depths as it has points a side."""
    capture, grid, wavelength = make_scene(count, 0.0)
    method = PlanarRSD(wavelength, CYCLES)
    floor, share = make_transforms(count, count * Band(method.pulse, capture.axis).wavenumbers.size)
    arrays = {"signal": capture.signal, "wall": capture.wall, "laser": capture.laser}
    arrays |= {"x": grid.x, "y": grid.y, "z": grid.z}
    numbers = {"spacing": capture.axis.spacing, "wavelength": wavelength, "cycles": CYCLES}
    peers = {"y-tal": lambda: ask_peer("y-tal", YTAL_SCRIPT, **arrays, **numbers)[0]}
    return PreparedCase(lambda: method.reconstruct(capture, grid), floor, 1, peers, share)


def prepare_hybrid(count: int) -> PreparedCase:
    """A curved wall, by way of a virtual plane."""
    capture, grid, wavelength = make_scene(count, RELIEF_M)
    pulse = VirtualPulse(wavelength, CYCLES)
    floor, share = make_transforms(count, count * Band(pulse, capture.axis).wavenumbers.size)
    work = partial(Hybrid(wavelength, CYCLES).reconstruct, capture, grid)
    return PreparedCase(work, floor, 1, floor_fraction=share)


def prepare_propagation(count: int) -> PreparedCase:
    """A curved wall's field onto a plane of as many points."""
    capture, grid, wavelength = make_scene(count, RELIEF_M)
    pulse = VirtualPulse(wavelength, CYCLES)
    plane = Plane(grid.x, grid.y, RELIEF_M + 0.1)
    floor, share = make_transforms(count, Band(pulse, capture.axis).wavenumbers.size)
    return PreparedCase(lambda: propagate(capture, plane, pulse), floor, 1, floor_fraction=share)


def prepare_confocal(method: Method, count: int) -> PreparedCase:
    """A confocal scan of a planar wall; the floor transforms its doubled box, there and back."""
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
    """Point by point; the floor copies a complex number for each look-up."""
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


STRICT_TOLERANCE = 1e-4  # one that only direct sums keep
ROWS_IN_TIME = 2
ROW_STEP = 8
LARGE_WAVELENGTH_M = 0.048


def prepare_propagation_in_time(count: int) -> PreparedCase:
    """A few rows of the plane in time; the floor takes all of them spectrally."""
    capture, grid, wavelength = make_scene(count, RELIEF_M)
    pulse, distance = VirtualPulse(wavelength, CYCLES), RELIEF_M + 0.1
    few, every = Plane(grid.x, grid.y[:ROWS_IN_TIME], distance), Plane(grid.x, grid.y, distance)
    return PreparedCase(
        lambda: propagate(capture, few, pulse, "time"),
        lambda: propagate(capture, every, pulse),
        ROWS_IN_TIME / count,
        floor_fraction=count / ROWS_IN_TIME,
    )


def prepare_scattered(count: int) -> PreparedCase:
    """Scattered wall points by non-uniform transforms; the floor sums directly for some rows."""
    wall = np.random.default_rng(0).uniform([-1, -1, 0], [1, 1, RELIEF_M], (count**2, 3))
    capture = PointScene(HIDDEN_POINTS_M).simulate_capture(
        wall, LASER_M, TimeAxis(512, 32e-12), 60e-12
    )
    pulse, axis = VirtualPulse(8 / count, CYCLES), np.linspace(-1, 1, count)
    plane, some = (Plane(axis, rows, RELIEF_M + 0.1) for rows in (axis, axis[::ROW_STEP]))
    return PreparedCase(
        lambda: propagate(capture, plane, pulse),
        lambda: propagate(capture, some, pulse, tolerance=STRICT_TOLERANCE),
        1,
        floor_fraction=1 / ROW_STEP,
    )


def prepare_large(count: int) -> PreparedCase:
    """A relief of 0.15 m and 1016 bins of 4.6 ps to 100^3 voxels; the floor is a planar wall."""
    x, y = np.meshgrid(np.linspace(-0.69, 0.69, count), np.linspace(-0.65, 0.65, count))
    axis = 0.006 * (np.arange(100, dtype=np.float64) - 49.5)
    grid = Grid(axis, axis, 0.16 + 0.004 * np.arange(100, dtype=np.float64))

    def capture_of(relief: float) -> Capture:
        wall = np.stack([x, y, relief / 2 * np.sin(2 * x + y)], axis=-1)
        laser = LASER_M / 2 * [1, 1, relief > 0]
        scene = PointScene(np.array([[0.1, -0.05, 0.35]]))
        return scene.simulate_capture(wall, laser, TimeAxis(1016, 4.6e-12, 0.14), 20e-12)

    curved, planar = capture_of(0.15), capture_of(0.0)
    return PreparedCase(
        lambda: Hybrid(LARGE_WAVELENGTH_M).reconstruct(curved, grid),
        lambda: PlanarRSD(LARGE_WAVELENGTH_M).reconstruct(planar, grid),
        1,
    )


PREPARE: dict[str, Prepare] = {
    "rsd-planar": prepare_planar,
    "rsd-hybrid": prepare_hybrid,
    "propagation-spectral": prepare_propagation,
    "confocal-lct": partial(prepare_confocal, LightCone()),
    "confocal-fk": partial(prepare_confocal, FKMigration()),
    "backprojection-single": partial(
        prepare_backprojection, lambda count: make_scene(count, 0.0)[0]
    ),
    "backprojection-exhaustive": partial(prepare_backprojection, make_exhaustive_capture),
    "corner-time": prepare_propagation_in_time,
    "corner-scattered": prepare_scattered,
    "corner-large": prepare_large,
}
