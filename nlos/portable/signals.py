"""Signals of a capture as arrays of any library, and their phasors."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.band import Band
from nlos.capture import Capture
from nlos.exposure import Exposure
from nlos.portable.library import Library
from nlos.rsd.wall import WallLattice
from tofclip.arrays import Array


def exposed_phasors(capture: Capture, part: Exposure, band: Band) -> Array:
    """Return the phasors (points, frequencies) of one exposure's members, complex64; see `nlos.band.Band.phasors`.

    One matrix product; memory for the members' signals and for the phasors twice.
    """
    library, xp = Library.of(capture.signal), Library.of(capture.signal).xp
    return phasors(library, xp.permute_dims(_in_time(capture, part.members), (1, 0)), band)


def phasors(library: Library, traces: Array, band: Band) -> Array:
    """Return the phasors (points, frequencies) of signals (points, t)."""
    paths = band.axis.start + band.axis.spacing * np.arange(traces.shape[1])
    waves = band.weights * np.exp(-1j * np.outer(paths, band.wavenumbers))
    return library.joined(traces @ library.put(waves.real), traces @ library.put(waves.imag))


def traces_of(capture: Capture, some: slice) -> Array:
    """Return the signals (points, t) of some valid wall points."""
    xp = Library.of(capture.signal).xp
    members = np.arange(len(capture.points))[some]
    return xp.permute_dims(_in_time(capture, members), (1, 0))


def on_lattice(values: Array, wall: WallLattice, library: Library) -> Array:
    """Put values (..., points) into their places on a lattice, (..., rows, columns); the others are 0."""
    xp = library.xp
    if not wall.complete:
        padded = xp.concat([values, library.zeros((*values.shape[:-1], 1))], axis=-1)
        values = xp.take(padded, library.put(wall.occupants), axis=-1)
    return xp.reshape(values, (*values.shape[:-1], *wall.shape))


def _in_time(capture: Capture, members: NDArray[Any]) -> Array:
    """Signals (t, points) of some of the valid wall points."""
    library = Library.of(capture.signal)
    flat = library.xp.reshape(capture.signal, (capture.axis.bins, -1))
    places = np.flatnonzero(capture.valid)[members]
    if places.size == flat.shape[1] and np.array_equal(places, np.arange(places.size)):
        return flat
    return library.xp.take(flat, library.put(places), axis=1)
