"""Settings that suit a capture, found from it and with their reasons.

`settings_for` looks at the capture as it was recorded and completes what is not given: the gate
that takes the wall's own light away, the virtual pulse, how many time bins are put together, the
voxels, the box, and the quickest method. The command line and Python use the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from nlos.analysis import (
    choose_wavelength,
    find_first_bounce,
    find_lit_end,
    find_longest_wavelength,
    require_plausible,
    require_usable_cycles,
    require_usable_wavelength,
)
from nlos.capture import Capture
from nlos.illumination import choose_roles
from nlos.method import Method, Plan
from nlos.preparation import (
    fade_record_end,
    flip_capture,
    join_near_lasers,
    rebin_capture,
    remove_first_bounce,
)
from nlos.volume import Grid, Volume
from tofclip.errors import InputError

Limits = tuple[float, float]

VOXELS_PER_WAVELENGTH = 8
VOXEL_BIN_FRACTION = 1 / 3
"""Of the path of a bin, the voxel of transforms. Half of it is the bin's depth, but a surface that
lies between two such voxels would be dimmed and drawn with stripes."""

MAX_VOXELS_PER_SIDE = 256
"""A default voxel is not so small that more would fit along the longest side of the wall."""

BINS_PER_WAVELENGTH = 16
"""Time bins are put together while a wavelength keeps this number: 0.6 % of the carrier is lost."""

SIGMAS_PER_WAVELENGTH = 4
"""The Laplacian of filtered back-projection is a quarter of a wavelength wide."""


GATE_RAMP_FRACTION = 0.25
"""A gate that was found opens over this fraction of its length: a sharp edge would be an image."""

FADE_FRACTION = 0.1
"""Of the record, what fades out where light still comes at its end."""


SCOUT_WAVELENGTHS, QUICK_SCOUT_VOXELS = 2.0, 1 << 13
"""Waves by which the box is looked over are this number of times longer, if the wall is so wide and
the voxels more than can be imaged in no time: longer waves see less of few photons.
"""


GATE_DEPTH_FRACTION = 0.4
"""Nearer than this fraction of the gate everything was blanked; the default box begins there."""

BRIGHTEST_ON_WALL_WAVELENGTHS = 0.5
"""A voxel nearer to a wall point than this is on the wall."""

METHOD_CLASSES = {
    "rsd": ("PlanarRSD", ("wavelength", "cycles", "tolerance")),
    "hybrid": ("Hybrid", ("wavelength", "cycles", "tolerance")),
    "backprojection": ("Backprojection", ("wavelength", "cycles")),
    "filtered-backprojection": ("FilteredBackprojection", ("sigma",)),
    "lct": ("LightCone", ("signal_to_noise", "falloff")),
    "fk": ("FKMigration", ("falloff",)),
}
"""Class in `nlos` by the method's name, and the settings that it takes."""

METHODS_BY_SPEED = ("rsd", "hybrid", "backprojection")
"""They give the same picture; the later one takes more walls and lasers, and more time."""

MIN_PAIRS_PER_IMAGE = 250
"""An image by waves takes as long as to back-project this many pairs of spots; measured. One is made
for every laser spot, or two for every wall point that sees many."""

TRANSFORM_METHODS = ("lct", "fk")
"""They see no finer than the wall's lattice and the time bins, whatever the wavelength."""


