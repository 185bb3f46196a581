"""`tofclip nlos`: what a relay wall shows of the scene around the corner, from one capture or a
folder of them, and what a capture can show at all.
"""

from __future__ import annotations

import hashlib
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apps.cli import make_group
from apps.options import (
    CLUSTER,
    DEVICE,
    PICTURE_FORMATS,
    SETTINGS,
    arg,
    load_settings,
    name_any,
    opt,
    save_settings,
    settings_to_dict,
    take_settings,
)
from apps.progress import (
    end_with,
    list_failures,
    resolve_device,
    run_with_progress,
    show_activity,
)
from apps.report import (
    PRINTS_JSON,
    RECORD_SUFFIXES,
    REPLACES,
    SETTINGS_SUFFIX,
    make_folder,
    report,
    require_writable,
    say,
    with_past,
)
from apps.verbs.nlos_imaging import (
    CAPTURE,
    PORTABLE_METHODS,
    ImagingSettings,
    choose_methods,
    compare,
    demo,
    image_capture,
    is_capture_folder,
    list_captures,
    prepare_imaging,
    require_valid_settings,
    show_settings,
    simulate,
    try_methods,
)
from apps.verbs.nlos_stream import film, stream
from nlos.settings import METHODS, Settings, declare_setting
from tofclip.errors import InputError, require_known
from tofclip.files import PICTURE_SUFFIXES, identify_file, require_apart
from tofclip.units import MILLIMETRE, PICOSECOND

if TYPE_CHECKING:
    from nlos import Capture, Method, Volume
    from nlos.imaging import PreparedImaging
    from tofclip.sequences.jobs import Report

PHOTONS = "photons"
REFINEMENTS = ("l1", "tv", PHOTONS)
NAMED_REFINEMENTS = name_any(REFINEMENTS)
REFINED_METHOD = "hybrid"  # which is iterated by l1 and tv
ITERATIONS = {"l1": 60, "tv": 60, PHOTONS: 12}
PRIOR_WEIGHTS = {"l1": 2e-2, "tv": 2e-2, PHOTONS: 1.0}

VOLUME_SUFFIXES = (*RECORD_SUFFIXES, ".vti", ".npz", ".exr", ".ply", ".pcd", ".csv")
FOLDER_SETTINGS_NAME = ".settings.toml"
CONTENT_MARK = "# the capture's content: "
"""In the settings beside a volume: what the capture was that it was made of."""

app = make_group("Image the scene hidden around a corner.")


@dataclass(frozen=True)
class ReconstructSettings(Settings):
    """How a capture is imaged, refined and written."""

    point_fraction: float = declare_setting(
        "",
        "Voxels with this share of the brightest become points of .ply, .pcd, .csv, and the surface.",
        0.3,
    )
    refine: str | None = declare_setting(
        "",
        "Iterate the image: photons by the statistics of counts; l1 for few bright things, tv for even surfaces.",
        shown="no",
        choices=REFINEMENTS,
    )
    iterations: int | None = declare_setting(
        "",
        "With --refine: steps at most; of l1 and tv each costs some four images.",
        shown=f"{ITERATIONS['l1']}; photons: {ITERATIONS[PHOTONS]}",
    )
    prior_weight: float | None = declare_setting(
        "",
        "With --refine: weight of the prior, of that which leaves nothing; photons: of noise's standard deviation.",
        shown=f"{PRIOR_WEIGHTS['l1']}; photons: {PRIOR_WEIGHTS[PHOTONS]:g}",
    )


@dataclass(frozen=True)
class ResultFiles:
    """Names of what is written of one capture."""

    volumes: Sequence[Path]  # the volume, in the format that each suffix names
    picture: Path | None
    surface: Path | None = None  # the front surface with normals

    @property
    def settings(self) -> Path:
        """Written last: where it stands, the others are whole."""
        return self.volumes[0].with_suffix(SETTINGS_SUFFIX)

    @property
    def paths(self) -> list[Path]:
        """Every file, in the order of writing."""
        others = [one for one in (self.picture, self.surface) if one is not None]
        return [*self.volumes, *others, self.settings]

    def require_writable(self, *inputs: Path | None) -> None:
        """Refuse names that cannot be written, or that would overwrite an input."""
        for volume in self.volumes:
            require_writable(volume, *VOLUME_SUFFIXES, inputs=inputs)
        if self.picture is not None:
            require_writable(self.picture, *PICTURE_SUFFIXES, inputs=inputs)
        if self.surface is not None:
            require_writable(self.surface, ".ply", inputs=inputs)
            if self.surface.resolve() in [volume.resolve() for volume in self.volumes]:
                raise InputError(f"{self.surface}: volume and surface need names of their own")
        require_writable(self.settings, inputs=inputs)

    def is_up_to_date(self, source: Path) -> bool:
        """Whether all are there and came from the capture as it is; without a note, if younger."""
        if not all(path.is_file() for path in self.paths):
            return False
        text = self.settings.read_text("utf-8", errors="replace")
        if CONTENT_MARK not in text:
            return self.settings.stat().st_mtime >= source.stat().st_mtime
        return note_content(source) in text.splitlines()


