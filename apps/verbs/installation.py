"""First steps with an installation: `tofclip demo` simulates a shot, recovers it and compares with the
truth; `tofclip warm-up` compiles everything once; `tofclip doctor` says what this machine has of what
the program can use, and `tofclip plugins` which parts have names, ours and those of other packages.
"""

from __future__ import annotations

import contextlib
import importlib.metadata as metadata
import inspect
import io
import os
import platform
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import typer

from apps.cli import EXIT_INTERRUPTED
from apps.options import SEED, arg, opt
from apps.progress import show_activity, show_progress
from apps.report import PRINTS_JSON, make_folder, report, require_new, with_past
from devices.address import Options
from tofclip.errors import InputError
from tofclip.files import describe_missing_package
from tofclip.plugins import DENOISERS, METHODS, READERS, Parts, Reader, find_type, list_settings
from tofclip.units import PICOSECOND
from tofclip.version import __version__

NEEDED = ("numpy", "scipy", "numba", "h5py", "tifffile", "matplotlib", "PIL", "skimage", "viser")
"""Modules without which verbs stop; the others bring single formats, filters and windows."""
EXTRA = re.compile(r"extra == ['\"](\w+)")
NOT_FOR_VERBS = {"test", "lint", "docs", "all"}
EXIT_BROKEN, GIB = 1, 1 << 30


def doctor() -> None:
    """Say what this installation has: packages, GPU, USB, compiled loops, graphics, disk and memory.

    Optional packages that are missing are listed with the command that installs them. The exit
    status is 1 if a package that nearly every verb needs is missing or does not load.

    Example: tofclip doctor
    """
    with show_activity("looking around"):
        faults = [*_find_faults()]
        packages = dict(_list_packages())
        figures = {
            "tofclip": __version__,
            "python": platform.python_version(),
            "system": f"{platform.system()} {platform.release()} {platform.machine()}",
            "gpu": _ask(_find_gpu),
            "usb": _ask(_find_usb),
            "compiled_loops": _ask(_find_cache),
            "graphics": _ask(_find_graphics),
            "disk_free_gib": shutil.disk_usage(Path.cwd()).free / GIB,
            "memory_gib": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / GIB,
        }
    lists = {
        "packages": [f"{name} {found}" for name, found in packages.items() if "pip" not in found],
        "missing": [f"{name}: {found}" for name, found in packages.items() if "pip" in found],
        "faults": faults,
    }
    report({**figures, **(lists if PRINTS_JSON.get() else {})})
    for name, lines in {} if PRINTS_JSON.get() else lists.items():
        print(f"{name}:", *(lines or ["none"]), sep="\n  ")
    if faults:
        raise typer.Exit(EXIT_BROKEN)


def _ask(question: Callable[[], str]) -> str:
    """Answer, or say why there is none: a broken library, of any exception, is what one looks for."""
    try:
        return question()
    except Exception as fault:
        return " ".join(str(fault).split()) or type(fault).__name__


def _find_faults() -> Iterator[str]:
    for name in NEEDED:
        try:
            import_module(name)
        except Exception as fault:
            said = describe_missing_package(fault) if isinstance(fault, ImportError) else None
            yield said or f"{name} does not load: {fault}"


def _list_packages() -> Iterator[tuple[str, str]]:
    """Yield each package that the program can use, with its version or the command that installs it."""
    from packaging.requirements import Requirement

    for one in map(Requirement, metadata.requires("tofclip") or ()):
        extra = (EXTRA.findall(str(one.marker)) or [""])[0]
        if extra in NOT_FOR_VERBS or (one.marker and not one.marker.evaluate({"extra": extra})):
            continue
        try:
            yield one.name, metadata.version(one.name)
        except metadata.PackageNotFoundError:
            wanted = f"'tofclip[{extra}]'" if extra else one.name
            yield one.name, f"pip install {wanted}"