@dataclass(frozen=True)
class Settings:
    """How a capture is imaged; None is found by `settings_for`.

    Parameters
    ----------
    flip : {"x", "y"}, optional
        Coordinate that changes sign, where the picture would be mirrored.
    gate : float, optional
        m of path after the wall's own light that are blanked; None where nothing is.
    gate_found : bool
        Whether the gate was found from the capture.
    gate_ramp : float, optional
        m of path over which signals then rise to their whole strength.
    fade : float, optional
        m of path before the record's end over which signals fade out.
    bins_together : int, optional
        Time bins added up to one before imaging.
    wavelength : float, optional
        Carrier of the virtual pulse, m of path.
    cycles : float
        Length of the virtual pulse in wavelengths.
    voxel : float, optional
        Distance of neighbouring voxels, m.
    x, y : (float, float), optional
        First and last voxel across the wall, m.
    near, far : float, optional
        First and last depth, m.
    everywhere : bool
        Whether all of that box is filled with voxels, not only the part that is bright.
    method : str, optional
        One of `METHOD_CLASSES`.
    tolerance, sigma, falloff, signal_to_noise : float, optional
        Of the methods; None where the method's own default holds, or does not apply. `sigma` in m.
    reasons : mapping of str to str
        Why the settings that were found are what they are, by their names.
    """

    flip: str | None = None
    gate: float | None = None
    gate_found: bool = False
    gate_ramp: float | None = None
    fade: float | None = None
    bins_together: int | None = None
    wavelength: float | None = None
    cycles: float = 3.0
    voxel: float | None = None
    x: Limits | None = None
    y: Limits | None = None
    near: float | None = None
    far: float | None = None
    everywhere: bool = False
    method: str | None = None
    tolerance: float | None = None
    sigma: float | None = None
    falloff: float | None = None
    signal_to_noise: float | None = None
    reasons: Mapping[str, str] = field(default_factory=dict)

    @property
    def box(self) -> tuple[Limits, Limits, Limits]:
        """First and last voxel along x, y and z, m."""
        x, y, near, far = self.x, self.y, self.near, self.far
        if x is None or y is None or near is None or far is None:
            raise InputError("these settings have no box yet; complete them by settings_for")
        return x, y, (near, far)

    def prepare(
        self, capture: Capture, join: Callable[[Capture], Capture] = join_near_lasers
    ) -> Capture:
        """Mirror coordinates, blank the wall's own light and put time bins together, as settings say.

        Of laser spots and wall points the fewer come as laser spots: a wave is imaged for each,
        and seen from a lone detector all of its surroundings would be bright.

        Parameters
        ----------
        capture : Capture
        join : callable
            Brings pairs to their midpoints; `nlos.preparation.MidpointJoin.join` for many captures of
            one geometry.

        Returns
        -------
        Capture
        """
        capture = self._orient(choose_roles(join(capture)))
        if self.gate is not None:
            capture = remove_first_bounce(capture, self.gate, self.gate_ramp or 0.0)
        if self.fade:
            capture = fade_record_end(capture, self.fade)
        return self._join_bins(capture)

    def prepare_counts(self, capture: Capture) -> Capture:
        """Do what `prepare` does but for blanking and midpoints: whatever is counted stays a count."""
        return self._join_bins(self._orient(capture))

    def _orient(self, capture: Capture) -> Capture:
        return flip_capture(capture, self.flip) if self.flip else capture

    def _join_bins(self, capture: Capture) -> Capture:
        bins = 1 if self.bins_together is None else self.bins_together
        return capture if bins == 1 else rebin_capture(capture, bins)

    def grid(self, voxel: float | None = None) -> Grid:
        """Fill the box with voxels, of the settings' size unless `voxel` (m) says otherwise."""
        return Grid.box(*self.box, _voxel_size(self) if voxel is None else voxel)

    def make_method(self, name: str | None = None) -> Method:
        """Build a method by its name, the settings' own by default; what is None is left to it."""
        import nlos

        class_name, taken = METHOD_CLASSES[name or self.method or METHODS_BY_SPEED[0]]
        arguments = {key: getattr(self, key) for key in taken if getattr(self, key) is not None}
        made: Method = getattr(nlos, class_name)(**arguments)
        return made

    def plan_quickest(self, capture: Capture, grid: Grid) -> tuple[str, Plan]:
        """Return the first method that takes the capture and does not take longer than the last
        one, and its plan.

        Parameters
        ----------
        capture : Capture
            As `prepare` returns it.
        grid : Grid

        Returns
        -------
        name : str
        plan : Plan

        Raises
        ------
        InputError
            None of them can image the capture; the reason is that of the last.
        """
        *quicker, last = METHODS_BY_SPEED
        for name in quicker:
            try:
                plan = self.make_method(name).plan(capture, grid)
            except InputError:
                continue
            images = getattr(plan, "images", 1)
            if images == 1 or images * MIN_PAIRS_PER_IMAGE <= len(capture.points):
                return name, plan
        return last, self.make_method(last).plan(capture, grid)

    def with_method(self, name: str) -> Settings:
        """Return the settings with the method that was found to be the quickest."""
        return _add(self, "method", name, "the quickest that takes this wall, laser and grid")

    def to_dict(self) -> dict[str, Any]:
        """Name every setting that has a value."""
        return {name: value for name, value in asdict(self).items() if value is not None}


