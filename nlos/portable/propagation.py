"""From a wall to a plane at the band's frequencies, on the arrays of any library."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nlos.band import Band
from nlos.capture import Capture
from nlos.exposure import Exposure
from nlos.plane import Plane
from nlos.portable.library import Library
from nlos.portable.signals import Analysis, exposed, on_lattice
from nlos.propagation.kernels import NEAREST
from nlos.propagation.passage import Passage
from nlos.propagation.plane_field import PlaneField
from nlos.propagation.propagate import SAMPLED_POINTS, strength
from nlos.rsd.kernels import TAPS
from nlos.rsd.planar import waves_of
from nlos.rsd.transfer import Waves
from tofclip.arrays import Array, to_numpy
from tofclip.threads import blocks

FloatArray = NDArray[np.float64]


def carried_elsewhere(capture: Capture, part: Exposure, plane: Plane, band: Band, tolerance: float) -> PlaneField:
    """Carry one exposure of a capture onto a plane where its signal lives; see `nlos.propagate`."""
    waves, points = waves_of(part, band, continued=False), capture.points[part.members]
    library = Library(capture.place)
    phasors = Analysis(band, capture.axis.bins, library).of(exposed(capture, part))
    field = WallToPlane(points, plane, waves, tolerance, library).field(phasors)
    return PlaneField(field, plane, part.passes * band.wavenumbers)


class WallToPlane:
    """``sum_p P_k(r_p) * exp(1j * k * |r_v - r_p|) / |r_v - r_p|`` on a plane, within a tolerance.

    By Fourier matrices where the compiled loops take Fourier transforms, with the same terms of the wall's relief (see
    `nlos.propagation.passage`), else by direct sums. The terms are chosen for the spectrum of the first phasors that
    come; they stay for later ones, so that a sequence of like signals is planned once.

    Memory beyond phasors and result: for the terms, some 8 bytes per wall point, term and six frequencies (20 MB for
    128 x 128 points and 120 frequencies); and four chunks (`Library.chunk_bytes`) for what is treated together.

    Parameters
    ----------
    points : (n, 3) array
        Wall points, m.
    plane : Plane
    waves : Waves
        From points.
    tolerance : float
        Relative error allowed.
    library : Library
    """

    def __init__(self, points: FloatArray, plane: Plane, waves: Waves, tolerance: float, library: Library) -> None:
        self.points, self.plane, self.waves, self.tolerance = points, plane, waves, tolerance
        self.library = library
        self._way: _Layered | _Direct | None = None

    def field(self, phasors: Array) -> Array:
        """Return the field (y, x, frequencies) on the plane of phasors (n, frequencies), complex64."""
        if self._way is None:
            self._way = self._chosen(phasors)
        return self._way.field(phasors)

    def _chosen(self, phasors: Array) -> _Layered | _Direct:
        some = np.arange(0, phasors.shape[0], phasors.shape[0] // SAMPLED_POINTS + 1)
        sample = to_numpy(self.library.xp.take(phasors, self.library.put(some), axis=0))
        passage = Passage.of(self.points, self.plane, self.waves, strength(sample), self.tolerance)
        if passage is not None and passage.quicker:
            return _Layered(passage, self.library)
        return _Direct(self.points, self.plane, self.waves, self.library)


@dataclass(frozen=True, eq=False)
class _Group:
    """Some neighbouring frequencies with their terms.

    Parameters
    ----------
    frequencies : slice
    over_points : (m, n) complex64 array
    over_nodes : (frequencies, nodes, m) complex64 array
    """

    frequencies: slice
    over_points: Array
    over_nodes: Array


class _Layered:
    """A wall in relief: every term is one flat wall; see `nlos.propagation.layered`."""

    def __init__(self, passage: Passage, library: Library) -> None:
        self.passage, self.library = passage, library

    def field(self, phasors: Array) -> Array:
        xp, shape = self.library.xp, self.passage.plane.shape
        field = self.library.zeros((*shape, phasors.shape[1]))
        for group in self._groups:
            values = xp.permute_dims(phasors[:, group.frequencies], (1, 0))
            field[:, :, group.frequencies] = xp.permute_dims(self._carried(group, values), (1, 2, 0))
        return field

    def _carried(self, group: _Group, values: Array) -> Array:
        """Fields (frequencies, y, x) of phasors (frequencies, n)."""
        xp = self.library.xp
        (from_y, from_x), (to_y, to_x) = self._from_wall, self._to_plane
        on_wall = on_lattice(values[:, None, :] * group.over_points, self.passage.wall, self.library)
        spectra = from_y @ on_wall @ from_x
        node, shares, corner = self._interpolation
        factors = shares[0] * xp.take(group.over_nodes, node, axis=1)
        for tap in range(1, TAPS):
            factors = factors + shares[tap] * xp.take(group.over_nodes, node + tap, axis=1)
        over_waves = xp.permute_dims(xp.take(factors, corner, axis=1), (0, 2, 1))
        joined = xp.sum(xp.reshape(over_waves, spectra.shape) * spectra, axis=1)
        return to_y @ (joined * self._counted[group.frequencies, ...]) @ to_x

    @cached_property
    def _groups(self) -> list[_Group]:
        """All frequencies, in groups that share their functions of depth, and so few that their spectra fit."""
        relief, put = self.passage.relief, self.library.put
        rows, columns = (2 * reach + 1 for reach in self.passage.reach)
        groups = []
        for number, together in enumerate(relief.groups):
            terms = relief.terms(number)
            count = len(terms.over_points)
            over_nodes = terms.over_waves[..., :count] + 1j * terms.over_waves[..., count : 2 * count]
            over_points = put(terms.over_points)
            for some in blocks(len(over_nodes), max(1, self.library.chunk_bytes // (8 * count * rows * columns))):
                frequencies = slice(together.start + some.start, together.start + some.stop)
                groups.append(_Group(frequencies, over_points, put(over_nodes[some])))
        return groups

    @cached_property
    def _from_wall(self) -> tuple[Array, Array]:
        """Fourier matrices from the wall's rows (waves, rows) and columns (columns, waves)."""
        y, x = (
            np.exp(-2j * np.pi / length * np.outer(np.arange(-reach, reach + 1), np.arange(count)))
            for length, reach, count in zip(
                self.passage.lattice, self.passage.reach, self.passage.wall.shape, strict=True
            )
        )
        return self.library.put(y), self.library.put(x.T)

    @cached_property
    def _to_plane(self) -> tuple[Array, Array]:
        """Fourier matrices to the plane's rows (rows, waves) and columns (waves, columns)."""
        y, x = (
            np.exp(2j * np.pi / length * np.outer(np.arange(count), np.arange(-reach, reach + 1))) * shift
            for length, reach, count, shift in zip(
                self.passage.plane_lattice,
                self.passage.reach,
                self.passage.plane.shape,
                self.passage.shifts,
                strict=True,
            )
        )
        return self.library.put(y), self.library.put(x.T)

    @cached_property
    def _interpolation(self) -> tuple[Array, list[Array], Array]:
        """First node and shares of the waves of one quadrant, and which of these every wave mirrors."""
        rows, columns = self.passage.reach
        y, x = (spacing * np.arange(n + 1) for spacing, n in zip(self.passage.steps, (rows, columns), strict=True))
        # In the corners no wave counts, and no transfer function is known.
        lateral = np.minimum(np.hypot(y[:, np.newaxis], x), self.passage.limits[-1])
        node, share = self.passage.relief.transfer.interpolation(lateral.ravel())
        row, column = (np.abs(np.arange(-n, n + 1)) for n in (rows, columns))
        corner = row[:, np.newaxis] * (columns + 1) + column
        shares = [self.library.put(share[:, tap, np.newaxis]) for tap in range(TAPS)]
        return self.library.put(node), shares, self.library.put(corner.ravel())

    @cached_property
    def _counted(self) -> Array:
        """1 where a wave counts at a frequency, else 0, shape (frequencies, rows, columns)."""
        row, column = (np.abs(np.arange(-n, n + 1)) for n in self.passage.reach)
        counted = np.zeros((self.passage.waves.count, row.size, column.size), np.float32)
        for frequency in range(len(counted)):
            tallest = self.passage.rows_within(frequency)
            tall = np.where(column < tallest.size, tallest[np.minimum(column, tallest.size - 1)], -1)
            counted[frequency] = row[:, np.newaxis] <= tall
        return self.library.put(counted)


