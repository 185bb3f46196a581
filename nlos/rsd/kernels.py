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

LANES, MIRRORED = 32, 4
"""Plane waves treated together: neighbours in lateral wavenumber, two full vectors of 512 bits, and their mirror images
in the axes."""

GROUP = 2 * MIRRORED * LANES
"""Real numbers of such a group at one frequency."""

STEPS, NODES = 8, 4
"""Frequencies, and nodes of the transfer function, that stay in registers."""

TWO, THREE, FOUR = np.uint64(2), np.uint64(3), np.uint64(4)


@compiled
def sample_waves(radius, distance, first, step, delay, continued, ahead, waves):
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
    ahead : int
        Entries before the lowest frequency, left alone.
    waves : (n, 2, ahead + frequencies) float32 array
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
        for w in range(waves.shape[2] - ahead):
            value = wave * complex(steady, -direction * rising * (first + w * step))
            waves[i, 0, ahead + w] = value.real
            waves[i, 1, ahead + w] = value.imag
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
def carry(spectrum, first, nodes, begin, offset, shares, coefficients, terms):
    """``terms[m] = sum_k coefficients[m, k] * transfer_k * spectrum_k`` for all plane waves and some depths.

    The transfer function depends on a wave's lateral wavenumber alone and is interpolated between its nodes, once for
    waves mirrored in the axes. A group is carried to all depths while its spectrum is in cache, and nothing between
    spectrum and terms leaves it. Frequencies come in steps of `STEPS`.

    Parameters
    ----------
    spectrum : (groups, frequencies, 2, MIRRORED, LANES) float32 array
        Real and imaginary parts.
    first : (groups,) int64 array
        Frequency that each group starts at.
    nodes : (depths, n, 2, frequencies) float32 array
        Transfer functions.
    begin : (groups,) int64 array
        First node that each group takes.
    offset : (groups + 1,) int64 array
        Where its interpolation weights begin; it has a multiple of `NODES` of them.
    shares : (some, LANES) float32 array
        Interpolation weights.
    coefficients : (depths, m, frequencies) float32 array
        An even number of terms.
    terms : (depths, m, groups, 2, MIRRORED, LANES) float32 array
        Overwritten.
    """
    groups, frequencies, count = spectrum.shape[0], spectrum.shape[1], coefficients.shape[1]
    waves, weights, flat = spectrum.reshape(-1), shares.reshape(-1), terms.reshape(-1)
    transfer, products = np.empty(2 * STEPS * LANES, np.float32), np.empty(STEPS * GROUP, np.float32)
    sums = np.empty(count * GROUP, np.float32)
    for group in range(groups):
        for depth in range(coefficients.shape[0]):
            sums[:] = 0
            for k in range(first[group], frequencies, STEPS):
                _interpolate(nodes[depth], begin[group], k, weights, offset[group], offset[group + 1], transfer)
                _multiply(waves, (group * frequencies + k) * GROUP, transfer, products)
                _reduce(coefficients[depth], k, products, sums)
            for m in range(count):
                to = ((depth * count + m) * groups + group) * GROUP
                flat[to : to + GROUP] = sums[m * GROUP : (m + 1) * GROUP]


# Unsigned indices into flat arrays: an index that might be negative would keep the loops from becoming vector code.


@compiled
def _interpolate(nodes, node, k, weights, begin, end, transfer):
    """Transfer function (`STEPS`, 2, `LANES`) of a group at some frequencies, four nodes at a time."""
    flat, lanes, imaginary = nodes.reshape(-1), np.uint64(LANES), np.uint64(nodes.shape[2])
    stride = np.uint64(2) * imaginary
    transfer[:] = 0
    for i in range(begin, end, NODES):
        at, w0 = np.uint64((node + i - begin) * 2 * nodes.shape[2] + k), np.uint64(i * LANES)
        w1, w2, w3 = w0 + lanes, w0 + np.uint64(2) * lanes, w0 + np.uint64(3) * lanes
        for step in range(np.uint64(STEPS)):
            n0, to = at + step, np.uint64(2) * lanes * step
            n1, n2, n3 = n0 + stride, n0 + np.uint64(2) * stride, n0 + np.uint64(3) * stride
            a0, a1, a2, a3 = flat[n0], flat[n1], flat[n2], flat[n3]
            n0, n1, n2, n3 = n0 + imaginary, n1 + imaginary, n2 + imaginary, n3 + imaginary
            b0, b1, b2, b3 = flat[n0], flat[n1], flat[n2], flat[n3]
            for j in range(lanes):
                s0, s1, s2, s3 = weights[w0 + j], weights[w1 + j], weights[w2 + j], weights[w3 + j]
                transfer[to + j] += (a0 * s0 + a1 * s1) + (a2 * s2 + a3 * s3)
                transfer[to + lanes + j] += (b0 * s0 + b1 * s1) + (b2 * s2 + b3 * s3)


