"""Compiled inner loops of diffraction from plane to planes."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

compiled = njit(nogil=True, cache=True, fastmath={"contract", "nsz", "reassoc", "arcp"}, error_model="numpy")

SQUARE = 16
"""Side of the squares that matrices are transposed in: two cache lines of complex64."""

TAPS = 6
"""Nodes that the interpolation along the radius takes."""


@compiled
def sample_waves(radius, distance, first, step, delay, continued, waves):
    """Spherical waves of all frequencies at every radius about their source: ``exp(1j * (k * R + (k - k_0) * delay))``.

    They are divided by R; or, if `continued`, weighted as in the first Rayleigh-Sommerfeld integral; at a negative
    distance they run backwards. Steps from one frequency to the next with one complex product.

    Parameters
    ----------
    radius : (n,) float64 array
    distance : float
        Along the axis, m.
    first, step : float
        Lowest wavenumber and distance of neighbouring ones, rad/m.
    delay : (2,) float64 array
        A path added to all, m, and the wavenumber k_0 whose phase it leaves alone.
    continued : bool
    waves : (n, 2, frequencies) float32 array
        Real and imaginary parts, overwritten.
    """
    direction = math.copysign(1.0, distance)
    for i in range(radius.size):
        path = math.sqrt(radius[i] ** 2 + distance**2)
        phase = first * direction * path + (first - delay[1]) * delay[0]
        turn = step * (direction * path + delay[0])
        wave, factor = complex(math.cos(phase), math.sin(phase)), complex(math.cos(turn), math.sin(turn))
        steady, rising = 1 / path, 0.0
        if continued:
            rising = abs(distance) / (2 * math.pi * path**2)
            steady = rising / path
        for w in range(waves.shape[2]):
            value = wave * complex(steady, -direction * rising * (first + w * step))
            waves[i, 0, w] = value.real
            waves[i, 1, w] = value.imag
            wave *= factor


@compiled
def interpolation(place, node, share):
    """Find the first of the `TAPS` nodes about every place, and their Lagrange weights (places, taps)."""
    for b in range(place.size):
        node[b] = int(place[b]) - TAPS // 2 + 1
        for i in range(TAPS):
            weight = 1.0
            for j in range(TAPS):
                if j != i:
                    weight *= (place[b] - node[b] - j) / (i - j)
            share[b, i] = weight


@compiled
def transferred(spectrum, nodes, node, share, begin, first, weights, products):
    """``products = spectrum * transfer`` for the plane waves from `begin` on and the frequencies from `first` on.

    The transfer function depends on a wave's lateral wavenumber alone and is interpolated between its nodes; waves of
    one lateral wavenumber stand side by side and share it.

    Parameters
    ----------
    spectrum : (waves, 2, frequencies) float32 array
        Real and imaginary parts.
    nodes : (n, 2, frequencies) float32 array
    node : (waves,) int64 array
    share : (waves, taps) float32 array
        As `interpolation` gives them.
    begin, first : int
    weights : (2, frequencies) float32 array
        Room for the interpolated transfer function.
    products : (some waves, 2, frequencies) float32 array
        Overwritten.
    """
    # Unsigned indices into flat arrays: an index that might be negative would keep the loops from becoming vector code.
    count = np.uint64(spectrum.shape[2])
    here = np.uint64(first)
    flat_spectrum, flat_products, transfer = spectrum.reshape(-1), products.reshape(-1), weights.reshape(-1)
    latest = -1.0
    for b in range(products.shape[0]):
        wave = begin + b
        if b == 0 or node[wave] != node[wave - 1] or share[wave, 0] != latest:
            latest = share[wave, 0]
            _interpolate(nodes, node[wave], share[wave], here, transfer)
        source, target = np.uint64(2 * wave) * count, np.uint64(2 * b) * count
        for w in range(here, count):
            real, imaginary = flat_spectrum[source + w], flat_spectrum[source + count + w]
            flat_products[target + w] = real * transfer[w] - imaginary * transfer[count + w]
        for w in range(here, count):
            real, imaginary = flat_spectrum[source + w], flat_spectrum[source + count + w]
            flat_products[target + count + w] = real * transfer[count + w] + imaginary * transfer[w]


@compiled
def _interpolate(nodes, node, share, first, transfer):
    """Interpolate real and imaginary parts of all frequencies from `first` on."""
    stride = np.uint64(2 * nodes.shape[2])
    flat, start = nodes.reshape(-1), np.uint64(node) * stride
    a0, a1, a2, a3, a4, a5 = share[0], share[1], share[2], share[3], share[4], share[5]
    n1, n2 = start + stride, start + np.uint64(2) * stride
    n3, n4, n5 = n2 + stride, n2 + np.uint64(2) * stride, n2 + np.uint64(3) * stride
    for w in range(first, stride):
        early = a0 * flat[start + w] + a1 * flat[n1 + w] + a2 * flat[n2 + w]
        transfer[w] = early + a3 * flat[n3 + w] + a4 * flat[n4 + w] + a5 * flat[n5 + w]


@compiled
def transpose(source, target):
    """Copy ``target[i, j] = source[j, i]``, in squares that stay in cache."""
    rows, columns = target.shape
    for top in range(0, rows, SQUARE):
        for left in range(0, columns, SQUARE):
            for i in range(top, min(top + SQUARE, rows)):
                for j in range(left, min(left + SQUARE, columns)):
                    target[i, j] = source[j, i]


@compiled
def scatter(terms, cell, begin, folded, spectra):
    """Put terms (m, some waves, 2) of the plane waves from `begin` on into ``spectra[m, cell[wave]]``.

    Waves that are `folded` into one another meet in one cell, and add up.
    """
    for m in range(terms.shape[0]):
        for b in range(terms.shape[1]):
            term = complex(terms[m, b, 0], terms[m, b, 1])
            if folded:
                term += spectra[m, cell[begin + b]]
            spectra[m, cell[begin + b]] = term


@compiled
def illuminate(terms, odd, x, y, depth, laser, wavenumber, table, span, carrier, field):
    """Add ``sum_m terms[m] * f_m(R) * exp(1j * wavenumber * R)``, R the distance from the laser spot, to a plane.

    Parameters
    ----------
    terms : (m, y, x) complex64 array
        May be larger than the plane along y and x.
    odd : int
        Terms from this one on are multiplied by 1j.
    x, y : (n,) float64 array
    depth : float
    laser : (3,) float64 array
    wavenumber : float
        rad/m; carrier of the illumination.
    table : (samples, m) float32 array
        The functions f_m, evenly spaced over the distances from ``span[0]`` to ``span[1]``.
    span : (2,) float64 array
    carrier : (x,) complex64 array
        Multiplies every column.
    field : (y, x) complex64 array
        Added to.
    """
    per_metre = (table.shape[0] - 1) / max(span[1] - span[0], 1e-12)
    last = table.shape[0] - 2
    for iy in range(y.size):
        across = (y[iy] - laser[1]) ** 2 + (depth - laser[2]) ** 2
        for ix in range(x.size):
            distance = math.sqrt((x[ix] - laser[0]) ** 2 + across)
            place = max((distance - span[0]) * per_metre, 0.0)
            before = min(int(place), last)
            share = np.float32(place - before)
            real = imaginary = np.float32(0)
            for m in range(terms.shape[0]):
                value = table[before, m] + share * (table[before + 1, m] - table[before, m])
                term = terms[m, iy, ix]
                if m < odd:
                    real += value * term.real
                    imaginary += value * term.imag
                else:
                    real -= value * term.imag
                    imaginary += value * term.real
            phase = wavenumber * distance
            wave = complex(math.cos(phase), math.sin(phase)) * carrier[ix]
            field[iy, ix] += complex(real, imaginary) * wave
