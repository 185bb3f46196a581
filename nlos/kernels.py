"""Compiled inner loops that methods of imaging around corners share, and that of f-k migration."""

from __future__ import annotations

import math

import numpy as np

from tofclip.compiling import compile_and_keep, inlined

# Only multiply and add are fused: exact zeros at the ends of the waveforms have to stay exact.
compiled = compile_and_keep(fastmath={"contract"}, error_model="numpy")

# Distance in m below which the weight 1 / distance stops growing, for voxels that touch the wall.
MIN_DISTANCE_M = 1e-3
# Polynomials in the square of an angle in cycles, fitted to cos(2 pi t) and sin(2 pi t) / t up to
# half a cycle; from the constant term on.
COSINE = (1.0, -19.739208, 64.939392, -85.456657, 60.242130, -26.404669, 7.8001313, -1.4531124)
SINE = (6.2831855, -41.341702, 81.605133, -76.703018, 42.025928, -14.899847, 3.2381375)


@inlined
def cosine_of_cycles(cycles):
    """Cosine of an angle of -0.5 to 0.5 cycles, to 1e-6."""
    u = cycles * cycles
    return _evaluate(COSINE, u, np.float32(COSINE[6]) + u * np.float32(COSINE[7]))


@inlined
def sine_of_cycles(cycles):
    """Sine of an angle of -0.5 to 0.5 cycles, to 1e-6."""
    return cycles * _evaluate(SINE, cycles * cycles, np.float32(SINE[6]))


@inlined
def _evaluate(c, u, last):
    """Polynomial by Horner's rule, whose coefficients from the sixth order on make up `last`."""
    last = np.float32(c[4]) + u * (np.float32(c[5]) + u * last)
    last = np.float32(c[2]) + u * (np.float32(c[3]) + u * last)
    return np.float32(c[0]) + u * (np.float32(c[1]) + u * last)


@compiled
def shift_signals(signal, delay_bins):
    """Read column p of `signal` (t, points) `delay_bins[p]` bins later, linearly; 0 outside."""
    bins, points = signal.shape
    result = np.zeros_like(signal)
    for i in range(bins):
        for p in range(points):
            position = i + delay_bins[p]
            if 0 <= position <= bins - 1:
                # so that the record's last bin itself can be read
                before = min(int(position), bins - 2)
                weight = np.float32(position - before)
                value = signal[before, p]
                result[i, p] = value + weight * (signal[before + 1, p] - value)
    return result


def rebin(values, edges, wanted):
    """Sums (..., m) between `wanted` edges (m + 1,) of sums (..., n) between `edges` (n + 1,), each
    spread evenly; what lies outside is lost.
    """
    # The running sum is interpolated: differences of it lose nothing and count nothing twice.
    arrived = np.cumsum(values, axis=-1, dtype=np.float64)
    before = np.clip(np.searchsorted(edges, wanted, side="right") - 1, 0, edges.size - 2)
    part = np.clip((wanted - edges[before]) / (edges[before + 1] - edges[before]), 0, 1)
    reached = np.take(arrived, before, axis=-1) - (1 - part) * np.take(values, before, axis=-1)
    return np.diff(reached, axis=-1).astype(np.float32)


