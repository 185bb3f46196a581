"""`tofclip nlos compare`: several methods on one capture, side by side."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from apps.conventions import (
    PICTURE_SUFFIXES,
    JsonOption,
    make_folder,
    name_beside,
    report,
    require_writable,
)
from apps.figures.nlos_compare import make_comparison_figure
from apps.figures.style import save_figure as save_figure
from apps.nlos.files import add_provenance
from apps.nlos.imaging import (
    METHODS,
    ImagingSettings,
    from_library,
    parse_method_names,
    prepare_imaging,
    require_valid_settings,
)
from apps.nlos.measure import compare_with_truth, measure_imaging, measure_sharpness
from apps.nlos.truth import HiddenTruth
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
from tofclip.files import require_apart

if TYPE_CHECKING:
    from apps.nlos.imaging import PreparedImaging
    from apps.nlos.measure import MeasuredVolume
    from nlos import Capture, Grid

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
    things and the contrast against the rest are reported.

    The settings that were given or found are written beside the picture (.toml) and give the same
    comparison.

    Example: tofclip nlos compare capture.h5 --methods hybrid,backprojection --out compare.png
    """
    wanted = load_settings(CompareSettings, settings, flags)
    written = [out, name_beside(out, ".toml")]
    require_writable(out, *PICTURE_SUFFIXES, inputs=(source, settings))
    require_writable(written[1], inputs=(source, settings))
    # Everything that can be refused is refused before the capture is read.
    _check_settings(wanted)
    if volumes is not None:
        require_apart([volumes, *(volumes / f"{name}.h5" for name in METHODS)], [source, settings])
        make_folder(volumes)
    capture, truth = read_capture(source), HiddenTruth.load(source)
    prepared, left_out = _choose_methods(wanted, capture)
    runs = _measure_methods(prepared)
    found, grid = prepared.shown, prepared.grid
    figures = _collect_metrics(runs, truth)
    save_figure(
        make_comparison_figure({name: run.volume for name, run in runs.items()}, figures, truth),
        out,
    )
    if volumes is not None:
        written += _save_volumes(runs, volumes, source, found)
    save_settings(found, written[1], SETTINGS_HEADING)
    _report_comparison(grid, figures, left_out, as_json, written)


def _check_settings(settings: CompareSettings) -> None:
    names = METHODS if settings.methods is None else parse_method_names(settings.methods)
    require_valid_settings(settings, names)


def _choose_methods(
    wanted: CompareSettings, capture: Capture
) -> tuple[PreparedImaging[CompareSettings], dict[str, str]]:
    """Choose methods and voxels; of methods that were not named, those that do not suit are left
    out, with the reason.
    """
    names = METHODS if wanted.methods is None else parse_method_names(wanted.methods)
    # The voxels are those of the virtual pulse, for all methods alike.
    prepared = prepare_imaging(capture, wanted)
    left_out = {}
    for name in names:
        try:
            # A plan checks the geometry without imaging, and so is cheap.
            prepared.settings.make_method(name).plan(prepared.capture, prepared.grid)
        except InputError as refused:
            left_out[name] = str(refused)
    # A method that was named must not vanish silently; of all methods, one has to remain.
    if left_out and (wanted.methods is not None or len(left_out) == len(names)):
        name, reason = next(iter(left_out.items()))
        raise InputError(f"{name} does not suit this capture: {reason}")
    chosen = [name for name in names if name not in left_out]
    shown = from_library(prepared.shown, prepared.settings, chosen)
    return replace(prepared, shown=replace(shown, methods=",".join(chosen))), left_out


def _measure_methods(prepared: PreparedImaging[CompareSettings]) -> dict[str, MeasuredVolume]:
    return {
        name: measure_imaging(
            name, prepared.settings.make_method(name), prepared.capture, prepared.grid
        )
        for name in (prepared.shown.methods or "").split(",")
    }


def _collect_metrics(
    runs: Mapping[str, MeasuredVolume], truth: HiddenTruth | None
) -> dict[str, dict[str, Any]]:
    """Figures of every method; the first is the reference."""
    # Dictionaries keep the order in which methods were named.
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
