"""Settings of imaging around corners as the command line has them, and captures imaged as they ask."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar, cast

from apps.settings import setting_field
from tofclip.errors import InputError
from tofclip.units import MILLIMETRE

if TYPE_CHECKING:
    from nlos import Grid, Hybrid, Settings
    from nlos.method import Method, PhasorMethod


import sys
from typing import TYPE_CHECKING, Generic

from apps.progress import show_progress
from nlos import Refinement
from nlos.band import Band, VirtualPulse
from nlos.illumination import describe_aliasing
from nlos.preparation import MidpointImaging
from nlos.refinement.l1 import build_total_variation
from nlos.refinement.photons import PhotonRefinement
from nlos.settings import METHOD_CLASSES, Settings, complete_settings, find_bright_box, find_scout
from tofclip.arrays import ComputeDevice, parse_device
from tofclip.solvers import Sparse

if TYPE_CHECKING:
    from nlos import Capture, Grid, Plan, Settings, Volume
    from tofclip.arrays import ComputeDevice


METHODS = ("rsd", "hybrid", "backprojection", "filtered-backprojection", "lct", "fk")
PULSE_SETTINGS = ("wavelength_mm", "cycles")
PORTABLE_METHODS = ("rsd", "hybrid", "backprojection")
"""They compute wherever the signal is; the others have compiled loops only."""

LENGTHS_IN_MM = ("wavelength", "voxel", "sigma")


@dataclass(frozen=True)
class ImagingSettings:
    """Where and how a hidden scene is imaged; None is found from the capture's geometry."""

    wavelength_mm: float | None = setting_field(
        "MM",
        "Carrier of the virtual pulse.",
        shown="the shortest that wall points and time bins carry, and that stands out of the noise",
    )
    cycles: float = setting_field("N", "Length of the virtual pulse in wavelengths.", 3.0)
    voxel_mm: float | None = setting_field(
        "MM",
        "Distance of neighbouring voxels.",
        shown="an eighth of the wavelength; lct, fk: a third of the path of a bin",
    )
    near_m: float | None = setting_field(
        "M",
        "First depth.",
        shown="one voxel beyond the middle of the wall's relief, and of the gate",
    )
    far_m: float | None = setting_field(
        "M", "Last depth.", shown="as far as the record reaches, at most two wall widths"
    )
    x_m: tuple[float, float] | None = setting_field("M M", "First and last x.", shown="the wall's")
    y_m: tuple[float, float] | None = setting_field(
        "M M", "First and last y; y points down.", shown="the wall's"
    )
    everywhere: bool = setting_field(
        None,
        "Fill all of that box with voxels, not only the part that coarse ones find bright.",
        False,
        shown="no",
    )
    flip: str | None = setting_field(
        "AXIS", "Mirror the picture along x or y.", shown="no", choices=("x", "y")
    )
    gate_m: float | None = setting_field(
        "M",
        "Blank what arrives up to so much path after the wall's own light.",
        shown="until it has faded, where the record holds it",
    )
    gate_ramp_m: float | None = setting_field(
        "M", "Signals rise over so much path after the gate.", shown="a quarter of a gate found"
    )
    fade_m: float | None = setting_field(
        "M",
        "Signals fade out over so much path before the record ends.",
        shown="a tenth of the record, where light still comes then",
    )
    bins_together: int | None = setting_field(
        "N", "Time bins added up to one before imaging.", shown="while a wavelength keeps 16"
    )
    tolerance: float | None = setting_field(
        "SHARE", "Error allowed for the sake of speed: rsd, hybrid.", shown="0.01"
    )
    sigma_mm: float | None = setting_field(
        "MM",
        "Width of the Laplacian: filtered-backprojection.",
        shown="a quarter of the wavelength",
    )
    falloff: float | None = setting_field(
        "POWER",
        "How light fades with distance: lct, fk; 4 for matte things, 2 for retroreflecting ones.",
        shown="4",
    )
    signal_to_noise: float | None = setting_field(
        "RATIO", "Of the Wiener filter: lct.", shown="0.8"
    )


