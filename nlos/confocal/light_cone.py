"""The light-cone transform: confocal imaging as one deconvolution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from nlos.confocal.scan import (
    ConfocalPlan,
    ConfocalScan,
    find_padded_length,
    resample_to_grid,
)
from nlos.geometry import FloatArray, Grid
from nlos.method import Method
from tofclip.errors import InputError
from tofclip.threads import run_blocks, thread_count

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True)
class LightCone(Method):
    """Confocal imaging by the light-cone transform.

    With u = z^2 and v = d^2, d half the path, the hyperboloid of a hidden point is ``v = u + x^2 +
    y^2``: the same paraboloid at every depth, so that the picture follows from one
    three-dimensional deconvolution with a Wiener filter. Needs a confocal scan of a lattice on a
    plane z = const; hidden things must scatter evenly or straight back.

    Memory: for P wall points and T bins, two half spectra of the box padded to twice its size along
    all three axes, some 100 * P * T bytes (0.2 GB for 64 x 64 x 512); time: four transforms of that
    box.

    O'Toole, Lindell, Wetzstein, "Confocal non-line-of-sight imaging based on the light-cone
    transform", Nature 555, 338-341 (2018), Eq. 3 and 5.

    Parameters
    ----------
    signal_to_noise : float
        Of the Wiener filter ``conj(h) / (|h|^2 + 1 / signal_to_noise)``, for a kernel h of unit
        energy. Smaller is smoother.
    falloff : float
        Power of the distance with which brightness falls: 4 for diffuse things, 2 for
        retroreflective ones.
    """

    signal_to_noise: float = 0.8
    falloff: float = 4.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.signal_to_noise) and self.signal_to_noise > 0):
            raise InputError(
                f"signal_to_noise must be a positive number, got {self.signal_to_noise}"
            )
        if not (np.isfinite(self.falloff) and self.falloff >= 0):
            raise InputError(f"falloff must be a power of 0 or more, got {self.falloff}")

    def plan(self, capture: Capture, grid: Grid) -> ConfocalPlan:
        """Make the method ready for captures like `capture` on `grid`.

        Parameters
        ----------
        capture : Capture
            A confocal scan of a lattice on a plane z = const, without the light that the wall
            returns at once; see `nlos.preparation.remove_first_bounce`.
        grid : Grid
            Up to half a wall beyond the wall's edges; read by linear interpolation.

        Returns
        -------
        ConfocalPlan

        Raises
        ------
        InputError
            The method cannot image such a capture on the grid, or not within memory.
        """
        settings = {
            "method": "lightcone",
            "signal_to_noise": self.signal_to_noise,
            "falloff": self.falloff,
        }
        return ConfocalPlan(capture, grid, self._compute, settings)

    def _compute(self, scan: ConfocalScan, grid: Grid) -> NDArray[np.float32]:
        """Return the image (z, y, x) of a scan on a grid."""
        bins = scan.signal.shape[2]
        # one sample of u = z^2 for each bin, over the same range of depths
        squares = (bins * scan.spacing) ** 2 / bins
        values = self._deconvolve(scan, squares)
        depth_position = (grid.z - scan.plane.z) ** 2 / squares - 0.5
        # Depths between the wall and the first sample read the first.
        image = resample_to_grid(values, scan, grid, np.clip(depth_position, 0, bins - 1))
        return np.maximum(image, 0)

    def _deconvolve(self, scan: ConfocalScan, squares: float) -> NDArray[np.float32]:
        """Return the image on the padded lattice over samples of u that are `squares` (m^2) apart."""
        from scipy.fft import ifft2, irfft

        bins, workers = scan.signal.shape[2], thread_count()
        spectrum, shape = transform_squared_distances(scan, squares, self.falloff)
        self._apply_wiener_filter(spectrum, _transform_paraboloid(scan, squares, shape))
        spectrum = ifft2(spectrum, axes=(0, 1), workers=workers, overwrite_x=True)
        image: NDArray[np.float32] = irfft(spectrum, shape[2], workers=workers, overwrite_x=True)[
            ..., :bins
        ]
        return image

    def _apply_wiener_filter(
        self, spectrum: NDArray[np.complex64], kernel: NDArray[np.complex64]
    ) -> None:
        """Apply the Wiener filter in place; the kernel is even, so that a quarter of its spectrum
        is enough.
        """
        # Wiener: the filter's gain falls where the kernel is weaker than the noise
        floor = np.float32(1 / self.signal_to_noise)
        # the kernel is even in x and y, so that a quarter of its spectrum is kept
        row, column = (np.minimum(np.arange(n), n - np.arange(n)) for n in spectrum.shape[:2])
        kernel = kernel.conj() / (np.abs(kernel) ** 2 + floor)

        def process_block(rows: slice) -> None:
            for r in range(rows.start, rows.stop):
                spectrum[r] *= kernel[row[r], column]

        run_blocks(process_block, spectrum.shape[0], 8)


def build_rebinning_matrix(source_edges: FloatArray, target_edges: FloatArray) -> csr_array:
    """Matrix (targets, sources) of the means over target intervals of a function given by its means
    over source ones.

    `source_edges, target_edges` (n + 1,): increasing; intervals of length 0 are allowed. Targets
    beyond the sources count as 0 there. Returns (targets, sources).
    """
    from scipy.sparse import csr_array

    # between two neighbouring edges both source and target are constant
    edges = np.unique(np.concatenate([source_edges, target_edges]))
    middles, lengths = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    source, target = (
        np.searchsorted(e, middles, side="right") - 1 for e in (source_edges, target_edges)
    )
    shape = (target_edges.size - 1, source_edges.size - 1)
    inside = (source >= 0) & (source < shape[1]) & (target >= 0) & (target < shape[0])
    source, target, lengths = source[inside], target[inside], lengths[inside]
    weights = (lengths / np.diff(target_edges)[target]).astype(np.float32)
    return csr_array((weights, (target, source)), shape=shape)


def transform_squared_distances(
    scan: ConfocalScan, squares: float, falloff: float
) -> tuple[NDArray[np.complex64], tuple[int, int, int]]:
    """Return the spectrum of the signals over the square v = d^2 of the distance, in which every
    depth has the same kernel.

    `squares`: distance of samples of v, m^2; `falloff`: power of the distance by which light is
    weaker; it is made up for. Returns `spectrum` (y, x, v): half spectrum, padded, so that no
    convolution wraps around; `shape`: samples along y, x and v with the padding.
    """
    from scipy.fft import fft2, rfft

    rows, columns, bins = scan.signal.shape
    shape = (find_padded_length(rows), find_padded_length(columns), find_padded_length(bins))
    # edges of the bins in v; a bin is centred on its distance
    edges = (np.clip(np.arange(bins + 1) - 0.5, 0, None) * scan.spacing) ** 2
    matrix = build_rebinning_matrix(edges, squares * np.arange(bins + 1))
    over_squares = matrix @ scan.correct_falloff(falloff).reshape(-1, bins).T
    workers = thread_count()
    spectrum = rfft(over_squares.T.reshape(scan.signal.shape), shape[2], workers=workers)
    return fft2(spectrum, shape[:2], axes=(0, 1), workers=workers), shape


def _transform_paraboloid(
    scan: ConfocalScan, squares: float, shape: tuple[int, int, int]
) -> NDArray[np.complex64]:
    """Spectrum of the kernel ``v = x^2 + y^2`` of unit energy, for frequencies that are not
    negative.

    Along v every column of it is an impulse between two samples, whose spectrum is known; along x
    and y it is even, so that cosine transforms of a quadrant suffice.
    """
    from scipy.fft import dctn

    y, x = (
        length * np.arange(n // 2 + 1)
        for length, n in zip(scan.plane.steps, shape[:2], strict=True)
    )
    late = (y[:, np.newaxis] ** 2 + x**2) / squares
    whole = np.floor(late)
    # an impulse between two samples is shared linearly
    weight = (late - whole)[..., np.newaxis]
    turn = np.exp(-2j * np.pi * np.arange(shape[2] // 2 + 1) / shape[2])
    # Impulses beyond the padded record would wrap around into it.
    height = (whole < shape[2] - 1) / np.sqrt(shape[0] * shape[1])
    columns: NDArray[Any] = tabulate_powers(turn, whole.astype(np.intp), shape[2]) * (
        1 - weight + weight * turn
    )
    columns *= height[..., np.newaxis]
    return np.asarray(
        dctn(columns.astype(np.complex64), 1, axes=(0, 1), workers=thread_count()), np.complex64
    )


def tabulate_powers(
    turn: NDArray[np.complex128], power: NDArray[np.intp], period: int, first: int = 0
) -> NDArray[np.complex64]:
    """``turn[w] ** power`` from a table of one whole turn.

    `turn` (w,): ``exp(-2j * pi * (first + w) / period)``. Returns (..., w).
    """
    # powers of a root of unity repeat: a table is quicker than exponentials, and as exact
    table = np.exp(-2j * np.pi * np.arange(period) / period).astype(np.complex64)
    exponent = power[..., np.newaxis] * np.arange(first, first + turn.size)
    return np.asarray(table[exponent % period])
