"""Shots recovered with a prior, each beginning at the one before."""

from __future__ import annotations

import numpy as np

from tofclip.camera import Camera
from tofclip.lidar.pulse_tables import TraceBins
from tofclip.sequences.following import WarmStartedRecovery
from tofclip.solvers import Sparse

CAMERA = Camera([16.0, 40.0, 64.0], [-0.6, 0.1, 0.7], (12, 12), 80)


def test_a_row_begins_at_its_own_picture_whatever_rows_were_lit_before():
    """Nothing moves and there is no noise: a row that goes on from its own picture stays there,
    whichever rows have come and gone around it.
    """
    random = np.random.default_rng(0)
    scene = np.where(random.random((12, 12, 9)) < 0.1, 1.0, 0.0).astype(np.float32)
    operator = CAMERA.operator()
    seen = operator(scene)
    method = Sparse(iterations=600, gap=0.0)
    recovery = WarmStartedRecovery(method, operator, ~CAMERA.dead_columns, iterations=1)

    def recover(*rows: int) -> dict[int, np.ndarray]:
        bins = TraceBins(np.array(rows), np.ones(len(rows), bool), np.ones(len(rows), np.float32))
        traces = recovery.recover(seen[:, rows], bins)
        pictures = np.empty((traces.pixels.size, len(rows)), np.float32)
        traces.fill(slice(None), pictures)
        return dict(zip(rows, pictures.T, strict=True))

    last = recover(0, 1, 2, 4, 5, 6)
    # another number of rows, then as many others
    for rows, new in (((1, 3, 5, 6, 8), 3), ((3, 5, 6, 7, 8), 7)):
        found = recover(*rows)
        last = {row: picture for row, picture in last.items() if row in rows}
        for row, picture in last.items():
            assert np.linalg.norm(found[row] - picture) < 0.01 * np.linalg.norm(picture)
        # one iteration from darkness, or from another row's picture, is far from it
        truth = scene[..., new].ravel()
        assert np.linalg.norm(found[new] - truth) > 0.3 * np.linalg.norm(truth)
