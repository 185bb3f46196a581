"""Other programs that do the same. They run in a Python of their own, named by `--peers`, where
they are installed.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apps.benchmarks.case import PeerUnavailableError

if TYPE_CHECKING:
    from nlos import Capture, Grid

PEERS_VARIABLE = "TOFCLIP_PEERS"
PEER_TIMEOUT_S = 900
"""A cube of 128^3 voxels, the page's largest, takes some of them minutes."""

YTAL_SCRIPT = """
import sys, time
import numpy as np
from tal.io.capture_data import NLOSCaptureData
from tal.enums import CameraSystem, HFormat, GridFormat, VolumeFormat
from tal.reconstruct import pf
stored = np.load(sys.argv[1])
data = NLOSCaptureData()
data.H = stored["signal"].transpose(0, 2, 1).astype(np.float32)
data.H_format, data.sensor_grid_format, data.laser_grid_format = HFormat.T_Sx_Sy, GridFormat.X_Y_3, GridFormat.X_Y_3
data.sensor_grid_xyz = stored["wall"].transpose(1, 0, 2).astype(np.float32)
data.laser_grid_xyz = stored["laser"].reshape(1, 1, 3).astype(np.float32)
data.sensor_xyz = data.laser_xyz = np.zeros(3, np.float32)
data.delta_t, data.t_start, data.t_accounts_first_and_last_bounces = float(stored["spacing"]), 0.0, False
data.volume_format, data.scene_info = VolumeFormat.X_Y_Z_3, {}
volume = np.stack(np.meshgrid(stored["x"], stored["y"], stored["z"], indexing="ij"), -1).astype(np.float32)
start = time.perf_counter()
pf.solve(data, float(stored["wavelength"]), float(stored["cycles"]), CameraSystem.DIRECT_LIGHT, volume)
print("seconds", time.perf_counter() - start)
"""

ASTRA_SCRIPT = """
import sys, time
import astra, numpy as np
stored = np.load(sys.argv[1])
picture, angles = stored["picture"], stored["angles"]
volume = astra.create_vol_geom(*picture.shape)
sinogram = astra.create_proj_geom("parallel", 1.0, int(1.5 * picture.shape[0]), angles)
projector = astra.create_projector("linear", sinogram, volume)
astra.create_sino(picture, projector)
start = time.perf_counter()
astra.create_sino(picture, projector)
print("seconds", time.perf_counter() - start)
"""

LENSLESS_SCRIPT = """
import sys, time
import numpy as np
from lensless import FISTA
stored = np.load(sys.argv[1])
spread, readings, iterations = stored["spread"], stored["readings"], int(stored["iterations"])
method = FISTA(spread[np.newaxis, :, :, np.newaxis])
method.set_data(readings[np.newaxis, :, :, np.newaxis])
method.apply(n_iter=1, disp_iter=None, plot=False, save=False)
start = time.perf_counter()
picture = method.apply(n_iter=iterations, disp_iter=None, plot=False, save=False)
seconds = time.perf_counter() - start
np.save(sys.argv[2], np.squeeze(picture))
print("seconds", seconds)
"""


@dataclass
class LenslessPeer:
    """LenslessPiCam's FISTA on a sensor's picture of a known point-spread function."""

    spread: NDArray[np.float32]  # (rows, columns)
    readings: NDArray[np.float32]  # (rows, columns)
    iterations: int
    picture: NDArray[Any] | None = None  # (rows, columns), what it made, once it was timed
    _seconds: float = 0.0

    def __call__(self) -> float:
        """Return the seconds of its iterations alone; it runs once."""
        if self.picture is not None:
            return self._seconds
        with tempfile.TemporaryDirectory() as folder:
            path, made = Path(folder) / "readings.npz", Path(folder) / "picture.npy"
            np.savez(path, spread=self.spread, readings=self.readings, iterations=self.iterations)
            self._seconds = run_peer(LENSLESS_SCRIPT, "LenslessPiCam", str(path), str(made))
            self.picture = np.load(made)
        return self._seconds


def time_astra(picture: NDArray[np.float32], angles: NDArray[np.float64]) -> float:
    """Seconds of ASTRA's parallel projections of a picture, linear interpolation, processor.

    `picture` (rows, columns); `angles` (angles,): rad. Returns seconds.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.npz"
        np.savez(path, picture=picture, angles=angles)
        return run_peer(ASTRA_SCRIPT, "ASTRA", str(path))


def time_ytal(capture: Capture, grid: Grid, wavelength: float, cycles: float) -> float:
    """Seconds of y-tal's phasor fields on the same arrays, its solve call alone.

    `wavelength`: metres. Returns seconds.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "capture.npz"
        arrays: dict[str, Any] = {
            "signal": capture.signal,
            "wall": capture.wall,
            "laser": capture.laser,
        }
        arrays |= {"x": grid.x, "y": grid.y, "z": grid.z}
        arrays |= {"spacing": capture.axis.spacing, "wavelength": wavelength, "cycles": cycles}
        np.savez(path, **arrays)
        return run_peer(YTAL_SCRIPT, "y-tal", str(path))


def run_peer(script: str, name: str, *words: str) -> float:
    """Run a script in the peers' Python and return the seconds that its last lines report.

    `name`: of the peer, for the message; `*words`: the script's arguments. Returns seconds.
    """
    python = os.environ.get(PEERS_VARIABLE)
    if not python:
        raise PeerUnavailableError(f"{name}: --peers names no Python that has it")
    clean = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    command = [python, "-c", script, *words]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, env=clean, timeout=PEER_TIMEOUT_S
        )
    except subprocess.TimeoutExpired as fault:
        raise PeerUnavailableError(f"{name}: takes more than {PEER_TIMEOUT_S} s") from fault
    reported = [line.split() for line in done.stdout.splitlines() if line.startswith("seconds ")]
    if done.returncode or not reported:
        problem = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise PeerUnavailableError(f"{name}: {problem}")
    return float(reported[-1][1])
