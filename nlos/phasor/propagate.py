"""From a wall of any shape to a plane in front of it, by the kind of array that the signal is: compiled
loops for NumPy's arrays; matrix products for arrays of any other library, which stay where they are.
What is computed, and in which order, is written once, in `nlos.phasor.plan`. `nlos.propagate` gives
the field on a plane.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Literal, get_args

import numpy as np

from nlos.band import Band, VirtualPulse
from nlos.capture import Capture
from nlos.illumination import IlluminationGroup, build_waves, find_leg_bounds, group_by_illumination
from nlos.method import Progress, ignore_progress, require_numpy_signal
from nlos.phasor.arrays import ArrayLibrary, BandTransform, arrange_on_lattice, get_traces
from nlos.phasor.depth_steps import DiffractionPlan
from nlos.phasor.to_depths import PortableDiffraction
from nlos.phasor.to_depths_compiled import CompiledDiffraction, LaserSource
from nlos.phasor.transfer import SphericalWaves
from nlos.phasor.wall_kernels import shift_and_sum
from nlos.phasor.wall_to_plane import WallBeforePlane, has_finufft, plan_transforms
from nlos.phasor.wall_to_plane_arrays import DevicePropagation, sum_waves_on_device
from nlos.phasor.wall_to_plane_compiled import (
    STRENGTH_POINTS,
    estimate_strength,
    propagate_direct,
    propagate_low_rank,
)
from nlos.plane import Plane, PlaneField, WallLattice
from nlos.volume import Grid
from tofclip.arrays import Array, ComplexArray, Float32Array, FloatArray, is_numpy, to_numpy
from tofclip.errors import InputError
from tofclip.threads import limit_blas_threads, run_blocks

Propagation = Literal["spectral", "time"]

WallToPlane = Callable[[Capture, Progress, IlluminationGroup], Array]
"""Carries what one of several groups of the same wall points recorded to a plane: the field (y, x,
frequencies) there.
"""


POINTS_PER_BLOCK = 64


class SpectralPropagation:
    """Phasors of wall points, carried onto a plane the faster way that keeps the tolerance: by direct
    sums, or by Fourier transforms, whose terms are chosen for the spectrum of the first phasors that
    come and stay for later ones. `waves`: from points; `library`: of the phasors, none for NumPy's.
    """

    def __init__(
        self,
        geometry: WallBeforePlane,
        waves: SphericalWaves,
        tolerance: float,
        library: ArrayLibrary | None,
    ) -> None:
        self.geometry, self.waves, self.tolerance = geometry, waves, tolerance
        self.library = library
        self._propagate: Callable[[Array, Progress], Array] | None = None

    def field(self, phasors: Array, progress: Progress = ignore_progress) -> Array:
        """Return the field (y, x, frequencies) on the plane of phasors (n, frequencies); progress
        counts its values.
        """
        self._propagate = self._propagate or self._choose(phasors)
        return self._propagate(phasors, progress)

    def _choose(self, phasors: Array) -> Callable[[Array, Progress], Array]:
        geometry, waves, library = self.geometry, self.waves, self.library
        some = slice(None, None, phasors.shape[0] // STRENGTH_POINTS + 1)
        sample = phasors[some, :]
        strength = estimate_strength(sample if library is None else to_numpy(sample))
        scattered = library is None and has_finufft()
        with limit_blas_threads():
            plan = plan_transforms(geometry, waves, strength, self.tolerance, scattered)
        if library is not None:
            carry = partial(sum_waves_on_device, geometry, waves, library)
            on_lattice = plan and DevicePropagation(plan, library).field

            def carry_at_once(phasors: Array, progress: Progress) -> Array:
                field = (on_lattice or carry)(phasors)
                progress(math.prod(field.shape))
                return field

            return carry_at_once
        if plan is not None:
            return partial(propagate_low_rank, plan)
        return lambda phasors, progress: propagate_direct(
            geometry.points, phasors, geometry.plane, waves.wavenumbers, progress
        )


Diffraction = CompiledDiffraction | PortableDiffraction


class Backend:
    """What computes on a capture's arrays at the frequencies of a band."""

    def __init__(self, band: Band, capture: Capture) -> None:
        self.band, self.library = band, None
        zeros: Callable[..., Array] = partial(np.zeros, dtype=np.complex64)
        if not is_numpy(capture.signal):
            self.library = library = ArrayLibrary(capture.device)
            self._transform, zeros = BandTransform(band, capture.axis.bins, library), library.zeros
        self.zeros = zeros

    def compute_phasors(self, capture: Capture, group: IlluminationGroup) -> Array:
        """Return the phasors P_k (points, frequencies) of a group's wall points, complex64."""
        if self.library is not None:
            return self._transform.of(get_traces(capture, group.indices))
        traces = capture.traces()
        own = traces if len(group.indices) == len(traces) else traces[group.indices]
        return np.asarray(self.band.compute_phasors(own), np.complex64)

    def place_on_lattice(self, phasors: Array, lattice: WallLattice) -> Array:
        """Put phasors (points, frequencies) into their places, (y, x, frequencies)."""
        if self.library is None:
            return lattice.place(phasors)
        xp = self.library.xp
        placed = arrange_on_lattice(xp.permute_dims(phasors, (1, 0)), lattice, self.library)
        return xp.permute_dims(placed, (1, 2, 0))

    def plane_to_depths(self, plan: DiffractionPlan, source: LaserSource) -> Diffraction:
        """Return what carries fields from a plane to all depths, in the light of a source."""
        if self.library is None:
            return CompiledDiffraction(plan, source)
        return PortableDiffraction(plan, source, self.library)


