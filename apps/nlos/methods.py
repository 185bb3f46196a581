"""The methods of imaging around corners by name: how they are built from settings, and what they
need.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import nlos
from apps.settings import setting_field
from tofclip.arrays import ComputeDevice, parse_device
from tofclip.errors import InputError
from tofclip.units import MILLIMETRE

if TYPE_CHECKING:
    from nlos import Capture, Grid
    from nlos.method import Reconstructor

PULSE_SETTINGS = ("wavelength_mm", "cycles")

METHODS = {
    "rsd": ("PlanarRSD", (*PULSE_SETTINGS, "tolerance")),
    "hybrid": ("Hybrid", (*PULSE_SETTINGS, "tolerance")),
    "backprojection": ("Backprojection", PULSE_SETTINGS),
    "filtered-backprojection": ("FilteredBackprojection", ("sigma_mm",)),
    "lct": ("LightCone", ("signal_to_noise", "falloff")),
    "fk": ("FKMigration", ("falloff",)),
}
"""Class in `nlos`, and the settings that it takes."""

METHODS_BY_SPEED = ("rsd", "hybrid", "backprojection")
"""They give the same picture; the later one takes more walls and lasers, and more time."""

PORTABLE_METHODS = METHODS_BY_SPEED
"""They compute wherever the signal is; the others have compiled loops only."""


@dataclass(frozen=True)
class ImagingSettings:
    """Where and how a hidden scene is imaged; None is found from the capture's geometry."""

    wavelength_mm: float | None = setting_field(
        "MM",
        "Carrier of the virtual pulse.",
        shown="the shortest that wall points and time bins carry",
    )
    cycles: float = setting_field("N", "Length of the virtual pulse in wavelengths.", 3.0)
    voxel_mm: float | None = setting_field(
        "MM", "Distance of neighbouring voxels.", shown="an eighth of the wavelength"
    )
    near_m: float | None = setting_field(
        "M", "First depth.", shown="one voxel beyond the middle of the wall's relief"
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
    )
    gate_m: float | None = setting_field(
        "M",
        "Blank what arrives up to so much path after the wall's own light.",
        shown="nothing is blanked",
    )
    bins_together: int = setting_field("N", "Time bins added up to one before imaging.", 1)
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
    """Refuse a setting that none of the methods takes, since it would change nothing.

    Parameters
    ----------
    settings : ImagingSettings
    methods : sequence of str

    Raises
    ------
    InputError
        There is such a setting.
    """
    taken = {name for method in methods for name in METHODS[method][1]}
    for name in sorted(
        {name for _, names in METHODS.values() for name in names} - taken - set(PULSE_SETTINGS)
    ):
        if getattr(settings, name) is not None:
            by = ", ".join(method for method, (_, names) in METHODS.items() if name in names)
            raise InputError(
                f"{name} is a setting of {by} and changes nothing for {', '.join(methods)}; leave it out"
            )


def build_method(method: str, settings: ImagingSettings) -> Reconstructor:
    """Build a method; what no setting says is left to its class.

    Parameters
    ----------
    method : str
        A key of `METHODS`.
    settings : ImagingSettings

    Returns
    -------
    Reconstructor
    """
    class_name, names = METHODS[method]
    arguments = {}
    for name in names:
        value = getattr(settings, name)
        if value is not None:
            arguments[name.removesuffix("_mm")] = (
                value * MILLIMETRE if name.endswith("_mm") else value
            )
    made: Reconstructor = getattr(nlos, class_name)(**arguments)
    return made


def fill_in_defaults(settings: Imaging, methods: Sequence[str]) -> Imaging:
    """Fill in the defaults of the methods' classes where nothing is given, and leave out what none
    of them takes.

    Parameters
    ----------
    settings : ImagingSettings
    methods : sequence of str

    Returns
    -------
    ImagingSettings
    """
    kept: dict[str, Any] = {
        name: None for _, names in METHODS.values() for name in names if name not in PULSE_SETTINGS
    }
    for method in methods:
        made = build_method(method, settings)
        for name in METHODS[method][1]:
            kept[name] = getattr(settings, name) if name.endswith("_mm") else getattr(made, name)
    return replace(settings, **kept)


def choose_quickest_method(settings: ImagingSettings, capture: Capture, grid: Grid) -> str:
    """Name the quickest method that takes a capture; where none does, the one that takes most,
    which says why.

    Parameters
    ----------
    settings : ImagingSettings
    capture : Capture
    grid : Grid

    Returns
    -------
    str
    """
    suits = (
        name for name in METHODS_BY_SPEED if build_method(name, settings).supports(capture, grid)
    )
    return next(suits, METHODS_BY_SPEED[-1])


def choose_device(device: str, settings: ImagingSettings) -> ComputeDevice:
    """Return the device that a name asks for; ``auto`` stays with the compiled loops where a method
    has nothing else.

    Parameters
    ----------
    device : str
        See `tofclip.arrays.parse_device`.
    settings : ImagingSettings

    Returns
    -------
    ComputeDevice
    """
    named, refine = (getattr(settings, name, None) for name in ("method", "refine"))
    portable = named in (None, *PORTABLE_METHODS) and refine is None
    return ComputeDevice() if device == "auto" and not portable else parse_device(device)
