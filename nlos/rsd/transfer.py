"""Transfer functions from plane to plane that are exact on a finite window.

Waves are followed inside a window about every source; in a periodic lattice so long that no image
of a source meets a target, a field is a sum of plane waves.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nlos.plane import Plane, axis_step
from nlos.rsd.kernels import TAPS, find_interpolation_weights, sample_waves

FloatArray = NDArray[np.float64]
Sides = tuple[float, float]

INNER_RADIUS_FRACTION = 0.88
"""Where the window begins to fall at least, relative to the largest distance of a source and a
target.
"""

MIN_EDGE_FRACTION, MAX_EDGE_FRACTION = 0.25, 0.5
"""Width of the window's edge, relative to the largest distance along one axis."""

SPREAD_FACTOR = 0.6
"""Widening of a grazing wave's spectrum by the window's edge, per squared digit of the tolerance and edge width;
measured on point scenes."""

FFT_LENGTH_FACTORS = (1, 3, 5, 15, 25)
"""Of these times a power of 2, single-precision Fourier transforms take half as long as of other
lengths; measured.
"""

VECTOR_LENGTH = 8
"""complex64 numbers in 64 bytes: where vector instructions like rows to start."""


@dataclass(frozen=True)
class Window:
    """A circle about every source, outside of which its wave is cut off smoothly.

    Parameters
    ----------
    inner_radius, outer_radius : float
        Radii up to which waves are whole, and from which on they are gone, m.
    """

    inner_radius: float
    outer_radius: float

    @classmethod
    def within(cls, offsets: Offsets, periods: Sides) -> Window:
        """Return the widest window that lets no image of a source in a periodic lattice meet a
        target.

        Parameters
        ----------
        offsets : Offsets
        periods : (float, float)
            Along y and x, m; at least `find_min_periods`.

        Returns
        -------
        Window
        """
        room = min(period - far for period, far in zip(periods, offsets.farthest, strict=True))
        inner = min(offsets.reach, room - MIN_EDGE_FRACTION * offsets.along)
        outer = min(room, inner + MAX_EDGE_FRACTION * offsets.along)
        return cls(float(inner), float(outer))

    def spectral_spread(self, tolerance: float) -> float:
        """Lateral wavenumbers by which the window's edge spreads grazing waves, rad/m."""
        return float(
            SPREAD_FACTOR * np.log10(tolerance) ** 2 / (self.outer_radius - self.inner_radius)
        )


@dataclass(frozen=True)
class Offsets:
    """How far sources and targets are apart along y and x.

    Parameters
    ----------
    farthest : (float, float)
        The largest there are, m: within these, no image of a source may meet a target.
    reach : float
        The largest distance across that a window may have to hold, m.
    along : float
        The largest along an axis that it may have to, m.
    extents : (float, float)
        Of sources or of targets, whichever are wider, m: a period holds them.
    """

    farthest: Sides
    reach: float
    along: float
    extents: Sides

    @classmethod
    def between(cls, sources: Plane, y: FloatArray, x: FloatArray) -> Offsets:
        """Return those of all sources on a plane from all targets.

        Parameters
        ----------
        sources : Plane
        y, x : (n,) float64 array
            Coordinates of the targets, ascending, m.

        Returns
        -------
        Offsets
        """
        pairs = ((y, sources.y), (x, sources.x))
        along_y, along_x = (float(max(abs(a[-1] - b[0]), abs(a[0] - b[-1]))) for a, b in pairs)
        high, wide = (
            max(axis.size * axis_step(axis) for axis in pair if axis.size > 1) for pair in pairs
        )
        reach = float(np.hypot(along_y, along_x))
        return cls((along_y, along_x), reach, max(along_y, along_x), (high, wide))

    def limit(self, reach: float, rim: Sides) -> Offsets:
        """Return the offsets where less reach is wanted, and where a rim carries little of the
        field.

        Parameters
        ----------
        reach : float
            m.
        rim : (float, float)
            Width of the rim along y and x, m.

        Returns
        -------
        Offsets
        """
        y, x = (far - width for far, width in zip(self.farthest, rim, strict=True))
        reach = min(reach, float(np.hypot(y, x)))
        # as far along both axes, as where all is wanted
        return Offsets((y, x), reach, min(max(y, x), reach / np.sqrt(2)), self.extents)


def find_min_periods(offsets: Offsets) -> Sides:
    """Return the shortest periods along y and x in which a window has room, m."""
    edge = INNER_RADIUS_FRACTION * offsets.reach + MIN_EDGE_FRACTION * offsets.along
    y, x = (
        max(edge + far, extent)
        for far, extent in zip(offsets.farthest, offsets.extents, strict=True)
    )
    return y, x


def find_fast_length(count: float) -> int:
    """Next length that Fourier transforms are quick at."""
    lengths = (
        factor * 2 * VECTOR_LENGTH << power for factor in FFT_LENGTH_FACTORS for power in range(20)
    )
    return min(length for length in lengths if length >= count)


NODE_OVERSAMPLING = 2.5
"""Nodes along the lateral wavenumber, relative to the Nyquist rate of the window's radius; interpolation then errs by
5e-5."""

RADII_PER_PERIOD = 1.25
"""Samples along the radius per period of the fastest product of wave and Bessel function."""

WINDOW_STEEPNESS = 1.6
"""Of the window's edge, an error function: at its ends it is 1 - 0.012 and 0.012."""


