"""What the verbs around corners share: captures on disk, and captures imaged as settings ask, under a bar
and with a watch on time and memory. `tofclip nlos compare`, `simulate` and `demo`: several methods side
by side, captures of known hidden scenes, and both together.
"""

from __future__ import annotations

import contextlib
import ctypes
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from apps.options import (
    PICTURE_FORMATS,
    SEED,
    SETTINGS,
    arg,
    find_key,
    opt,
    save_settings,
    settings_to_dict,
    take_settings,
)
from apps.progress import show_activity, show_progress
from apps.report import (
    RECORD_SUFFIXES,
    make_folder,
    place_settings,
    report,
    require_new,
    require_writable,
    say,
    with_past,
)
from nlos.settings import (
    METHODS,
    METHODS_BY_SPEED,
    SceneSettings,
    Settings,
    declare_setting,
    list_taken,
)
from tofclip.errors import InputError, require_known
from tofclip.files import PICTURE_SUFFIXES, require_apart

if TYPE_CHECKING:
    from nlos import Capture, Grid, Method, Plan, Volume
    from nlos.imaging import PreparedImaging
    from nlos.known_scenes import HiddenTruth
    from tofclip.arrays import ComputeDevice

PORTABLE_METHODS = METHODS_BY_SPEED
"""They compute wherever the signal is; the others have compiled loops only."""

CAPTURE = arg("CAPTURE", "Recovered frames of a relay wall, or a capture.", read=True)

PULSE_SETTINGS = {"wavelength", "cycles"}
CAPTURE_SUFFIXES = (".h5", ".hdf5", ".npz", ".mat")
GEOMETRY_FILE = "geometry.toml"
"""Makes a folder of renderings one capture; see `nlos.io`."""

WARM_UP_VOXELS = 8


@dataclass(frozen=True)
class ImagingSettings(Settings):
    """Settings of imaging where the verb does not let a method be named."""

    method: str | None = None
    set: list[str] | None = None


Imaging = TypeVar("Imaging", bound=Settings)


def is_capture_folder(source: Path) -> bool:
    """Whether a path names a folder, and one that is not itself a capture."""
    return source.is_dir() and not (source / GEOMETRY_FILE).is_file()


def list_captures(folder: Path, may_be_empty: bool = False) -> list[Path]:
    """List the captures of a folder; one that is waited for may be empty yet."""
    found = sorted(
        path
        for path in folder.iterdir()
        if not path.name.startswith(".")
        and (path.suffix.lower() in CAPTURE_SUFFIXES or (path / GEOMETRY_FILE).is_file())
    )
    if not found and not may_be_empty:
        raise InputError(
            f"{folder}: no capture is in there ({', '.join(CAPTURE_SUFFIXES)}, or folders of renderings)"
        )
    names: dict[str, Path] = {}
    for path in found:
        other = names.setdefault(path.stem, path)
        if other is not path:
            raise InputError(
                f"{folder}: {other.name} and {path.name} would have results of one name; rename one"
            )
    return found


def parse_method_names(text: str) -> tuple[str, ...]:
    """Split a list of methods at its commas, refusing unknown names and repetitions."""
    names = tuple(name.strip() for name in text.split(","))
    for name in names:
        require_known("method", name, METHODS)
    if len(set(names)) < len(names):
        raise InputError(f"a method is named twice in '{text}'")
    return names


def choose_methods(method: str | None, usual: Sequence[str]) -> Sequence[str]:
    """Return the methods that may image a capture: the one that is named, or the usual ones."""
    names = usual if method is None else parse_method_names(method)
    if method is not None and len(names) > 1:
        one = f"one method images a stream or a capture, got '{method}'"
        raise InputError(f"{one}; nlos compare takes several")
    return names


def require_valid_settings(settings: Settings, methods: Sequence[str]) -> None:
    """Refuse settings of which nothing could be made, and those that none of the methods takes."""
    for name in sorted(_list_own_settings(METHODS.own) - _list_own_settings(methods)):
        if getattr(settings, name) is not None:
            by = ", ".join(one for one in METHODS.own if name in list_taken(one))
            raise InputError(
                f"{find_key(type(settings), name)} is a setting of {by} and changes nothing for "
                f"{', '.join(methods)}; leave it out"
            )
    if settings.flip not in (None, "x", "y"):
        raise InputError(f"flip is x or y, got '{settings.flip}'")
    if settings.wavelength is None:
        settings = replace(settings, wavelength=1.0)
    for name in methods:
        settings.make_method(name)


