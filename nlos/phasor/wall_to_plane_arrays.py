"""From a wall to a plane at the band's frequencies, on the arrays of any library: the counterpart
of `nlos.phasor.wall_to_plane_compiled`.
"""

from __future__ import annotations

import numpy as np

from nlos.kernels import MIN_DISTANCE_M
from nlos.phasor.arrays import ArrayLibrary, arrange_on_lattice
from nlos.phasor.to_depths_kernels import TAPS
from nlos.phasor.transfer import SphericalWaves
from nlos.phasor.wall_to_plane import WallBeforePlane, WallToPlanePlan
from tofclip.arrays import Array
from tofclip.threads import split_blocks


class DevicePropagation:
    """A wall in relief by Fourier matrices: every term is one flat wall; see
    `nlos.phasor.wall_to_plane_compiled`. Memory beyond phasors and result: some 8 bytes per wall point,
    term and six frequencies (20 MB for 128 x 128 points and 120 frequencies), and four chunks
    (`ArrayLibrary.chunk_bytes`).
    """

    def __init__(self, plan: WallToPlanePlan, library: ArrayLibrary) -> None:
        self.plan, self.library, put = plan, library, library.put
        indices = [np.arange(-reach, reach + 1) for reach in plan.max_indices]
        # Fourier matrices from the wall's rows (waves, rows) and columns (columns, waves), and to
        # the plane's rows (rows, waves) and columns (waves, columns)
        from_y, from_x = (
            np.exp(-2j * np.pi / length * np.outer(index, np.arange(count)))
            for length, index, count in zip(plan.lattice, indices, plan.wall.shape, strict=True)
        )
        to_y, to_x = (
            np.exp(2j * np.pi / length * np.outer(np.arange(count), index)) * shift
            for length, index, count, shift in zip(
                plan.plane_lattice, indices, plan.plane.shape, plan.phase_shifts(), strict=True
            )
        )
        self._from_wall, self._to_plane = (put(from_y), put(from_x.T)), (put(to_y), put(to_x.T))
        # First node and weights of the waves of one quadrant, and which of these every wave mirrors.
        node, weight = plan.node_interpolation
        row, column = (np.abs(index) for index in indices)
        corner = column * (plan.max_indices[0] + 1) + row[:, np.newaxis]
        weights = [put(weight[..., tap].reshape(-1, 1)) for tap in range(TAPS)]
        self._nodes = put(node.ravel()), weights, put(corner.ravel())
        # 1 where a wave counts at a frequency, else 0, (frequencies, rows, columns)
        counted = np.zeros((plan.lateral_limits.size, row.size, column.size), np.float32)
        for frequency, mask in enumerate(counted):
            tallest = plan.max_row_indices(frequency)
            tall = np.append(tallest, -1)[np.minimum(column, tallest.size)]
            mask[:] = row[:, np.newaxis] <= tall
        self._mask = put(counted)
        # Frequencies that share their functions of depth, and so few that their spectra fit: with
        # their terms at points (m, n) and at nodes (frequencies, nodes, m)
        self._groups: list[tuple[slice, Array, Array]] = []
        for number, together in enumerate(plan.low_rank_transfer.groups):
            parts, over_points = plan.low_rank_transfer.terms(number)
            count = len(over_points)
            at_nodes = parts[..., :count] + 1j * parts[..., count : 2 * count]
            at_points = put(over_points)
            size = library.chunk_bytes // (8 * count * row.size * column.size)
            for some in split_blocks(len(at_nodes), max(1, size)):
                frequencies = slice(together.start + some.start, together.start + some.stop)
                self._groups.append((frequencies, at_points, put(at_nodes[some])))

    def field(self, phasors: Array) -> Array:
        """Return the field (y, x, frequencies) on the plane of phasors (n, frequencies)."""
        xp = self.library.xp
        field = self.library.zeros((*self.plan.plane.shape, phasors.shape[1]))
        (from_y, from_x), (to_y, to_x) = self._from_wall, self._to_plane
        node, weights, corner = self._nodes
        for frequencies, at_points, at_nodes in self._groups:
            values = xp.permute_dims(phasors[:, frequencies], (1, 0))[:, None, :] * at_points
            spectra = from_y @ arrange_on_lattice(values, self.plan.wall, self.library) @ from_x
            factors = weights[0] * xp.take(at_nodes, node, axis=1)
            for tap in range(1, TAPS):
                factors = factors + weights[tap] * xp.take(at_nodes, node + tap, axis=1)
            factors = xp.permute_dims(xp.take(factors, corner, axis=1), (0, 2, 1))
            joined = xp.sum(xp.reshape(factors, spectra.shape) * spectra, axis=1)
            on_plane = to_y @ (joined * self._mask[frequencies, ...]) @ to_x
            field[:, :, frequencies] = xp.permute_dims(on_plane, (1, 2, 0))
        return field


def sum_waves_on_device(
    geometry: WallBeforePlane, waves: SphericalWaves, library: ArrayLibrary, phasors: Array
) -> Array:
    """Every wall point's spherical wave, summed; see `nlos.phasor.wall_to_plane_compiled`."""
    xp, shape, sources = library.xp, geometry.plane.shape, phasors.shape[0]
    ends = geometry.plane.points.reshape(-1, 3), geometry.points
    # Distances are what counts: near the middle, single-precision coordinates have most digits.
    middle = ends[0].mean(axis=0)
    targets, walls = (library.put((one - middle).T) for one in ends)
    # Products of few coarse and few fine waves make up all frequencies: exponentials cost more than
    # products.
    fine = int(np.ceil(np.sqrt(waves.count)))
    coarse = -(-waves.count // fine)
    first = waves.first + waves.step * fine * np.arange(coarse)
    steps = [library.put(k / (2 * np.pi)) for k in (first, waves.step * np.arange(fine))]
    missing = library.zeros((sources, coarse * fine - waves.count))
    padded = xp.reshape(xp.concat([phasors, missing], axis=1), (sources, coarse, fine))
    field = library.zeros((targets.shape[1], coarse * fine))
    size = max(1, library.chunk_bytes // (8 * sources * coarse * fine))
    for some in split_blocks(targets.shape[1], size):
        across = xp.sum((targets[:, some, None] - walls[:, None, :]) ** 2, axis=0)
        distance = xp.sqrt(xp.clip(across, MIN_DISTANCE_M**2, None))[:, :, None]
        slow, fast = (library.exp_cycles(distance * cycles) for cycles in steps)
        spherical = (slow / distance)[:, :, :, None] * fast[:, :, None, :]
        field[some, :] = xp.reshape(xp.sum(spherical * padded, axis=1), (-1, coarse * fine))
    return xp.reshape(field[:, : waves.count], (*shape, waves.count))
