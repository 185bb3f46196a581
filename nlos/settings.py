"""Settings that suit a capture, found from it and with their reasons.

`settings_for` looks at the capture as it was recorded and completes what is not given: the gate
that takes the wall's own light away, the virtual pulse, how many time bins are put together, the
voxels, the box, and the quickest method. The command line and Python use the same.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
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
# Of the path of a bin, the voxel of transforms. Half of it is the bin's depth, but a surface that
# lies between two such voxels would be dimmed and drawn with stripes.
VOXEL_BIN_FRACTION = 1 / 3
# A default voxel is not so small that more would fit along the longest side of the wall.
MAX_VOXELS_PER_SIDE = 256
# Time bins are put together while a wavelength keeps this number: 0.6 % of the carrier is lost.
BINS_PER_WAVELENGTH = 16
# The Laplacian of filtered back-projection is a quarter of a wavelength wide.
SIGMAS_PER_WAVELENGTH = 4
# A gate that was found opens over this fraction of its length: a sharp edge would be an image.
GATE_RAMP_FRACTION = 0.25
# Of the record, what fades out where light still comes at its end.
FADE_FRACTION = 0.1
# Waves by which the box is looked over are this number of times longer, if the wall is so wide and
# the voxels more than can be imaged in no time: longer waves see less of few photons.
SCOUT_WAVELENGTHS, QUICK_SCOUT_VOXELS = 2.0, 1 << 13
# Nearer than this fraction of the gate everything was blanked; the default box begins there.
GATE_DEPTH_FRACTION = 0.4
# A voxel nearer to a wall point than this is on the wall.
BRIGHTEST_ON_WALL_WAVELENGTHS = 0.5

# Class in `nlos` by the method's name, and the settings that it takes.
METHOD_CLASSES = {
    "rsd": ("PlanarRSD", ("wavelength", "cycles", "tolerance")),
    "hybrid": ("Hybrid", ("wavelength", "cycles", "tolerance")),
    "backprojection": ("Backprojection", ("wavelength", "cycles")),
    "filtered-backprojection": ("FilteredBackprojection", ("sigma",)),
    "lct": ("LightCone", ("signal_to_noise", "falloff")),
    "fk": ("FKMigration", ("falloff",)),
}
# They give the same picture; the later one takes more walls and lasers, and more time.
METHODS_BY_SPEED = ("rsd", "hybrid", "backprojection")
# An image by waves takes as long as to back-project this many pairs of spots; measured. One is made
# for every laser spot, or two for every wall point that sees many.
MIN_PAIRS_PER_IMAGE = 250
# They see no finer than the wall's lattice and the time bins, whatever the wavelength.
TRANSFORM_METHODS = ("lct", "fk")


def _setting(
    unit: str, meaning: str, default: Any = None, shown: str | None = None, **more: Any
) -> Any:
    """Declare a setting: its unit, what it means, and in words what it is where it is not given."""
    shown = str(default) if shown is None else shown
    metadata = {"unit": unit, "help": meaning, "shown": shown, **more}
    return dataclasses.field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Settings:
    """How a capture is imaged; None is found by `settings_for`.

    What is done to the capture first: `flip`, `gate`, `gate_ramp`, `fade`, `bins_together`; the
    virtual pulse: `wavelength`, `cycles`; the voxels: `voxel`, and their box, `x`, `y`, `near`,
    `far`, `everywhere`; the `method`, one of `METHOD_CLASSES`, and its own settings, of which None
    is left to it: `tolerance`, `sigma`, `falloff`, `signal_to_noise`. The metadata of each field
    hold its ``unit``, its meaning (``help``) and, in words, the default (``shown``). `gate_found`
    tells whether the gate was found from the capture, and `reasons`, by the names of settings, why
    those that were found are what they are.
    """

    wavelength: float | None = _setting(
        "m",
        "Carrier of the virtual pulse.",
        shown="the shortest that wall points and time bins carry, and that stands out of the noise",
    )
    cycles: float = _setting("wavelengths", "Length of the virtual pulse in wavelengths.", 3.0)
    voxel: float | None = _setting(
        "m",
        "Distance of neighbouring voxels.",
        shown="an eighth of the wavelength; lct, fk: a third of the path of a bin",
    )
    near: float | None = _setting(
        "m",
        "First depth.",
        shown="one voxel beyond the middle of the wall's relief, and of the gate",
    )
    far: float | None = _setting(
        "m", "Last depth.", shown="as far as the record reaches, at most two wall widths"
    )
    x: tuple[float, float] | None = _setting("m", "First and last x.", shown="the wall's")
    y: tuple[float, float] | None = _setting(
        "m", "First and last y; y points down.", shown="the wall's"
    )
    everywhere: bool = _setting(
        "",
        "Fill all of that box with voxels, not only the part that coarse ones find bright.",
        False,
        shown="no",
    )
    flip: str | None = _setting(
        "", "Mirror the picture along x or y.", shown="no", choices=("x", "y")
    )
    gate: float | None = _setting(
        "m",
        "Blank what arrives up to so much path after the wall's own light.",
        shown="until it has faded, where the record holds it",
    )
    gate_ramp: float | None = _setting(
        "m", "Signals rise over so much path after the gate.", shown="a quarter of a gate found"
    )
    fade: float | None = _setting(
        "m",
        "Signals fade out over so much path before the record ends.",
        shown="a tenth of the record, where light still comes then",
    )
    bins_together: int | None = _setting(
        "bins", "Time bins added up to one before imaging.", shown="while a wavelength keeps 16"
    )
    tolerance: float | None = _setting(
        "1", "Error allowed for the sake of speed: rsd, hybrid.", shown="0.01"
    )
    sigma: float | None = _setting(
        "m", "Width of the Laplacian: filtered-backprojection.", shown="a quarter of the wavelength"
    )
    falloff: float | None = _setting(
        "1",
        "How light fades with distance: lct, fk; 4 for matte things, 2 for retroreflecting ones.",
        shown="4",
    )
    signal_to_noise: float | None = _setting("1", "Of the Wiener filter: lct.", shown="0.8")
    method: str | None = _setting("", "How the hidden scene is imaged.", shown="the quickest")
    gate_found: bool = False
    reasons: Mapping[str, str] = dataclasses.field(default_factory=dict)

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

        Of laser spots and wall points the fewer come as laser spots: a wave is imaged for each, and
        seen from a lone detector all of its surroundings would be bright.

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
            if plan.images == 1 or plan.images * MIN_PAIRS_PER_IMAGE <= len(capture.points):
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
        found = found.with_method(scout.plan_quickest(prepared, grid)[0])
    return found


def complete_settings(capture: Capture, **given: Any) -> Settings:
    """Find settings that suit a capture, but for the method; see `settings_for`."""
    # As recorded: midpoints would hide that lasers stand off the wall.
    require_plausible(choose_roles(capture))
    capture = choose_roles(join_near_lasers(capture))
    found = Settings(**given)
    if found.gate is None:
        found = _complete(found, _find_gate(capture, found))
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
        found = _add(found, "wavelength", *choose_wavelength(gated, found.cycles))
    else:
        require_usable_wavelength(capture, found.wavelength, found.cycles)
    for rule in (_find_bins, _find_voxel, _find_sigma):
        found = _complete(found, rule(capture, found))
    return _complete_box(gated, found)


def find_scout(capture: Capture, settings: Settings) -> tuple[Settings, Grid] | None:
    """Return settings and coarse voxels with which all of the box is looked over quickly.

    Waves twice as long have an eighth of the work, on voxels of their half; small boxes are looked
    over with the waves themselves. `settings`: complete but for the method. Returns none where the
    voxels asked for are no finer, or all of the box is wanted.
    """
    wavelength = settings.wavelength or 0.0
    if settings.everywhere or (settings.voxel or 0.0) >= wavelength / 2:
        return None
    quick = settings.grid(wavelength / 2)
    if math.prod(quick.shape) <= QUICK_SCOUT_VOXELS:
        return settings, quick
    record = float(np.ptp(capture.axis.paths))
    usable = min(find_longest_wavelength(capture), record / settings.cycles)
    longer = max(wavelength, min(SCOUT_WAVELENGTHS * wavelength, usable))
    return replace(settings, wavelength=longer), settings.grid(longer / 2)


def find_bright_box(settings: Settings, scouted: Volume) -> Settings:
    """Return the settings with the box that holds everything bright in a coarse volume, which was
    imaged as `find_scout` says.
    """
    x, y, (near, far) = _find_ends(Grid.around(scouted, _voxel_size(settings)))
    return replace(settings, x=x, y=y, near=near, far=far, everywhere=True)


def is_brightest_on_wall(volume: Volume, capture: Capture, wavelength: float) -> bool:
    """Whether the brightest voxel lies on the wall, so that the picture shows the wall's own light.

    `wavelength`: nearer to a wall point than half of it, m, is on the wall.
    """
    away = np.linalg.norm(capture.points - np.array(volume.find_brightest()), axis=1)
    return bool(away.min() < BRIGHTEST_ON_WALL_WAVELENGTHS * wavelength)


def _voxel_size(settings: Settings) -> float:
    """Distance of voxels, m; NaN, which every grid refuses, where it is not known yet."""
    return math.nan if settings.voxel is None else settings.voxel


def _find_ends(grid: Grid) -> tuple[Limits, Limits, Limits]:
    x, y, z = ((float(axis[0]), float(axis[-1])) for axis in (grid.x, grid.y, grid.z))
    return x, y, z


Found = Iterator[tuple[str, Any, str]]
"""Settings that a rule finds: name, value, and the reason, which may be empty."""


def _complete(settings: Settings, found: Found) -> Settings:
    """Take what a rule finds for what is not given."""
    for name, value, reason in found:
        if (given := getattr(settings, name)) is None or given is False:
            settings = _add(settings, name, value, reason)
    return settings


def _add(settings: Settings, name: str, value: Any, reason: str) -> Settings:
    """Return the settings with one more that was found, and why."""
    reasons = {**settings.reasons, name: reason} if reason else settings.reasons
    return replace(settings, **{name: value}, reasons=reasons)


def _find_gate(capture: Capture, settings: Settings) -> Found:
    bounce = find_first_bounce(capture)
    if bounce is None:
        yield "gate", None, "no light of the wall's own is in the record"
        return
    reason = f"the wall's own light is in the record, {bounce.ratio:.3g} times what follows; "
    yield "gate", bounce.end, f"{reason}{bounce.end:.3g} m later it has faded"
    yield "gate_ramp", GATE_RAMP_FRACTION * bounce.end, ""
    yield "gate_found", True, ""


def _by_lattice(capture: Capture, settings: Settings) -> bool:
    """Whether the wall's lattice, not a virtual pulse, tells what is resolved."""
    return settings.method in TRANSFORM_METHODS and capture.spacing < math.inf