Imaging = TypeVar("Imaging", bound=ImagingSettings)


def parse_method_names(text: str) -> tuple[str, ...]:
    """Split a list of methods at its commas, refusing unknown names and repetitions."""
    names = tuple(name.strip() for name in text.split(","))
    for name in names:
        if name not in METHODS:
            raise InputError(f"unknown method '{name}'; choose from {', '.join(METHODS)}")
    if len(set(names)) < len(names):
        raise InputError(f"a method is named twice in '{text}'")
    return names


def require_used_settings(settings: ImagingSettings, methods: Sequence[str]) -> None:
    """Refuse a setting that none of the methods takes, since it would change nothing."""
    by_method = {name: _list_settings(name) for name in METHODS}
    taken = {name for method in methods for name in by_method[method]}
    for name in sorted(
        {name for names in by_method.values() for name in names} - taken - set(PULSE_SETTINGS)
    ):
        if getattr(settings, name) is not None:
            by = ", ".join(method for method, names in by_method.items() if name in names)
            raise InputError(
                f"{name} is a setting of {by} and changes nothing for {', '.join(methods)}; leave it out"
            )


def require_valid_settings(settings: ImagingSettings, methods: Sequence[str]) -> None:
    """Refuse settings that no capture could make sense of, before any is read."""
    require_used_settings(settings, methods)
    if settings.flip not in (None, "x", "y"):
        raise InputError(f"flip is x or y, got '{settings.flip}'")
    given = to_library(settings)
    if given.wavelength is None:
        given = replace(given, wavelength=1.0)
    for name in methods:
        given.make_method(name)


def to_library(settings: ImagingSettings) -> Settings:
    """Return the settings in the library's units; None stays to be found."""
    lengths: dict[str, Any] = {
        name: None if (value := getattr(settings, f"{name}_mm")) is None else value * MILLIMETRE
        for name in LENGTHS_IN_MM
    }
    names = ("cycles", "bins_together", "everywhere", "tolerance", "falloff", "signal_to_noise")
    others: dict[str, Any] = {name: getattr(settings, name) for name in names}
    return Settings(
        flip=settings.flip,
        gate=settings.gate_m,
        gate_ramp=settings.gate_ramp_m,
        fade=settings.fade_m,
        x=settings.x_m,
        y=settings.y_m,
        near=settings.near_m,
        far=settings.far_m,
        method=getattr(settings, "method", None),
        **lengths,
        **others,
    )


def from_library(settings: Imaging, found: Settings, methods: Sequence[str]) -> Imaging:
    """Return the command line's settings with what was found, and what the methods' classes take
    where nothing is given; what none of the methods takes is left out.

    `settings`: as given on the command line; `found`: what the library chose for the rest, in m.
    Returns in mm where names end so.
    """
    kept: dict[str, Any] = {
        name: None
        for method in METHODS
        for name in _list_settings(method)
        if name not in PULSE_SETTINGS
    }
    for method in methods:
        made = found.make_method(method)
        for name in _list_settings(method):
            bare = name.removesuffix("_mm")
            value = getattr(found, bare) if bare in LENGTHS_IN_MM else getattr(made, name)
            kept[name] = value / MILLIMETRE if bare in LENGTHS_IN_MM else value
    x, y, (near, far) = found.box
    kept |= {
        "gate_m": found.gate,
        "gate_ramp_m": found.gate_ramp,
        "fade_m": found.fade,
        "bins_together": found.bins_together,
        "wavelength_mm": _to_mm(found.wavelength),
        "voxel_mm": _to_mm(found.voxel),
        "x_m": x,
        "y_m": y,
        "near_m": near,
        "far_m": far,
        "everywhere": found.everywhere,
    }
    # What was given stays to the last bit.
    for name in ("wavelength_mm", "voxel_mm", "sigma_mm"):
        if getattr(settings, name) is not None and kept[name] is not None:
            kept[name] = getattr(settings, name)
    return replace(settings, **kept)


