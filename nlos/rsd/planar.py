"""Phasor-field imaging from a planar wall, by Rayleigh-Sommerfeld diffraction in the frequency
domain.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from nlos.band import Band, VirtualPulse
from nlos.capture import Capture
from nlos.geometry import Grid
from nlos.illumination_groups import (
    IlluminationGroup,
    check_illumination_support,
    choose_unaliased_band,
    group_by_illumination,
)
from nlos.method import PhasorMethod, Progress, Support, check_common_support, ignore_progress
from nlos.plane import Plane, is_evenly_spaced
from nlos.rsd.diffraction import DiffractionPlan
from nlos.rsd.image_planes import LaserSource, diffract_to_grid
from nlos.rsd.transfer import SphericalWaves
from nlos.rsd.wall import PlanarWall
from nlos.sampling import warn_of_aliasing
from nlos.volume import Volume
from tofclip.arrays import is_numpy
from tofclip.errors import InputError


@dataclass(frozen=True)
class PlanarRSD(PhasorMethod):
    """Diffraction from a planar wall to all depths: the image of `Backprojection`, thousands of
    times faster.

    ``I(r) = | sum_k exp(1j * k * |r_L - r|) * sum_p P_k(r_p) * exp(1j * k * |r_p - r|) / |r_p - r|
    |``: the inner sum is a convolution over the wall, done in the frequency domain; the outer one
    takes a few inverse Fourier transforms per depth, since the laser's wave varies little across
    the band. For a confocal scan the wavenumber is doubled and the laser's wave drops out; several
    laser spots add up.

    Errs by less than `tolerance` at depths of a wavelength and more; nearer to the wall, waves that
    fade within a wavelength are missing. Holds the wall's spectrum, 8 bytes per plane wave and
    frequency (60 MB for 128 x 128 points and 120 frequencies), the volume, and per thread the waves
    of all terms of two depths (30 MB). A capture of another library's arrays is imaged in that
    library; see `nlos.portable`.

    Liu, Bauer, Velten, "Phasor field diffraction based reconstruction for fast non-line-of-sight
    imaging systems", Nat. Commun. 11, 1645 (2020).

    Parameters
    ----------
    wavelength : float
        Carrier wavelength of the virtual pulse, m of path.
    cycles : float
        Length of the pulse in wavelengths; see `nlos.band.VirtualPulse`.
    tolerance : float
        Relative error of the image that is allowed for the sake of speed, 1e-4 to 0.1.

    Examples
    --------
    >>> import numpy as np
    >>> import nlos
    >>> from nlos.simulate.points import PointScene
    >>> from nlos.time_axis import TimeAxis
    >>> x, y = np.meshgrid(np.linspace(-0.5, 0.5, 16), np.linspace(-0.5, 0.5, 16))
    >>> wall, hidden = np.stack([x, y, 0 * x], axis=-1), PointScene([[0.1, -0.2, 0.8]])
    >>> capture = hidden.simulate_capture(wall, np.zeros(3), TimeAxis(256, 40e-12), jitter=60e-12)
    >>> grid = nlos.Grid.box((-0.4, 0.4), (-0.4, 0.4), (0.6, 1.0), voxel=0.1)
    >>> volume = nlos.PlanarRSD(wavelength=0.28).reconstruct(capture, grid)
    >>> volume.values.shape
    (5, 9, 9)
    """

    wavelength: float
    cycles: float = 3.0
    tolerance: float = 1e-2
    pulse: VirtualPulse = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "pulse", VirtualPulse(self.wavelength, self.cycles))
        require_tolerance(self.tolerance)

    def supports(self, capture: Capture, grid: Grid) -> Support:
        """Say whether `capture` can be imaged on `grid`, and if not, why.

        Needed are a planar, evenly sampled wall at z = const, voxels evenly spaced along x and y
        and in front of the wall, few laser spots, and memory.

        Parameters
        ----------
        capture : Capture
        grid : Grid

        Returns
        -------
        Support
            True in a condition if it can; ``.reason`` says why not.
        """
        general = (
            check_common_support(capture, grid)
            and check_grid_support(grid)
            and check_illumination_support(capture)
        )
        if not general:
            return general
        try:
            band = choose_unaliased_band(capture, grid, self.pulse)
            walls = [
                PlanarWall.of(capture.points[group.indices])
                for group in group_by_illumination(capture)
            ]
        except InputError as problem:
            return Support(str(problem))
        if grid.z[0] <= walls[0].plane.z:
            return Support(
                f"the grid must begin in front of the wall, which is at z = {walls[0].plane.z:.4g} m"
            )
        return self._plan(walls[0].plane, grid, band, group_by_illumination(capture)[0]).supports()

    def phasor_field(
        self, capture: Capture, grid: Grid, progress: Progress = ignore_progress
    ) -> Volume:
        """Return the complex sum whose magnitude `reconstruct` gives, complex64; it is linear in
        the signal.

        Parameters
        ----------
        capture : Capture
        grid : Grid
        progress : callable
            Called with the amount of work just done; see `reconstruct`.

        Returns
        -------
        Volume
            (z, y, x) complex64.

        Raises
        ------
        InputError
            `supports` says no.
        """
        self.supports(capture, grid).require()
        band = choose_unaliased_band(capture, grid, self.pulse)
        warn_of_aliasing(capture, band)
        if is_numpy(capture.signal):
            total = self._diffract_compiled(capture, grid, band, progress)
        else:
            from nlos.portable.prepared import PreparedField

            total = PreparedField(self, capture, grid).of(capture, progress)
        return Volume(total, grid, {**capture.provenance, "imaging": self.settings})

    @property
    def settings(self) -> dict[str, str | float]:
        """How a volume was imaged, for its provenance."""
        return {
            "method": "rsd",
            "wavelength_m": self.wavelength,
            "cycles": self.cycles,
            "tolerance": self.tolerance,
        }

    def _diffract_compiled(
        self, capture: Capture, grid: Grid, band: Band, progress: Progress
    ) -> NDArray[np.complex64]:
        total = np.zeros(grid.shape, np.complex64)
        for group in group_by_illumination(capture):
            wall = PlanarWall.of(capture.points[group.indices])
            values = wall.field(group.compute_phasors(capture, band))
            diffract_to_grid(
                self._plan(wall.plane, grid, band, group),
                values,
                build_source(group, band),
                total,
                progress,
            )
        return total

    def _plan(
        self, plane: Plane, grid: Grid, band: Band, group: IlluminationGroup
    ) -> DiffractionPlan:
        return DiffractionPlan(
            plane, grid, build_waves(group, band, continued=False), self.tolerance
        )


def require_tolerance(tolerance: float) -> None:
    """Refuse a tolerance that makes no sense or cannot be met in single precision."""
    if not 1e-4 <= tolerance <= 0.1:
        raise InputError(f"the tolerance must lie between 1e-4 and 0.1, got {tolerance}")


def check_grid_support(grid: Grid) -> Support:
    """Check that Fourier transforms can reach the voxels."""
    for name in ("x", "y"):
        if not is_evenly_spaced(getattr(grid, name)):
            return Support(
                f"the voxels are not evenly spaced along {name}: Fourier transforms need them to be"
            )
    return Support()


def build_waves(group: IlluminationGroup, band: Band, continued: bool) -> SphericalWaves:
    """Return the waves between wall and voxels of one illumination group.

    Parameters
    ----------
    group : IlluminationGroup
        Its ``legs``: how many legs of the path run between wall and voxels, 2 for confocal
        captures.
    band : Band
        Wavenumbers of the virtual pulse, rad/m.
    continued : bool
        False for point sources, True for a field known on a plane; see `SphericalWaves`.

    Returns
    -------
    SphericalWaves
    """
    k = group.legs * band.wavenumbers
    step = float(k[1] - k[0]) if k.size > 1 else 1.0
    return SphericalWaves(float(k[0]), step, k.size, continued)


def build_source(group: IlluminationGroup, band: Band) -> LaserSource:
    """Return what shines on the scene in one illumination group.

    Parameters
    ----------
    group : IlluminationGroup
        Its laser spot, m.
    band : Band
        Wavenumbers and weights of the virtual pulse.

    Returns
    -------
    LaserSource
    """
    return LaserSource(group.laser, band.wavenumbers, band.weights / band.weights.max())