def _find_bins(capture: Capture, settings: Settings) -> Found:
    if _by_lattice(capture, settings):
        finest, reason = capture.spacing, "path per bin as neighbouring wall points are apart"
    else:
        finest = (settings.wavelength or math.nan) / BINS_PER_WAVELENGTH
        reason = f"{BINS_PER_WAVELENGTH} bins per wavelength, or as recorded"
    bins = min(int(finest / capture.axis.spacing + 1e-9), capture.axis.bins // 2)
    yield "bins_together", max(1, bins), reason


def _find_voxel(capture: Capture, settings: Settings) -> Found:
    if _by_lattice(capture, settings):
        path = (settings.bins_together or 1) * capture.axis.spacing
        wanted, reason = path * VOXEL_BIN_FRACTION, "a third of the path of a bin"
    else:
        wanted = (settings.wavelength or math.nan) / VOXELS_PER_WAVELENGTH
        reason = "an eighth of the wavelength"
    extent = float(np.ptp(capture.points, axis=0).max())
    yield "voxel", max(wanted, extent / MAX_VOXELS_PER_SIDE), reason


def _find_sigma(capture: Capture, settings: Settings) -> Found:
    yield "sigma", (settings.wavelength or math.nan) / SIGMAS_PER_WAVELENGTH, ""


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
    x, y, (first, last) = _find_ends(Grid.in_front_of(capture, voxel, near, settings.far))
    ends = (("x", x, ""), ("y", y, ""), ("near", first, ""), ("far", last, ""))
    completed = _complete(settings, iter(ends))
    # The longest path from a laser spot by way of the box to a wall point is one by way of corners.
    corners = np.array(np.meshgrid(*completed.box)).reshape(3, -1).T
    longest = sum(
        max(float(np.linalg.norm(spots - corner, axis=1).max()) for corner in corners)
        for spots in (capture.lasers, capture.points)
    )
    if capture.start > longest:
        raise InputError(
            f"the record begins at a path of {capture.start:.4g} m, but none by way of the box up to "
            f"z = {completed.far:.4g} m is longer than {longest:.4g} m: take the ways to and from the "
            "devices off, or choose a farther box"
        )
    return completed