def settings_for(capture: Capture, **given: Any) -> Settings:
    """Find settings that suit a capture.

    Parameters
    ----------
    capture : Capture
        As it was recorded: with the light that the wall returns at once, if that is in the record.
    **given
        Fields of `Settings` that are known; they rule over what would be found. Lengths in m.

    Returns
    -------
    Settings
        Complete but for the settings of other methods, with reasons for what was found. The box is
        all that may be seen; `find_bright_box` makes it smaller.

    Raises
    ------
    InputError
        No settings suit: the record holds nothing, or nothing but the wall's own light.

    Examples
    --------
    >>> import numpy as np, nlos
    >>> x, y = np.meshgrid(np.linspace(-0.5, 0.5, 8), np.linspace(-0.5, 0.5, 8))
    >>> wall = np.stack([x, y, 0 * x], axis=-1)
    >>> signal = np.zeros((64, 8, 8)); signal[40] = 1
    >>> nlos.settings_for(nlos.Capture(signal, wall, [0, 0, 0], 1e-10)).method
    'rsd'
    """
    found = complete_settings(capture, **given)
    if found.method is None:
        # Which walls a method takes does not depend on the voxels: coarse ones are planned quickly.
        prepared = found.prepare(capture)
        scout, grid = find_scout(prepared, found) or (found, found.grid())
        name, _ = scout.plan_quickest(prepared, grid)
        found = found.with_method(name)
    return found


def complete_settings(capture: Capture, **given: Any) -> Settings:
    """Find settings that suit a capture, but for the method; see `settings_for`."""
    # As recorded: midpoints would hide that lasers stand off the wall.
    require_plausible(choose_roles(capture))
    capture = choose_roles(join_near_lasers(capture))
    found = _complete_gate(capture, Settings(**given))
    gated = replace(found, bins_together=1).prepare(capture)
    if found.fade is None and find_lit_end(gated):
        fade = FADE_FRACTION * float(np.ptp(capture.axis.paths))
        found = _add(found, "fade", fade, "light still comes when the record ends")
        gated = fade_record_end(gated, fade)
    if not float(abs(gated.signal).max()) > 0:
        raise InputError(
            f"a gate of {found.gate or 0.0:.4g} m blanks the whole record; blank less (`gate`)"
        )
    require_usable_cycles(capture, found.cycles)
    if found.wavelength is None:
        wavelength, reason = choose_wavelength(gated, found.cycles)
        found = _add(found, "wavelength", wavelength, reason)
    else:
        require_usable_wavelength(capture, found.wavelength, found.cycles)
    return _complete_box(gated, _complete_sampling(capture, found))


def find_scout(capture: Capture, settings: Settings) -> tuple[Settings, Grid] | None:
    """Return settings and coarse voxels with which all of the box is looked over quickly.

    Waves twice as long have an eighth of the work, on voxels of their half; small boxes are looked
    over with the waves themselves.

    `settings`: complete but for the method. Returns (Settings, Grid): none where the voxels asked
    for are no finer, or all of the box is wanted.
    """
    wavelength = settings.wavelength or 0.0
    if settings.everywhere or (settings.voxel or 0.0) >= wavelength / 2:
        return None
    quick = settings.grid(wavelength / 2)
    if math.prod(quick.shape) <= QUICK_SCOUT_VOXELS:
        return settings, quick
    usable = min(
        find_longest_wavelength(capture), float(np.ptp(capture.axis.paths)) / settings.cycles
    )
    longer = max(wavelength, min(SCOUT_WAVELENGTHS * wavelength, usable))
    return replace(settings, wavelength=longer), settings.grid(longer / 2)


def find_bright_box(settings: Settings, scouted: Volume) -> Settings:
    """Return the settings with the box that holds everything bright in a coarse volume.

    `scouted`: by `find_scout`.
    """
    part = Grid.around(scouted, _voxel_size(settings))
    x, y, z = ((float(axis[0]), float(axis[-1])) for axis in (part.x, part.y, part.z))
    return replace(settings, x=x, y=y, near=z[0], far=z[1], everywhere=True)


def is_brightest_on_wall(volume: Volume, capture: Capture, wavelength: float) -> bool:
    """Whether the brightest voxel lies on the wall, so that the picture shows the wall's own light.

    `wavelength`: nearer to a wall point than half of it, m, is on the wall.
    """
    away = np.linalg.norm(capture.points - np.array(volume.find_brightest()), axis=1)
    return bool(away.min() < BRIGHTEST_ON_WALL_WAVELENGTHS * wavelength)