def _find_gpu() -> str:
    from tofclip.arrays import parse_device

    return str(parse_device("auto")).replace("cpu", "none through CuPy or PyTorch")


def _find_usb() -> str:
    from devices import discover
    from devices.usb import system_backend

    system_backend()
    found = [f"{one.uri} {one.note}" for one in discover()]
    return f"libusb loads; {', '.join(found) or 'no instruments are connected'}"


def _find_cache() -> str:
    from tofclip.operators.kernels import project_onto_lines

    place = project_onto_lines.stats.cache_path or "nowhere"
    note = "writable" if os.access(place, os.W_OK) else "name a writable folder in NUMBA_CACHE_DIR"
    warm = any(Path(place).glob("*.nbi"))
    return f"{place}, {note}, {'warm' if warm else 'cold: tofclip warm-up fills it'}"


def _find_graphics() -> str:
    from apps.viewer.still import DISPLAY_VARIABLES, has_working_graphics

    drawn = "PyVista draws" if has_working_graphics() else "PyVista cannot draw, --png can"
    shown = any(map(os.environ.get, DISPLAY_VARIABLES)) or platform.system() != "Linux"
    return f"{drawn}; {'a' if shown else 'no'} display for view --desktop"


VIEW_ANGLES_DEG = (-43.0, -26.0, -13.0, 0.5, 23.0, 37.0, 48.0)
VIEW_PITCH_PX, IMAGE_SHAPE = 40.0, (24, 24)
ROWS, PULSE_ROWS, BIN_WIDTH_S = 64, 1.3, 20 * PICOSECOND
HIDDEN_SCENE = "--letters T --facet-mm 100 --wall-width-m 0.8 --wall-points 12 --bin-width-ps 16"
IMAGINGS = (
    ("planar", "single", ("rsd", "hybrid", "backprojection", "filtered-backprojection")),
    ("planar", "confocal", ("lct", "fk", "backprojection")),
    ("cylinder", "single", ("hybrid", "backprojection")),
)
"""Walls, scans, and the methods to run on them."""


def warm_up() -> None:
    """Run everything that is compiled on first use once, on small data.

    Compiled code is kept beside the program, or in NUMBA_CACHE_DIR; later runs load it. After an
    update, or on a machine with another processor, it is compiled anew.

    Example: tofclip warm-up
    """
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        steps = list_steps()
        _save_shots(Path(folder))
        with show_progress("compiling", len(steps)) as advance:
            for step in steps:
                words = [word.replace("@", f"{folder}/") for word in step.split()]
                _run_quietly([*words, "--overwrite"])  # steps write under the same names
                advance(1)
    report({"steps": len(steps), "seconds": time.perf_counter() - started})


def list_steps() -> list[str]:
    """Commands that between them call every compiled function; ``@`` stands for a folder."""
    recovery = "recover @shots/first.h5 --out @frames.h5 --method"
    steps = [f"{recovery} {method} --iterations 2" for method in ("tv", "l1", "surfaces")]
    steps += [
        f"{recovery} linear",
        f"{recovery} adjoint",
        "cloud @frames.h5 --out @cloud.ply",
        "lidar accuracy --trials 10",
        "lidar sequence @shots --out @clouds",
        "demo --out @demo",
    ]
    for wall, scan, methods in IMAGINGS:
        capture = f"@{wall}_{scan}.h5"
        steps.append(f"nlos simulate --wall {wall} --scan {scan} {HIDDEN_SCENE} --out {capture}")
        steps += [
            f"nlos reconstruct {capture} --method {method} --voxel-mm 50 --out @{method}.h5"
            for method in methods
        ]
    return steps


