"""Transfer functions from plane to plane that are exact on a finite window.

Waves are followed inside a window about every source; in a periodic lattice so long that no image
of a source meets a target, a field is a sum of plane waves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from nlos.phasor.to_depths_kernels import TAPS, find_interpolation_weights, sample_waves
from nlos.plane import Plane, axis_step
from tofclip.arrays import Float32Array, FloatArray, IntArray

Sides = tuple[float, float]

# Where the window begins to fall at least, relative to the largest distance of a source and a
# target, and how much farther out for each digit of the tolerance. Between two squares few pairs
# are so far apart: independent signals (noise) miss some 0.1 % of their amplitude beyond 0.87, 0.01
# % beyond 0.93, and of an even background, all of which is in step, ten times as much.
INNER_RADIUS_FRACTION, INNER_RADIUS_FRACTION_PER_DIGIT = 0.67, 0.1
# Width of the window's edge, relative to the largest distance along one axis.
MIN_EDGE_FRACTION, MAX_EDGE_FRACTION = 0.25, 0.5
# Lengths of single-precision Fourier transforms, among the multiples of 16, that take no longer
# than a greater one; others, such as 176 and 288, take twice as long. Measured. From here on they
# are powers of 2, and five times such.
FAST_LENGTHS = (16, 32, 48, 64, 80, 96, 128, 144, 160, 192, 240, 256, 320, 384, 400, 512, 640)
# Of the window's edge, an error function, and how much more for each digit of the tolerance: for
# 1e-2 it is cut off at 1 - 0.012 and at 0.012, for 1e-4 at a tenth of that; and of one that is not
# cut off.
STEEPNESS, STEEPNESS_PER_DIGIT, WHOLE_STEEPNESS = 1.1, 0.25, 4.0
# complex64 numbers in 64 bytes: where vector instructions like rows to start.
VECTOR_LENGTH = 8


@dataclass(frozen=True)
class Window:
    """A circle about every source, outside of which its wave is cut off smoothly."""

    # radii up to which waves are whole, and from which on they are gone, m
    inner_radius: float
    outer_radius: float
    steepness: float  # of the edge, an error function: it is cut off at this argument on both ends

    @classmethod
    def within(cls, offsets: Offsets, periods: Sides, tolerance: float) -> Window:
        """Return the widest window that lets no image of a source in a periodic lattice, of at
        least `find_min_periods`, meet a target; `tolerance`: relative error allowed.
        """
        room = min(period - far for period, far in zip(periods, offsets.farthest, strict=True))
        inner = min(offsets.reach, room - MIN_EDGE_FRACTION * offsets.along)
        outer = min(room, inner + MAX_EDGE_FRACTION * offsets.along)
        steepness = STEEPNESS - STEEPNESS_PER_DIGIT * np.log10(tolerance)
        return cls(float(inner), float(outer), float(steepness))

    def fall(self, radii: FloatArray) -> FloatArray:
        """Return what a wave is multiplied by at every radius."""
        from scipy.special import erfc

        ramp = (radii - self.inner_radius) / (self.outer_radius - self.inner_radius)
        # erfc has a spectrum that falls like a Gaussian: little ringing at the window's edge
        return np.where(ramp <= 1, erfc(self.steepness * (2 * ramp - 1)) / 2, 0)

    @property
    def without_cut(self) -> Window:
        """The same edge to where nothing is left of it."""
        middle, half = (
            (self.outer_radius + self.inner_radius) / 2,
            (self.outer_radius - self.inner_radius) / 2,
        )
        half *= WHOLE_STEEPNESS / self.steepness
        return Window(middle - half, middle + half, WHOLE_STEEPNESS)

    def spectral_spread(self, error: float) -> float:
        """Lateral wavenumbers by which the window's edge spreads grazing waves, down to a relative
        error, rad/m.
        """
        half = (self.outer_radius - self.inner_radius) / 2
        return float(2 * self.steepness / half * np.sqrt(np.log(1 / error)))


@dataclass(frozen=True)
class Offsets:
    """How far sources and targets are apart along y and x."""

    # the largest there are, m: within these, no image of a source may meet a target
    farthest: Sides
    reach: float  # the largest distance across that a window may have to hold, m
    along: float  # the largest along an axis that it may have to, m
    extents: Sides  # of sources or of targets, whichever are wider, m: a period holds them

    @classmethod
    def between(cls, sources: Plane, y: FloatArray, x: FloatArray) -> Offsets:
        """Return those of all sources on a plane from all targets, whose coordinates ascend, m."""
        pairs = ((y, sources.y), (x, sources.x))
        along_y, along_x = (float(max(abs(a[-1] - b[0]), abs(a[0] - b[-1]))) for a, b in pairs)
        high, wide = (
            max(axis.size * axis_step(axis) for axis in pair if axis.size > 1) for pair in pairs
        )
        reach = float(np.hypot(along_y, along_x))
        return cls((along_y, along_x), reach, max(along_y, along_x), (high, wide))

    def limit(self, reach: float, rim: Sides) -> Offsets:
        """Return the offsets where less reach is wanted, m, and where a rim of some width along y
        and x, m, carries little of the field.
        """
        y, x = (far - width for far, width in zip(self.farthest, rim, strict=True))
        reach = min(reach, float(np.hypot(y, x)))
        # as far along both axes, as where all is wanted
        return Offsets((y, x), reach, min(max(y, x), reach / np.sqrt(2)), self.extents)


def find_min_periods(offsets: Offsets, tolerance: float) -> Sides:
    """Return the shortest periods along y and x in which a window has room, m."""
    inner = INNER_RADIUS_FRACTION - INNER_RADIUS_FRACTION_PER_DIGIT * np.log10(tolerance)
    edge = min(inner, 1) * offsets.reach + MIN_EDGE_FRACTION * offsets.along
    y, x = (
        max(edge + far, extent)
        for far, extent in zip(offsets.farthest, offsets.extents, strict=True)
    )
    return y, x


def find_fast_length(count: float) -> int:
    """Next length that Fourier transforms are quick at."""
    longer = (factor << power for factor in (4, 5) for power in range(8, 30))
    return min(length for length in (*FAST_LENGTHS, *longer) if length >= count)


# Nodes along the lateral wavenumber, relative to the Nyquist rate of the window's radius;
# interpolation then errs by 1.6e-4 in noise, which comes from the rim as well, and with finer nodes
# by 3e-5.
NODE_OVERSAMPLING, FINE_NODE_OVERSAMPLING = 2.5, 3.5
# Relative error allowed, below which nodes are finer.
FINE_NODES_TOLERANCE = 1e-3
# Samples along the radius per period of the fastest product of wave and Bessel function.
RADII_PER_PERIOD = 1.25


def choose_oversampling(tolerance: float) -> float:
    """Return how close nodes have to be for a relative error."""
    return FINE_NODE_OVERSAMPLING if tolerance < FINE_NODES_TOLERANCE else NODE_OVERSAMPLING


@dataclass(frozen=True, eq=False)
class SphericalWaves:
    """The spherical waves that carry a field on."""

    # evenly spaced wavenumbers, rad/m
    first: float
    step: float
    count: int
    # false for ``exp(1j * k * R) / R``, the wave of a point; True for the first Rayleigh-Sommerfeld
    # integral's ``z / (2 pi R^2) * (1 / R - 1j * k) * exp(1j * k * R)``, which continues a field
    # known on a plane
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
    """

    waves: SphericalWaves
    window: Window
    max_lateral_wavenumber: float  # largest lateral wavenumber q wanted, rad/m
    # smallest distance that will be asked for, m: the nearer, the more sharply peaked the wave
    min_distance: float
    # nodes along the lateral wavenumber, relative to the Nyquist rate of the window's radius
    oversampling: float = NODE_OVERSAMPLING

    @cached_property
    def node_step(self) -> float:
        """Distance of neighbouring nodes in q, rad/m."""
        return np.pi / (self.window.outer_radius * self.oversampling)

    @cached_property
    def nodes(self) -> FloatArray:
        """Lateral wavenumbers of the nodes, rad/m."""
        # even in q: nodes on both sides of 0 serve the interpolation there
        return self.node_step * np.arange(
            -(TAPS // 2), np.ceil(self.max_lateral_wavenumber / self.node_step) + TAPS // 2 + 1
        )

    @cached_property
    def _radii(self) -> tuple[FloatArray, FloatArray]:
        """Radii, m, and the weights of an integral over the plane; exponentially accurate for
        smooth waves. A trapezoidal rule in t with ``rho = h * log(1 + exp(t))``: evenly spaced but
        for a few ever smaller radii.
        """
        # the fastest phase along the radius is that of wave and Bessel function together; and waves
        # that fade along z, with q far beyond k, are sampled as others are
        widest = self.max_lateral_wavenumber
        fastest = RADII_PER_PERIOD * (self.waves.max_wavenumber + widest)
        h = min(2 * np.pi / max(fastest, 2 * widest), self.min_distance)
        t = np.arange(-8.0, self.window.outer_radius / h + 1)
        radii = h * np.logaddexp(0, t)
        return radii, 2 * np.pi * radii * h / (1 + np.exp(-t))

    @cached_property
    def bessel_matrix(self) -> Float32Array:
        """``J_0(q * rho)`` with all weights, shape (nodes, radii)."""
        from scipy.special import j0

        radii, weights = self._radii
        falling = self.window.fall(radii)
        return np.asarray(j0(np.outer(self.nodes, radii)) * (weights * falling), np.float32)

    def tabulate(self) -> int:
        """Compute now the table that all evaluations share, before threads do; return its bytes."""
        return self.bessel_matrix.nbytes

    def interpolation(self, lateral: FloatArray) -> tuple[IntArray, Float32Array]:
        """Find lateral wavenumbers among the nodes: the first node to take, and the weights of
        `TAPS` from it on.
        """
        node, weight = np.empty(lateral.size, np.int64), np.empty((lateral.size, TAPS), np.float32)
        find_interpolation_weights(lateral / self.node_step + TAPS // 2, node, weight)
        return node, weight

    def evaluate(self, distance: float, delay: FloatArray, leading_zeros: int = 0) -> Float32Array:
        """Return the transfer function over a distance, m: real and imaginary parts (nodes, 2,
        leading_zeros + frequencies).

        A delay, path in m and wavenumber k_0 in rad/m, turns every frequency by ``(k - k_0) *
        path`` besides. A negative distance undoes a positive one, as far as waves travel at all.
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
        return flat.reshape(-1, *waves.shape[1:])


# Nodes that tell how strong waves are, without interpolation between them.
ENERGY_OVERSAMPLING = 1.25


def find_lateral_limits(
    waves: SphericalWaves,
    window: Window,
    strength: FloatArray,
    distance: float,
    error: float,
    fading: bool = False,
) -> FloatArray:
    """Return the largest lateral wavenumber that counts at each frequency, rad/m, increasing.

    Independent signals of all sources excite all lateral wavenumbers alike, and what gets to a
    distance is the transfer function's. Those that are weakest there are left out, over all
    frequencies together: among them waves that travel aside at the band's edges, where the pulse is
    weak, and evanescent ones.

    `strength` (frequencies,): relative amplitude of each frequency; `distance`: from the sources,
    along z, m; `error`: allowed, root mean square, relative; `fading`: whether waves that fade over
    the distance, but not to the error, may count, too.
    """
    # of the window's fall only, not of where it is cut: that lies beyond all targets
    whole = window.without_cut
    decay = np.log(1 / error) / abs(distance) if fading else 0.0
    beyond = np.hypot(waves.max_wavenumber, decay) + whole.spectral_spread(error)
    points = replace(waves, continued=False)
    transfer = TransferFunction(points, whole, beyond, abs(distance), ENERGY_OVERSAMPLING)
    first = TAPS // 2  # the node at 0
    lateral = transfer.nodes[first:]
    real, imaginary = np.moveaxis(transfer.evaluate(abs(distance), np.zeros(2))[first:], 1, 0)
    density = (real.astype(np.float64) ** 2 + imaginary.astype(np.float64) ** 2) * strength**2
    # a ring of lateral wavenumbers holds waves in proportion to its radius
    energy = density * lateral[:, np.newaxis]
    order = np.argsort(density, axis=None)
    left_out = np.searchsorted(np.cumsum(energy.ravel()[order]), error**2 * energy.sum())
    counts = density >= density.ravel()[order[min(left_out, order.size - 1)]]
    last = lateral.size - 1 - np.argmax(counts[::-1], axis=0)
    farthest = np.where(counts.any(axis=0), last, 1)
    return np.maximum.accumulate(lateral[np.maximum(farthest, 1)])