def _list_own_settings(methods: Iterable[str]) -> set[str]:
    return {name for one in methods for name in list_taken(one)} - PULSE_SETTINGS


def try_methods(
    found: Settings, methods: Iterable[str], capture: Capture, grid: Grid
) -> tuple[dict[str, int], dict[str, str]]:
    """Return the memory, bytes, of methods that suit a capture, and why others do not."""
    memory, refused = {}, {}
    for name in methods:
        try:
            memory[name] = found.make_method(name).plan(capture, grid).memory_bytes
        except InputError as refusal:
            refused[name] = str(refusal)
    return memory, refused


def show_settings(found: Imaging, methods: Sequence[str]) -> Imaging:
    """Return the settings as they are written beside a result: what the methods' classes take where
    nothing is given is named, and what none of the methods takes is left out.
    """
    made: dict[str, Any] = {
        name: getattr(found.make_method(one), name, getattr(found, name))
        for one in methods
        for name in _list_own_settings([one])
    }
    shown: dict[str, Any] = dict.fromkeys(_list_own_settings(METHODS.own))
    return replace(found, **shown | made)


def prepare_imaging(
    recorded: Capture, wanted: Imaging, device: ComputeDevice | None = None
) -> PreparedImaging[Imaging]:
    """Do what `nlos.imaging.prepare_imaging` does, under a progress bar."""
    from nlos import imaging
    from nlos.band import Band, VirtualPulse
    from nlos.illumination import describe_aliasing

    with show_activity("finding settings"):
        wanted = imaging.complete_settings(recorded, wanted)
    prepared = imaging.prepare_imaging(recorded, wanted, device, image_capture)
    found, capture = prepared.settings, prepared.capture
    is_taken = "wavelength" in list_taken(found.method or METHODS_BY_SPEED[0])
    # One that was found was so with the wall's sampling in mind; a given one may make false images.
    if found.wavelength is not None and "wavelength" not in found.reasons and is_taken:
        band = Band(VirtualPulse(found.wavelength, found.cycles), capture.axis)
        if text := describe_aliasing(capture, band):
            say("warning", text)
    return prepared


def image_capture(title: str, plan: Plan, capture: Capture) -> Volume:
    """Image the hidden scene under a bar that counts look-ups or voxels."""
    with show_progress(title, plan.cost) as advance:
        return plan.image(capture, advance)


@dataclass(frozen=True, eq=False)
class MeasuredVolume:
    """A volume and what it cost."""

    volume: Volume
    seconds: float  # wall-clock time of the imaging, without compiling
    # most memory that the program took at a time beyond what it had before; None where the system
    # does not show
    peak_mib: float | None


def measure_imaging(name: str, imaging: Method, capture: Capture, grid: Grid) -> MeasuredVolume:
    """Image the hidden scene, and measure time and memory, without loading the compiled loops."""
    from nlos import Grid
    from tofclip.sequences.jobs import measure_peak_memory_bytes

    few = slice(WARM_UP_VOXELS)
    with show_activity(f"{name}: loading its loops"):
        imaging.reconstruct(capture, Grid(grid.x[few], grid.y[few], grid.z[:1]))
    before = _reset_peak_memory()
    started = time.perf_counter()
    volume = image_capture(name, imaging.plan(capture, grid), capture)
    seconds = time.perf_counter() - started
    taken = None if before is None else max(0, measure_peak_memory_bytes() - before) / 2**20
    return MeasuredVolume(volume, seconds, taken)


def _reset_peak_memory() -> int | None:
    """Let the system forget the most memory ever taken; return what is taken now, bytes."""
    from tofclip.sequences.jobs import measure_peak_memory_bytes

    # The C library keeps what was given back for later; what is taken from there again would not be
    # seen.
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # Linux only: see proc(5)
    except OSError:
        return None
    return measure_peak_memory_bytes()


WALL_SHAPE, WALL_POINTS = "cylinder", 64
FACET_M = 0.03
LETTERS = (("3", -0.27, 0.9, 0.5), ("D", 0.27, 1.15, 1.0))
"""Of the demonstration: text, x and depth in m, and albedo: the nearer one is of grey paper, or it
would outshine the other.
"""

