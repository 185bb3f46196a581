"""Counts of a photon-counting camera from the physics, apart from the program's own code: rates of
bins, then chance, cycle by cycle where the detector goes blind.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from tofclip.units import SPEED_OF_LIGHT

BIN = 100e-12
FWHM = 300e-12
BIN_M = SPEED_OF_LIGHT / 2 * BIN


def make_surface(shape=(80, 80), bins=512):
    """Slanted wall, ball, box and poles; arrival in bins."""
    rows, columns = shape
    y, x = np.mgrid[:rows, :columns] / np.maximum(shape, 2).reshape(2, 1, 1)
    surface = bins * (0.62 + 0.06 * x + 0.03 * y)
    near = np.hypot(y - 0.35, x - 0.32) / 0.24
    ball = bins * (0.42 - 0.05 * np.sqrt(np.maximum(1 - near**2, 0)))
    surface = np.where(near < 1, ball, surface)
    box = (np.abs(x - 0.75) < 0.13) & (np.abs(y - 0.6) < 0.2)
    surface = np.where(box, bins * (0.3 + 0.08 * y), surface)
    for place in (0.1, 0.55, 0.93):
        surface = np.where(
            (np.abs(x - place) < 0.02) & (y > 0.2), bins * (0.2 + 0.1 * place), surface
        )
    return surface


def make_art(shape=(120, 140), bins=512, seed=7):
    """Many things before each other, with steep edges: discs, bars and slats at depths of their own."""
    noise = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]]
    surface = bins * (0.8 + 0.05 * x / shape[1])
    for level in np.linspace(0.72, 0.2, 26):
        cy, cx = noise.uniform(0, shape[0]), noise.uniform(0, shape[1])
        size, turn = noise.uniform(3, 18), noise.uniform(0, np.pi)
        u = (x - cx) * np.cos(turn) + (y - cy) * np.sin(turn)
        v = (y - cy) * np.cos(turn) - (x - cx) * np.sin(turn)
        kind = noise.integers(3)
        inside = (
            np.hypot(u, v) < size,
            (np.abs(u) < size) & (np.abs(v) < 0.5 * size),
            (np.abs(u) < 2.5 * size) & (np.abs(v) < 2.5),
        )[kind]
        surface = np.where(inside, bins * (level + noise.uniform(-0.001, 0.001) * u), surface)
    return surface


def find_edges(surface, step=6.0):
    """Pixels of which a neighbour lies further off than `step` bins."""
    padded = np.pad(surface, 1, mode="edge")
    rows, columns = surface.shape
    beside = [padded[v : v + rows, u : u + columns] for v in range(3) for u in range(3)]
    return np.max(np.abs(np.array(beside) - surface), axis=0) > step


def make_rates(
    surface,
    signal,
    background,
    bins=512,
    fwhm=FWHM / BIN,
    lengths=None,
):
    """Expected photons, (rows, columns, bins): signal of each pixel, background of each bin; `lengths`
    of the bins of an uneven converter, of 1 in the mean.
    """
    lengths = np.ones(bins) if lengths is None else lengths
    edges = np.concatenate([[0], np.cumsum(lengths)]) - 0.5 - surface[..., np.newaxis]
    passed = ndtr(edges / fwhm * np.sqrt(8 * np.log(2)))
    return np.asarray(signal)[..., np.newaxis] * np.diff(passed, axis=-1) + background * lengths


def count_first_photons(rates, cycles, seed):
    """Histograms of a detector that counts the first photon of a cycle; `rates` of all cycles."""
    missed = np.exp(-np.cumsum(rates, axis=-1) / cycles)
    before = np.concatenate([np.ones_like(missed[..., :1]), missed[..., :-1]], axis=-1)
    share = np.concatenate([before - missed, missed[..., -1:]], axis=-1)
    return np.random.default_rng(seed).multinomial(cycles, share)[..., :-1]


def spoil_pixels(rates, level, seed, share=0.02):
    """Rates with hot pixels (so many photons a bin more: even, in a few bins only, or rising) and
    dead ones, and both masks.
    """
    noise, (rows, columns, bins) = np.random.default_rng(seed), rates.shape
    number = round(share * rows * columns)
    chosen = noise.choice(rows * columns, 2 * number, replace=False)
    hot, dead = (np.isin(np.arange(rows * columns), part) for part in np.split(chosen, 2))
    spoilt = rates.reshape(-1, bins).copy()
    for row in np.flatnonzero(hot):
        spectrum = (
            np.ones(bins),
            np.linspace(0, 2, bins),
            np.exp(-np.arange(bins) / (0.2 * bins)) * 5,
        )[noise.integers(3)]
        spoilt[row] += level * spectrum
    spoilt[dead] = 0
    return spoilt.reshape(rates.shape), hot.reshape(rows, columns), dead.reshape(rows, columns)