@compiled
def add_backprojection(waveforms, start, spacing, wall, lasers, x, y, z, powers, field):
    """Add every wall point's waveform (points, 2 * samples), real and imaginary parts interleaved,
    read at each voxel's path and divided by the last leg, to `field` (z, y, x), a brick so small
    that its paths span a piece of waveform that stays in cache. The first and the last two samples
    are 0; `start, spacing`: path of the first and between two, m; `lasers`: one or one for each
    point; `powers` (2,): further weights, of the last leg and of the cosine of its angle with z.
    """
    per_metre = np.float32(1) / spacing
    # Of every voxel: real and imaginary part of the sample before its path, then of the one after.
    sums = np.zeros((z.size, y.size, 4 * x.size), np.float32)
    outward = np.empty((z.size, y.size, x.size), np.float32)
    sample, weights = np.empty(x.size, np.int32), np.empty((2, x.size), np.float32)
    before, after = weights[0], weights[1]
    weighted = powers[0] != 0 or powers[1] != 0
    for p in range(wall.shape[0]):
        # The outgoing leg is the same for all points that share a laser spot: in an exhaustive capture
        # many in a row.
        if p == 0 or (p < lasers.shape[0] and np.any(lasers[p] != lasers[p - 1])):
            _compute_outward_samples(lasers[p], start, per_metre, x, y, z, outward)
        for iz in range(z.size):
            for iy in range(y.size):
                across = (y[iy] - wall[p, 1]) ** 2 + (z[iz] - wall[p, 2]) ** 2
                last = np.float32(waveforms.shape[1] // 2 - 2)
                _find_samples(
                    x, wall[p, 0], across, outward[iz, iy], per_metre, last, sample, before, after
                )
                if weighted:
                    ahead = max(z[iz] - wall[p, 2], np.float32(0))
                    _apply_weights(x, wall[p, 0], across, ahead, powers, weights)
                _add_samples(waveforms[p], sample, before, after, sums[iz, iy])
    for iz in range(z.size):
        for iy in range(y.size):
            row = sums[iz, iy].reshape(-1, 2, 2)
            for ix in range(x.size):
                field[iz, iy, ix] += complex(
                    row[ix, 0, 0] + row[ix, 1, 0], row[ix, 0, 1] + row[ix, 1, 1]
                )


@compiled
def _compute_outward_samples(laser, start, per_metre, x, y, z, outward):
    """Distance from the laser spot to every voxel, less `start`, in samples."""
    for iz in range(z.size):
        for iy in range(y.size):
            across = (y[iy] - laser[1]) ** 2 + (z[iz] - laser[2]) ** 2
            for ix in range(x.size):
                distance = math.sqrt((x[ix] - laser[0]) ** 2 + across)
                outward[iz, iy, ix] = (distance - start) * per_metre


@compiled
def _find_samples(x, wall_x, across, outward, per_metre, last, sample, before, after):
    """Where a row of voxels reads a waveform: the sample before, and its and the next's weights."""
    across = max(across, np.float32(MIN_DISTANCE_M * MIN_DISTANCE_M))
    for ix in range(x.size):
        distance = math.sqrt((x[ix] - wall_x) ** 2 + across)
        position = min(max(outward[ix] + distance * per_metre, np.float32(0)), last)
        index = np.int32(position)
        sample[ix] = np.int32(2) * index
        weight = np.float32(1) / distance
        # linear interpolation, and the fall with distance that the wave has on its way back
        after[ix] = (position - np.float32(index)) * weight
        before[ix] = weight - after[ix]


@compiled
def _raise_to_power(base, exponent):
    """Power of a number, quick for the exponents that occur most."""
    # the usual exponents without a logarithm
    if exponent == 0:
        return np.float32(1)
    if exponent == 1:
        return base
    return base**exponent


@compiled
def _apply_weights(x, wall_x, across, ahead, powers, weights):
    """Multiply a row's weights by powers of their distance and of their direction's cosine."""
    across = max(across, np.float32(MIN_DISTANCE_M * MIN_DISTANCE_M))
    for ix in range(x.size):
        distance = math.sqrt((x[ix] - wall_x) ** 2 + across)
        factor = _raise_to_power(distance, powers[0]) * _raise_to_power(ahead / distance, powers[1])
        weights[0, ix] *= factor
        weights[1, ix] *= factor


@compiled
def _add_samples(waveform, sample, before, after, sums):
    """Add two neighbouring complex samples per voxel: one vector load, one multiply-add."""
    for ix in range(sample.size):
        first, place = np.uint32(sample[ix]), 4 * ix
        sums[place] += before[ix] * waveform[first]
        sums[place + 1] += before[ix] * waveform[first + 1]
        sums[place + 2] += after[ix] * waveform[first + 2]
        sums[place + 3] += after[ix] * waveform[first + 3]


@compiled
def add_illuminated_terms(terms, odd, x, y, depth, laser, wavenumber, table, span, carrier, field):
    """Add ``sum_m terms[m] * f_m(R) * exp(1j * wavenumber * R)``, R the distance from the laser
    spot, to a plane (y, x). Terms from `odd` on are multiplied by 1j; `table` (m, samples): f_m,
    evenly spaced from ``span[0]`` to ``span[1]``; `carrier` (x,) multiplies columns; m and rad/m.
    """
    before, weight = np.empty(x.size, np.uint32), np.empty(x.size, np.float32)
    sums, waves = np.empty((2, x.size), np.float32), np.empty((2, x.size), np.float32)
    # A plane of one voxel has a span of 0: any sample is right there.
    per_metre = (table.shape[1] - 1) / max(span[1] - span[0], 1e-12)
    cycles_per_metre = wavenumber / (2 * math.pi)
    for iy in range(y.size):
        across = (y[iy] - laser[1]) ** 2 + (depth - laser[2]) ** 2
        for ix in range(x.size):
            # The wave oscillates across the plane and is computed; f_m is smooth and interpolated.
            distance = math.sqrt((x[ix] - laser[0]) ** 2 + across)
            place = max((distance - span[0]) * per_metre, 0.0)
            # So that the last sample has a neighbour behind it; the weight is then 1.
            sample = min(int(place), table.shape[1] - 2)
            before[ix], weight[ix] = sample, place - sample
            waves[0, ix], waves[1, ix] = _compute_wave(distance * cycles_per_metre)
        sums[:] = 0
        for m in range(terms.shape[0]):
            _add_term(terms[m, iy], table[m], before, weight, m >= odd, sums)
        for ix in range(x.size):
            wave = complex(waves[0, ix], waves[1, ix]) * carrier[ix]
            field[iy, ix] += complex(sums[0, ix], sums[1, ix]) * wave


@compiled
def add_with_carrier(values, x, y, z, laser, wavenumber, field):
    """Add ``values * exp(1j * wavenumber * R)``, R the distance from the laser spot, to a field (z,
    y, x); lengths in m, `wavenumber` in rad/m.
    """
    waves = np.empty((2, x.size), np.float32)
    cycles_per_metre = wavenumber / (2 * math.pi)
    for iz in range(z.size):
        for iy in range(y.size):
            across = (y[iy] - laser[1]) ** 2 + (z[iz] - laser[2]) ** 2
            # in a loop of its own, since what is complex keeps it from being done in vectors
            for ix in range(x.size):
                distance = math.sqrt((x[ix] - laser[0]) ** 2 + across)
                waves[0, ix], waves[1, ix] = _compute_wave(distance * cycles_per_metre)
            for ix in range(x.size):
                field[iz, iy, ix] += values[iz, iy, ix] * complex(waves[0, ix], waves[1, ix])


@compiled
def _compute_wave(cycles):
    """Real and imaginary part of the carrier wave after some cycles."""
    cycles -= math.floor(cycles + 0.5)
    return cosine_of_cycles(np.float32(cycles)), sine_of_cycles(np.float32(cycles))


@compiled
def _add_term(term, samples, before, weight, odd, sums):
    """Add a row of one term times its function, and 1j if `odd`."""
    real, imaginary = sums[0], sums[1]
    for ix in range(before.size):
        value = samples[before[ix]]
        value += weight[ix] * (samples[before[ix] + np.uint32(1)] - value)
        if odd:
            real[ix] -= value * term[ix].imag
            imaginary[ix] += value * term[ix].real
        else:
            real[ix] += value * term[ix].real
            imaginary[ix] += value * term[ix].imag


@compiled
def migrate_row(spectrum, ky, kx, delay):
    """Resample a row of a spectrum (kx, frequency) to depth wavenumbers, in place: ``kz / k * S(kx,
    ky, k)`` with ``k = sqrt(kx^2 + ky^2 + kz^2)``, S linearly interpolated and delayed by `delay`,
    rad per sample of frequency; `kx` (columns,) in such samples.
    """
    count = spectrum.shape[1]
    for column in range(spectrum.shape[0]):
        lateral = kx[column] * kx[column] + ky * ky
        row = spectrum[column]
        # Samples are read at or beyond where they are written: upwards nothing is lost.
        for depth in range(count):
            place = math.sqrt(depth * depth + lateral)
            below = int(place)
            if depth == 0 or below >= count - 1:
                row[depth] = 0
                continue
            fraction = np.float32(place - below)
            value = row[below] + fraction * (row[below + 1] - row[below])
            weight = depth / place
            along, aside = weight * math.cos(delay * place), -weight * math.sin(delay * place)
            row[depth] = value * complex(np.float32(along), np.float32(aside))