def note_content(source: Path) -> str:
    """Return a comment by which a capture, or a folder of renderings, is known again by content."""
    if not source.is_dir():
        return CONTENT_MARK + identify_file(source)
    files = sorted(path for path in source.rglob("*") if path.is_file())
    marks = "\n".join(f"{path.relative_to(source)} {identify_file(path)}" for path in files)
    return CONTENT_MARK + hashlib.sha256(marks.encode()).hexdigest()


@app.command()
@take_settings(ReconstructSettings)
def reconstruct(
    wanted: ReconstructSettings,
    source: Path = arg(
        "CAPTURE", "Recovered frames of a relay wall, a capture, or a folder.", read=True
    ),
    out: Path = opt("FILE", f"The volume to write, {name_any(VOLUME_SUFFIXES)}; or a folder.", ...),
    png: Path | None = opt(
        "PNG", f"Picture of the volume, three views: {PICTURE_FORMATS}.", shown="only in a folder"
    ),
    surface: Path | None = opt(
        "PLY", "What is seen from the wall as a mesh: depth, normals, brightness."
    ),
    settings: Path | None = SETTINGS,
    suffix: list[str] | None = opt(
        ".EXT", "Format of the volumes in a folder; may be repeated.", shown=".h5"
    ),
    cluster: str | None = CLUSTER,
    device: str = DEVICE,
) -> None:
    """Image the hidden scene from the transients on a relay wall.

    rsd is quick and for planar, evenly scanned walls, hybrid nearly as quick and for any wall;
    backprojection takes every wall, laser and grid, and is slow. These three see through a virtual
    pulse, give the same picture, and compute on a GPU as well (--device). filtered-backprojection,
    lct (light-cone transform) and fk (f-k migration) do without; the last two want a confocal scan of
    a planar wall.

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

    Of a folder every capture is imaged into the folder --out. Captures whose results are there
    already are skipped. If some fail, the others are done all the same, and the exit status is 1.

    Example: tofclip nlos reconstruct capture.h5 --out volume.h5 --png volume.png --surface mesh.ply
    """
    # Settings that no capture could make sense of are refused before any is read.
    if not 0 <= wanted.point_fraction <= 1:
        raise InputError(f"point_fraction is a share between 0 and 1, got {wanted.point_fraction}")
    names = choose_methods(wanted.method, PORTABLE_METHODS)
    _check_refinement(wanted)
    require_valid_settings(wanted, names)
    # A device that does not exist is refused before any capture is read.
    resolve_device(device, cluster)
    if is_capture_folder(source):
        if surface is not None:
            raise InputError(f"{source}: --surface is for a single capture, and this is a folder")
        _reconstruct_folder((source, settings), out, wanted, suffix or [".h5"], device, cluster)
        return
    if cluster is not None:
        raise InputError(f"{source}: --cluster is for a folder of captures")
    results = ResultFiles([out], png, surface)
    results.require_writable(source, settings)
    report(reconstruct_single(source, results, wanted, device), results.paths)