def propagate(
    capture: Capture,
    plane: Plane,
    pulse: VirtualPulse,
    propagation: Propagation = "spectral",
    tolerance: float = 1e-2,
) -> PlaneField:
    """Carry a capture's phasor field from its wall onto a plane between wall and scene.

    The wall may have any shape and any number of pieces; its points need no order, and masked ones
    are left out.

    Parameters
    ----------
    capture : Capture
        Of one laser spot, or confocal.
    plane : Plane
        In front of every wall point.
    pulse : VirtualPulse
    propagation : {"spectral", "time"}
        At the band's frequencies only; or the paper's shifting and adding of transients, whose
        error is that of linear interpolation between bins.
    tolerance : float
        Relative error of the field that is allowed for the sake of speed, 1e-4 to 0.1; "spectral"
        only. Walls of many points go by Fourier transforms, those of scattered points if finufft is
        installed (``tofclip[scattered]``), others by direct sums, good to 1e-5.

    Raises
    ------
    InputError
        Several laser spots, an empty band, or a plane that is not in front of the wall.
    """
    groups = group_by_illumination(capture)
    if len(groups) > 1:
        raise InputError(
            f"{len(groups)} laser spots make as many fields: propagate the wall points of one at a time"
        )
    require_tolerance(tolerance)
    require_propagation(propagation)
    group, band = groups[0], Band(pulse, capture.axis)
    wall = WallBeforePlane.of(capture.points[group.indices], plane)
    how = Backend(band, capture), propagation, tolerance
    carry = plan_wall_to_plane(capture, wall, group, band, *how)
    wavenumbers = group.legs * band.wavenumbers
    return PlaneField(carry(capture, ignore_progress, group), plane, wavenumbers)


def plan_wall_to_plane(
    capture: Capture,
    geometry: WallBeforePlane,
    group: IlluminationGroup,
    band: Band,
    backend: Backend,
    propagation: Propagation = "spectral",
    tolerance: float = 1e-2,
) -> WallToPlane:
    """Return what carries groups of the same wall points onto a plane; see `propagate`. Progress
    counts points of the plane times frequencies.
    """
    points, plane = geometry.points, geometry.plane
    require_in_front(plane.z, points)
    if propagation == "time":
        require_numpy_signal("propagation in time", capture)

        def shift_and_sum(one: Capture, progress: Progress, group: IlluminationGroup) -> Array:
            traces = np.ascontiguousarray(one.traces()[group.indices])
            return propagate_in_time(points, traces, plane, band, group.legs, progress)

        return shift_and_sum
    waves = build_waves(group, band, continued=False)
    propagated = SpectralPropagation(geometry, waves, tolerance, backend.library)

    def propagate_spectrum(one: Capture, progress: Progress, group: IlluminationGroup) -> Array:
        return propagated.field(backend.compute_phasors(one, group), progress)

    return propagate_spectrum


def propagate_in_time(
    points: FloatArray,
    traces: Float32Array,
    plane: Plane,
    band: Band,
    legs: int,
    progress: Progress = ignore_progress,
) -> ComplexArray:
    """Return the phasors (y, x, frequencies) of transients (n, t) of points (n, 3), m, carried onto
    a plane bin by bin: earlier by their way there, `legs` times, linear between bins, an error of
    some 0.5 % for 15 bins per wavelength that grows with their square.

    Supplementary Note 12 of X. Feng, Y. Ma, L. Gao, Nat. Commun. 13, 3333 (2022).
    """
    targets = plane.points.reshape(-1, 3)
    scale = legs / band.axis.spacing
    nearest, farthest = find_leg_bounds(points, Grid(plane.x, plane.y, np.array([plane.z])))
    latest = np.ceil(farthest * scale)
    bins = traces.shape[1] + int(latest - np.floor(nearest * scale)) + 2
    paths = band.axis.start + band.axis.spacing * (np.arange(bins) - latest)
    analysis = (band.weights * np.exp(-1j * np.outer(paths, band.wavenumbers))).astype(np.complex64)
    field = np.empty((len(targets), band.wavenumbers.size), np.complex64)

    def process_block(block: slice) -> None:
        sums = np.zeros((block.stop - block.start, bins), np.float32)
        shift_and_sum(traces, points, targets[block], scale, float(latest), sums)
        field[block] = sums @ analysis
        progress(field[block].size)

    run_blocks(process_block, len(targets), size=POINTS_PER_BLOCK)
    return field.reshape(*plane.shape, -1)


def require_in_front(z: float, points: FloatArray) -> None:
    """Refuse a virtual plane that a wall's points (n, 3) reach up to."""
    foremost = float(points[:, 2].max())
    if z <= foremost:
        raise InputError(
            f"the virtual plane must lie in front of the wall, which reaches up to z = {foremost:.4g} m"
        )


def require_propagation(propagation: str) -> None:
    """Refuse a word that is not a propagation from wall to plane."""
    if propagation not in get_args(Propagation):
        raise InputError(
            f"propagation must be one of {', '.join(get_args(Propagation))}, got '{propagation}'"
        )


def require_tolerance(tolerance: float) -> None:
    """Refuse a tolerance that makes no sense or cannot be met in single precision."""
    if not 1e-4 <= tolerance <= 0.1:
        raise InputError(f"the tolerance must lie between 1e-4 and 0.1, got {tolerance}")
