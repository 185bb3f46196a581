from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nlos import Backprojection, Capture, Grid, Hybrid, PlanarRSD

# The wall is coarser than the shortest of the pulse's waves wants; see test_sampling.py.
pytestmark = pytest.mark.filterwarnings("ignore::nlos.illumination.AliasingWarning")

FIRST_BOUNCE_BINS = 600


def test_the_recorded_letter_looks_as_by_backprojection(shared_data: Path) -> None:
    with np.load(shared_data / "nlos" / "otoole2018_diffuse_s.npz") as stored:
        counts = stored["H"].astype(np.float32)[:1200]
        wall, bin_width = stored["wall_xyz"], float(stored["delta_t_s"])
    counts[:FIRST_BOUNCE_BINS] = 0
    capture = Capture(counts, wall, wall, bin_width)
    grid = Grid.box((-0.3, 0.3), (-0.3, 0.35), (0.46, 0.54), (0.03, 0.03, 0.02))
    expected = Backprojection(0.05, 4).reconstruct(capture, grid)
    for method in (PlanarRSD(0.05, 4), Hybrid(0.05, 4)):
        found = method.reconstruct(capture, grid)
        assert 0.48 <= found.find_brightest()[2] <= 0.52
        pictures = (volume.maximum_projection().brightness.ravel() for volume in (found, expected))
        # Beyond the band that both share, only tolerance, interpolation and the record's ends
        # differ.
        assert np.corrcoef(*pictures)[0, 1] > 0.99