def _check_refinement(wanted: ReconstructSettings) -> None:
    """Refuse a refinement that makes no sense, and settings of one that is not asked for."""
    if wanted.refine is None:
        for name in ("iterations", "prior_weight"):
            if getattr(wanted, name) is not None:
                raise InputError(
                    f"{name} is a setting of --refine; give --refine {NAMED_REFINEMENTS} as well"
                )
        return
    if wanted.refine not in REFINEMENTS:
        raise InputError(f"unknown prior '{wanted.refine}'; refine by {NAMED_REFINEMENTS}")
    begins, suitable, most = f"iterates the {REFINED_METHOD} method", [REFINED_METHOD], 1.0
    if wanted.refine == PHOTONS:
        begins = f"photons begins with an image by {', '.join(PORTABLE_METHODS)}"
        suitable, most = [*PORTABLE_METHODS], 10.0
    if wanted.method not in (None, *suitable):
        raise InputError(f"--refine {begins}, not {wanted.method}; leave --method out")
    if wanted.iterations is not None and wanted.iterations < 1:
        raise InputError(f"iterations must be 1 or more, got {wanted.iterations}")
    weight = wanted.prior_weight
    if weight is not None and not 0 <= weight < most:
        raise InputError(f"prior_weight is a share from 0 to less than {most:g}, got {weight}")


def reconstruct_single(
    source: Path, results: ResultFiles, wanted: ReconstructSettings, device: str
) -> dict[str, Any]:
    """Image one capture, write its results, and return the figures."""
    from nlos.imaging import MIN_EVIDENCE, is_brightest_on_wall
    from nlos.io import read_capture
    from nlos.normals import find_imaged_surface
    from tofclip.arrays import ComputeDevice, parse_device

    portable = wanted.method in (None, *PORTABLE_METHODS) and wanted.refine is None
    # ``auto`` stays with the compiled loops where a method has nothing else.
    used = ComputeDevice() if device == "auto" and not portable else parse_device(device)
    # Before it is read: a capture that is replaced meanwhile is imaged again next time.
    content = note_content(source)
    with show_activity(f"reading {source.name}"):  # raw archives are recovered
        capture = read_capture(source)
    if wanted.refine not in (None, PHOTONS):
        wanted = replace(wanted, method=REFINED_METHOD)
    started = time.perf_counter()
    prepared = prepare_imaging(capture, wanted, used)
    found, volume = _image(prepared)
    on_wall = is_brightest_on_wall(volume, capture, found.wavelength or 0.0)
    if on_wall:
        say(
            "warning",
            f"{source}: the brightest voxel lies on the wall, whose own light the picture shows; "
            "blank more of it by --gate-m, or begin farther away by --near-m",
        )
    # Files are written from the host's memory.
    volume = prepared.describe(volume).on(ComputeDevice())
    seconds, imaging = time.perf_counter() - started, volume.provenance["imaging"]
    if not imaging["evidence"] >= MIN_EVIDENCE:
        say(
            "warning",
            f"{source}: the picture's brightest is {imaging['evidence']:.2g} times that of shuffled "
            "copies of the capture: noise or a glow; see that the bin width and the wall's size are right",
        )
    shown = settings_to_dict(found)
    past = {"verb": "nlos reconstruct", "device": str(used), **shown}
    volume = with_past(volume, past, source)
    for path in results.volumes:
        if path.suffix.lower() in RECORD_SUFFIXES:
            volume.save(path)
        else:
            volume.export(path, found.point_fraction)
    if results.picture is not None:
        volume.save_picture(results.picture)
    further, refined = {}, dict[str, Any]()
    if results.surface is not None:
        seen = find_imaged_surface(prepared.capture, volume, found.point_fraction)
        seen.save(results.surface)
        further = {"surface_points": len(seen.points), "surface_source": seen.source}
    if found.refine:
        refined = {name: imaging[name] for name in ("iterations", "stopped_because")}
        refined = {"refine": found.refine, **refined}
    heading = "tofclip nlos reconstruct CAPTURE --settings THIS --out VOLUME"
    save_settings(found, results.settings, f"{heading}\n{content}")
    return {
        "method": found.method,
        "device": str(used),
        **refined,
        "gate_m": found.gate,
        "gate_found": found.gate_found,
        "wavelength_mm": shown["wavelength_mm"],
        "wavelength_reason": found.reasons.get("wavelength", "given"),
        "bins_together": found.bins_together,
        "brightest_on_wall": on_wall,
        "evidence": imaging["evidence"],
        "resolution_m": imaging.get("resolution_m"),
        "voxel_mm": shown["voxel_mm"],
        "voxels": volume.grid.shape,
        "wall_points": len(capture.points),
        "seconds": seconds,
        "voxels_per_second": volume.grid.size / seconds,
        "peak_m": dict(zip("xyz", volume.find_brightest(), strict=True)),
        **further,
    }


