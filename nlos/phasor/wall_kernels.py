"""Compiled inner loops of the way from the wall to a plane."""

from __future__ import annotations

import math

import numpy as np

from nlos.kernels import MIN_DISTANCE_M, cosine_of_cycles, sine_of_cycles
from nlos.phasor.to_depths_kernels import TAPS
from tofclip.compiling import SUMS_IN_ANY_ORDER, compile_and_keep

compiled = compile_and_keep(fastmath=SUMS_IN_ANY_ORDER, error_model="numpy")

UINT64_ONE = np.uint64(1)

# Points of the plane treated together: four full vectors of 512 bits.
TARGET_LANES = 64
# Frequencies for which a wave stays in registers.
FREQUENCY_STEPS = 8
# float32 factors in a vector of 512 bits.
VECTOR_FLOATS = 16


@compiled
def add_spherical_waves(sources, phasors, targets, first, step, sums):
    """Sum ``phasors * exp(1j * k * R) / R`` over all sources, for `TARGET_LANES` targets.

    The exponential is computed at the lowest wavenumber and continued by ``e_(w+1) = 2 cos(dk R)
    e_w - e_(w-1)``, two products instead of four. All that the inner loop writes lies in two flat
    arrays, so that it becomes vector code.

    `sources` (n, 3): m; `phasors` (n, 2 * frequencies): real and imaginary parts interleaved; the
    number of frequencies is a multiple of `FREQUENCY_STEPS`; `targets` (3 * LANES,): all x, all y,
    all z, m; `first, step`: lowest wavenumber and distance of neighbouring ones, in cycles per m;
    `sums` (frequencies * 2 * LANES,): added to: per frequency all real, then all imaginary parts.
    """
    wave = np.empty(5 * TARGET_LANES, np.float32)
    for p in range(sources.shape[0]):
        _start_waves(sources[p, 0], sources[p, 1], sources[p, 2], targets, first, step, wave)
        for w in range(0, phasors.shape[1] // 2, FREQUENCY_STEPS):
            _add_frequencies(phasors[p], w, wave, sums)


@compiled
def _start_waves(x, y, z, targets, first, step, wave):
    """Lowest wave of every target over its distance, the one a step below, and ``2 cos(dk R)``."""
    for j in range(TARGET_LANES):
        across = (
            (targets[j] - x) ** 2
            + (targets[TARGET_LANES + j] - y) ** 2
            + (targets[2 * TARGET_LANES + j] - z) ** 2
        )
        distance = math.sqrt(max(across, np.float32(MIN_DISTANCE_M * MIN_DISTANCE_M)))
        weight = np.float32(1) / distance
        cycles = distance * first
        cycles -= math.floor(cycles + np.float32(0.5))
        real, imaginary = cosine_of_cycles(cycles) * weight, sine_of_cycles(cycles) * weight
        cycles = distance * step
        cycles -= math.floor(cycles + np.float32(0.5))
        along, aside = cosine_of_cycles(cycles), sine_of_cycles(cycles)
        wave[j], wave[TARGET_LANES + j] = real, imaginary
        wave[2 * TARGET_LANES + j] = real * along + imaginary * aside
        wave[3 * TARGET_LANES + j] = imaginary * along - real * aside
        wave[4 * TARGET_LANES + j] = along + along


@compiled
def _add_frequencies(phasors, w, wave, sums):
    """Add `FREQUENCY_STEPS` frequencies of one source and leave the waves of the next one."""
    own = phasors[2 * w : 2 * (w + FREQUENCY_STEPS)]
    # Unsigned, because an index that might be negative keeps a loop from becoming vector code.
    place = np.uint64(2 * TARGET_LANES * w)
    for j in range(TARGET_LANES):
        cosine, sine = wave[j], wave[TARGET_LANES + j]
        cosine_before, sine_before, twice = (
            wave[2 * TARGET_LANES + j],
            wave[3 * TARGET_LANES + j],
            wave[4 * TARGET_LANES + j],
        )
        for n in range(FREQUENCY_STEPS):
            real, imaginary = own[2 * n], own[2 * n + 1]
            sums[place + np.uint64(2 * TARGET_LANES * n + j)] += real * cosine - imaginary * sine
            sums[place + np.uint64(2 * TARGET_LANES * n + TARGET_LANES + j)] += (
                real * sine + imaginary * cosine
            )
            cosine, cosine_before = twice * cosine - cosine_before, cosine
            sine, sine_before = twice * sine - sine_before, sine
        wave[j], wave[TARGET_LANES + j] = cosine, sine
        wave[2 * TARGET_LANES + j], wave[3 * TARGET_LANES + j] = cosine_before, sine_before


@compiled
def shift_and_sum(signals, sources, targets, scale, latest, sums):
    """Add every source's signal, moved earlier by its way to a target and divided by it, to the
    target's. `signals` (n, bins); `sources, targets` (n, 3): m; `scale`: bins per m of distance;
    `latest`: distance in bins that bin 0 of the results is early by; at least the largest; `sums`
    (m, bins): added to; long enough for the earliest and the latest arrival.
    """
    bins = signals.shape[1]
    for v in range(targets.shape[0]):
        for p in range(sources.shape[0]):
            across = (targets[v, 0] - sources[p, 0]) ** 2 + (targets[v, 1] - sources[p, 1]) ** 2
            distance = math.sqrt(
                max(across + (targets[v, 2] - sources[p, 2]) ** 2, MIN_DISTANCE_M * MIN_DISTANCE_M)
            )
            position = latest - distance * scale
            before = int(position)
            later = np.float32((position - before) / distance)
            _add_shifted(
                signals[p],
                np.float32(1 / distance) - later,
                later,
                sums[v, before : before + bins + 1],
            )


@compiled
def _add_shifted(signal, now, later, total):
    """Add a signal between two bins; `total` is one longer."""
    total[0] += now * signal[0]
    total[signal.size] += later * signal[signal.size - 1]
    for i in range(1, signal.size):
        total[i] += now * signal[i] + later * signal[i - 1]


@compiled
def add_low_rank_terms(
    spectra, node_factors, node, weight, reach, shift_x, shift_y, cell_x, cell_y, joined
):
    """Add ``sum_m factor_m(q) * spectra[m]``, moved by an offset in space, to the plane waves of a
    flat spectrum.

    The factors depend on the lateral wavenumber alone and are interpolated once for a column and
    its mirror image.

    `spectra` (m, columns, 2 * rows): real and imaginary parts interleaved; columns and rows in the
    order of Fourier transforms; `node_factors` (nodes, n): factors at the nodes: the real parts of
    all m terms, then the imaginary parts, then anything; `node` (columns, rows): first node about
    every wave whose indices are not negative; `weight` (columns, rows, taps): weights of the nodes
    from it on; `reach` (some columns,): largest index along y that counts in every column from 0
    on; `shift_x, shift_y`: phases of all indices from the most negative on; `cell_x, cell_y`: where
    plane waves go: the sum of the numbers of their indices; `joined` (cells,): added to.
    """
    highest = shift_y.size // 2
    factors = np.empty((node_factors.shape[1], shift_y.size), np.float32)
    line = np.empty(2 * shift_y.size, np.float32)
    for column in range(reach.size):
        tall = reach[column]
        _interpolate_factors(
            node_factors, node[column], weight[column], tall, 2 * spectra.shape[0], factors
        )
        for x in range(-column, column + 1, max(1, 2 * column)):
            _add_terms(spectra, x % spectra.shape[1], factors, tall, line)
            along, to = shift_x[shift_x.size // 2 + x], cell_x[cell_x.size // 2 + x]
            for y in range(highest - tall, highest + tall + 1):
                joined[to + cell_y[y]] += complex(line[2 * y], line[2 * y + 1]) * along * shift_y[y]


@compiled
def _interpolate_factors(node_factors, node, weight, tall, wanted, factors):
    """Interpolate the factors of a column from index 0 to `tall` between the nodes, and mirror
    them.
    """
    count, wide, lanes = node_factors.shape[1], factors.shape[1], np.uint64(VECTOR_FLOATS)
    flat, tap_weights, mirrored = node_factors.reshape(-1), weight.reshape(-1), factors.reshape(-1)
    square = np.empty(VECTOR_FLOATS * VECTOR_FLOATS, np.float32)
    for start in range(0, tall + 1, VECTOR_FLOATS):
        rows = min(VECTOR_FLOATS, tall + 1 - start)
        for m in range(0, wanted, VECTOR_FLOATS):
            for row in range(rows):
                of, weights = (
                    np.uint64(node[start + row] * count + m),
                    np.uint64((start + row) * TAPS),
                )
                for lane in range(lanes):
                    total = np.float32(0)
                    for tap in range(np.uint64(TAPS)):
                        total += (
                            tap_weights[weights + tap] * flat[of + tap * np.uint64(count) + lane]
                        )
                    square[np.uint64(row) * lanes + lane] = total
            for lane in range(min(VECTOR_FLOATS, wanted - m)):
                middle = (m + lane) * wide + wide // 2
                after, before = np.uint64(middle + start), np.uint64(middle - start - rows + 1)
                for row in range(np.uint64(rows)):
                    mirrored[after + row] = square[row * lanes + np.uint64(lane)]
                for row in range(np.uint64(rows)):
                    mirrored[before + row] = square[
                        (np.uint64(rows - 1) - row) * lanes + np.uint64(lane)
                    ]


@compiled
def _add_terms(spectra, column, factors, tall, line):
    """Leave the sum of all terms of a column in the middle of `line`; a spectrum shorter than it
    repeats itself.
    """
    terms, rows, highest = spectra.shape[0], spectra.shape[2] // 2, factors.shape[1] // 2
    # Flat arrays and unsigned indices: an index that might be negative would keep the loop from
    # becoming vector code.
    values, real = spectra.reshape(-1), factors.reshape(-1)
    imaginary = real[terms * factors.shape[1] :]
    line[2 * (highest - tall) : 2 * (highest + tall + 1)] = 0
    for m in range(terms):
        y, row = highest - tall, -tall % rows
        while y <= highest + tall:
            count = min(rows - row, highest + tall + 1 - y)
            at, to = np.uint64(m * factors.shape[1] + y), np.uint64(2 * y)
            of = np.uint64(2 * ((m * spectra.shape[1] + column) * rows + row))
            for i in range(np.uint64(count)):
                a, b, c, d = (
                    real[at + i],
                    imaginary[at + i],
                    values[of + i + i],
                    values[of + i + i + UINT64_ONE],
                )
                line[to + i + i] += a * c - b * d
                line[to + i + i + UINT64_ONE] += a * d + b * c
            y, row = y + count, 0
