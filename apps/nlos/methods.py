"""The methods of imaging around corners by name: how they are built from settings, and what they need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

from apps.settings import setting
from tofclip.errors import InputError
from tofclip.units import MILLIMETRE

if TYPE_CHECKING:
    from nlos import Capture, Grid
    from nlos.method import Reconstructor
    from tofclip.arrays import Place

PULSED = ("wavelength_mm", "cycles")

METHODS = {
    "rsd": ("PlanarRSD", (*PULSED, "tolerance")),
    "hybrid": ("Hybrid", (*PULSED, "tolerance")),
    "backprojection": ("Backprojection", PULSED),
    "filtered-backprojection": ("FilteredBackprojection", ("sigma_mm",)),
    "lct": ("LightCone", ("signal_to_noise", "falloff")),
    "fk": ("FKMigration", ("falloff",)),
}
"""Class in `nlos`, and the settings that it takes."""

QUICKEST_FIRST = ("rsd", "hybrid", "backprojection")
"""They give the same picture; the later one takes more walls and lasers, and more time."""

PORTABLE = QUICKEST_FIRST
"""They compute wherever the signal is; the others have compiled loops only."""


@dataclass(frozen=True)
class ImagingSettings:
    """Where and how a hidden scene is imaged; None is found from the capture's geometry."""

    wavelength_mm: float | None = setting(
        "MM", "Carrier of the virtual pulse.", shown="the shortest that wall points and time bins carry"
    )
    cycles: float = setting("N", "Length of the virtual pulse in wavelengths.", 3.0)
    voxel_mm: float | None = setting("MM", "Distance of neighbouring voxels.", shown="an eighth of the wavelength")
    near_m: float | None = setting("M", "First depth.", shown="one voxel beyond the middle of the wall's relief")
    far_m: float | None = setting("M", "Last depth.", shown="as far as the record reaches, at most two wall widths")
    x_m: tuple[float, float] | None = setting("M M", "First and last x.", shown="the wall's")
    y_m: tuple[float, float] | None = setting("M M", "First and last y; y points down.", shown="the wall's")
    everywhere: bool = setting(
        None, "Fill all of that box with voxels, not only the part that coarse ones find bright.", False
    )
    gate_m: float | None = setting(
        "M", "Blank what arrives up to so much path after the wall's own light.", shown="nothing is blanked"
    )
    bins_together: int = setting("N", "Time bins added up to one before imaging.", 1)
    tolerance: float | None = setting("SHARE", "Error allowed for the sake of speed: rsd, hybrid.", shown="0.01")
    sigma_mm: float | None = setting(
        "MM", "Width of the Laplacian: filtered-backprojection.", shown="a quarter of the wavelength"
    )
    falloff: float | None = setting(
        "POWER", "How light fades with distance: lct, fk; 4 for matte things, 2 for retroreflecting ones.", shown="4"
    )
    signal_to_noise: float | None = setting("RATIO", "Of the Wiener filter: lct.", shown="0.8")


Imaging = TypeVar("Imaging", bound=ImagingSettings)


def names_in(text: str) -> tuple[str, ...]:
    """Split a list of methods at its commas, refusing unknown names and repetitions."""
    names = tuple(name.strip() for name in text.split(","))
    for name in names:
        if name not in METHODS:
            raise InputError(f"unknown method '{name}'; choose from {', '.join(METHODS)}")
    if len(set(names)) < len(names):
        raise InputError(f"a method is named twice in '{text}'")
    return names


def require_taken(settings: ImagingSettings, methods: Sequence[str]) -> None:
    """Refuse a setting that none of the methods takes, since it would change nothing."""
    taken = {name for method in methods for name in METHODS[method][1]}
    for name in sorted({name for _, names in METHODS.values() for name in names} - taken - set(PULSED)):
        if getattr(settings, name) is not None:
            by = ", ".join(method for method, (_, names) in METHODS.items() if name in names)
            raise InputError(f"{name} is a setting of {by} and changes nothing for {', '.join(methods)}; leave it out")


def built(method: str, settings: ImagingSettings) -> Reconstructor:
    """Build a method; what no setting tells is left to its class."""
    import nlos

    class_name, names = METHODS[method]
    arguments = {}
    for name in names:
        value = getattr(settings, name)
        if value is not None:
            arguments[name.removesuffix("_mm")] = value * MILLIMETRE if name.endswith("_mm") else value
    made: Reconstructor = getattr(nlos, class_name)(**arguments)
    return made


def spelt_out(settings: Imaging, methods: Sequence[str]) -> Imaging:
    """Fill in what the methods' classes take where nothing is told, and leave out what none of them takes."""
    kept: dict[str, Any] = {name: None for _, names in METHODS.values() for name in names if name not in PULSED}
    for method in methods:
        made = built(method, settings)
        for name in METHODS[method][1]:
            kept[name] = getattr(settings, name) if name.endswith("_mm") else getattr(made, name)
    return replace(settings, **kept)


def quickest(settings: ImagingSettings, capture: Capture, grid: Grid) -> str:
    """Name the quickest method that takes a capture; where none does, the one that takes most, which says why."""
    suits = (name for name in QUICKEST_FIRST if built(name, settings).supports(capture, grid))
    return next(suits, QUICKEST_FIRST[-1])


def place_for(device: str, settings: ImagingSettings) -> Place:
    """Return the place that a name asks for; ``auto`` stays with the compiled loops where a method has nothing else."""
    from tofclip.arrays import Place, place_named

    named, refine = (getattr(settings, name, None) for name in ("method", "refine"))
    portable = named in (None, *PORTABLE) and refine is None
    return Place() if device == "auto" and not portable else place_named(device)