def _image(prepared: PreparedImaging[ReconstructSettings]) -> tuple[ReconstructSettings, Volume]:
    """Make the image that settings ask for; return them as they are written beside it."""
    from nlos import Refinement
    from nlos.preparation import MidpointImaging
    from nlos.refinement.l1 import build_total_variation
    from nlos.refinement.photons import PhotonRefinement
    from tofclip.solvers import Sparse

    settings, capture, grid = prepared.settings, prepared.capture, prepared.grid
    found, method = show_settings(settings, [settings.method or ""]), settings.make_method()
    if not found.refine:
        return found, image_capture("imaging", method.plan(capture, grid), capture)
    iterations = found.iterations or ITERATIONS[found.refine]
    weight = found.prior_weight
    weight = PRIOR_WEIGHTS[found.refine] if weight is None else weight
    found = replace(found, iterations=iterations, prior_weight=weight)
    iterated: Any = method
    refined: Method
    if found.refine == PHOTONS:
        capture = settings.prepare_counts(prepared.recorded)
        dark = {"blank": settings.gate or 0.0, "ramp": settings.gate_ramp or 0.0}
        refined = PhotonRefinement(MidpointImaging(iterated), iterations, weight, **dark)
    else:
        prior: Any = Sparse(weight, iterations)
        if found.refine == "tv":
            prior = build_total_variation(grid, weight, iterations)
        refined = Refinement(iterated, prior)
    return found, image_capture("refining", refined.plan(capture, grid), capture)


def _reconstruct_folder(
    inputs: tuple[Path, Path | None],
    out: Path,
    wanted: ReconstructSettings,
    suffixes: Sequence[str],
    device: str,
    cluster: str | None,
) -> None:
    """Image every capture of a folder whose results are not there yet."""
    from tofclip.sequences.jobs import Job, run_jobs

    for suffix in suffixes:
        require_known("format of volumes", suffix, VOLUME_SUFFIXES)
    sources, results = list_captures(inputs[0]), {}
    for path in sources:
        volumes = [out.resolve() / f"{path.stem}{suffix}" for suffix in suffixes]
        results[path] = ResultFiles(volumes, volumes[0].with_suffix(".png"))
    written = [path for one in results.values() for path in one.paths]
    require_apart([out, *written], [*inputs, *sources])
    make_folder(out)
    # Results of other settings in the same folder would be taken for finished.
    _check_folder_settings(out / FOLDER_SETTINGS_NAME, wanted)
    jobs, skipped, imaged = [], [], list[dict[str, Any]]()
    for path, made in results.items():
        if made.is_up_to_date(path) and not REPLACES.get():
            skipped.append(path.name)
            continue
        made.settings.unlink(missing_ok=True)  # it says that results are whole, and these are old
        work = partial(_run_job, path.resolve(), made, wanted, device)
        jobs.append(Job(path.name, made.settings, work, tuple(made.paths[:-1])))

    def note(report: Report) -> None:
        if report.figures is not None:  # None where the result was there already
            imaged.append({"capture": report.name, **report.figures})

    # Here every capture has a bar of its own; on a cluster there is one for all.
    summary = (
        run_jobs(jobs, None, note)
        if cluster is None
        else run_with_progress("imaging", jobs, cluster, note)
    )
    # Workers of a cluster finish in any order.
    imaged.sort(key=lambda one: str(one["capture"]))
    failed = list_failures(summary)
    lists = {"imaged": imaged, "skipped": skipped, "failed": failed}
    counts = {"imaged": summary.done, "skipped": len(skipped), "failed": len(failed)}
    figures = {"captures": len(sources), **(lists if PRINTS_JSON.get() else counts)}
    report(figures, [out])
    end_with(failed)


def _run_job(
    source: Path, results: ResultFiles, wanted: ReconstructSettings, device: str
) -> dict[str, Any]:
    """Image one capture, here or on a worker, and report which one it is."""
    if sys.stderr.isatty() and threading.current_thread() is threading.main_thread():
        print(source.name, file=sys.stderr)
    return reconstruct_single(source, results, wanted, device)


def _check_folder_settings(file: Path, wanted: ReconstructSettings) -> None:
    """Refuse to mix results of different settings in one folder."""
    if not file.exists():
        save_settings(wanted, file, "tofclip nlos reconstruct FOLDER --settings THIS --out RESULTS")
        return
    before = settings_to_dict(load_settings(ReconstructSettings, file, {}))
    now = settings_to_dict(wanted)
    for name in sorted(before.keys() | now.keys()):
        if before.get(name) != now.get(name):
            raise InputError(
                f"{file.parent}: the results there were made with {name} = {before.get(name, 'not given')}, now it is "
                f"{now.get(name, 'not given')}; choose another folder"
            )


