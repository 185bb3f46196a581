"""`tofclip nlos reconstruct`: what a relay wall shows of the scene around the corner."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from apps.conventions import (
    ClusterOption,
    DeviceOption,
    JsonOption,
    make_folder,
    name_beside,
    report,
)
from apps.nlos.files import (
    ResultFiles,
    add_provenance,
    is_capture_folder,
    list_captures,
    list_volume_suffixes,
    note_content,
    write_volume,
)
from apps.nlos.imaging import (
    METHODS,
    PHOTONS,
    PORTABLE_METHODS,
    REFINED_METHOD,
    RefinementSettings,
    build_refinement,
    choose_device,
    image_capture,
    parse_method_names,
    prepare_imaging,
    require_valid_refinement,
    require_valid_settings,
)
from apps.sequences import resolve_device, run_with_progress
from apps.settings import (
    SettingsOption,
    add_setting_flags,
    load_settings,
    save_settings,
    setting_field,
    settings_to_dict,
)
from nlos.io import read_capture
from nlos.normals import find_imaged_surface
from nlos.settings import is_brightest_on_wall
from tofclip.arrays import ComputeDevice
from tofclip.errors import InputError
from tofclip.files import require_apart
from tofclip.sequences.jobs import Job, run_jobs

if TYPE_CHECKING:
    from apps.nlos.imaging import PreparedImaging
    from nlos import Volume
    from tofclip.sequences.jobs import Report

EXIT_SOME_FAILED = 1
STOP_KEYS = ("iterations", "stopped_because")
"""What is reported of an iteration."""

SETTINGS_SUFFIX = ".toml"
FOLDER_SETTINGS_NAME = ".settings.toml"
SETTINGS_HEADING = "tofclip nlos reconstruct CAPTURE --settings THIS --out VOLUME"


@dataclass(frozen=True)
class ReconstructSettings(RefinementSettings):
    """How a capture is imaged and written."""

    method: str | None = setting_field(
        "NAME",
        f"One of {', '.join(METHODS)}.",
        shown="the quickest that suits the capture",
        choices=METHODS,
    )
    point_fraction: float = setting_field(
        "SHARE",
        "Voxels with this share of the brightest become points of .ply, .pcd, .csv, and the surface.",
        0.3,
    )


@dataclass(frozen=True)
class _ImagingRequest:
    """What is asked for every capture: settings, and where to compute."""

    settings: ReconstructSettings
    device: str


@add_setting_flags(ReconstructSettings)
def reconstruct(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="CAPTURE", help="Recovered frames of a relay wall, a capture, or a folder."
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE", help="The volume to write, .h5, .vti, .npz, .exr or .ply; or a folder."
        ),
    ],
    png: Annotated[
        Path | None,
        typer.Option(
            metavar="PNG",
            help="Picture of the volume, three views.",
            show_default="only in a folder",
        ),
    ] = None,
    surface: Annotated[
        Path | None,
        typer.Option(
            metavar="PLY",
            help="What is seen from the wall as a mesh: depth, normals, brightness.",
        ),
    ] = None,
    settings: SettingsOption = None,
    suffix: Annotated[
        list[str] | None,
        typer.Option(
            metavar=".EXT",
            help="Format of the volumes in a folder; may be repeated.",
            show_default=".h5",
        ),
    ] = None,
    cluster: ClusterOption = None,
    device: DeviceOption = "cpu",
    as_json: JsonOption = False,
    **flags: Any,
) -> None:
    """Image the hidden scene from the transients on a relay wall.

    rsd is quick and for planar, evenly scanned walls, hybrid nearly as quick and for any wall;
    backprojection takes every wall, laser and grid, and is slow. These three see through a virtual
    pulse and give the same picture. filtered-backprojection, lct (light-cone transform) and fk (f-k
    migration) do without; the last two want a confocal scan of a planar wall.

    The space in front of the wall is looked over with voxels of half a wavelength first, by the
    quickest of the first three; then the part that is bright is imaged with the voxels asked for.
    The settings that were given or found are written beside the volume (.toml); given back by
    --settings they make the same volume, on another --device to some hundred-thousandths.

    --refine photons looks for the albedo under which the photons that were counted are likeliest:
    for captures of few photons, by time of flight, background included. --refine l1 or tv look for
    the albedo that explains the wall's waves best, at the cost of some four images per iteration.

    --surface takes what is foremost and bright on every line of sight from the wall (above
    --point-fraction of the brightest) and its direction: from a confocal scan of a planar wall by
    the directional light-cone transform, else from the gradients of the volume.

    With --device rsd, hybrid and backprojection compute on a GPU; the
    others cannot.

    Of a folder every capture is imaged into the folder --out. Captures whose results are there
    already are skipped. If some fail, the others are done all the same, and the exit status is 1.

    Example: tofclip nlos reconstruct capture.h5 --out volume.h5 --png volume.png --surface mesh.ply
    """
    order = _ImagingRequest(load_settings(ReconstructSettings, settings, flags), device)
    _check_settings(order.settings)
    # A device that does not exist is refused before any capture is read.
    resolve_device(device, cluster)
    if is_capture_folder(source):
        if surface is not None:
            raise InputError(f"{source}: --surface is for a single capture, and this is a folder")
        _reconstruct_folder((source, settings), out, order, suffix or [".h5"], (cluster, as_json))
        return
    if cluster is not None:
        raise InputError(f"{source}: --cluster is for a folder of captures")
    results = ResultFiles([out], png, name_beside(out, SETTINGS_SUFFIX), surface)
    results.require_writable(source, settings)
    report(_reconstruct_single(source, results, order), as_json, results.paths)


def _check_settings(settings: ReconstructSettings) -> None:
    """Refuse settings that no capture could make sense of, before any is read."""
    if not 0 <= settings.point_fraction <= 1:
        raise InputError(
            f"point_fraction is a share between 0 and 1, got {settings.point_fraction}"
        )
    names = PORTABLE_METHODS if settings.method is None else parse_method_names(settings.method)
    if settings.method is not None and len(names) > 1:
        raise InputError(
            f"one method is asked for, got '{settings.method}'; nlos compare takes several"
        )
    require_valid_refinement(settings, settings.method)
    require_valid_settings(settings, names)


def _reconstruct_single(
    source: Path, results: ResultFiles, order: _ImagingRequest
) -> dict[str, Any]:
    """Image one capture, write its results, and return the figures."""
    device = choose_device(order.device, order.settings)
    # Before it is read: a capture that is replaced meanwhile is imaged again next time.
    content = note_content(source)
    capture, wanted = read_capture(source), order.settings
    if wanted.refine and wanted.refine != PHOTONS:
        wanted = replace(wanted, method=REFINED_METHOD)
    started = time.perf_counter()
    prepared = prepare_imaging(capture, wanted, device=device)
    found, volume = _image(prepared)
    chosen = prepared.settings
    on_wall = is_brightest_on_wall(volume, capture, chosen.wavelength or 0.0)
    if on_wall:
        print(
            f"tofclip: warning: {source}: the brightest voxel lies on the wall, whose own light the picture shows; "
            "blank more of it by --gate-m, or begin farther away by --near-m",
            file=sys.stderr,
        )
    # Files are written from the host's memory.
    volume = volume.on(ComputeDevice())
    seconds, imaging = time.perf_counter() - started, volume.provenance["imaging"]
    volume = add_provenance(
        volume,
        source,
        {"verb": "nlos reconstruct", "device": str(device), **settings_to_dict(found)},
    )
    for path in results.volumes:
        write_volume(volume, path, found.point_fraction)
    if results.picture is not None:
        volume.save_picture(results.picture)
    figures = {}
    if results.surface is not None:
        seen = find_imaged_surface(prepared.capture, volume, found.point_fraction)
        seen.save(results.surface)
        figures = {"surface_points": len(seen.points), "surface_source": seen.source}
    save_settings(found, results.settings, f"{SETTINGS_HEADING}\n{content}")
    return {
        "method": found.method,
        "device": str(device),
        **(
            {"refine": found.refine, **{name: imaging[name] for name in STOP_KEYS}}
            if found.refine
            else {}
        ),
        "gate_m": found.gate_m,
        "gate_found": chosen.gate_found,
        "wavelength_mm": found.wavelength_mm,
        "wavelength_reason": chosen.reasons.get("wavelength", "given"),
        "bins_together": found.bins_together,
        "brightest_on_wall": on_wall,
        "voxel_mm": found.voxel_mm,
        "voxels": volume.grid.shape,
        "wall_points": len(capture.points),
        "seconds": seconds,
        "voxels_per_second": volume.grid.size / seconds,
        "peak_m": dict(zip("xyz", volume.find_brightest(), strict=True)),
        **figures,
    }


def _image(
    prepared: PreparedImaging[ReconstructSettings],
) -> tuple[ReconstructSettings, Volume]:
    """Plan the image that settings ask for, and make it."""
    found = replace(prepared.shown, method=prepared.settings.method)
    capture, grid = prepared.capture, prepared.grid
    if not found.refine:
        plan = prepared.settings.make_method().plan(capture, grid)
        return found, image_capture("imaging", plan, capture)
    found, refinement = build_refinement(found, prepared.settings, grid)
    if found.refine == PHOTONS:
        capture = prepared.settings.prepare_counts(prepared.recorded)
    return found, image_capture("refining", refinement.plan(capture, grid), capture)


def _reconstruct_folder(
    inputs: tuple[Path, Path | None],
    out: Path,
    order: _ImagingRequest,
    suffixes: Sequence[str],
    how: tuple[str | None, bool],
) -> None:
    """Image every capture of a folder whose results are not there yet."""
    cluster, as_json = how
    _require_formats(suffixes)
    sources = list_captures(inputs[0])
    results = [path for one in sources for path in _name_results(out, one.stem, suffixes).paths]
    require_apart([out, *results], [*inputs, *sources])
    make_folder(out)
    # Results of other settings in the same folder would be taken for finished.
    _check_folder_settings(out / FOLDER_SETTINGS_NAME, order.settings)
    jobs, skipped = _plan_jobs(sources, out, order, suffixes)
    imaged: list[dict[str, Any]] = []

    def note(report: Report) -> None:
        # None where the result was there already.
        if report.figures is not None:
            imaged.append({"capture": report.name, **report.figures})

    # Here every capture has a bar of its own; on a cluster there is one for all.
    summary = (
        run_jobs(jobs, None, note)
        if cluster is None
        else run_with_progress("imaging", jobs, cluster, note)
    )
    # Workers of a cluster finish in any order.
    imaged.sort(key=lambda one: str(one["capture"]))
    failed = {failure.name: failure.problem for failure in summary.failures}
    for name, reason in failed.items():
        print(f"tofclip: failed: {name}: {reason}", file=sys.stderr)
    counts = {
        "captures": len(sources),
        "imaged": summary.done,
        "skipped": len(skipped),
        "failed": len(failed),
    }
    lists = {"imaged": imaged, "skipped": skipped, "failed": failed} if as_json else {}
    report({**counts, **lists}, as_json, [out])
    if failed:
        raise typer.Exit(EXIT_SOME_FAILED)


def _plan_jobs(
    sources: Sequence[Path], out: Path, order: _ImagingRequest, suffixes: Sequence[str]
) -> tuple[list[Job], list[str]]:
    """Return one job for each capture without results, and the names of the others."""
    jobs, skipped = [], []
    for path in sources:
        results = _name_results(out.resolve(), path.stem, suffixes)
        if results.is_up_to_date(path):
            skipped.append(path.name)
            continue
        results.settings.unlink(
            missing_ok=True
        )  # it says that results are whole, and these are of an older capture
        work = partial(_run_job, path.resolve(), results, order)
        jobs.append(Job(path.name, results.settings, work, tuple(results.paths[:-1])))
    return jobs, skipped


def _run_job(source: Path, results: ResultFiles, order: _ImagingRequest) -> dict[str, Any]:
    """Image one capture, here or on a worker, and report which one it is."""
    if sys.stderr.isatty() and threading.current_thread() is threading.main_thread():
        print(source.name, file=sys.stderr)
    return _reconstruct_single(source, results, order)


def _require_formats(suffixes: Sequence[str]) -> None:
    for suffix in suffixes:
        if suffix not in list_volume_suffixes():
            raise InputError(
                f"no format of volumes is called '{suffix}'; use one of {', '.join(list_volume_suffixes())}"
            )


def _name_results(folder: Path, stem: str, suffixes: Sequence[str]) -> ResultFiles:
    volumes = [folder / f"{stem}{suffix}" for suffix in suffixes]
    return ResultFiles(volumes, folder / f"{stem}.png", folder / f"{stem}{SETTINGS_SUFFIX}")


def _check_folder_settings(file: Path, wanted: ReconstructSettings) -> None:
    """Refuse to mix results of different settings in one folder."""
    if not file.exists():
        save_settings(wanted, file, "tofclip nlos reconstruct FOLDER --settings THIS --out RESULTS")
        return
    before, now = (
        settings_to_dict(load_settings(ReconstructSettings, file, {})),
        settings_to_dict(wanted),
    )
    for name in sorted(before.keys() | now.keys()):
        if before.get(name) != now.get(name):
            raise InputError(
                f"{file.parent}: the results there were made with {name} = {before.get(name, 'not given')}, now it is "
                f"{now.get(name, 'not given')}; choose another folder"
            )