def _save_shots(folder: Path) -> None:
    """Write two small shots of a bright square, whose sweep and gains are not known."""
    import numpy as np

    from tofclip.camera import Camera
    from tofclip.shots import Streak

    centres = VIEW_PITCH_PX * (0.5 + np.arange(len(VIEW_ANGLES_DEG), dtype=np.float64))
    angles = np.deg2rad(np.array(VIEW_ANGLES_DEG))
    camera = Camera(centres, angles, IMAGE_SHAPE, round(VIEW_PITCH_PX * centres.size))
    frames = np.zeros((*IMAGE_SHAPE, ROWS), np.float32)
    pulse = np.exp(-(((np.arange(ROWS) - ROWS / 2) / PULSE_ROWS) ** 2) / 2)
    frames[8:16, 8:16] = 100 * pulse.astype(np.float32)
    expected = camera.operator()(frames).T + 20
    (folder / "shots").mkdir()
    for seed, name in enumerate(("first", "second")):
        counts = np.random.default_rng(seed).poisson(expected).astype(np.float32)
        streak = Streak(counts, camera=camera).with_bin_width(BIN_WIDTH_S)
        streak.save(folder / "shots" / f"{name}.h5")


def _run_quietly(words: list[str]) -> None:
    """Run a command without its output."""
    from apps.cli import main

    messages = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(messages):
        status = main(words)
    if status == EXIT_INTERRUPTED:
        raise KeyboardInterrupt
    if status != os.EX_OK:
        last = messages.getvalue().strip().splitlines()[-1:] or ["no message"]
        raise InputError(
            f"{' '.join(words[:2])} failed: {last[0].removeprefix('tofclip: error: ')}"
        )


BORDER_PX = 12  # views leave the slit there, so the picture's rim is not scored


def demo(
    out: Path = opt("DIR", "Folder for the results; made if missing.", Path("demo-output")),
    seed: int = SEED,
) -> None:
    """Simulate a scene of letters and plates, recover it from one streak image, and compare with
    the truth.

    Skew, gains and slit centres are found from the shot itself. Surfaces are recovered from the whole shot at
    once; the picture shows them beside total variation of each frame. Writes streak.h5, frames.h5,
    cloud.ply and preview.png. The first run on a machine compiles the loops that it needs, once.

    Example: tofclip demo --out demo-output
    """
    from apps.figures.shot import make_demo_figure
    from tofclip import simulate
    from tofclip.lidar import depth, point_cloud
    from tofclip.metrics import nmse
    from tofclip.notebook import save_figure
    from tofclip.recovery import open_shot, plan_recovery

    started = time.perf_counter()
    make_folder(out)
    written = [out / name for name in ("streak.h5", "frames.h5", "cloud.ply", "preview.png")]
    require_new(*written)
    scene, instrument = simulate.make_default_scene(), simulate.make_default_instrument()
    shot = simulate.simulate_shot(scene, instrument, seed)
    streak = replace(shot.streak, camera=simulate.make_nominal_camera(shot.camera))
    surfaces = plan_recovery(open_shot(streak), "surfaces")
    with show_progress("recovering", surfaces.work) as advance:
        frames = surfaces.run(advance)
    # The sweep found by the first recovery serves the second, so that only the methods differ.
    by_frames = plan_recovery(open_shot(streak, frames.camera), "tv")
    with show_progress("for comparison", by_frames.work) as advance:
        compared = by_frames.run(advance)
    frames = with_past(frames, {"verb": "demo", "seed": seed})
    returns = depth(frames)
    cloud = point_cloud(returns)
    streak.save(written[0])
    frames.save(written[1])
    cloud.save(written[2])
    figure = make_demo_figure(streak, frames, returns, cloud, shot.truth, compared)
    save_figure(figure, written[3])
    # Light of all instants together: the picture a camera without time of flight would take.
    picture = frames.values.sum(axis=0)
    truth = simulate.render_true_frames(scene, instrument, shot.exposure).values.sum(axis=0)
    figures = {
        "seed": seed,
        **simulate.score_returns(returns, shot.truth),
        "image_nmse": nmse(picture, truth),
        "image_nmse_inner": nmse(picture, truth, BORDER_PX),
        "relative_residual": frames.figures["relative_residual"],
        "points": len(cloud),
        "seconds": time.perf_counter() - started,
    }
    report(figures, written)