for verb in (stream, film, compare, simulate):
    app.command()(verb)


@app.command()
@take_settings(ImagingSettings)
def info(wanted: ImagingSettings, source: Path = CAPTURE, settings: Path | None = SETTINGS) -> None:
    """Report a capture's geometry and sampling, usable wavelengths, resolution, and which methods
    suit it.

    Resolution is the width of a point's image that a perfect instrument would give in the middle of
    the box. Memory is an estimate for filling the whole box with voxels.

    Example: tofclip nlos info capture.h5
    """
    from nlos.analysis import find_longest_wavelength, find_shortest_wavelength
    from nlos.band import VirtualPulse
    from nlos.imaging import find_settings
    from nlos.io import read_capture
    from nlos.known_scenes import HiddenTruth
    from nlos.resolution import compute_diffraction_limit

    with show_activity(f"reading {source.name}"):
        recorded = read_capture(source)
    with show_activity("finding settings"):
        found = find_settings(recorded, wanted)
    capture, grid = found.prepare(recorded), found.grid()
    shown = settings_to_dict(found)
    middle = [axis[[0, -1]].mean() for axis in (grid.x, grid.y, grid.z)]
    pulse = VirtualPulse(found.wavelength or 0.0, found.cycles)
    paths = capture.axis.paths
    shortest = find_shortest_wavelength(capture, found.cycles) / MILLIMETRE
    figures = {
        "wall": _describe_wall(capture),
        "laser": _describe_laser(capture),
        "record": {
            "bins": capture.axis.bins,
            "bin_width_ps": capture.bin_width / PICOSECOND,
            "path_per_bin_m": capture.axis.spacing,
            "first_path_m": paths[0],
            "last_path_m": paths[-1],
        },
        "wavelength_mm": {
            "shortest": shortest,
            "longest": find_longest_wavelength(capture) / MILLIMETRE,
            "chosen": shown["wavelength_mm"],
        },
        "gate": {"m": found.gate, "found": found.gate_found},
        "bins_together": found.bins_together,
        "method": found.method,
        "reasons": dict(found.reasons),
        "resolution_m": {**asdict(compute_diffraction_limit(capture, middle, pulse)), "at": middle},
        "box_m": dict(zip("xyz", found.box, strict=True)),
        "voxels": {"size_mm": shown["voxel_mm"], "shape": grid.shape},
        "truth": HiddenTruth.find(source) is not None,
    }
    memory, refused = try_methods(found, METHODS, capture, grid)
    suits: dict[str, dict[str, Any]] = {
        name: {"suits": True, "memory_mib": size / 2**20} for name, size in memory.items()
    }
    suits |= {name: {"suits": False, "reason": reason} for name, reason in refused.items()}
    note = ""
    if shown["wavelength_mm"] < shortest:
        note = "the wall samples the shortest wavelength at every angle, the chosen one at that of the brightest light"
    report({**figures, "methods": suits}, note=note)


def _describe_wall(capture: Capture) -> dict[str, Any]:
    from nlos.analysis import find_sampling_step
    from nlos.plane import PlanarWall

    try:
        # The class refuses any other wall, which is the test wanted here.
        PlanarWall.of(capture.points)
        shape = "planar lattice"
    except InputError:
        shape = "no planar lattice"
    width, height, relief = capture.points.max(axis=0) - capture.points.min(axis=0)
    return {
        "points": len(capture.points),
        "masked": capture.valid.size - len(capture.points),
        "shape": shape,
        "width_m": width,
        "height_m": height,
        "relief_m": relief,
        "step_m": find_sampling_step(capture),
    }


def _describe_laser(capture: Capture) -> str:
    from nlos.illumination import group_by_illumination

    parts = group_by_illumination(capture)
    # Confocal captures have a laser spot for each wall point, and none for the group.
    if parts[0].laser is None:
        return "confocal"
    if len(parts) > 1:
        return f"{len(parts)} spots"
    x, y, z = parts[0].laser
    return f"one spot at ({x:.3g}, {y:.3g}, {z:.3g}) m"


app.command()(demo)
