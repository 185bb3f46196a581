"""Plane waves in groups, and what a transfer function makes of them, against the sums that they
stand for.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import nlos.phasor.to_depths_compiled
from nlos.phasor.depth_steps import PlaneWaves
from nlos.phasor.to_depths_compiled import WaveGroups, choose_inverse
from nlos.phasor.to_depths_kernels import (
    FREQUENCY_STEPS,
    LANES,
    MIRROR_IMAGES,
    propagate_spectrum,
    scatter_terms,
    transpose,
)
from nlos.phasor.transfer import SphericalWaves, TransferFunction, Window
from nlos.plane import Plane

PLANE = Plane(np.linspace(-0.4, 0.5, 12), np.linspace(-0.3, 0.6, 11), 0.0)
WAVES = SphericalWaves(40.0, 1.5, 13, continued=False)  # 13 frequencies: not a multiple of STEPS
GROUPS = WaveGroups(PlaneWaves((3.0, 3.4), WAVES.wavenumbers + 5))
ORIGIN = (-0.2, 0.1)


def field(frequencies: int = WAVES.count) -> np.ndarray:
    random = np.random.default_rng(3)
    shape = (*PLANE.shape, frequencies)
    return (random.normal(size=shape) + 1j * random.normal(size=shape)).astype(np.complex64)


def complex_waves(parts: np.ndarray) -> np.ndarray:
    """Complex numbers of all distinct waves, (..., waves), of parts (..., 2, MIRRORED, LANES) by
    group.
    """
    values = np.moveaxis(parts[..., 0, :, :] + 1j * parts[..., 1, :, :], 0, -3)
    return values[..., GROUPS.is_distinct]


def lateral_of_distinct(groups: WaveGroups) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    row, column = (index[groups.is_distinct] for index in groups.indices)
    return (
        row,
        column,
        2 * np.pi * np.hypot(row / groups.waves.period[0], column / groups.waves.period[1]),
    )


@settings(max_examples=20, deadline=None)
@given(y=st.floats(0.3, 6), x=st.floats(0.3, 6), highest=st.floats(4, 60))
def test_every_wave_stands_in_one_place(y: float, x: float, highest: float) -> None:
    waves = PlaneWaves((y, x), np.array([highest / 2, highest]))
    groups = WaveGroups(waves)
    row, column, lateral = lateral_of_distinct(groups)
    assert sorted(zip(row, column, strict=True)) == sorted(
        zip(waves.row, waves.column, strict=True)
    )
    assert lateral.max() <= highest + 1e-8
    assert groups.is_distinct.shape == (len(groups.first_frequency), MIRROR_IMAGES, LANES)
    assert np.all(np.diff(waves.lateral_wavenumbers) >= 0)
    # A rectangle of indices one larger on each side holds no further wave.
    rows, columns = (np.arange(-n - 1, n + 2) for n in waves.max_indices)
    inside = np.hypot(2 * np.pi * rows[:, None] / y, 2 * np.pi * columns / x) <= highest
    assert abs(np.count_nonzero(inside) - row.size) <= 4 * np.count_nonzero(
        abs(waves.lateral_wavenumbers - highest) < 1e-8
    )


def test_the_analysis_is_the_sum_over_the_plane() -> None:
    values = field()
    spectrum = GROUPS.to_plane_waves(values, PLANE, ORIGIN)
    assert spectrum.shape[1] == GROUPS.leading_zeros + WAVES.count
    assert spectrum.shape[1] % FREQUENCY_STEPS == 0
    assert not spectrum[:, : GROUPS.leading_zeros].any()
    found = complex_waves(spectrum)[GROUPS.leading_zeros :]
    row, column, lateral = lateral_of_distinct(GROUPS)
    qy, qx = (
        2 * np.pi * index / period
        for index, period in zip((row, column), GROUPS.waves.period, strict=True)
    )
    along_y, along_x = (
        np.exp(-1j * np.outer(qy, PLANE.y - ORIGIN[0])),
        np.exp(-1j * np.outer(qx, PLANE.x - ORIGIN[1])),
    )
    expected = np.einsum("qy,qx,yxk->kq", along_y, along_x, values) / np.prod(GROUPS.waves.period)
    expected[lateral > GROUPS.waves.lateral_limits[:, np.newaxis]] = 0
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()  # float32
    repeated = ~GROUPS.is_distinct
    assert not np.moveaxis(spectrum, 0, 2)[:, :, repeated].any()


@pytest.mark.parametrize("count", [2, 4, 6])
def test_carrying_is_transfer_and_sum_over_frequencies(count: int) -> None:
    transfer = TransferFunction(
        WAVES, Window(1.2, 1.6, 1.6), float(GROUPS.waves.lateral_limits[-1]), 0.1
    )
    between = GROUPS.interpolation(transfer)
    delay = np.array([0.3, 45.0])
    spectrum = GROUPS.to_plane_waves(field(), PLANE, ORIGIN)
    coefficients = np.zeros((2, count, spectrum.shape[1]), np.float32)
    coefficients[..., GROUPS.leading_zeros :] = np.random.default_rng(1).normal(
        size=(2, count, WAVES.count)
    )
    terms = np.empty((2, count, *GROUPS.shape), np.float32)
    nodes = np.stack(
        [transfer.evaluate(depth, delay, GROUPS.leading_zeros) for depth in (0.7, 0.9)]
    )
    # Two products of different widths agree to rounding, not to the bit: BLAS may take another
    # kernel for each.
    alone = transfer.evaluate(0.7, delay)
    assert not nodes[..., : GROUPS.leading_zeros].any()
    assert (
        np.abs(nodes[0, ..., GROUPS.leading_zeros :] - alone).max() < 1e-5 * np.abs(alone).max()
    )  # float32
    propagate_spectrum(
        spectrum,
        GROUPS.first_frequency,
        nodes,
        between.begin,
        between.offset,
        between.weights,
        coefficients,
        terms,
    )
    _, _, lateral = lateral_of_distinct(GROUPS)
    node, share = transfer.interpolation(lateral)
    at_waves = np.einsum(
        "qt,zqtck->zqck", share, nodes[:, node[:, np.newaxis] + np.arange(share.shape[1])]
    )
    at_waves = at_waves[:, :, 0] + 1j * at_waves[:, :, 1]
    expected = np.einsum("zmk,zqk,kq->zmq", coefficients, at_waves, complex_waves(spectrum))
    found = complex_waves(np.moveaxis(terms, 2, 0))
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()


@pytest.mark.parametrize(
    "lattice", [(64, 80), (24, 20), (37.5, 41.0)], ids=["fine", "folded", "no whole number"]
)
def test_images_are_sums_of_plane_waves(
    lattice: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A few of them at a time, and waves that repeat each other on coarse voxels added up."""
    monkeypatch.setattr(nlos.phasor.to_depths_compiled, "CACHE_BYTES", 12_000)
    wanted, terms, random = (7, 9), 5, np.random.default_rng(2)
    plan = choose_inverse(GROUPS.indices, lattice, wanted, terms)
    assert 0 < len(plan.spectra) < terms
    parts = random.normal(
        size=(terms, *GROUPS.is_distinct.shape[:1], 2, MIRROR_IMAGES, LANES)
    ).astype(np.float32)
    cell = np.where(GROUPS.is_distinct, plan.cell_indices, plan.spare)
    for first in range(0, terms, len(plan.spectra)):
        some = slice(first, min(first + len(plan.spectra), terms))
        scatter_terms(parts[some], cell, lattice[0] < 64, plan.spectra)
        plan.transform(some)
    row, column, _ = lateral_of_distinct(GROUPS)
    along = (
        np.exp(2j * np.pi * np.outer(i, np.arange(n)) / side)
        for i, n, side in zip((row, column), wanted, lattice, strict=True)
    )
    expected = np.einsum("mq,qy,qx->myx", complex_waves(np.moveaxis(parts, 0, 1)), *along)
    found = plan.images * plan.carrier
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()


@pytest.mark.parametrize("shape", [(5, 7), (16, 32), (33, 50), (100, 17)])
def test_matrices_are_transposed_whatever_their_sides(shape: tuple[int, int]) -> None:
    source = np.random.default_rng(0).normal(size=(shape[0], shape[1] + 3))[:, 1:-2]
    target = np.zeros((shape[1], shape[0] + 2))
    transpose(source, target[:, : shape[0]])
    assert np.array_equal(target[:, : shape[0]], source.T)
    assert not target[:, shape[0] :].any()
