"""Compiled inner loops of diffraction from plane to planes."""

from __future__ import annotations

import math

import numpy as np

from tofclip.compiling import SUMS_IN_ANY_ORDER, compile_and_keep, compile_as_part, inlined
from tofclip.vectors import LENGTH, STEP, fill_vector, load_vector, store_vector

compiled = compile_and_keep(fastmath=SUMS_IN_ANY_ORDER, error_model="numpy")

part_of_loop = compile_as_part(_nrt=False)

# Side of the squares that matrices are transposed in: two cache lines of complex64.
TILE_SIDE = 16
# Nodes that the interpolation along the radius takes.
TAPS = 6
# Neighbours in lateral wavenumber, two vectors of 512 bits, and their images in the axes.
LANES, MIRROR_IMAGES = 32, 4
# Real numbers of such a group at one frequency.
GROUP_FLOATS = 2 * MIRROR_IMAGES * LANES
WAVE_LANES = np.uintp(LANES)

# Frequencies of the transfer function that stay in registers.
FREQUENCY_STEPS = 8


@compiled
def sample_waves(radius, distance, first, step, delay, continued, leading_zeros, waves):
    """Overwrite `waves` (n, 2, zeros + frequencies), but for the leading zeros, with real and
    imaginary parts of ``exp(1j * (k * R + (k - k_0) * path)) / R``, R from a source to `radius`
    (n,) at a distance along the axis, backwards if negative, or, if `continued`, as the first
    Rayleigh-Sommerfeld integral has it. `delay` (2,): path, m, and k_0; `first, step`: of the
    wavenumbers, rad/m.
    """
    direction = math.copysign(1.0, distance)
    for i in range(radius.size):
        path = math.sqrt(radius[i] ** 2 + distance**2)
        phase = first * direction * path + (first - delay[1]) * delay[0]
        turn = step * (direction * path + delay[0])
        wave = complex(math.cos(phase), math.sin(phase))
        factor = complex(math.cos(turn), math.sin(turn))
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
    """Overwrite `node` (places,) with the first of `TAPS` nodes about every place, in their steps,
    and `share` (places, TAPS) with Lagrange weights.
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
    some depths: the transfer function is interpolated between its nodes once for waves mirrored in
    the axes, and a group goes to all depths while its spectrum is in cache.

    `spectrum` (groups, frequencies, 2, MIRROR_IMAGES, LANES), real and imaginary parts, each group
    from frequency `first` (groups,) on; `nodes` (depths, n, 2, frequencies), of which it takes
    those from `begin` (groups,) on by `node_weights` (some, LANES) from `offset` (groups + 1,) on;
    `coefficients` (depths, m, frequencies): m is even; `terms` (depths, m, groups, 2,
    MIRROR_IMAGES, LANES): overwritten.
    """
    groups, frequencies, count = spectrum.shape[0], spectrum.shape[1], coefficients.shape[1]
    waves, weights, flat = spectrum.reshape(-1), node_weights.reshape(-1), terms.reshape(-1)
    at_nodes, shares = nodes.reshape(-1), coefficients.reshape(-1)
    transfer = np.empty(2 * frequencies * LANES, np.float32)
    products = np.empty(4 * frequencies * LENGTH, np.float32)
    row, stride = np.uintp(frequencies), np.uintp(groups * GROUP_FLOATS)
    for group in range(groups):
        lowest = first[group]
        steps = np.uintp(frequencies - lowest)
        of = (group * frequencies + lowest) * GROUP_FLOATS
        for depth in range(coefficients.shape[0]):
            node = (depth * nodes.shape[1] + begin[group]) * 2 * frequencies + lowest
            share_begin = np.uintp(offset[group] * LANES)
            share_end = np.uintp(offset[group + 1] * LANES)
            of_nodes = at_nodes, np.uintp(node), row
            _interpolate_transfer(of_nodes, weights, share_begin, share_end, steps, transfer)
            for part in range(2 * LANES // LENGTH):
                # two mirrored waves, and half of their lanes
                lane = part % 2 * LENGTH
                place = part // 2 * 2 * LANES + lane
                _apply_transfer(
                    waves, np.uintp(of + place), transfer, np.uintp(lane), steps, products
                )
                for m in range(0, count, 4):
                    share = np.uintp((depth * count + m) * frequencies + lowest)
                    to = np.uintp(((depth * count + m) * groups + group) * GROUP_FLOATS + place)
                    if m + 4 <= count:
                        _sum_four_terms(products, shares, share, row, steps, flat, to, stride)
                    else:
                        _sum_two_terms(products, shares, share, row, steps, flat, to, stride)


# Unsigned indices into flat arrays, and vectors that are written down: in loops over lanes,
# frequencies and terms the compiler keeps no sums in registers.


@part_of_loop
def _interpolate_transfer(of_nodes, weights, begin, end, steps, transfer):
    """Transfer function (frequencies, 2, `LANES`) of a group, `FREQUENCY_STEPS` at a time."""
    nodes, start, row = of_nodes
    zero = fill_vector(np.float32(0))
    nothing = (zero, zero, zero, zero, zero, zero, zero, zero)
    for lane in range(np.uintp(0), WAVE_LANES, STEP):
        for k in range(np.uintp(0), steps, np.uintp(FREQUENCY_STEPS)):
            real, imaginary, node = nothing, nothing, start + k
            for weight in range(begin + lane, end, WAVE_LANES):
                share = load_vector(weights, weight)
                real = _add_eight(real, share, nodes, node)
                imaginary = _add_eight(imaginary, share, nodes, node + row)
                node += row + row
            to = k * (WAVE_LANES + WAVE_LANES) + lane
            _store_eight(transfer, to, real)
            _store_eight(transfer, to + WAVE_LANES, imaginary)


@part_of_loop
def _add_eight(sums, lanes, numbers, at):
    """Add lanes times each of eight numbers to eight vectors."""
    return (
        sums[0] + lanes * fill_vector(numbers[at]),
        sums[1] + lanes * fill_vector(numbers[at + np.uintp(1)]),
        sums[2] + lanes * fill_vector(numbers[at + np.uintp(2)]),
        sums[3] + lanes * fill_vector(numbers[at + np.uintp(3)]),
        sums[4] + lanes * fill_vector(numbers[at + np.uintp(4)]),
        sums[5] + lanes * fill_vector(numbers[at + np.uintp(5)]),
        sums[6] + lanes * fill_vector(numbers[at + np.uintp(6)]),
        sums[7] + lanes * fill_vector(numbers[at + np.uintp(7)]),
    )


@part_of_loop
def _store_eight(transfer, to, sums):
    """Write eight frequencies of the transfer function."""
    step = WAVE_LANES + WAVE_LANES
    store_vector(transfer, to, sums[0])
    store_vector(transfer, to + step, sums[1])
    store_vector(transfer, to + np.uintp(2) * step, sums[2])
    store_vector(transfer, to + np.uintp(3) * step, sums[3])
    store_vector(transfer, to + np.uintp(4) * step, sums[4])
    store_vector(transfer, to + np.uintp(5) * step, sums[5])
    store_vector(transfer, to + np.uintp(6) * step, sums[6])
    store_vector(transfer, to + np.uintp(7) * step, sums[7])


@part_of_loop
def _apply_transfer(waves, of, transfer, lane, steps, products):
    """Products of two mirrored waves with their transfer function at all frequencies."""
    to, half = np.uintp(0), np.uintp(GROUP_FLOATS // 2)
    for _ in range(steps):
        along, aside = load_vector(transfer, lane), load_vector(transfer, lane + WAVE_LANES)
        for wave in range(of, of + WAVE_LANES + WAVE_LANES, WAVE_LANES):
            real, imaginary = load_vector(waves, wave), load_vector(waves, wave + half)
            store_vector(products, to, real * along - imaginary * aside)
            store_vector(products, to + STEP, real * aside + imaginary * along)
            to += STEP + STEP
        lane += WAVE_LANES + WAVE_LANES
        of += np.uintp(GROUP_FLOATS)


@part_of_loop
def _sum_four_terms(products, shares, share, row, steps, terms, to, stride):
    """Sum two waves over all frequencies, for four terms."""
    zero = fill_vector(np.float32(0))
    first = second = third = fourth = (zero, zero, zero, zero)
    of = np.uintp(0)
    for _ in range(steps):
        two = _load_two_waves(products, of)
        first = _add_two_waves(first, two, shares[share])
        second = _add_two_waves(second, two, shares[share + row])
        third = _add_two_waves(third, two, shares[share + row + row])
        fourth = _add_two_waves(fourth, two, shares[share + row + row + row])
        of += np.uintp(4 * LENGTH)
        share += np.uintp(1)
    _store_two_waves(terms, to, first)
    _store_two_waves(terms, to + stride, second)
    _store_two_waves(terms, to + stride + stride, third)
    _store_two_waves(terms, to + stride + stride + stride, fourth)


@part_of_loop
def _sum_two_terms(products, shares, share, row, steps, terms, to, stride):
    """Sum two waves over all frequencies, for two terms."""
    zero = fill_vector(np.float32(0))
    first = second = (zero, zero, zero, zero)
    of = np.uintp(0)
    for _ in range(steps):
        two = _load_two_waves(products, of)
        first = _add_two_waves(first, two, shares[share])
        second = _add_two_waves(second, two, shares[share + row])
        of += np.uintp(4 * LENGTH)
        share += np.uintp(1)
    _store_two_waves(terms, to, first)
    _store_two_waves(terms, to + stride, second)


@part_of_loop
def _load_two_waves(products, of):
    """Real and imaginary parts of two waves."""
    return (
        load_vector(products, of),
        load_vector(products, of + STEP),
        load_vector(products, of + STEP + STEP),
        load_vector(products, of + STEP + STEP + STEP),
    )


@part_of_loop
def _add_two_waves(sums, waves, share):
    """Add a share of two waves."""
    everywhere = fill_vector(share)
    return (
        sums[0] + everywhere * waves[0],
        sums[1] + everywhere * waves[1],
        sums[2] + everywhere * waves[2],
        sums[3] + everywhere * waves[3],
    )


@part_of_loop
def _store_two_waves(terms, to, sums):
    """Write the sums of two waves of one term."""
    half = np.uintp(GROUP_FLOATS // 2)
    store_vector(terms, to, sums[0])
    store_vector(terms, to + half, sums[1])
    store_vector(terms, to + WAVE_LANES, sums[2])
    store_vector(terms, to + half + WAVE_LANES, sums[3])


@compiled
def assemble_groups(parts, row, column, along_y, along_x, share, counts, first, spectrum):
    """Put the plane waves of some frequencies, as many as `counts` (k,), into their groups of
    `spectrum` (groups, frequencies, 2, MIRROR_IMAGES, LANES), from frequency `first` on. `parts`
    (4, columns, k, rows): sums with cosine and sine along x, first with cosine, then with sine
    along y; `row, column` (groups, LANES): indices; `along_y, along_x` (n,), conjugate for negative
    indices, and `share` (groups, MIRROR_IMAGES, LANES) multiply them.
    """
    for k in range(counts.size):
        for lane in range(counts[k]):
            group, j = lane // LANES, lane % LANES
            r, c = row[group, j], column[group, j]
            cosines, across = parts[0, c, k, r], parts[1, c, k, r]
            along, sines = parts[2, c, k, r], parts[3, c, k, r]
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
    """Copy ``target[i, j] = source[j, i]`` in squares that stay in cache; complex64 as float64."""
    rows, columns = target.shape
    for top in range(0, rows, TILE_SIDE):
        for left in range(0, columns, TILE_SIDE):
            if top + TILE_SIDE <= rows and left + TILE_SIDE <= columns:
                square = source[left : left + TILE_SIDE, top : top + TILE_SIDE]
                turned = target[top:, left : left + TILE_SIDE]
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
    """Put the waves of terms (m, groups, 2, MIRROR_IMAGES, LANES) into their cells of `spectra` (m,
    cells); add up those that meet, if `folded`.
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
