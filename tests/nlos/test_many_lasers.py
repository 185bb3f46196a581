"""Scans of many laser spots: several fields added up, and roles swapped."""

import tracemalloc
from functools import cache

import numpy as np
import pytest
from scenes import scaled_error

from nlos import Backprojection, Capture, Grid, Hybrid, PlanarRSD, Refinement, settings_for
from nlos.capture import TimeAxis
from nlos.simulate import PointScene, add_poisson_noise
from tofclip.solvers import Sparse

AXIS, JITTER, WAVELENGTH = TimeAxis(320, 32e-12), 40e-12, 0.2
HIDDEN = [[0.1, -0.2, 0.7], [-0.2, 0.1, 0.9]]
SCENE = PointScene(HIDDEN, [400.0, 500.0])
GRID = Grid.box((-0.4, 0.4), (-0.4, 0.4), (0.55, 1.0), 0.04)
LASERS = np.array([[0.1, 0.05, 0.0], [-0.15, 0.2, 0.0]])


def lattice(points, curved=False):
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, points), np.linspace(-0.5, 0.5, points))
    return np.stack([x, y, 0.1 * x**2 if curved else 0 * x], axis=-1)


@cache
def exhaustive(kind, points=16):
    """Two spots, each seen by all points of a wall; or all points lit in turns, seen by two."""
    wall = lattice(points, "curved" in kind)
    signals = [SCENE.simulate_capture(wall, spot, AXIS, JITTER).signal for spot in LASERS]
    if "scanned" not in kind:
        return Capture.exhaustive(np.stack(signals, axis=1), wall, LASERS, AXIS.bin_width)
    signal = np.stack(signals, axis=-1)
    # As seen from the detectors: the fall of light is symmetric.
    return Capture.exhaustive(signal, LASERS, wall, AXIS.bin_width)


@pytest.mark.parametrize("kind", ["planar", "curved", "planar, scanned", "curved, scanned"])
def test_many_spots_show_what_backprojection_shows(kind):
    capture = exhaustive(kind)
    method = Hybrid(WAVELENGTH) if "curved" in kind else PlanarRSD(WAVELENGTH)
    exact = Backprojection(WAVELENGTH).reconstruct(capture, GRID)
    found = method.reconstruct(capture, GRID)
    # The tolerance of each way, and of waves that meet no distance any more.
    assert scaled_error(found.values, exact.values) < 0.02
    assert found.provenance["imaging"]["method"] in ("rsd", "hybrid")


@pytest.mark.parametrize("spots", [1, 2, 4])
def test_a_plan_keeps_no_more_than_it_announces_however_many_spots(spots):
    """Each spot is seen by a part of the wall of its own, and so has a plane of its own."""
    wall = lattice(20, curved=True).reshape(-1, 3)
    lasers = np.outer(np.arange(len(wall)) * spots // len(wall), [0.05, 0.02, 0.0])
    signal = np.random.default_rng(0).random((AXIS.bins, len(wall)))
    capture = Capture(signal, wall, lasers, AXIS.bin_width)
    Hybrid(WAVELENGTH).reconstruct(capture, GRID)  # what is imported stays as well
    tracemalloc.start()
    try:
        plan = Hybrid(WAVELENGTH).plan(capture, GRID)
        plan.image(capture)
        kept, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert plan.images == spots
    assert kept < plan.memory_bytes
    assert most < 2 * plan.memory_bytes


def test_a_scan_by_the_laser_is_imaged_by_default():
    capture = exhaustive("planar, scanned")
    settings = settings_for(capture, wavelength=WAVELENGTH)
    # 512 pairs for two images, as if the two detectors were the laser spots.
    assert settings.method == "rsd"
    assert len(np.unique(settings.prepare(capture).lasers, axis=0)) == 2
    wall, spot = capture.wall[:, :, :1], capture.laser[:, :, :1]
    one = Capture(capture.signal[..., :1], wall, spot, AXIS.bin_width)
    found = settings_for(one, wavelength=WAVELENGTH)
    # The box is as wide as the laser's scan, for the wall is a single point.
    assert found.x == pytest.approx((-0.5, 0.5), abs=0.05)


def test_a_lone_detector_is_not_the_brightest():
    """Its own surroundings are near every pair; as a laser spot it shows what is hidden."""
    capture = exhaustive("planar, scanned")
    one = Capture(capture.signal[..., :1], capture.wall[:, :, :1], capture.laser[:, :, :1], 32e-12)
    counts = add_poisson_noise(one, 2, 0.02, seed=1)
    x, y, _ = LASERS[0]
    grid = Grid(x + GRID.x, y + GRID.y, np.arange(0.01, 1.0, 0.04))
    method = PlanarRSD(WAVELENGTH / 2)
    prepared = settings_for(counts, wavelength=WAVELENGTH / 2).prepare(counts)
    assert method.reconstruct(prepared, grid).find_brightest()[2] == pytest.approx(0.69)
    assert method.reconstruct(counts, grid).find_brightest()[2] == pytest.approx(0.01)


def test_scans_by_the_laser_are_refined():
    capture, grid = exhaustive("planar, scanned", 8), Grid(GRID.x[::2], GRID.y[::2], GRID.z[::2])
    longer = Hybrid(2 * WAVELENGTH)
    shot = longer.reconstruct(capture, grid)
    refined = Refinement(longer, Sparse(2e-2, 5)).reconstruct(capture, grid)
    # The sparse image gathers its light in fewer voxels than the shot does.
    spread = [float(one.values.sum() ** 2 / np.sum(one.values**2)) for one in (shot, refined)]
    assert spread[1] < 0.5 * spread[0]
    nearest = np.linalg.norm(np.array(HIDDEN) - refined.find_brightest(), axis=1).min()
    assert nearest < 0.12
