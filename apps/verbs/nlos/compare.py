"""`tofclip nlos compare`: several methods on one capture, side by side."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from apps.figures.nlos_compare import make_comparison_figure
from apps.figures.style import save_figure as save_figure
from apps.files import PICTURE_SUFFIXES, make_folder, require_writable
from apps.nlos.files import add_provenance
from apps.nlos.imaging import (
    choose_grid,
    fill_box,
    find_scales,
    preprocess_capture,
    warnings_to_stderr,
)
from apps.nlos.measure import compare_with_truth, measure_imaging, measure_sharpness
from apps.nlos.methods import (
    METHODS,
    ImagingSettings,
    build_method,
    fill_in_defaults,
    parse_method_names,
    require_used_settings,
)
from apps.nlos.truth import HiddenTruth
from apps.options import JsonOption
from apps.report import report
from apps.settings import (
    SettingsOption,
    add_setting_flags,
    load_settings,
    save_settings,
    setting_field,
    settings_to_dict,
)
from apps.studies.hidden_scene_adjoint import correlate_views
from nlos.io import read_capture
from tofclip.errors import InputError
from tofclip.units import MILLIMETRE

if TYPE_CHECKING:
    from apps.nlos.measure import MeasuredVolume
    from nlos import Capture, Grid
    from nlos.method import Reconstructor

SETTINGS_HEADING = "tofclip nlos compare CAPTURE --settings THIS --out PICTURE"


@dataclass(frozen=True)
class CompareSettings(ImagingSettings):
    """What is compared on one capture."""

    methods: str | None = setting_field(
        "A,B,...",
        f"Of {', '.join(METHODS)}; the first is the reference.",
        shown="all that suit the capture",
        choices=METHODS,
    )


@add_setting_flags(CompareSettings)
def compare(
    source: Annotated[
        Path,
        typer.Argument(metavar="CAPTURE", help="Recovered frames of a relay wall, or a capture."),
    ],
    out: Annotated[Path, typer.Option(metavar="PNG", help="The picture to write.")],
    volumes: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for the volumes, one file per method."),
    ] = None,
    settings: SettingsOption = None,
    as_json: JsonOption = False,
    **flags: Any,
) -> None:
    """Image one capture by several methods, and show images, time, memory and figures of merit side
    by side.

    The correlation is that of the front views with the first method's. The sharpness says how far
    the light of the front view is gathered, which is good only where it is gathered in the right
    place: captures of nlos simulate carry the truth, and for them the share of energy near hidden
    things and the contrast against the rest are told.

    The settings that were told or found are written beside the picture (.toml) and give the same
    comparison.

    Example: tofclip nlos compare capture.h5 --methods hybrid,backprojection --out compare.png
    """
    wanted = load_settings(CompareSettings, settings, flags)
    written = [out, out.with_suffix(".toml")]
    _require_writable(written, volumes, (source,) if settings is None else (source, settings))
    _check_settings(wanted)
    capture, truth = preprocess_capture(read_capture(source), wanted), HiddenTruth.load(source)
    with warnings_to_stderr():
        found, grid, methods, left_out = _choose_methods(wanted, capture)
        runs = _measure_methods(methods, capture, grid)
    figures = _collect_metrics(runs, truth)
    save_figure(
        make_comparison_figure({name: run.volume for name, run in runs.items()}, figures, truth),
        out,
    )
    if volumes is not None:
        written += _save_volumes(runs, volumes, source, found)
    save_settings(found, written[1], SETTINGS_HEADING)
    _report_comparison(grid, figures, left_out, as_json, written)


def _require_writable(
    pictures: Sequence[Path], volumes: Path | None, inputs: tuple[Path, ...]
) -> None:
    picture, settings = pictures
    require_writable(picture, *PICTURE_SUFFIXES, inputs=inputs)
    require_writable(settings, inputs=inputs)
    if volumes is not None:
        make_folder(volumes)


def _check_settings(settings: CompareSettings) -> None:
    names = tuple(METHODS) if settings.methods is None else parse_method_names(settings.methods)
    require_used_settings(settings, names)
    for name in names:
        build_method(
            name,
            settings
            if settings.wavelength_mm is not None
            else replace(settings, wavelength_mm=1.0),
        )


def _choose_methods(
    wanted: CompareSettings, capture: Capture
) -> tuple[CompareSettings, Grid, dict[str, Reconstructor], dict[str, str]]:
    """Choose methods and voxels; of methods that nobody named, those that do not suit are left out,
    with the reason.
    """
    scales = find_scales(wanted, capture)
    found = replace(wanted, **scales._asdict())
    _, whole = fill_box(found, capture, scales.voxel_mm * MILLIMETRE)
    names = tuple(METHODS) if found.methods is None else parse_method_names(found.methods)
    support = {name: build_method(name, found).supports(capture, whole) for name in names}
    left_out = {name: one.reason for name, one in support.items() if not one}
    if left_out and (found.methods is not None or len(left_out) == len(names)):
        name, reason = next(iter(left_out.items()))
        raise InputError(f"{name} does not suit this capture: {reason}")
    chosen = [name for name in names if name not in left_out]
    found = replace(fill_in_defaults(found, chosen), methods=",".join(chosen))
    found, grid = choose_grid(found, capture)
    return found, grid, {name: build_method(name, found) for name in chosen}, left_out


def _measure_methods(
    methods: Mapping[str, Reconstructor], capture: Capture, grid: Grid
) -> dict[str, MeasuredVolume]:
    return {
        name: measure_imaging(name, imaging, capture, grid) for name, imaging in methods.items()
    }


def _collect_metrics(
    runs: Mapping[str, MeasuredVolume], truth: HiddenTruth | None
) -> dict[str, dict[str, Any]]:
    """Figures of every method; the first is the reference."""
    reference = next(iter(runs.values())).volume
    return {
        name: {
            **run.costs,
            "correlation": correlate_views(run.volume, reference),
            "sharpness": measure_sharpness(run.volume),
            **({} if truth is None else compare_with_truth(run.volume, truth)),
        }
        for name, run in runs.items()
    }


def _save_volumes(
    runs: Mapping[str, MeasuredVolume], folder: Path, source: Path, settings: CompareSettings
) -> Iterator[Path]:
    """Write each method's volume, and name the files."""
    for name, run in runs.items():
        path = folder / f"{name}.h5"
        add_provenance(
            run.volume,
            source,
            {"verb": "nlos compare", "method": name, **settings_to_dict(settings)},
        ).save(path)
        yield path


def _report_comparison(
    grid: Grid,
    figures: Mapping[str, Mapping[str, Any]],
    left_out: Mapping[str, str],
    as_json: bool,
    written: Sequence[Path],
) -> None:
    if as_json:
        report({"voxels": grid.shape, "methods": figures, "left_out": left_out}, as_json)
        return
    lines = {name: _format_line(one) for name, one in figures.items()}
    reasons = {name: f"no: {reason}" for name, reason in left_out.items()}
    report({"voxels": grid.shape, **lines, **reasons}, as_json, written)


def _format_line(figures: Mapping[str, Any]) -> str:
    """Put a method's figures into columns that stand below those of other methods."""
    memory = "" if figures["peak_mib"] is None else f"{figures['peak_mib']:7.0f} MiB"
    line = f"{figures['seconds']:8.2f} s{memory}  correlation {figures['correlation']:6.3f}"
    line += f"  sharpness {figures['sharpness']:5.2f}"
    if "energy_near_truth" in figures:
        line += f"  near truth {figures['energy_near_truth']:4.0%}  contrast {figures['contrast_to_truth']:5.1f}"
    return line
