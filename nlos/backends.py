"""The inner loops that imaging by waves needs, per kind of array and under the same names.

`CompiledBackend` has loops of its own for NumPy's arrays; `PortableBackend` has matrix products for
arrays of any library, which stay where they are. What is computed, and in which order, is written
once, in `nlos.wave_plan`.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from nlos.band import Band
from nlos.capture import Capture
from nlos.geometry import FloatArray
from nlos.illumination_groups import IlluminationGroup
from nlos.method import Progress, ignore_progress
from nlos.plane import WallLattice
from nlos.propagation.compiled import CompiledPropagation
from nlos.propagation.wall_to_plane_plan import WallBeforePlane
from nlos.rsd.diffraction import DiffractionPlan
from nlos.rsd.image_planes import CompiledDiffraction, LaserSource
from nlos.rsd.transfer import SphericalWaves
from tofclip.arrays import Array, is_numpy


class PhasorPropagation(Protocol):
    """Carries phasors from wall points onto a plane."""

    def field(self, phasors: Array, progress: Progress = ignore_progress) -> Array:
        """Return the field (y, x, frequencies) on the plane of phasors (n, frequencies), complex64.

        `phasors` (n, frequencies); `progress`: called with the number of plane points times
        frequencies just done. Returns (y, x, frequencies).
        """
        ...


class Diffraction(Protocol):
    """Carries fields from a plane to all depths of a grid, where they meet the laser's wave."""

    def add(self, values: Array, total: Array, progress: Progress) -> None:
        """Add the image of a field (y, x, frequencies) to a volume (z, y, x).

        `values` (y, x, frequencies); `total` (z, y, x): added to, in place; `progress`: called with
        the number of voxels just done.
        """
        ...

    def for_laser(self, laser: FloatArray | None) -> Diffraction:
        """Return the same for the light of another spot (3,), m, sharing what both need."""
        ...


class Backend(Protocol):
    """What `nlos.wave_plan` asks of a kind of array."""

    def zeros(self, shape: tuple[int, ...]) -> Array:
        """Make complex64 zeros."""
        ...

    def compute_phasors(self, capture: Capture, group: IlluminationGroup) -> Array:
        """Return the phasors P_k (points, frequencies) of a group's wall points, complex64.

        Parameters
        ----------
        capture : Capture
        group : IlluminationGroup

        Returns
        -------
        (points, frequencies) complex64 array
        """
        ...

    def place_on_lattice(self, phasors: Array, lattice: WallLattice) -> Array:
        """Put phasors (points, frequencies) into their places, (y, x, frequencies).

        Parameters
        ----------
        phasors : (points, frequencies) complex64 array
        lattice : WallLattice

        Returns
        -------
        (y, x, frequencies) complex64 array
        """
        ...

    def propagate_phasors(
        self, geometry: WallBeforePlane, waves: SphericalWaves, tolerance: float
    ) -> PhasorPropagation:
        """Return what carries phasors from wall points onto a plane.

        Parameters
        ----------
        geometry : WallBeforePlane
        waves : SphericalWaves
        tolerance : float
            Relative error.

        Returns
        -------
        PhasorPropagation
        """
        ...

    def plane_to_depths(self, plan: DiffractionPlan, source: LaserSource) -> Diffraction:
        """Return what carries fields from the plane of `plan` to all depths.

        Parameters
        ----------
        plan : DiffractionPlan
        source : LaserSource

        Returns
        -------
        Diffraction
        """
        ...


class CompiledBackend:
    """Compiled loops on NumPy's arrays."""

    def __init__(self, band: Band) -> None:
        self.band = band

    def zeros(self, shape: tuple[int, ...]) -> Array:
        """Make complex64 zeros."""
        return np.zeros(shape, np.complex64)

    def compute_phasors(self, capture: Capture, group: IlluminationGroup) -> Array:
        """Return the phasors P_k (points, frequencies) of a group's wall points, complex64."""
        return group.compute_phasors(capture, self.band)

    def place_on_lattice(self, phasors: Array, lattice: WallLattice) -> Array:
        """Put phasors (points, frequencies) into their places, (y, x, frequencies)."""
        return lattice.place(phasors)

    def propagate_phasors(
        self, geometry: WallBeforePlane, waves: SphericalWaves, tolerance: float
    ) -> PhasorPropagation:
        """Return what carries phasors from wall points onto a plane."""
        return CompiledPropagation(geometry, waves, tolerance)

    def plane_to_depths(self, plan: DiffractionPlan, source: LaserSource) -> Diffraction:
        """Return what carries fields from the plane of `plan` to all depths."""
        return CompiledDiffraction(plan, source)


class PortableBackend:
    """Matrix products on the arrays of any library, where these live.

    `capture`: for the device and the number of bins of its signal.
    """

    def __init__(self, band: Band, capture: Capture) -> None:
        from nlos.portable.library import ArrayLibrary
        from nlos.portable.signals import BandTransform

        self.library = ArrayLibrary(capture.device)
        self._transform = BandTransform(band, capture.axis.bins, self.library)

    def zeros(self, shape: tuple[int, ...]) -> Array:
        """Make complex64 zeros."""
        return self.library.zeros(shape)

    def compute_phasors(self, capture: Capture, group: IlluminationGroup) -> Array:
        """Return the phasors P_k (points, frequencies) of a group's wall points, complex64."""
        from nlos.portable.signals import get_group_traces

        return self._transform.of(get_group_traces(capture, group))

    def place_on_lattice(self, phasors: Array, lattice: WallLattice) -> Array:
        """Put phasors (points, frequencies) into their places, (y, x, frequencies)."""
        from nlos.portable.signals import arrange_on_lattice

        xp = self.library.xp
        placed = arrange_on_lattice(xp.permute_dims(phasors, (1, 0)), lattice, self.library)
        return xp.permute_dims(placed, (1, 2, 0))

    def propagate_phasors(
        self, geometry: WallBeforePlane, waves: SphericalWaves, tolerance: float
    ) -> PhasorPropagation:
        """Return what carries phasors from wall points onto a plane."""
        from nlos.portable.propagation import PortablePropagation

        return PortablePropagation(geometry, waves, tolerance, self.library)

    def plane_to_depths(self, plan: DiffractionPlan, source: LaserSource) -> Diffraction:
        """Return what carries fields from the plane of `plan` to all depths."""
        from nlos.portable.diffraction import PortableDiffraction

        return PortableDiffraction(plan, source, self.library)


def choose_backend(capture: Capture, band: Band) -> Backend:
    """Return the backend of a capture's arrays, for the frequencies of a band.

    `band`: wavenumbers, rad/m.
    """
    return CompiledBackend(band) if is_numpy(capture.signal) else PortableBackend(band, capture)