def choose_device(device: str, settings: ImagingSettings) -> ComputeDevice:
    """Return the device that a name asks for; ``auto`` stays with the compiled loops where a method
    has nothing else.

    `device`: see `tofclip.arrays.parse_device`.
    """
    named, refine = (getattr(settings, name, None) for name in ("method", "refine"))
    portable = named in (None, *PORTABLE_METHODS) and refine is None
    return ComputeDevice() if device == "auto" and not portable else parse_device(device)


def _list_settings(method: str) -> tuple[str, ...]:
    """Names of the command line's settings that a method takes."""
    return tuple(
        f"{name}_mm" if name in LENGTHS_IN_MM else name for name in METHOD_CLASSES[method][1]
    )


def _to_mm(length: float | None) -> float | None:
    """Return a length in mm, without the rounding errors of the change of unit."""
    return None if length is None else float(f"{length / MILLIMETRE:.12g}")


PRIORS = ("l1", "tv")
PHOTONS = "photons"
REFINEMENTS = (*PRIORS, PHOTONS)
REFINED_METHOD = "hybrid"
"""The method that is iterated by l1 and tv."""

DEFAULT_ITERATIONS, DEFAULT_PRIOR_WEIGHT = 60, 2e-2
PHOTON_ITERATIONS, PHOTON_PRIOR_WEIGHT = 12, 1.0


@dataclass(frozen=True)
class RefinementSettings(ImagingSettings):
    """Whether and how an image is refined; None is left to `nlos.Refinement`."""

    refine: str | None = setting_field(
        "NAME",
        "Iterate the image: photons by the statistics of counts; l1 for few bright things, tv for even surfaces.",
        shown="no",
        choices=REFINEMENTS,
    )
    iterations: int | None = setting_field(
        "N",
        "With --refine: steps at most; of l1 and tv each costs some four images.",
        shown=f"{DEFAULT_ITERATIONS}; photons: {PHOTON_ITERATIONS}",
    )
    prior_weight: float | None = setting_field(
        "SHARE",
        "With --refine: weight of the prior, of that which leaves nothing; photons: of noise's standard deviation.",
        shown=f"{DEFAULT_PRIOR_WEIGHT}; photons: {PHOTON_PRIOR_WEIGHT:g}",
    )


Refining = TypeVar("Refining", bound=RefinementSettings)


_NAMED_REFINEMENTS = f"{', '.join(REFINEMENTS[:-1])} or {REFINEMENTS[-1]}"


def require_valid_refinement(settings: RefinementSettings, method: str | None) -> None:
    """Refuse a refinement that makes no sense, and settings of one that is not asked for."""
    if settings.refine is None:
        for name in ("iterations", "prior_weight"):
            if getattr(settings, name) is not None:
                raise InputError(
                    f"{name} is a setting of --refine; give --refine {_NAMED_REFINEMENTS} as well"
                )
        return
    if settings.refine not in REFINEMENTS:
        raise InputError(f"unknown prior '{settings.refine}'; refine by {_NAMED_REFINEMENTS}")
    by_photons = settings.refine == PHOTONS
    if by_photons and method not in (None, *PORTABLE_METHODS):
        raise InputError(
            f"--refine photons begins with an image by {', '.join(PORTABLE_METHODS)}, not by "
            f"{method}; leave --method out"
        )
    if not by_photons and method not in (None, REFINED_METHOD):
        raise InputError(
            f"--refine iterates the {REFINED_METHOD} method, not {method}; leave --method out"
        )
    if settings.iterations is not None and settings.iterations < 1:
        raise InputError(f"iterations must be 1 or more, got {settings.iterations}")
    weight, most = settings.prior_weight, 10.0 if by_photons else 1.0
    if weight is not None and not 0 <= weight < most:
        raise InputError(f"prior_weight is a share from 0 to less than {most:g}, got {weight}")