@dataclass(frozen=True, eq=False)
class SphericalWaves:
    """The spherical waves that carry a field on.

    Parameters
    ----------
    first, step, count : float, float, int
        Evenly spaced wavenumbers, rad/m.
    continued : bool
        False for ``exp(1j * k * R) / R``, the wave of a point; True for the first
        Rayleigh-Sommerfeld integral's ``z / (2 pi R^2) * (1 / R - 1j * k) * exp(1j * k * R)``,
        which continues a field known on a plane.
    """

    first: float
    step: float
    count: int
    continued: bool

    @property
    def wavenumbers(self) -> FloatArray:
        """Wavenumbers, rad/m."""
        return self.first + self.step * np.arange(self.count, dtype=np.float64)

    @property
    def max_wavenumber(self) -> float:
        """Largest wavenumber, rad/m."""
        return self.first + self.step * (self.count - 1)


@dataclass(frozen=True, eq=False)
class TransferFunction:
    """Fourier transform of a wave's cross-section at some distance, cut off smoothly outside a
    circle.

    It is the Hankel transform ``2 pi * int g(sqrt(rho^2 + z^2)) * window(rho) * J_0(q * rho) * rho
    d rho``. Since the window, not a period, ends the wave, a convolution through it is as exact as
    one with the sampled wave, wherever source and target are nearer to each other than the window's
    reach; and since it depends on q alone, few values make it up.

    Parameters
    ----------
    waves : SphericalWaves
    window : Window
    max_lateral_wavenumber : float
        Largest lateral wavenumber q wanted, rad/m.
    min_distance : float
        Smallest distance that will be asked for, m: the nearer, the more sharply peaked the wave.
    """

    waves: SphericalWaves
    window: Window
    max_lateral_wavenumber: float
    min_distance: float

    @cached_property
    def node_step(self) -> float:
        """Distance of neighbouring nodes in q, rad/m."""
        return np.pi / (self.window.outer_radius * NODE_OVERSAMPLING)

    @cached_property
    def nodes(self) -> FloatArray:
        """Lateral wavenumbers of the nodes, rad/m."""
        # The transfer function is even in q: nodes on both sides of 0 serve the interpolation
        # there.
        return self.node_step * np.arange(
            -(TAPS // 2), np.ceil(self.max_lateral_wavenumber / self.node_step) + TAPS // 2 + 1
        )

    @cached_property
    def _radii(self) -> tuple[FloatArray, FloatArray]:
        """Radii, m, and the weights of an integral over the plane; exponentially accurate for
        smooth waves.

        A trapezoidal rule in t with ``rho = h * log(1 + exp(t))``: evenly spaced but for a few ever
        smaller radii.
        """
        fastest = self.waves.max_wavenumber + self.max_lateral_wavenumber
        # the fastest phase along the radius is that of wave and Bessel function together
        h = min(2 * np.pi / (fastest * RADII_PER_PERIOD), self.min_distance)
        t = np.arange(-8.0, self.window.outer_radius / h + 1)
        radii = h * np.logaddexp(0, t)
        return radii, 2 * np.pi * radii * h / (1 + np.exp(-t))

    @cached_property
    def bessel_matrix(self) -> NDArray[np.float32]:
        """``J_0(q * rho)`` with all weights, shape (nodes, radii)."""
        from scipy.special import erfc, j0

        radii, weights = self._radii
        ramp = (radii - self.window.inner_radius) / (
            self.window.outer_radius - self.window.inner_radius
        )
        # erfc has a spectrum that falls like a Gaussian: little ringing at the window's edge
        falling = np.where(ramp <= 1, erfc(WINDOW_STEEPNESS * (2 * ramp - 1)) / 2, 0)
        return np.asarray(j0(np.outer(self.nodes, radii)) * (weights * falling), np.float32)

    def tabulate(self) -> int:
        """Compute now the table that all evaluations share, before threads do; return its bytes."""
        return self.bessel_matrix.nbytes

    def interpolation(self, lateral: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Find lateral wavenumbers among the nodes: the first node to take, and the weights of
        `TAPS` from it on.
        """
        node, weight = np.empty(lateral.size, np.int64), np.empty((lateral.size, TAPS), np.float32)
        find_interpolation_weights(lateral / self.node_step + TAPS // 2, node, weight)
        return node, weight

    def evaluate(
        self, distance: float, delay: FloatArray, leading_zeros: int = 0
    ) -> NDArray[np.float32]:
        """Return the transfer function over a distance, shape (nodes, 2, frequencies), real and
        imaginary parts.

        A delay (path, k_0) turns every frequency by ``(k - k_0) * path`` besides. A negative
        distance undoes a positive one, as far as waves travel at all. `leading_zeros` zeros stand
        before the lowest frequency.

        Parameters
        ----------
        distance : float
            Metres.
        delay : (2,) float64 array
            Path in m and the wavenumber k_0 in rad/m.
        leading_zeros : int

        Returns
        -------
        (nodes, 2, leading_zeros + frequencies) float32 array
        """
        radii, _ = self._radii
        waves = np.zeros((radii.size, 2, leading_zeros + self.waves.count), np.float32)
        sample_waves(
            radii,
            distance,
            self.waves.first,
            self.waves.step,
            delay,
            self.waves.continued,
            leading_zeros,
            waves,
        )
        # the Hankel transform as one matrix product for all frequencies
        flat = self.bessel_matrix @ waves.reshape(radii.size, -1)
        nodes: NDArray[np.float32] = flat.reshape(-1, *waves.shape[1:])
        return nodes