class _Direct:
    """Every wall point's spherical wave, summed; see `nlos.propagation.direct`."""

    def __init__(self, points: FloatArray, plane: Plane, waves: Waves, library: Library) -> None:
        self.shape, self.library, self.count = plane.shape, library, waves.count
        targets = plane.points.reshape(-1, 3)
        # Distances are what counts: near the middle, single-precision coordinates have most digits.
        middle = targets.mean(axis=0)
        self._targets, self._sources = (library.put((ends - middle).T) for ends in (targets, points))
        # Products of few coarse and few fine waves make up all frequencies: exponentials cost more than products.
        fine = int(np.ceil(np.sqrt(waves.count)))
        coarse = -(-waves.count // fine)
        self._coarse = library.put((waves.first + waves.step * fine * np.arange(coarse)) / (2 * np.pi))
        self._fine = library.put(waves.step * np.arange(fine) / (2 * np.pi))

    def field(self, phasors: Array) -> Array:
        """Return the field (y, x, frequencies) of phasors (n, frequencies)."""
        xp, sources = self.library.xp, phasors.shape[0]
        coarse, fine = self._coarse.shape[0], self._fine.shape[0]
        missing = self.library.zeros((sources, coarse * fine - self.count))
        padded = xp.reshape(xp.concat([phasors, missing], axis=1), (sources, coarse, fine))
        targets = self._targets.shape[1]
        field = self.library.zeros((targets, coarse * fine))
        for some in blocks(targets, max(1, self.library.chunk_bytes // (8 * sources * coarse * fine))):
            field[some, :] = xp.reshape(self._summed(some, padded), (-1, coarse * fine))
        return xp.reshape(field[:, : self.count], (*self.shape, self.count))

    def _summed(self, some: slice, phasors: Array) -> Array:
        """Field (targets, coarse, fine) at some targets."""
        xp = self.library.xp
        across = xp.sum((self._targets[:, some, None] - self._sources[:, None, :]) ** 2, axis=0)
        distance = xp.sqrt(xp.clip(across, NEAREST**2, None))[:, :, None]
        coarse, fine = (self.library.turned(distance * turns) for turns in (self._coarse, self._fine))
        waves = (coarse / distance)[:, :, :, None] * fine[:, :, None, :]
        return xp.sum(waves * phasors, axis=1)