LETTER_HEIGHT_M = 0.62
BINS, BIN_WIDTH_S, JITTER_S = 480, 32e-12, 25e-12
PEAK_COUNTS, BACKGROUND_COUNTS = 200.0, 0.5
WAVELENGTH_M, VOXEL_M = 0.125, 0.012
BOX_M = ((-0.8, 0.8), (-0.5, 0.5), (0.72, 1.32))


@dataclass(frozen=True)
class CompareSettings(ImagingSettings):
    """What is compared on one capture."""

    methods: str | None = declare_setting(
        "",
        f"Of {', '.join(METHODS.own)}; the first is the reference.",
        shown="all that suit the capture",
        choices=METHODS,
    )


@take_settings(CompareSettings)
def compare(
    wanted: CompareSettings,
    source: Path = CAPTURE,
    out: Path = opt("PNG", f"The picture to write: {PICTURE_FORMATS}.", ...),
    volumes: Path | None = opt("DIR", "Folder for the volumes, one file per method."),
    settings: Path | None = SETTINGS,
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
    from apps.figures.nlos import make_comparison_figure
    from nlos import known_scenes
    from nlos.io import read_capture
    from tofclip.notebook import save_figure

    written = [out, place_settings(out, *PICTURE_SUFFIXES, inputs=(source, settings))]
    # Everything that can be refused is refused before the capture is read.
    names = tuple(METHODS.own) if wanted.methods is None else parse_method_names(wanted.methods)
    require_valid_settings(wanted, names)
    if volumes is not None:
        require_apart([volumes, *(volumes / f"{name}.h5" for name in METHODS)], [source, settings])
        make_folder(volumes)
    capture, truth = read_capture(source), known_scenes.HiddenTruth.find(source)
    # The voxels are those of the virtual pulse, for all methods alike.
    prepared = prepare_imaging(capture, wanted)
    ours, grid = prepared.capture, prepared.grid
    chosen, left_out = try_methods(prepared.settings, names, ours, grid)
    # A method that was named must not vanish silently; of all methods, one has to remain.
    if left_out and (wanted.methods is not None or not chosen):
        name, reason = next(iter(left_out.items()))
        raise InputError(f"{name} does not suit this capture: {reason}")
    runs: dict[str, MeasuredVolume] = {}
    figures: dict[str, dict[str, Any]] = {}
    for name in chosen:
        method = prepared.settings.make_method(name)
        runs[name] = run = measure_imaging(name, method, ours, grid)
        figures[name] = {
            "seconds": run.seconds,
            "peak_mib": run.peak_mib,
            "correlation": known_scenes.correlate_views(
                run.volume, next(iter(runs.values())).volume
            ),
            "sharpness": known_scenes.measure_sharpness(run.volume),
            **({} if truth is None else known_scenes.compare_with_truth(run.volume, truth)),
        }
    images = {name: run.volume for name, run in runs.items()}
    save_figure(make_comparison_figure(images, figures, truth), out)
    found = replace(show_settings(prepared.settings, [*chosen]), methods=",".join(chosen))
    for name, volume in images.items():
        if volumes is not None:
            past = {"verb": "nlos compare", "method": name, **settings_to_dict(found)}
            written.append(volumes / f"{name}.h5")
            with_past(volume, past, source).save(written[-1])
    save_settings(found, written[1], "tofclip nlos compare CAPTURE --settings THIS --out PICTURE")
    report({"voxels": grid.shape, "methods": figures, "left_out": left_out}, written)


@take_settings(SceneSettings)
def simulate(
    chosen: SceneSettings,
    out: Path = opt("H5", "The capture to write.", ...),
    settings: Path | None = SETTINGS,
) -> None:
    """Simulate the capture of a known hidden scene before a relay wall.

    Letters and meshes hide what is behind them; light that meets several surfaces is left out. The
    capture carries the truth, for nlos compare. The settings are written beside it (.toml).

    Example: tofclip nlos simulate --letters T --wall cylinder --wall-points 32 --out capture.h5
    """
    from nlos.known_scenes import simulate_scene

    inputs = [Path(path) for path in (settings, chosen.mesh) if path]
    beside = place_settings(out, *RECORD_SUFFIXES, inputs=inputs)
    started = time.perf_counter()
    capture, truth = simulate_scene(chosen)
    capture = with_past(capture, {"verb": "nlos simulate", **settings_to_dict(chosen)}, *inputs)
    truth.attach_to_record(capture).save(out)
    save_settings(chosen, beside, "tofclip nlos simulate --settings THIS --out CAPTURE")
    figures = {
        "wall_points": len(capture.points),
        "bins": capture.axis.bins,
        "path_m": [capture.axis.paths[0], capture.axis.paths[-1]],
        "hidden_facets": len(truth.positions),
        "largest": capture.signal.max(),
        "total": capture.signal.sum(dtype="float64"),
        "seconds": time.perf_counter() - started,
    }
    report(figures, [out, beside])


def demo(
    out: Path = opt("DIR", "Folder for the results; made if missing.", Path("nlos-demo-output")),
    png: Path | None = opt(
        "PNG", f"The picture to write: {PICTURE_FORMATS}.", shown="nlos_demo.png in --out"
    ),
    seed: int = SEED,
) -> None:
    """Hide two characters before a curved wall, simulate what the wall shows, and image them by two
    methods.

    The hybrid method and back-projection give the same picture; the times are those of this run, on
    this machine. As if the wall were flat, the same signal gives none. Writes capture.h5,
    hybrid.h5, backprojection.h5 and the picture.

    Example: tofclip nlos demo --out nlos-demo-output
    """
    from apps.figures.nlos import make_demo_figure
    from nlos import Backprojection, Grid, Hybrid
    from nlos.known_scenes import compare_with_truth, correlate_views
    from tofclip.notebook import save_figure

    started = time.perf_counter()
    make_folder(out)
    picture = out / "nlos_demo.png" if png is None else png
    # Before the simulation and three images, which take a while.
    require_writable(picture, *PICTURE_SUFFIXES)
    written = [out / f"{name}.h5" for name in ("capture", "hybrid", "backprojection")]
    require_new(*written)
    with show_activity("simulating"):
        capture, truth = _simulate_letters(seed)
    capture = with_past(capture, {"verb": "nlos demo", "seed": seed})
    # The same signals with the curve ignored show what knowing the wall is worth.
    wall, laser = capture.wall.copy(), capture.laser.copy()
    wall[..., 2] = laser[..., 2] = 0.0
    flat = replace(capture, wall=wall, laser=laser)
    grid, hybrid = Grid.box(*BOX_M, VOXEL_M), Hybrid(WAVELENGTH_M)
    slow = Backprojection(WAVELENGTH_M)
    images = {
        "hybrid": measure_imaging("hybrid", hybrid, capture, grid),
        "backprojection": measure_imaging("backprojection", slow, capture, grid),
        "flat": measure_imaging("as if flat", hybrid, flat, grid),
    }
    volumes = {name: image.volume for name, image in images.items()}
    truth.attach_to_record(capture).save(written[0])
    for path in written[1:]:
        volumes[path.stem].save(path)
    save_figure(make_demo_figure(capture, truth, volumes), picture)
    figures = {
        "seed": seed,
        "wall_points": len(capture.points),
        "voxels": grid.shape,
        **{
            name: {
                "seconds": image.seconds,
                "peak_mib": image.peak_mib,
                "correlation": correlate_views(image.volume, volumes["backprojection"]),
                **compare_with_truth(image.volume, truth),
            }
            for name, image in images.items()
        },
        "times_faster": images["backprojection"].seconds / images["hybrid"].seconds,
        "seconds": time.perf_counter() - started,
    }
    report(figures, [*written, picture])


def _simulate_letters(seed: int) -> tuple[Capture, HiddenTruth]:
    import numpy as np

    from nlos.capture import TimeAxis
    from nlos.known_scenes import HiddenTruth, find_nearest_wall_point
    from nlos.simulate import HiddenScene, Lambert, Surface, add_poisson_noise, build_relay_wall

    surfaces = [
        Surface.letters(text, (x, 0.0, z), LETTER_HEIGHT_M, FACET_M, Lambert(albedo))
        for text, x, z, albedo in LETTERS
    ]
    wall = build_relay_wall(WALL_SHAPE, WALL_POINTS)
    spot = find_nearest_wall_point(wall, (0.0, 0.0))
    axis = TimeAxis(BINS, BIN_WIDTH_S)
    expected = HiddenScene(surfaces).simulate_capture(wall, spot, axis, JITTER_S)
    truth = HiddenTruth(np.concatenate([surface.positions for surface in surfaces]), FACET_M)
    return add_poisson_noise(expected, PEAK_COUNTS, BACKGROUND_COUNTS, seed), truth
