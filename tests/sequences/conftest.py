"""Two workers behind a scheduler, as on a cluster, and a small sequence of shots."""

import contextlib
import logging

import numpy as np
import pytest

from tofclip.camera import Camera, SkewSweep
from tofclip.io.streaks import save_stack
from tofclip.simulate import Instrument, Scene, StreakDetector, make_plate, simulate_shot
from tofclip.simulate.patterns import make_checkerboard, make_plain_pattern

CENTRES = 40.0 + 60 * np.arange(5)
SHOTS = 6


@pytest.fixture(scope="package")
def scheduler():
    """Address of a scheduler with two workers; a job may outlive one of them and no more."""
    dask = pytest.importorskip("dask", reason="dask.distributed is an extra")
    distributed = pytest.importorskip("distributed", reason="dask.distributed is an extra")
    with dask.config.set({"distributed.scheduler.allowed-failures": 1}):
        cluster = distributed.LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            dashboard_address="127.0.0.1:0",
            silence_logs=logging.CRITICAL,
            env={"TOFCLIP_THREADS": "1"},
        )
        yield cluster.scheduler_address
        with contextlib.suppress(TimeoutError):  # what is left of it ends with this process
            cluster.close(timeout=60)


@pytest.fixture(scope="package")
def camera():
    """Five views of 32 x 32 pixels, with its sweep."""
    sweep = SkewSweep(CENTRES, np.array([-2.0, 1.0, 0.0, 0.5, 3.0]), np.zeros(5))
    angles = np.arctan([0.5, -0.8, 0.9, -0.4, 0.1])
    optics = {"focal_length_px": 100.0, "lenslet_pitch": 5e-3, "focus_distance": 1.3}
    times = {"time_zero": -6e-9, "pulse_fwhm": 150e-12}
    return Camera(CENTRES, angles, (32, 32), 320, sweep=sweep, **times, **optics)


def make_body(distance, place_px, side_px=9, pattern=None):
    """A plate across the axis, so many pixels wide and aside."""
    at, side = place_px * distance / 100, side_px * distance / 100
    pattern = make_checkerboard(3, 0.3, 0.9) if pattern is None else pattern
    return make_plate((at, at, distance), (side, side), pattern)


@pytest.fixture(scope="package")
def see():
    """Simulate a shot of a camera: of two plates, or of one plain one."""

    def simulate(camera, seed=0, peak=5e4, side_px=0):
        plates = make_body(1.1, -8), make_body(1.5, 8)
        if side_px:
            plates = (make_body(1.3, 0, side_px, make_plain_pattern(0.8)),)
        made = Instrument(camera, StreakDetector(128, 50e-12, peak_photons=peak))
        return simulate_shot(Scene(plates), made, seed).streak

    return simulate


@pytest.fixture(scope="package")
def streaks(camera, see):
    """Shots of two plates that differ in their noise."""
    return [see(camera, seed) for seed in range(SHOTS)]


@pytest.fixture(scope="package")
def recorded(tmp_path_factory, camera, streaks):
    """A folder with ``camera.h5``, ``shots.h5`` (a stack) and ``shots`` (a folder with a file for
    each).
    """
    folder = tmp_path_factory.mktemp("recorded")
    camera.save(folder / "camera.h5")
    save_stack(streaks, folder / "shots.h5")
    (folder / "shots").mkdir()
    for number, streak in enumerate(streaks):
        streak.save(folder / "shots" / f"shot{number}.h5")
    return folder
