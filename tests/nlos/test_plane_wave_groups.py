"""Plane waves in groups, and what a transfer function makes of them, against the sums that they stand for."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import nlos.rsd.inverse
from nlos.plane import Plane
from nlos.rsd.groups import Groups
from nlos.rsd.inverse import inverse
from nlos.rsd.kernels import LANES, MIRRORED, STEPS, carry, scatter, transpose
from nlos.rsd.spectrum import PlaneWaves
from nlos.rsd.transfer import Transfer, Waves
from nlos.rsd.window import Window

PLANE = Plane(np.linspace(-0.4, 0.5, 12), np.linspace(-0.3, 0.6, 11), 0.0)
WAVES = Waves(40.0, 1.5, 13, continued=False)  # 13 frequencies: not a multiple of STEPS
GROUPS = Groups(PlaneWaves((3.0, 3.4), WAVES.numbers + 5))
ORIGIN = (-0.2, 0.1)


def field(frequencies: int = WAVES.count) -> np.ndarray:
    random = np.random.default_rng(3)
    shape = (*PLANE.shape, frequencies)
    return (random.normal(size=shape) + 1j * random.normal(size=shape)).astype(np.complex64)


def complex_waves(parts: np.ndarray) -> np.ndarray:
    """Complex numbers of all distinct waves, (..., waves), of parts (..., 2, MIRRORED, LANES) by group."""
    values = np.moveaxis(parts[..., 0, :, :] + 1j * parts[..., 1, :, :], 0, -3)
    return values[..., GROUPS.distinct]


def lateral_of_distinct(groups: Groups) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    row, column = (index[groups.distinct] for index in groups.indices)
    return row, column, 2 * np.pi * np.hypot(row / groups.waves.period[0], column / groups.waves.period[1])


@settings(max_examples=20, deadline=None)
@given(y=st.floats(0.3, 6), x=st.floats(0.3, 6), highest=st.floats(4, 60))
def test_every_wave_stands_in_one_place(y: float, x: float, highest: float) -> None:
    waves = PlaneWaves((y, x), np.array([highest / 2, highest]))
    groups = Groups(waves)
    row, column, lateral = lateral_of_distinct(groups)
    assert sorted(zip(row, column, strict=True)) == sorted(zip(waves.row, waves.column, strict=True))
    assert lateral.max() <= highest + 1e-8
    assert groups.distinct.shape == (len(groups.first), MIRRORED, LANES)
    assert np.all(np.diff(waves.lateral) >= 0)
    # A rectangle of indices one larger on each side holds no further wave.
    rows, columns = (np.arange(-n - 1, n + 2) for n in waves.reach)
    inside = np.hypot(2 * np.pi * rows[:, None] / y, 2 * np.pi * columns / x) <= highest
    assert abs(np.count_nonzero(inside) - row.size) <= 4 * np.count_nonzero(abs(waves.lateral - highest) < 1e-8)


def test_the_analysis_is_the_sum_over_the_plane() -> None:
    values = field()
    spectrum = GROUPS.analysed(values, PLANE, ORIGIN)
    assert spectrum.shape[1] == GROUPS.ahead + WAVES.count
    assert spectrum.shape[1] % STEPS == 0
    assert not spectrum[:, : GROUPS.ahead].any()
    found = complex_waves(spectrum)[GROUPS.ahead :]
    row, column, lateral = lateral_of_distinct(GROUPS)
    qy, qx = (2 * np.pi * index / period for index, period in zip((row, column), GROUPS.waves.period, strict=True))
    along_y, along_x = np.exp(-1j * np.outer(qy, PLANE.y - ORIGIN[0])), np.exp(-1j * np.outer(qx, PLANE.x - ORIGIN[1]))
    expected = np.einsum("qy,qx,yxk->kq", along_y, along_x, values) / np.prod(GROUPS.waves.period)
    expected[lateral > GROUPS.waves.limits[:, np.newaxis]] = 0
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()  # float32
    repeated = ~GROUPS.distinct
    assert not np.moveaxis(spectrum, 0, 2)[:, :, repeated].any()


@pytest.mark.parametrize("count", [2, 4, 6])
def test_carrying_is_transfer_and_sum_over_frequencies(count: int) -> None:
    transfer = Transfer(WAVES, Window(1.2, 1.6), float(GROUPS.waves.limits[-1]), 0.1)
    between = GROUPS.interpolation(transfer)
    delay = np.array([0.3, 45.0])
    spectrum = GROUPS.analysed(field(), PLANE, ORIGIN)
    coefficients = np.zeros((2, count, spectrum.shape[1]), np.float32)
    coefficients[..., GROUPS.ahead :] = np.random.default_rng(1).normal(size=(2, count, WAVES.count))
    terms = np.empty((2, count, *GROUPS.shape), np.float32)
    nodes = np.stack([transfer.at(depth, delay, GROUPS.ahead) for depth in (0.7, 0.9)])
    # Two products of different widths agree to rounding, not to the bit: BLAS may take another kernel for each.
    alone = transfer.at(0.7, delay)
    assert not nodes[..., : GROUPS.ahead].any()
    assert np.abs(nodes[0, ..., GROUPS.ahead :] - alone).max() < 1e-5 * np.abs(alone).max()  # float32
    carry(spectrum, GROUPS.first, nodes, between.begin, between.offset, between.shares, coefficients, terms)
    _, _, lateral = lateral_of_distinct(GROUPS)
    node, share = transfer.interpolation(lateral)
    at_waves = np.einsum("qt,zqtck->zqck", share, nodes[:, node[:, np.newaxis] + np.arange(share.shape[1])])
    at_waves = at_waves[:, :, 0] + 1j * at_waves[:, :, 1]
    expected = np.einsum("zmk,zqk,kq->zmq", coefficients, at_waves, complex_waves(spectrum))
    found = complex_waves(np.moveaxis(terms, 2, 0))
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()


@pytest.mark.parametrize("lattice", [(64, 80), (24, 20), (37.5, 41.0)], ids=["fine", "folded", "no whole number"])
def test_images_are_sums_of_plane_waves(lattice: tuple[float, float], monkeypatch: pytest.MonkeyPatch) -> None:
    """A few of them at a time, and waves that repeat each other on coarse voxels added up."""
    monkeypatch.setattr(nlos.rsd.inverse, "CACHE_BYTES", 12_000)
    wanted, terms, random = (7, 9), 5, np.random.default_rng(2)
    way = inverse(GROUPS.indices, lattice, wanted, terms)
    assert 0 < len(way.spectra) < terms
    parts = random.normal(size=(terms, *GROUPS.distinct.shape[:1], 2, MIRRORED, LANES)).astype(np.float32)
    cell = np.where(GROUPS.distinct, way.cell, way.spare)
    for first in range(0, terms, len(way.spectra)):
        some = slice(first, min(first + len(way.spectra), terms))
        scatter(parts[some], cell, lattice[0] < 64, way.spectra)
        way.transform(some)
    row, column, _ = lateral_of_distinct(GROUPS)
    along = (
        np.exp(2j * np.pi * np.outer(i, np.arange(n)) / side)
        for i, n, side in zip((row, column), wanted, lattice, strict=True)
    )
    expected = np.einsum("mq,qy,qx->myx", complex_waves(np.moveaxis(parts, 0, 1)), *along)
    found = way.images * way.carrier
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()


@pytest.mark.parametrize("shape", [(5, 7), (16, 32), (33, 50), (100, 17)])
def test_matrices_are_transposed_whatever_their_sides(shape: tuple[int, int]) -> None:
    source = np.random.default_rng(0).normal(size=(shape[0], shape[1] + 3))[:, 1:-2]
    target = np.zeros((shape[1], shape[0] + 2))
    transpose(source, target[:, : shape[0]])
    assert np.array_equal(target[:, : shape[0]], source.T)
    assert not target[:, shape[0] :].any()