@compiled
def _multiply(waves, start, transfer, products):
    """Products of a group's waves with their transfer function at some frequencies."""
    of, lanes, half = np.uint64(start), np.uint64(LANES), np.uint64(GROUP // 2)
    for step in range(np.uint64(STEPS)):
        at = np.uint64(2) * lanes * step
        for mirrored in range(np.uint64(MIRRORED)):
            to = np.uint64(GROUP) * step + lanes * mirrored
            for j in range(lanes):
                real, imaginary = waves[of + to + j], waves[of + to + half + j]
                along, aside = transfer[at + j], transfer[at + lanes + j]
                products[to + j] = real * along - imaginary * aside
                products[to + half + j] = real * aside + imaginary * along


@compiled
def _reduce(coefficients, k, products, sums):
    """Add `STEPS` frequencies to all terms, two terms at a time."""
    g = np.uint64(GROUP)
    for m in range(0, coefficients.shape[0], 2):
        a, b, to = coefficients[m, k : k + STEPS], coefficients[m + 1, k : k + STEPS], np.uint64(m * GROUP)
        a0, a1, a2, a3, a4, a5, a6, a7 = a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7]
        b0, b1, b2, b3, b4, b5, b6, b7 = b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]
        for j in range(g):
            p0, p1, p2, p3 = products[j], products[g + j], products[TWO * g + j], products[THREE * g + j]
            low, high = a0 * p0 + a1 * p1 + a2 * p2 + a3 * p3, b0 * p0 + b1 * p1 + b2 * p2 + b3 * p3
            at = FOUR * g + j
            p4, p5, p6, p7 = products[at], products[at + g], products[at + TWO * g], products[at + THREE * g]
            sums[to + j] += low + (a4 * p4 + a5 * p5 + a6 * p6 + a7 * p7)
            sums[to + g + j] += high + (b4 * p4 + b5 * p5 + b6 * p6 + b7 * p7)


@compiled
def group_waves(full, row, column, share, count, k, spectrum):
    """Put the first plane waves of one frequency, as many as count there, into their groups.

    Parameters
    ----------
    full : (rows, columns) complex64 array
        All plane waves of a rectangle, index 0 in its middle.
    row, column : (groups, MIRRORED, LANES) int64 array
        Indices of the waves.
    share : (groups, MIRRORED, LANES) float32 array
        What they are multiplied by.
    count : int
        Lanes of all groups that count at this frequency.
    k : int
    spectrum : (groups, frequencies, 2, MIRRORED, LANES) float32 array
        Written to at frequency `k`.
    """
    middle_row, middle_column = full.shape[0] // 2, full.shape[1] // 2
    for group in range(-(-count // LANES)):
        for mirrored in range(MIRRORED):
            for j in range(min(LANES, count - group * LANES)):
                weight = share[group, mirrored, j]
                wave = full[middle_row + row[group, mirrored, j], middle_column + column[group, mirrored, j]]
                spectrum[group, k, 0, mirrored, j] = wave.real * weight
                spectrum[group, k, 1, mirrored, j] = wave.imag * weight


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
def scatter(terms, cell, folded, spectra):
    """Put the waves of some terms into their cells.

    Parameters
    ----------
    terms : (m, groups, 2, MIRRORED, LANES) float32 array
        Real and imaginary parts.
    cell : (groups, MIRRORED, LANES) int64 array
    folded : bool
        Waves may meet in one cell, and then add up.
    spectra : (m, cells) complex64 array
    """
    flat, cells, half = terms.reshape(-1), cell.reshape(-1), np.uint64(GROUP // 2)
    for m in range(terms.shape[0]):
        if folded:
            spectra[m] = 0
        for group in range(terms.shape[1]):
            of, to = np.uint64((m * terms.shape[1] + group) * GROUP), np.uint64(group) * half
            for j in range(half):
                wave = complex(flat[of + j], flat[of + half + j])
                if folded:
                    wave += spectra[m, cells[to + j]]
                spectra[m, cells[to + j]] = wave


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
