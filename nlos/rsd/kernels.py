"""Compiled inner loops of diffraction from plane to planes."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tofclip.compiling import inlined

compiled = njit(
    nogil=True, cache=True, fastmath={"contract", "nsz", "reassoc", "arcp"}, error_model="numpy"
)

TILE_SIDE = 16
"""Side of the squares that matrices are transposed in: two cache lines of complex64."""

TAPS = 6
"""Nodes that the interpolation along the radius takes."""

LANES, MIRROR_IMAGES = 32, 4
"""Plane waves treated together: neighbours in lateral wavenumber, two full vectors of 512 bits, and their mirror images
in the axes."""

GROUP_FLOATS = 2 * MIRROR_IMAGES * LANES
"""Real numbers of such a group at one frequency."""

FREQUENCY_STEPS, NODE_STEPS = 8, 4
"""Frequencies, and nodes of the transfer function, that stay in registers."""

UINT64_TWO = np.uint64(2)


@compiled
def sample_waves(radius, distance, first, step, delay, continued, leading_zeros, waves):
    """Spherical waves of all frequencies at every radius about their source: ``exp(1j * (k * R + (k
    - k_0) * delay))``.

    They are divided by R; or, if `continued`, weighted as in the first Rayleigh-Sommerfeld
    integral; at a negative distance they run backwards. Steps from one frequency to the next with
    one complex product.

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
    leading_zeros : int
        Entries before the lowest frequency, left alone.
    waves : (n, 2, ahead + frequencies) float32 array
        Real and imaginary parts, overwritten.
    """
    direction = math.copysign(1.0, distance)
    for i in range(radius.size):
        path = math.sqrt(radius[i] ** 2 + distance**2)
        phase = first * direction * path + (first - delay[1]) * delay[0]
        turn = step * (direction * path + delay[0])
        wave, factor = (
            complex(math.cos(phase), math.sin(phase)),
            complex(math.cos(turn), math.sin(turn)),
        )
        # the first Rayleigh-Sommerfeld integral: z / (2 pi R^2) * (1 / R - 1j * k)
        steady, rising = 1 / path, 0.0
        if continued:
            rising = abs(distance) / (2 * math.pi * path**2)
            steady = rising / path
        for w in range(waves.shape[2] - leading_zeros):
            value = wave * complex(steady, -direction * rising * (first + w * step))
            waves[i, 0, leading_zeros + w] = value.real
            waves[i, 1, leading_zeros + w] = value.imag
            # one complex product a frequency instead of a sine and a cosine; double precision keeps
            # the error below float32's
            wave *= factor


@compiled
def find_interpolation_weights(place, node, share):
    """Find the first of the `TAPS` nodes about every place, and their Lagrange weights (places,
    taps).

    Parameters
    ----------
    place : (places,) float array
        In steps of the nodes.
    node : (places,) int array
        Overwritten with the first node of each place.
    share : (places, TAPS) float array
        Overwritten with the weights.
    """
    for b in range(place.size):
        node[b] = int(place[b]) - TAPS // 2 + 1
        for i in range(TAPS):
            weight = 1.0
            for j in range(TAPS):
                if j != i:
                    weight *= (place[b] - node[b] - j) / (i - j)
            share[b, i] = weight


@compiled
def propagate_spectrum(spectrum, first, nodes, begin, offset, node_weights, coefficients, terms):
    """``terms[m] = sum_k coefficients[m, k] * transfer_k * spectrum_k`` for all plane waves and
    some depths.

    The transfer function depends on a wave's lateral wavenumber alone and is interpolated between
    its nodes, once for waves mirrored in the axes. A group is propagated to all depths while its
    spectrum is in cache, and nothing between spectrum and terms leaves it. Frequencies come in
    steps of `FREQUENCY_STEPS`.

    Parameters
    ----------
    spectrum : (groups, frequencies, 2, MIRROR_IMAGES, LANES) float32 array
        Real and imaginary parts.
    first : (groups,) int64 array
        Frequency that each group starts at.
    nodes : (depths, n, 2, frequencies) float32 array
        Transfer functions.
    begin : (groups,) int64 array
        First node that each group takes.
    offset : (groups + 1,) int64 array
        Where its interpolation weights begin; it has a multiple of `NODE_STEPS` of them.
    node_weights : (some, LANES) float32 array
        Interpolation weights.
    coefficients : (depths, m, frequencies) float32 array
        An even number of terms.
    terms : (depths, m, groups, 2, MIRROR_IMAGES, LANES) float32 array
        Overwritten.
    """
    groups, frequencies, count = spectrum.shape[0], spectrum.shape[1], coefficients.shape[1]
    waves, weights, flat = spectrum.reshape(-1), node_weights.reshape(-1), terms.reshape(-1)
    transfer, products = (
        np.empty(2 * FREQUENCY_STEPS * LANES, np.float32),
        np.empty(FREQUENCY_STEPS * GROUP_FLOATS, np.float32),
    )
    sums = np.empty(count * GROUP_FLOATS, np.float32)
    for group in range(groups):
        for depth in range(coefficients.shape[0]):
            sums[:] = 0
            for k in range(first[group], frequencies, FREQUENCY_STEPS):
                _interpolate_transfer(
                    nodes[depth],
                    begin[group],
                    k,
                    weights,
                    offset[group],
                    offset[group + 1],
                    transfer,
                )
                _apply_transfer(waves, (group * frequencies + k) * GROUP_FLOATS, transfer, products)
                _sum_frequencies(coefficients[depth], k, products, sums)
            for m in range(count):
                to = np.uint64(((depth * count + m) * groups + group) * GROUP_FLOATS)
                of = np.uint64(m * GROUP_FLOATS)
                # a loop, since assigning slices goes by way of a copy
                for i in range(np.uint64(GROUP_FLOATS)):
                    flat[to + i] = sums[of + i]


# Unsigned indices into flat arrays: an index that might be negative would keep the loops from
# becoming vector code.


@compiled
def _interpolate_transfer(nodes, node, k, weights, begin, end, transfer):
    """Transfer function (`FREQUENCY_STEPS`, 2, `LANES`) of a group at some frequencies,
    `NODE_STEPS` at a time.
    """
    flat, lanes, imaginary = nodes.reshape(-1), np.uint64(LANES), np.uint64(nodes.shape[2])
    transfer[:] = 0
    for i in range(begin, end, NODE_STEPS):
        for step in range(np.uint64(FREQUENCY_STEPS)):
            at = np.uint64((node + i - begin) * 2 * nodes.shape[2] + k) + step
            of, to = np.uint64(i * LANES), np.uint64(2) * lanes * step
            for j in range(lanes):
                along = aside = np.float32(0)
                for n in range(np.uint64(NODE_STEPS)):
                    share = weights[of + lanes * n + j]
                    along += flat[at + UINT64_TWO * imaginary * n] * share
                    aside += flat[at + UINT64_TWO * imaginary * n + imaginary] * share
                transfer[to + j] += along
                transfer[to + lanes + j] += aside


@compiled
def _apply_transfer(waves, start, transfer, products):
    """Products of a group's waves with their transfer function at some frequencies."""
    of, lanes, half = np.uint64(start), np.uint64(LANES), np.uint64(GROUP_FLOATS // 2)
    for step in range(np.uint64(FREQUENCY_STEPS)):
        at = np.uint64(2) * lanes * step
        for mirrored in range(np.uint64(MIRROR_IMAGES)):
            to = np.uint64(GROUP_FLOATS) * step + lanes * mirrored
            for j in range(lanes):
                real, imaginary = waves[of + to + j], waves[of + to + half + j]
                along, aside = transfer[at + j], transfer[at + lanes + j]
                products[to + j] = real * along - imaginary * aside
                products[to + half + j] = real * aside + imaginary * along


@compiled
def _sum_frequencies(coefficients, k, products, sums):
    """Add `FREQUENCY_STEPS` frequencies to all terms, two terms at a time."""
    size = np.uint64(GROUP_FLOATS)
    for m in range(0, coefficients.shape[0], 2):
        even, odd, to = (
            coefficients[m, k : k + FREQUENCY_STEPS],
            coefficients[m + 1, k : k + FREQUENCY_STEPS],
            np.uint64(m * GROUP_FLOATS),
        )
        for j in range(size):
            low = high = np.float32(0)
            for step in range(np.uint64(FREQUENCY_STEPS)):
                product = products[size * step + j]
                low += even[step] * product
                high += odd[step] * product
            sums[to + j] += low
            sums[to + size + j] += high


@compiled
def assemble_groups(parts, row, column, along_y, along_x, share, counts, first, spectrum):
    """Put together the plane waves of some frequencies, as many as count there, and put them into
    their groups.

    Parameters
    ----------
    parts : (4, columns, k, rows) complex64 array
        Sums with cosine and with sine along x, first with cosine and then with sine along y.
    row, column : (groups, LANES) int64 array
        Indices of the waves, not negative.
    along_y, along_x : (n,) complex64 array
        What waves of every index are multiplied by, those of negative ones by its conjugate.
    share : (groups, MIRROR_IMAGES, LANES) float32 array
        What they are multiplied by besides.
    counts : (k,) int64 array
        Lanes of all groups that count at each frequency.
    first : int
        Where the frequencies begin in `spectrum`.
    spectrum : (groups, frequencies, 2, MIRROR_IMAGES, LANES) float32 array
        Written to.
    """
    for k in range(counts.size):
        for lane in range(counts[k]):
            group, j = lane // LANES, lane % LANES
            r, c = row[group, j], column[group, j]
            cosines, across, along, sines = (
                parts[0, c, k, r],
                parts[1, c, k, r],
                parts[2, c, k, r],
                parts[3, c, k, r],
            )
            same, other = along_y[r] * along_x[c], np.conj(along_y[r]) * along_x[c]
            sums = multiply_by_minus_i(along + across), multiply_by_minus_i(across - along)
            for mirrored, wave in enumerate(
                (
                    (cosines - sines + sums[0]) * same,
                    (cosines + sines + sums[1]) * other,
                    (cosines + sines - sums[1]) * np.conj(other),
                    (cosines - sines - sums[0]) * np.conj(same),
                )
            ):
                spectrum[group, first + k, 0, mirrored, j] = wave.real * share[group, mirrored, j]
                spectrum[group, first + k, 1, mirrored, j] = wave.imag * share[group, mirrored, j]


@inlined
def multiply_by_minus_i(number):
    """Return -1j times a number."""
    return complex(number.imag, -number.real)


@compiled
def transpose(source, target):
    """Copy ``target[i, j] = source[j, i]``, in squares that stay in cache; quickest for complex64
    seen as float64.

    Parameters
    ----------
    source : (columns, rows) array
    target : (rows, columns) array
        Overwritten.
    """
    rows, columns = target.shape
    for top in range(0, rows, TILE_SIDE):
        for left in range(0, columns, TILE_SIDE):
            if top + TILE_SIDE <= rows and left + TILE_SIDE <= columns:
                square, turned = (
                    source[left : left + TILE_SIDE, top : top + TILE_SIDE],
                    target[top:, left : left + TILE_SIDE],
                )
                # A fixed number of steps becomes vector code.
                for i in range(np.uint64(TILE_SIDE)):
                    for j in range(np.uint64(TILE_SIDE)):
                        turned[i, j] = square[j, i]
            else:
                for i in range(top, min(top + TILE_SIDE, rows)):
                    for j in range(left, min(left + TILE_SIDE, columns)):
                        target[i, j] = source[j, i]


@compiled
def scatter_terms(terms, cell, folded, spectra):
    """Put the waves of some terms into their cells.

    Parameters
    ----------
    terms : (m, groups, 2, MIRROR_IMAGES, LANES) float32 array
        Real and imaginary parts.
    cell : (groups, MIRROR_IMAGES, LANES) int64 array
    folded : bool
        Waves may meet in one cell, and then add up.
    spectra : (m, cells) complex64 array
    """
    flat, cells, half = terms.reshape(-1), cell.reshape(-1), np.uint64(GROUP_FLOATS // 2)
    for m in range(terms.shape[0]):
        if folded:
            spectra[m] = 0
        for group in range(terms.shape[1]):
            of, to = np.uint64((m * terms.shape[1] + group) * GROUP_FLOATS), np.uint64(group) * half
            for j in range(half):
                wave = complex(flat[of + j], flat[of + half + j])
                if folded:
                    wave += spectra[m, cells[to + j]]
                spectra[m, cells[to + j]] = wave
