"""`tofclip nlos compare`: several methods on one capture, side by side."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from apps.nlos.methods import METHODS, ImagingSettings
from apps.options import AsJson
from apps.settings import SettingsFile, setting, takes

if TYPE_CHECKING:
    from apps.nlos.measure import Measured
    from apps.nlos.truth import HiddenTruth
    from nlos import Capture, Grid
    from nlos.method import Reconstructor

HEADING = "tofclip nlos compare CAPTURE --settings THIS --out PICTURE"


@dataclass(frozen=True)
class CompareSettings(ImagingSettings):
    """What is compared on one capture."""

    methods: str | None = setting(
        "A,B,...",
        f"Of {', '.join(METHODS)}; the first is the reference.",
        shown="all that suit the capture",
        choices=METHODS,
    )


@takes(CompareSettings)
def compare(
    source: Annotated[Path, typer.Argument(metavar="CAPTURE", help="Recovered frames of a relay wall, or a capture.")],
    out: Annotated[Path, typer.Option(metavar="PNG", help="The picture to write.")],
    volumes: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for the volumes, one file per method.")
    ] = None,
    settings: SettingsFile = None,
    as_json: AsJson = False,
    **flags: Any,
) -> None:
    """Image one capture by several methods, and show images, time, memory and figures of merit side by side.

    The correlation is that of the front views with the first method's. The sharpness says how far the light of the
    front view is gathered, which is good only where it is gathered in the right place: captures of nlos simulate carry
    the truth, and for them the share of energy near hidden things and the contrast against the rest are told.

    The settings that were told or found are written beside the picture (.toml) and give the same comparison.

    Example: tofclip nlos compare capture.h5 --methods hybrid,backprojection --out compare.png
    """
    from apps.figures.nlos_compare import compare_figure
    from apps.figures.style import save as save_figure
    from apps.nlos.imaging import prepared, warnings_in_a_line
    from apps.nlos.truth import HiddenTruth
    from apps.settings import save, told
    from nlos.io import read_capture

    wanted = told(CompareSettings, settings, flags)
    written = [out, out.with_suffix(".toml")]
    _require_writable(written, volumes, (source,) if settings is None else (source, settings))
    _require_sense(wanted)
    capture, truth = prepared(read_capture(source), wanted), HiddenTruth.inside(source)
    with warnings_in_a_line():
        found, grid, methods, left_out = _chosen(wanted, capture)
        runs = _measured(methods, capture, grid)
    figures = _figures(runs, truth)
    save_figure(compare_figure({name: run.volume for name, run in runs.items()}, figures, truth), out)
    if volumes is not None:
        written += _save_volumes(runs, volumes, source, found)
    save(found, written[1], HEADING)
    _report(grid, figures, left_out, as_json, written)


def _require_writable(pictures: Sequence[Path], volumes: Path | None, inputs: tuple[Path, ...]) -> None:
    from apps.files import PICTURE_SUFFIXES, make_folder, require_writable

    picture, settings = pictures
    require_writable(picture, *PICTURE_SUFFIXES, inputs=inputs)
    require_writable(settings, inputs=inputs)
    if volumes is not None:
        make_folder(volumes)


def _require_sense(settings: CompareSettings) -> None:
    from apps.nlos.methods import built, names_in, require_taken

    names = tuple(METHODS) if settings.methods is None else names_in(settings.methods)
    require_taken(settings, names)
    for name in names:
        built(name, settings if settings.wavelength_mm is not None else replace(settings, wavelength_mm=1.0))


def _chosen(
    wanted: CompareSettings, capture: Capture
) -> tuple[CompareSettings, Grid, dict[str, Reconstructor], dict[str, str]]:
    """Choose methods and voxels; of methods that nobody named, those that do not suit are left out, with the reason."""
    from apps.nlos.imaging import box_of, boxed, scales_of
    from apps.nlos.methods import built, names_in, spelt_out
    from tofclip.errors import InputError
    from tofclip.units import MILLIMETRE

    scales = scales_of(wanted, capture)
    found = replace(wanted, **scales._asdict())
    _, whole = box_of(found, capture, scales.voxel_mm * MILLIMETRE)
    names = tuple(METHODS) if found.methods is None else names_in(found.methods)
    support = {name: built(name, found).supports(capture, whole) for name in names}
    left_out = {name: one.reason for name, one in support.items() if not one}
    if left_out and (found.methods is not None or len(left_out) == len(names)):
        name, reason = next(iter(left_out.items()))
        raise InputError(f"{name} does not suit this capture: {reason}")
    chosen = [name for name in names if name not in left_out]
    found = replace(spelt_out(found, chosen), methods=",".join(chosen))
    found, grid = boxed(found, capture)
    return found, grid, {name: built(name, found) for name in chosen}, left_out


def _measured(methods: Mapping[str, Reconstructor], capture: Capture, grid: Grid) -> dict[str, Measured]:
    from apps.nlos.measure import measured

    return {name: measured(name, imaging, capture, grid) for name, imaging in methods.items()}


def _figures(runs: Mapping[str, Measured], truth: HiddenTruth | None) -> dict[str, dict[str, Any]]:
    """Figures of every method; the first is the reference."""
    from apps.nlos.measure import sharpness, truth_figures
    from apps.studies.hidden_scene_adjoint import correlation

    reference = next(iter(runs.values())).volume
    return {
        name: {
            **run.costs,
            "correlation": correlation(run.volume, reference),
            "sharpness": sharpness(run.volume),
            **({} if truth is None else truth_figures(run.volume, truth)),
        }
        for name, run in runs.items()
    }


def _save_volumes(
    runs: Mapping[str, Measured], folder: Path, source: Path, settings: CompareSettings
) -> Iterator[Path]:
    """Write each method's volume, and name the files."""
    from apps.nlos.files import with_history
    from apps.settings import plain

    for name, run in runs.items():
        path = folder / f"{name}.h5"
        with_history(run.volume, source, {"verb": "nlos compare", "method": name, **plain(settings)}).save(path)
        yield path


def _report(
    grid: Grid,
    figures: Mapping[str, Mapping[str, Any]],
    left_out: Mapping[str, str],
    as_json: bool,
    written: Sequence[Path],
) -> None:
    from apps.report import report

    if as_json:
        report({"voxels": grid.shape, "methods": figures, "left_out": left_out}, as_json)
        return
    lines = {name: _in_a_line(one) for name, one in figures.items()}
    reasons = {name: f"no: {reason}" for name, reason in left_out.items()}
    report({"voxels": grid.shape, **lines, **reasons}, as_json, written)


def _in_a_line(figures: Mapping[str, Any]) -> str:
    """Put a method's figures into columns that stand below those of other methods."""
    memory = "" if figures["peak_mib"] is None else f"{figures['peak_mib']:7.0f} MiB"
    line = f"{figures['seconds']:8.2f} s{memory}  correlation {figures['correlation']:6.3f}"
    line += f"  sharpness {figures['sharpness']:5.2f}"
    if "energy_near_truth" in figures:
        line += f"  near truth {figures['energy_near_truth']:4.0%}  contrast {figures['contrast_to_truth']:5.1f}"
    return line
