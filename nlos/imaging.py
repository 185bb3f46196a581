"""A capture imaged as its settings ask: what they leave open is found, coarse voxels tell where the
scene is bright, and that part is imaged, with evidence that there is something to see.

`settings_for` looks at the capture as it was recorded and completes what is not given: the gate
that takes the wall's own light away, the virtual pulse, how many time bins are put together, the
voxels, the box, and the quickest method. The command line and Python use the same.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any, Generic

import numpy as np

from nlos import analysis
from nlos.band import VirtualPulse
from nlos.capture import Capture, measure_extent
from nlos.illumination import AliasingWarning, choose_roles
from nlos.method import Plan
from nlos.plane import WallLattice
from nlos.preparation import fade_record_end, join_near_lasers
from nlos.resolution import compute_diffraction_limit
from nlos.settings import METHODS_BY_SPEED, Limits, Settings, Wanted, list_taken
from nlos.volume import Grid, Volume
from tofclip.arrays import ComputeDevice, IndexArray, namespace, to_numpy
from tofclip.errors import InputError

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
# They see no finer than the wall's lattice and the time bins, whatever the wavelength.
TRANSFORM_METHODS = ("lct", "fk")
# Where pictures choose the wavelength: the brightest of one is clear if it is so many times a
# shuffled copy's (letters and a mannequin of a streak camera, a bunny), from so few wall points;
# and the ratio of wavelengths tried.
CLEAR_EVIDENCE, MAX_JUDGED_POINTS, WAVELENGTH_RATIO = 30.0, 4096, math.sqrt(2)
# Where none is so clear: of the most evidence.
CLEAR_FRACTION = 2 / 3
# A voxel nearer to a wall point than this is on the wall.
BRIGHTEST_ON_WALL_WAVELENGTHS = 0.5


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
    return find_settings(capture, Settings(**given))


def find_settings(capture: Capture, wanted: Wanted) -> Wanted:
    """Find settings that suit a capture and are as wanted where that is said; see `settings_for`."""
    found = complete_settings(capture, wanted)
    if found.method is None:
        # Which walls a method takes does not depend on the voxels: coarse ones are planned quickly.
        prepared = found.prepare(capture)
        scout, grid = find_scout(prepared, found) or (found, found.grid())
        found = _with_quickest(found, scout.plan_quickest(prepared, grid)[0])
    return found


def complete_settings(capture: Capture, wanted: Wanted) -> Wanted:
    """Find settings that suit a capture, but for the method; see `settings_for`."""
    # As recorded: midpoints would hide that lasers stand off the wall.
    analysis.require_plausible(choose_roles(capture))
    capture = choose_roles(join_near_lasers(capture))
    found = wanted if wanted.gate is not None else _find_gate(capture, wanted)
    gated = replace(found, bins_together=1).prepare(capture)
    if found.fade is None and analysis.find_lit_end(gated):
        fade = FADE_FRACTION * float(np.ptp(capture.axis.paths))
        found = found.with_found("fade", fade, "light still comes when the record ends")
        gated = fade_record_end(gated, fade)
    if not float(abs(gated.signal).max()) > 0:
        raise InputError(
            f"a gate of {found.gate or 0.0:.4g} m blanks the whole record; blank less (`gate`)"
        )
    analysis.require_usable_cycles(capture, found.cycles)
    if found.wavelength is None:
        chosen = analysis.choose_wavelength(gated, found.cycles)
        found = found.with_found("wavelength", *(chosen or _choose_by_pictures(gated, found)))
    else:
        analysis.require_usable_wavelength(capture, found.wavelength, found.cycles)
    return _complete_voxels(gated, found)


def find_scout(capture: Capture, settings: Settings) -> tuple[Settings, Grid] | None:
    """Return settings, complete but for the method, and coarse voxels that look all of the box over
    quickly: of waves twice as long, an eighth of the work, but in small boxes. None where voxels
    are to be no finer, or all of the box is wanted.
    """
    wavelength = settings.wavelength or 0.0
    if settings.everywhere or (settings.voxel or 0.0) >= wavelength / 2:
        return None
    quick = settings.grid(wavelength / 2)
    if math.prod(quick.shape) <= QUICK_SCOUT_VOXELS:
        return settings, quick
    record = float(np.ptp(capture.axis.paths))
    usable = min(analysis.find_longest_wavelength(capture), record / settings.cycles)
    longer = max(wavelength, min(SCOUT_WAVELENGTHS * wavelength, usable))
    return replace(settings, wavelength=longer), settings.grid(longer / 2)


def find_bright_box(settings: Wanted, scouted: Volume) -> Wanted:
    """Return the settings with the bright box of a volume imaged as `find_scout` says."""
    x, y, (near, far) = _find_ends(Grid.around(scouted, settings.voxel_size))
    return replace(settings, x=x, y=y, near=near, far=far, everywhere=True)


def is_brightest_on_wall(volume: Volume, capture: Capture, wavelength: float) -> bool:
    """Whether the brightest voxel is within half a `wavelength`, m, of the wall: its own light."""
    away = np.linalg.norm(capture.points - np.array(volume.find_brightest()), axis=1)
    return bool(away.min() < BRIGHTEST_ON_WALL_WAVELENGTHS * wavelength)


def _find_ends(grid: Grid) -> tuple[Limits, Limits, Limits]:
    x, y, z = ((float(axis[0]), float(axis[-1])) for axis in (grid.x, grid.y, grid.z))
    return x, y, z


def _with_quickest(settings: Wanted, method: str) -> Wanted:
    return settings.with_found(
        "method", method, "the quickest that takes this wall, laser and grid"
    )


def _find_gate(capture: Capture, settings: Wanted) -> Wanted:
    bounce = analysis.find_first_bounce(capture)
    if bounce is None:
        return settings.with_found("gate", None, "no light of the wall's own is in the record")
    reason = f"the wall's own light is in the record, {bounce.ratio:.3g} times what follows; "
    found = settings.with_found(
        "gate", bounce.end, f"{reason}{bounce.end:.3g} m later it has faded"
    )
    found = found.with_found("gate_ramp", GATE_RAMP_FRACTION * bounce.end)
    return found.with_found("gate_found", True)


def _complete_voxels(gated: Capture, found: Wanted) -> Wanted:
    """Find the bins, the voxels and the box for the settings' wavelength."""
    wavelength, spacing = found.wavelength or math.nan, gated.axis.spacing
    # whether the wall's lattice, not a virtual pulse, tells what is resolved
    by_lattice = found.method in TRANSFORM_METHODS and gated.spacing < math.inf
    finest = wavelength / BINS_PER_WAVELENGTH
    reason = f"{BINS_PER_WAVELENGTH} bins per wavelength, or as recorded"
    if by_lattice:
        finest, reason = gated.spacing, "path per bin as neighbouring wall points are apart"
    bins = max(1, min(int(finest / spacing + 1e-9), gated.axis.bins // 2))
    found = found.with_found("bins_together", bins, reason)
    voxel, reason = wavelength / VOXELS_PER_WAVELENGTH, "an eighth of the wavelength"
    if by_lattice:
        voxel = (found.bins_together or 1) * spacing * VOXEL_BIN_FRACTION
        reason = "a third of the path of a bin"
    found = found.with_found(
        "voxel", max(voxel, measure_extent(gated) / MAX_VOXELS_PER_SIDE), reason
    )
    return _complete_box(gated, found.with_found("sigma", wavelength / SIGMAS_PER_WAVELENGTH))


def _choose_by_pictures(gated: Capture, settings: Settings) -> tuple[float, str]:
    """Choose the wavelength where the spectrum does not tell noise from signal: the shortest whose
    coarse picture is clear, or nearly as clear as any, by the logarithms of the last two tried.

    Waves are tried from long ones on, whose pictures cost next to nothing. The last ones would cost
    most: what large pictures show, whose speckles scatter little, goes on as far as to the next.
    """
    capture = _thin_out(gated)
    shortest = analysis.find_finest_wavelength(capture, settings.cycles)
    longest = max(shortest, analysis.find_longest_wavelength(gated) / 2)
    waves, brightest, decoys = [], [0.0], []
    for step in range(math.ceil(math.log(longest / shortest, WAVELENGTH_RATIO)) + 1):
        waves.append(max(longest / WAVELENGTH_RATIO**step, shortest))
        own, shuffled = _judge_wavelength(capture, settings, waves[-1])
        brightest.append(own)
        # Decoys of all waves are about as bright: together they tell how bright.
        decoys.append(float(np.mean(shuffled)))
        evidences = np.array(brightest) / max(float(np.mean(decoys)), np.finfo(np.float64).tiny)
        least = min(CLEAR_EVIDENCE, CLEAR_FRACTION * float(evidences.max()))
        before, last = evidences[-2:]
        ahead = last * min(last / before, 1.0) if step and len(shuffled) == 1 else last
        if ahead < least:
            share = math.log(least / last) / math.log(before / last)
            waves.append(max(waves[-1] * (waves[-2] / waves[-1]) ** share, shortest))
            break
    return analysis.round_wavelength_up(waves[-1]), "the shortest whose coarse picture is clear"


def _judge_wavelength(
    capture: Capture, settings: Settings, wavelength: float
) -> tuple[float, list[float]]:
    """Brightness of a capture's coarse picture by one wavelength, m, and of its decoys."""
    found = _complete_voxels(capture, replace(settings, wavelength=wavelength))
    prepared = replace(found, gate=None, fade=None, flip=None).prepare(capture)
    grid = found.grid(wavelength / 2)
    if grid.size > DECOY_VOXELS:  # every other depth tells as much: a pulse is three of them long
        grid = Grid(grid.x, grid.y, grid.z[::2])
    plan = found.plan_quickest(prepared, grid)[1]
    with warnings.catch_warnings():
        # Of a wave that is only tried.
        warnings.simplefilter("ignore", AliasingWarning)
        return measure_brightness(prepared, plan, plan.image(prepared))


def _thin_out(capture: Capture) -> Capture:
    """Return a capture of about `MAX_JUDGED_POINTS`, evenly picked, in whatever order they come:
    every nth row and column of a lattice, else one of each cell of the wall.
    """
    points, places = capture.points, np.flatnonzero(capture.valid)
    if len(points) <= MAX_JUDGED_POINTS:
        return capture
    if (lattice := WallLattice.find(points)) is not None:
        step = math.ceil(math.sqrt(len(points) / MAX_JUDGED_POINTS))
        some = np.flatnonzero((lattice.row % step == 0) & (lattice.column % step == 0))
    else:
        # Of a round size, so that a wall without some points has the same cells.
        side = float(np.ptp(points[:, :2], axis=0).max()) / math.sqrt(MAX_JUDGED_POINTS)
        cells = np.floor(points[:, :2] / 2 ** (math.ceil(4 * math.log2(side)) / 4))
        ordered = _sort_points(capture)
        some = np.sort(ordered[np.unique(cells[ordered], axis=0, return_index=True)[1]])
    laser = capture.laser if capture.laser.ndim == 1 else capture.lasers[some]
    xp = namespace(capture.signal)
    flat = xp.reshape(capture.signal, (capture.axis.bins, -1))
    signal = xp.take(flat, capture.device.put(places[some]), axis=1)
    return replace(capture, signal=signal, wall=points[some], laser=laser)


def _sort_points(capture: Capture) -> IndexArray:
    """Return the order of the wall's points by where they and their lasers are."""
    return np.lexsort((capture.points + capture.lasers).T)


def _complete_box(capture: Capture, settings: Wanted) -> Wanted:
    """Fill in what is not given of the box: the space in front of the wall that the record covers."""
    voxel = settings.voxel_size
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
    completed = settings
    for name, value in (("x", x), ("y", y), ("near", first), ("far", last)):
        completed = completed.with_found(name, value)
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


# A picture is judged by what this fraction of its voxels exceeds, against that of as many decoys as
# fill these voxels: the few speckles of small pictures tell little.
BRIGHT_QUANTILE, MAX_DECOYS, DECOY_VOXELS = 0.999, 8, 1 << 15
# With less evidence than this, a picture may be of noise or a glow: backgrounds and shuffled records
# reach 1.24, other laboratories' scenes have 1.5 to 47.
MIN_EVIDENCE = 1.35


def measure_brightness(capture: Capture, plan: Plan, picture: Volume) -> tuple[float, list[float]]:
    """Brightest of a coarse picture, and of decoys, the same capture with its signals shuffled among
    the wall points. Each depth counts relative to the decoys': noise and the wall's glow fade with it.
    """
    count = int(np.clip(DECOY_VOXELS // math.prod(picture.values.shape), 1, MAX_DECOYS))
    xp, places = namespace(capture.signal), np.flatnonzero(capture.valid)
    # Whatever order the points come in, the decoys are the same.
    ordered = places[_sort_points(capture)]
    flat, pictures = xp.reshape(capture.signal, (capture.axis.bins, -1)), [picture]
    for seed in range(1, count + 1):
        order = np.arange(capture.valid.size)
        order[ordered] = np.random.default_rng(seed).permutation(ordered)
        signal = xp.take(flat, capture.device.put(order), axis=1)
        shuffled = replace(capture, signal=xp.reshape(signal, capture.signal.shape))
        pictures.append(plan.image(shuffled))
    energies = [np.square(to_numpy(one.values), dtype=np.float64) for one in pictures]
    level = np.mean(energies[1:], axis=(0, 2, 3))[:, np.newaxis, np.newaxis]
    level = np.maximum(level, np.finfo(np.float32).tiny)
    own, *decoys = (float(np.quantile(energy / level, BRIGHT_QUANTILE)) for energy in energies)
    return own, decoys


Draw = Callable[[str, Plan, Capture], Volume]
"""Images a capture by a plan, under a title that a progress bar may show."""


@dataclass(frozen=True, eq=False)
class PreparedImaging(Generic[Wanted]):
    """A capture ready to be imaged, with every setting known."""

    capture: Capture  # gated, its bins put together
    grid: Grid
    settings: Wanted
    recorded: Capture  # as it came
    scouted: tuple[Plan, Volume] | None  # coarse voxels that were looked over

    def describe(self, volume: Volume) -> Volume:
        """Return the volume with settings and reasons, `evidence`, and of a virtual pulse
        `resolution_m`, widths of a point's image where it is brightest, under ``imaging``.
        """
        described = {**volume.provenance.get("imaging", {}), "settings": self.settings.to_dict()}
        described["evidence"] = self.measure_evidence()
        if "wavelength" in list_taken(self.settings.method or METHODS_BY_SPEED[0]):
            pulse = VirtualPulse(self.settings.wavelength or 0.0, self.settings.cycles)
            widths = compute_diffraction_limit(self.capture, volume.find_brightest(), pulse)
            described["resolution_m"] = asdict(widths)
        return replace(volume, provenance={**volume.provenance, "imaging": described})

    def measure_evidence(self) -> float:
        """How much brighter the brightest of the coarse picture is than that of decoys; about 1 where
        there is nothing.
        """
        scouted = self.scouted
        if scouted is None:
            coarse = find_scout(self.capture, replace(self.settings, everywhere=False))
            settings, grid = coarse or (self.settings, self.grid)
            plan = settings.plan_quickest(self.capture, grid)[1]
            scouted = plan, plan.image(self.capture)
        own, decoys = measure_brightness(self.capture, *scouted)
        return own / max(float(np.mean(decoys)), np.finfo(np.float64).tiny)


def prepare_imaging(
    recorded: Capture,
    wanted: Wanted,
    device: ComputeDevice | None = None,
    draw: Draw = lambda _, plan, capture: plan.image(capture),
) -> PreparedImaging[Wanted]:
    """Find every setting that is not given, and the voxels of the box or of its bright part."""
    found = complete_settings(recorded, wanted)
    capture = found.prepare(recorded)
    if device is not None:
        capture = capture.on(device)
    scout, scouted = find_scout(capture, found), None
    if scout is not None or found.method is None:
        coarse, grid = scout or (found, found.grid())
        quickest, plan = coarse.plan_quickest(capture, grid)
        found = _with_quickest(found, quickest)
    if scout is not None:
        scouted = plan, draw("looking over", plan, capture)
        found = find_bright_box(found, scouted[1])
    found = replace(found, everywhere=True)
    return PreparedImaging(capture, found.grid(), found, recorded, scouted)


def reconstruct(capture: Capture, **given: Any) -> Volume:
    """Image the hidden scene as ``tofclip nlos reconstruct`` does by default.

    Parameters
    ----------
    capture : Capture
        As it was recorded.
    **given
        Fields of `Settings` that are known, lengths in m; the others are found.

    Returns
    -------
    Volume
        The part of the space before the wall that is bright. ``provenance["imaging"]`` names the ``settings``
        with the reasons for what was found; ``evidence``, how much brighter the picture's brightest
        is than that of shuffled copies of the capture, about 1 where there is nothing; and
        ``resolution_m``, how wide a point's image is where the volume is brightest.

    Raises
    ------
    InputError
        No picture can come of the capture, or not with what is given.

    Examples
    --------
    >>> import numpy as np, nlos
    >>> from nlos.simulate import PointScene
    >>> x, y = np.meshgrid(np.linspace(-0.5, 0.5, 16), np.linspace(-0.5, 0.5, 16))
    >>> wall, scene = np.stack([x, y, 0 * x], axis=-1), PointScene([[0.1, -0.2, 0.8]])
    >>> axis = nlos.capture.TimeAxis(256, 40e-12)
    >>> volume = nlos.reconstruct(scene.simulate_capture(wall, np.zeros(3), axis, 200e-12))
    >>> bool(abs(volume.find_brightest()[2] - 0.8) < 0.1)
    True
    """
    prepared = prepare_imaging(capture, Settings(**given))
    method = prepared.settings.make_method()
    return prepared.describe(method.reconstruct(prepared.capture, prepared.grid))
