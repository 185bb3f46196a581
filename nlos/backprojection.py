"""Phasor-field back-projection: every wall point's filtered signal, smeared over the voxels that it may come from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from nlos.band import Band, VirtualPulse, Waveforms
from nlos.capture import Capture
from nlos.geometry import Grid
from nlos.kernels import BRICK_Z, add_backprojection
from nlos.method import Progress, Support, common_support, silent
from nlos.volume import Volume
from tofclip.errors import InputError

TABLE_BYTES = 32 << 20
"""Filtered signals held at a time; the captures of this world have up to 64 MB raw."""

LOOKUPS_PER_CALL = 250_000_000
"""About a quarter of a second of work: as long as an interruption has to wait for a compiled loop."""


@dataclass(frozen=True)
class Backprojection:
    """Point-wise back-projection with a virtual pulse: exact for every wall, laser and grid, slow.

    ``I(r) = | sum_p s_p(|r_L - r| + |r - r_p|) / |r - r_p| |`` with s_p the signal of wall point r_p, filtered with
    the pulse to its complex (analytic) form. It is read between finely spaced samples by complex linear interpolation,
    so the carrier's phase never has to be computed per voxel and stays accurate in float32.

    Costs one look-up per voxel and wall point; memory for the volume and for 32 MiB of signals.

    Liu et al., Nature 572, 620 (2019), Methods; "Rayleigh-Sommerfeld diffraction" summed point by point.

    Parameters
    ----------
    wavelength : float
        Carrier wavelength of the virtual pulse, m of path. Lateral resolution is about wavelength * depth / wall size.
    cycles : float
        Length of the pulse in wavelengths; see `nlos.band.VirtualPulse`.
    """

    wavelength: float
    cycles: float = 3.0
    pulse: VirtualPulse = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "pulse", VirtualPulse(self.wavelength, self.cycles))

    def supports(self, capture: Capture, grid: Grid) -> Support:
        """Say whether `capture` can be imaged on `grid`, and if not, why.

        True in a condition if it can; ``.reason`` tells why not. Refused are a single wall point, a grid behind the
        wall, a volume above 8 GiB, and time bins too coarse for the wavelength.
        """
        try:
            Band(self.pulse, capture.axis)
        except InputError as problem:
            return Support(str(problem))
        return common_support(capture, grid)

    def lookups(self, capture: Capture, grid: Grid) -> int:
        """Number of look-ups that a reconstruction costs; what `progress` counts up to."""
        return len(capture.points) * grid.size

    def reconstruct(self, capture: Capture, grid: Grid, progress: Progress = silent) -> Volume:
        """Image the hidden scene.

        Parameters
        ----------
        capture : Capture
        grid : Grid
        progress : callable, optional
            Called with the number of look-ups just done.

        Returns
        -------
        Volume
            Brightness I(r), float32.

        Raises
        ------
        InputError
            `supports` says no.
        """
        complex_field = self.phasor_field(capture, grid, progress)
        return Volume(np.abs(complex_field.values), grid, complex_field.provenance)

    def phasor_field(self, capture: Capture, grid: Grid, progress: Progress = silent) -> Volume:
        """Return the complex sum whose magnitude `reconstruct` gives, complex64; it is linear in the signal."""
        self.supports(capture, grid).require()
        total = np.zeros(grid.shape, np.complex64)
        band = Band(self.pulse, capture.axis)
        axes = [axis.astype(np.float32) for axis in (grid.x, grid.y, grid.z)]
        for selection, waveforms in _in_batches(capture, band):
            wall, lasers = _geometry(capture, selection)
            for planes in _slabs(grid, len(wall)):
                _add(waveforms, wall, lasers, [*axes[:2], axes[2][planes]], total[planes])
                progress(len(wall) * total[planes].size)
        settings = {"method": "backprojection", "wavelength_m": self.wavelength, "cycles": self.cycles}
        return Volume(total, grid, {**capture.provenance, "imaging": settings})


def _in_batches(capture: Capture, band: Band) -> Iterator[tuple[slice, Waveforms]]:
    """Filter as many wall points at a time as fit into the table."""
    points = len(capture.points)
    batch = max(1, TABLE_BYTES // (band.samples * np.dtype(np.complex64).itemsize))
    for first in range(0, points, batch):
        selection = slice(first, min(first + batch, points))
        yield selection, band.waveforms(band.phasors(capture.traces(selection)))


def _geometry(capture: Capture, selection: slice) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    lasers = capture.lasers if len(capture.lasers) == 1 else capture.lasers[selection]
    return capture.points[selection].astype(np.float32), lasers.astype(np.float32)


def _slabs(grid: Grid, points: int) -> Iterator[slice]:
    """Cut the volume into layers of whole bricks that take about `LOOKUPS_PER_CALL` each."""
    layers = LOOKUPS_PER_CALL // (points * grid.y.size * grid.x.size)
    thickness = max(1, layers // BRICK_Z) * BRICK_Z
    for first in range(0, grid.z.size, thickness):
        yield slice(first, min(first + thickness, grid.z.size))


def _add(
    waveforms: Waveforms,
    wall: NDArray[np.float32],
    lasers: NDArray[np.float32],
    axes: list[NDArray[np.float32]],
    total: NDArray[np.complex64],
) -> None:
    interleaved = waveforms.values.view(np.float32)
    start, spacing = np.float32(waveforms.start), np.float32(waveforms.spacing)
    add_backprojection(interleaved, start, spacing, wall, lasers, *axes, total)
