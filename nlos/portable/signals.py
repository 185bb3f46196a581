"""Signals of a capture as arrays of any library, and their phasors."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.band import Band
from nlos.capture import Capture
from nlos.illumination_groups import IlluminationGroup
from nlos.plane import WallLattice
from nlos.portable.library import ArrayLibrary
from tofclip.arrays import Array


class BandTransform:
    """The Fourier transform of signals at a band's frequencies, as a matrix that is kept where the
    signals live.

    `bins`: of the signals; a band may have been made for a longer record.
    """

    def __init__(self, band: Band, bins: int, library: ArrayLibrary) -> None:
        paths = band.axis.start + band.axis.spacing * np.arange(bins)
        waves = band.weights * np.exp(-1j * np.outer(paths, band.wavenumbers))
        self._library, self._real, self._imaginary = (
            library,
            library.put(waves.real),
            library.put(waves.imag),
        )

    def of(self, traces: Array) -> Array:
        """Return the phasors (points, frequencies) of signals (points, t); see
        `nlos.band.Band.compute_phasors`.
        """
        return self._library.make_complex(traces @ self._real, traces @ self._imaginary)


def get_group_traces(capture: Capture, group: IlluminationGroup) -> Array:
    """Return the signals of one illumination group.

    Returns (points, t): in the capture's own library.
    """
    return ArrayLibrary.of(capture.signal).xp.permute_dims(
        _select_signals(capture, group.indices), (1, 0)
    )


def get_traces(capture: Capture, some: slice) -> Array:
    """Return the signals (points, t) of some valid wall points.

    `some`: of the valid wall points. Returns (points, t): in the capture's own library.
    """
    xp = ArrayLibrary.of(capture.signal).xp
    indices = np.arange(len(capture.points))[some]
    return xp.permute_dims(_select_signals(capture, indices), (1, 0))


def arrange_on_lattice(values: Array, wall: WallLattice, library: ArrayLibrary) -> Array:
    """Put values (..., points) into their places on a lattice, (..., rows, columns); the others are
    0.

    `values` (..., points). Returns (..., rows, columns).
    """
    xp = library.xp
    if not wall.is_complete:
        padded = xp.concat([values, library.zeros((*values.shape[:-1], 1))], axis=-1)
        values = xp.take(padded, library.put(wall.point_numbers), axis=-1)
    return xp.reshape(values, (*values.shape[:-1], *wall.shape))


def _select_signals(capture: Capture, indices: NDArray[Any]) -> Array:
    """Signals (t, points) of some of the valid wall points."""
    library = ArrayLibrary.of(capture.signal)
    flat = library.xp.reshape(capture.signal, (capture.axis.bins, -1))
    places = np.flatnonzero(capture.valid)[indices]
    if places.size == flat.shape[1] and np.array_equal(places, np.arange(places.size)):
        return flat
    return library.xp.take(flat, library.put(places), axis=1)