def _voxel_size(settings: Settings) -> float:
    """Distance of voxels, m; NaN, which every grid refuses, where it is not known yet."""
    return math.nan if settings.voxel is None else settings.voxel


def _add(settings: Settings, name: str, value: Any, reason: str) -> Settings:
    """Return the settings with one more that was found, and why."""
    return replace(settings, **{name: value}, reasons={**settings.reasons, name: reason})


def _complete_gate(capture: Capture, settings: Settings) -> Settings:
    if settings.gate is not None:
        return settings
    bounce = find_first_bounce(capture)
    if bounce is None:
        return _add(settings, "gate", None, "no light of the wall's own is in the record")
    reason = (
        f"the wall's own light is in the record, {bounce.ratio:.3g} times what follows; "
        f"{bounce.end:.3g} m later it has faded"
    )
    ramp = GATE_RAMP_FRACTION * bounce.end if settings.gate_ramp is None else settings.gate_ramp
    return replace(_add(settings, "gate", bounce.end, reason), gate_found=True, gate_ramp=ramp)


def _complete_sampling(capture: Capture, settings: Settings) -> Settings:
    """Find time bins and voxels: of what the wavelength resolves, or for methods without a virtual
    pulse of what the wall's lattice does.
    """
    wavelength = settings.wavelength or math.nan
    by_lattice = settings.method in TRANSFORM_METHODS and capture.spacing < math.inf
    if settings.bins_together is None:
        finest = capture.spacing if by_lattice else wavelength / BINS_PER_WAVELENGTH
        bins = max(1, min(int(finest / capture.axis.spacing + 1e-9), capture.axis.bins // 2))
        reason = (
            "path per bin as neighbouring wall points are apart"
            if by_lattice
            else f"{BINS_PER_WAVELENGTH} bins per wavelength, or as recorded"
        )
        settings = _add(settings, "bins_together", bins, reason)
    if settings.voxel is None:
        extent = float(np.ptp(capture.points, axis=0).max())
        depth = (settings.bins_together or 1) * capture.axis.spacing * VOXEL_BIN_FRACTION
        wanted = depth if by_lattice else wavelength / VOXELS_PER_WAVELENGTH
        reason = "a third of the path of a bin" if by_lattice else "an eighth of the wavelength"
        settings = _add(settings, "voxel", max(wanted, extent / MAX_VOXELS_PER_SIDE), reason)
    if settings.sigma is None:
        settings = replace(settings, sigma=wavelength / SIGMAS_PER_WAVELENGTH)
    return settings


def _complete_box(capture: Capture, settings: Settings) -> Settings:
    """Fill in what is not given of the box: the space in front of the wall that the record covers."""
    voxel = _voxel_size(settings)
    near = settings.near
    if near is None and settings.gate_found:
        low, high = capture.points[:, 2].min(), capture.points[:, 2].max()
        near = float(low + high) / 2 + max(voxel, GATE_DEPTH_FRACTION * (settings.gate or 0.0))
    last = float(capture.axis.paths[-1])
    if near is not None and 2 * (near - float(capture.points[:, 2].max())) > last:
        raise InputError(
            f"a box from z = {near:.4g} m on lies beyond the record, whose paths end at {last:.4g} m"
        )
    front = Grid.in_front_of(capture, voxel, near, settings.far)
    x, y, z = ((float(axis[0]), float(axis[-1])) for axis in (front.x, front.y, front.z))
    completed = replace(
        settings,
        x=x if settings.x is None else settings.x,
        y=y if settings.y is None else settings.y,
        near=z[0] if settings.near is None else settings.near,
        far=z[1] if settings.far is None else settings.far,
    )
    longest = _find_longest_path(capture, completed)
    if capture.start > longest:
        raise InputError(
            f"the record begins at a path of {capture.start:.4g} m, but none by way of the box up to "
            f"z = {completed.far:.4g} m is longer than {longest:.4g} m: take the ways to and from the "
            "devices off, or choose a farther box"
        )
    return completed


def _find_longest_path(capture: Capture, settings: Settings) -> float:
    """Longest path from a laser spot by way of the box to a wall point at most, m."""
    corners = np.array(np.meshgrid(*settings.box)).reshape(3, -1).T
    legs = [
        max(float(np.linalg.norm(spots - corner, axis=1).max()) for corner in corners)
        for spots in (capture.lasers, capture.points)
    ]
    return sum(legs)
