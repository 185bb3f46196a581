from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nlos import Backprojection, Capture, Grid
from nlos.capture import unwarp_signal
from tofclip.units import SPEED_OF_LIGHT

# The walls here are coarser than the shortest of the pulse's waves wants; see test_sampling.py.
pytestmark = pytest.mark.filterwarnings("ignore::nlos.illumination.AliasingWarning")

FIRST_BOUNCE_BINS = 600


def test_the_confocal_letter_s_stands_half_a_metre_from_the_wall(shared_data: Path) -> None:
    with np.load(shared_data / "nlos" / "otoole2018_diffuse_s.npz") as stored:
        counts = stored["H"].astype(np.float32)[:1200]
        wall, laser, bin_width = stored["wall_xyz"], stored["laser_xyz"], float(stored["delta_t_s"])
    counts[:FIRST_BOUNCE_BINS] = 0
    capture = Capture(counts, wall, laser, bin_width)
    volume = Backprojection(0.04).reconstruct(
        capture, Grid.box((-0.3, 0.3), (-0.3, 0.35), (0.4, 0.62), 0.01)
    )
    assert 0.48 <= volume.find_brightest()[2] <= 0.52
    picture = volume.maximum_projection().brightness
    rows = {
        y: picture[np.argmin(np.abs(volume.grid.y - y))] for y in (-0.15, -0.06, 0.05, 0.15, 0.25)
    }
    x = volume.grid.x
    left, right = (x > -0.2) & (x < -0.1), (x > 0.06) & (x < 0.16)
    # Bars of the S at y = -0.15, 0.05 and 0.25, joined on the right above the middle and on the
    # left below it (an S seen in a mirror, because y points down here and up in that recording).
    assert rows[-0.06][right].mean() > 1.3 * rows[-0.06][left].mean()
    assert rows[0.15][left].mean() > 1.3 * rows[0.15][right].mean()
    for bar, gap in ((-0.15, -0.06), (0.05, -0.06), (0.05, 0.15), (0.25, 0.15)):
        middle = np.abs(x) < 0.05
        assert rows[bar][middle].mean() > 1.2 * rows[gap][middle].mean()


@pytest.mark.parametrize("name", ["LetterN", "LetterVI", "Circle_Square"])
def test_a_flash_at_the_laser_spot_reaches_all_of_a_recorded_wall_at_once(
    name: str, shared_data: Path
) -> None:
    """Ways to the camera, computed from the recorded geometry, are taken off by what
    `unwarp_signal` does.
    """
    with np.load(shared_data / "lift" / f"nlos_{name}.npz") as stored:
        wall = np.moveaxis(stored["wall_grid_m"], 0, -1)[::8, ::8]
        camera, laser, bin_width = (
            stored["camera_pos_m"],
            stored["laser_pos_m"],
            float(stored["dt_s"]),
        )
    late = (np.linalg.norm(wall - camera, axis=-1) - np.linalg.norm(laser - camera)) / (
        SPEED_OF_LIGHT * bin_width
    )
    bins = np.arange(1016)
    signal = np.exp(-0.5 * ((bins[:, None, None] - 500 - late) / 6) ** 2)
    found = unwarp_signal(signal, wall, camera, laser, bin_width)
    expected = np.exp(-0.5 * ((bins - 500) / 6) ** 2)
    # Linear interpolation of a Gaussian of 6 bins: at most 1 / (8 * 36).
    assert np.max(np.abs(found - expected[:, None, None])) < 4e-3