def build_refinement(settings: Refining, imaging: Settings, grid: Grid) -> tuple[Refining, Method]:
    """Build the refinement that settings ask for.

    `imaging`: of the method that is iterated. Returns the settings come back with what was not
    given.
    """
    if settings.refine == PHOTONS:
        found = replace(
            settings,
            prior_weight=PHOTON_PRIOR_WEIGHT
            if settings.prior_weight is None
            else settings.prior_weight,
            iterations=settings.iterations or PHOTON_ITERATIONS,
        )
        linear = cast("PhasorMethod", imaging.make_method())
        return found, PhotonRefinement(
            MidpointImaging(linear),
            found.iterations or PHOTON_ITERATIONS,
            found.prior_weight or 0.0,
            blank=imaging.gate or 0.0,
            ramp=imaging.gate_ramp or 0.0,
        )
    weight = DEFAULT_PRIOR_WEIGHT if settings.prior_weight is None else settings.prior_weight
    iterations = settings.iterations or DEFAULT_ITERATIONS
    prior = (
        build_total_variation(grid, weight, iterations)
        if settings.refine == "tv"
        else Sparse(weight, iterations)
    )
    hybrid = cast("Hybrid", imaging.make_method(REFINED_METHOD))
    return replace(settings, prior_weight=weight, iterations=iterations), Refinement(hybrid, prior)


@dataclass(frozen=True, eq=False)
class PreparedImaging(Generic[Imaging]):
    """A capture ready to be imaged, with every setting known."""

    capture: Capture  # gated, its bins put together
    grid: Grid
    settings: Settings  # as the library has them
    shown: Imaging  # as the command line has them; given back, they lead here again
    recorded: Capture  # as it came


def prepare_imaging(
    recorded: Capture,
    wanted: Imaging,
    methods: Sequence[str] | None = None,
    device: ComputeDevice | None = None,
) -> PreparedImaging[Imaging]:
    """Find every setting that is not given, and the voxels: all that the box holds, or the part
    that coarse voxels show to be bright.

    `methods`: that will image; by default the one in the settings, or the quickest; `device`: where
    to compute; where the capture is by default.
    """
    given = to_library(wanted).to_dict()
    if methods:
        given["method"] = methods[0]
    given = {name: value for name, value in given.items() if name not in ("reasons", "gate_found")}
    found = complete_settings(recorded, **given)
    capture = found.prepare(recorded)
    if device is not None:
        capture = capture.on(device)
    scout = find_scout(capture, found)
    if scout is not None or found.method is None:
        coarse, grid = scout or (found, found.grid())
        quickest, plan = coarse.plan_quickest(capture, grid)
        found = found if found.method else found.with_method(quickest)
    if scout is not None:
        found = find_bright_box(found, image_capture("looking over", plan, capture))
    found = replace(found, everywhere=True)
    _warn_of_given_wavelength(capture, found)
    shown = from_library(wanted, found, methods or [found.method or ""])
    return PreparedImaging(capture, found.grid(), found, shown, recorded)


def _warn_of_given_wavelength(capture: Capture, found: Settings) -> None:
    """Warn of false images; a wavelength that was found was so with the wall's sampling in mind."""
    wavelength, (_, taken) = found.wavelength, METHOD_CLASSES[found.method or METHODS[0]]
    if wavelength is None or "wavelength" in found.reasons or "wavelength" not in taken:
        return
    band = Band(VirtualPulse(wavelength, found.cycles), capture.axis)
    if text := describe_aliasing(capture, band):
        print(f"tofclip: warning: {text}", file=sys.stderr)


def image_capture(title: str, plan: Plan, capture: Capture) -> Volume:
    """Image the hidden scene under a progress bar that counts look-ups or voxels, whichever the
    plan does.
    """
    with show_progress(title, plan.cost) as advance:
        return plan.image(capture, advance)
