"""Compiled inner loop of f-k migration."""

from __future__ import annotations

import math

import numpy as np

from nlos.kernels import compiled


@compiled
def migrate_row(spectrum, ky, kx, delay):
    """Resample a row of a spectrum (kx, frequency) to depth wavenumbers, in place.

    ``F(kx, ky, kz) = kz / k * S(kx, ky, k)`` with ``k = sqrt(kx^2 + ky^2 + kz^2)``, S linearly
    interpolated and then delayed by the time that was taken off it.

    `spectrum` (columns, frequencies); `kx` (columns,): lateral wavenumbers in samples of the
    frequency axis; `delay`: phase per sample of frequency by which the spectrum is ahead of its
    time, rad.
    """
    count = spectrum.shape[1]
    for column in range(spectrum.shape[0]):
        lateral = kx[column] * kx[column] + ky * ky
        row = spectrum[column]
        # Every sample is read at or beyond where it is written, so that going upwards nothing is
        # overwritten too soon.
        for depth in range(count):
            place = math.sqrt(depth * depth + lateral)
            below = int(place)
            if depth == 0 or below >= count - 1:
                row[depth] = 0
                continue
            fraction = np.float32(place - below)
            value = row[below] + fraction * (row[below + 1] - row[below])
            weight = depth / place
            turned = complex(
                np.float32(weight * math.cos(delay * place)),
                np.float32(-weight * math.sin(delay * place)),
            )
            row[depth] = value * turned
