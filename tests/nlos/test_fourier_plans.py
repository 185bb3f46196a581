"""FFTW's plans and scipy's functions give the same transforms, and images do not depend on which."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from nlos import Capture, Grid, PlanarRSD
from nlos.phasor import fourier as fourier_plans

pytest.importorskip("pyfftw")


@pytest.mark.parametrize("inverse", [False, True])
def test_both_ways_of_transforming_agree(inverse: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    chance = np.random.default_rng(1)
    found = []
    for absent in (False, True):
        if absent:
            monkeypatch.setattr(fourier_plans, "pyfftw", None)
        source, target = (fourier_plans.allocate_zeros((3, 40)) for _ in range(2))
        plan = fourier_plans.plan_transform(source[:, :24], target[:, :24], 1, inverse)
        chance = np.random.default_rng(1)
        for _ in range(2):  # the second time with other buffers
            source[:, :24] = chance.normal(size=(3, 24)) + 1j * chance.normal(size=(3, 24))
            plan.execute()
            found.append(target[:, :24].copy())
            source, target = (fourier_plans.allocate_zeros((3, 40)) for _ in range(2))
            plan.update_arrays(source[:, :24], target[:, :24])
    np.testing.assert_allclose(found[:2], found[2:], rtol=1e-5, atol=1e-5)


def test_an_image_without_fftw(monkeypatch: pytest.MonkeyPatch) -> None:
    y, x = np.meshgrid(np.linspace(-0.5, 0.5, 16), np.linspace(-0.5, 0.5, 16), indexing="ij")
    signal = np.random.default_rng(2).random((96, 16, 16), dtype=np.float32)
    capture = Capture.exhaustive(
        signal, np.stack([x, y, 0 * x], axis=-1), np.zeros(3), bin_width=3e-11
    )
    grid = Grid.in_front_of(capture, voxel=0.08)
    method = PlanarRSD(0.2)
    with_fftw = method.reconstruct(capture, grid).values
    monkeypatch.setattr(fourier_plans, "pyfftw", None)
    without = method.reconstruct(capture, grid).values
    np.testing.assert_allclose(without, with_fftw, atol=1e-4 * with_fftw.max())


def test_transforms_load_neither_dask_nor_pandas() -> None:
    code = (
        "import sys, nlos.phasor.fourier as plans;"
        "assert plans.pyfftw is not None; assert not {'dask', 'pandas'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