TEXT_WIDTH = 70  # columns, of a part's meaning in the list of all


def plugins(
    name: str | None = arg("NAME", "Of one part: show its settings.", None),
) -> None:
    """List methods, denoisers, readers and instruments, by whom they are, and what does not load.

    A package adds its own by entry points; docs/extending.md has a template. Of one part this shows
    what it is and the settings that --set takes, with their defaults.

    Example: tofclip plugins

    Example: tofclip plugins red
    """
    shown = [one for one in list_parts() if name in (None, one["name"])]
    if not shown:
        raise InputError(f"no part is called '{name}'; tofclip plugins lists them all")
    if PRINTS_JSON.get():
        report({"parts": shown})
        return
    width = max(len(one["name"]) for one in shown)
    for one in shown:
        text = one["fault"] or (one["meaning"] if name else shorten(one["meaning"]))
        print(f"{one['group']:<18}{one['name']:<{width}}  {one['origin']:<12}  {text}")
        for setting in one["settings"] if name else ():
            lead = "?" if one["group"] == "tofclip.sources" else "--set "
            print(f"    {lead}{setting['name']}={setting['default']}")


def shorten(text: str) -> str:
    """Cut a text where a word, or a value of an address, ends.

    Examples
    --------
    >>> shorten("Half-quadratic splitting with a denoiser in the place of the prior's proximal map.")
    "Half-quadratic splitting with a denoiser in the place of the ..."
    """
    if len(text) <= TEXT_WIDTH:
        return text
    found = re.match(rf".{{,{TEXT_WIDTH - 4}}}(?=[ &?])", text)
    return f"{found[0] if found else text[: TEXT_WIDTH - 4]} ..."


def list_parts() -> Iterator[dict[str, Any]]:
    """Describe every part; `fault`: why it cannot be used, where it cannot."""
    from devices.registry import CODECS, FINDERS, SOURCES
    from nlos.io.format_detection import READERS as CAPTURE_READERS
    from nlos.settings import METHODS as HIDDEN_SCENE_METHODS

    streaks = METHODS, DENOISERS, READERS, SOURCES, FINDERS, CODECS
    for parts in (*streaks, HIDDEN_SCENE_METHODS, CAPTURE_READERS):
        for name in parts:
            known = {"group": parts.group, "name": name, "origin": parts.get_origin(name)}
            yield known | _describe(parts, name)
        for name, package in parts.list_unused():
            fault = f"not used: {parts.get_origin(name)} has this name already"
            known = {"group": parts.group, "name": name, "origin": package}
            yield known | NOTHING_KNOWN | {"fault": fault}


NOTHING_KNOWN: dict[str, Any] = {"fault": "", "meaning": "", "settings": []}


def _describe(parts: Parts, name: str) -> dict[str, Any]:
    try:
        part = parts[name]
    except InputError as fault:
        return NOTHING_KNOWN | {"fault": str(fault)}
    makes = parts.kind in ("method", "denoiser", "codec")  # the others are used as they are
    known = list_settings(part) if makes else {}
    settings = [
        {"name": one, "default": _show_default(value)}
        for one, value in known.items()
        if find_type(value)
    ]
    if inspect.isfunction(part):  # an opener: the options that it reads an address by
        used = inspect.getclosurevars(part).globals.values()
        settings += [
            {"name": entry.name, "default": str(entry.default)}
            for one in used
            if inspect.isclass(one) and issubclass(one, Options)
            for entry in one.declared()
        ]
    explained = part.read if isinstance(part, Reader) else part
    meaning = (inspect.getdoc(explained) or "").split("\n\n")[0]
    return NOTHING_KNOWN | {"meaning": " ".join(meaning.split()), "settings": settings}


def _show_default(setting: inspect.Parameter) -> str:
    if setting.default is setting.empty:
        return "needed"
    return "its own" if "factory" in str(setting.default) else str(setting.default)
