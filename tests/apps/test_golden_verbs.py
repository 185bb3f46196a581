"""What the command line promises: every verb's words and the keys of its `--json`, in one file.

A line of `golden/verbs.txt` is an argument, an option or a key. Whoever adds or takes away one
changes the file by hand; the failure names the lines.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from verb_pages import collect_verbs

from apps.cli import main
from tofclip.camera import Camera, SkewSweep
from tofclip.io.light_fields import write_light_field
from tofclip.light_field import LightField
from tofclip.simulate import Instrument, Scene, StreakDetector, make_plate, simulate_shot
from tofclip.simulate.patterns import make_checkerboard

pytestmark = pytest.mark.xdist_group("golden")

GOLDEN = Path(__file__).parents[1] / "golden" / "verbs.txt"
VERBS = collect_verbs()
NOT_RUN = {
    "warm-up": "compiles every loop of the program; test_warm_up holds its keys",
}
"""Verbs whose keys are not recorded, and why."""

TAGGER = "sim+timetag://?seed=1&rate=1e5"
STREAMING = "sim+remoteex://?seed=1&scene=small&frame_rate=40"
COARSE = ("--voxel-mm", 60)


def name_type(annotation: Any) -> str:
    return annotation.__name__ if isinstance(annotation, type) else str(annotation)


def list_options(verb: str) -> Iterator[str]:
    """One line for each argument and option of a verb."""
    for param in VERBS[verb].get_params(typer.Context(VERBS[verb], info_name=verb)):
        if param.name == "help":
            continue
        is_option = param.param_type_name == "option"
        words = [*param.opts, *param.secondary_opts] if is_option else []
        words += [param.metavar] if param.metavar else []
        words.append(name_type(param.type_descriptor.annotation))
        limits = [
            f"{name} {value}"
            for name in ("min", "max")
            if (value := getattr(param, name)) is not None
        ]
        repeated = ["repeated"] if getattr(param, "multiple", False) or param.nargs == -1 else []
        default = str(param.default) if isinstance(param.default, Path) else param.default
        needed = "required" if param.required else f"default {default!r}"
        yield f"{verb}: {' '.join([*words, *limits, *repeated])}, {needed}"


def list_keys(value: Any, path: str = "") -> Iterator[str]:
    """The keys of nested mappings, without values; what stands in lists counts once."""
    if isinstance(value, dict):
        for key, entry in value.items():
            yield f"{path}{key}"
            # which libraries a machine has is its own affair
            if key != "libraries":
                yield from list_keys(entry, f"{path}{key}.")
    elif isinstance(value, list):
        for entry in value:
            yield from list_keys(entry, f"{path.removesuffix('.')}[].")


def run_verb(verb: str, *words: object, status: int = 0) -> dict[str, Any]:
    """Run a verb with --json; standard output must hold the object and nothing else."""
    called = [*verb.split(), *map(str, words), "--json"]
    with (
        contextlib.redirect_stdout(io.StringIO()) as out,
        contextlib.redirect_stderr(io.StringIO()) as err,
    ):
        ended = main(called)
    assert ended == status, f"{called}: {err.getvalue()}"
    found: dict[str, Any] = json.loads(out.getvalue())
    return found


def copy_twice(file: Path, folder: Path) -> Path:
    folder.mkdir()
    for number in range(2):
        shutil.copy(file, folder / f"{number}.h5")
    return folder


def run_streaks(folder: Path, files: Path) -> Iterator[tuple[str, tuple[object, ...]]]:
    """From focus pictures and shots to frames, clouds and objects."""
    pictures = ("line", "line_background", "dot", "dot_background")
    flags = [(f"--{name.replace('_', '-')}", files / f"{name}.tif") for name in pictures]
    yield "calibrate", (*itertools.chain(*flags), "--out", folder / "camera.h5")
    shots = copy_twice(files / "streak.h5", folder / "shots")
    quick = ("--method", "l1", "--iterations", 3)
    frames = folder / "frames.h5"
    yield "recover", (files / "streak.h5", "--out", frames, *quick)
    yield "recover", (files / "streak.h5", "--out", folder / "f.h5", "--method", "linear")
    yield "recover", (shots, "--out", folder / "frames", *quick)
    yield "cloud", (frames, "--out", folder / "clouds.ply")
    yield "cloud", (folder / "frames", "--out", folder / "clouds")
    yield "lidar scene", (frames, "--out", folder / "scene.png", "--fewest-points", 5)
    yield "lidar sequence", (shots, "--out", folder / "sequence")
    yield "lidar bag", (folder / "clouds", "--out", folder / "clouds.mcap")
    yield "view", (folder / "clouds.ply", "--png", folder / "cloud.png")
    yield "convert", (files / "wall.h5", "--out", folder / "wall.h5")
    for file in (files / "streak.h5", files / "camera.h5", frames, folder / "clouds.ply"):
        yield "info", (file,)
    yield "stream", (STREAMING, "--shots", 2, "--out", folder / "streamed")
    made = simulate_shot(SCENE, Instrument(CAMERA, StreakDetector(180, 100e-12)), seed=0)
    made.streak.save(folder / "deep.h5")
    yield "lidar parallax", (folder / "deep.h5", "--out", folder / "locked.h5", "--gates", 3)


CENTRES = 40.0 + 60 * np.arange(5)
CAMERA = Camera(
    CENTRES,
    np.arctan([0.5, -0.8, 0.9, -0.4, 0.1]),
    (32, 32),
    320,
    sweep=SkewSweep(CENTRES, np.zeros(5), np.zeros(5)),
    time_zero=-2e-9,
    pulse_fwhm=300e-12,
    focal_length_px=100.0,
    lenslet_pitch=10e-3,
    focus_distance=1.3,
)
SCENE = Scene(
    tuple(
        make_plate((place, place, distance), (0.09, 0.09), make_checkerboard(3, 0.1, 0.9))
        for distance, place in ((0.8, -0.07), (1.3, 0.0), (2.0, 0.18))
    )
)


def run_photons(folder: Path) -> Iterator[tuple[str, tuple[object, ...]]]:
    """Histograms of photons, and instruments made of software."""
    noise = np.random.default_rng(0)
    cube = noise.poisson(0.03, (12, 14, 100))
    cube[:, :, 40:46] += noise.poisson(2.0, (12, 14, 6))
    np.save(folder / "cube.npy", cube.astype(np.uint8))
    words = ("--bin-width-ps", 80, "--pulse-ps", 400)
    yield "lidar photons", (folder / "cube.npy", "--out", folder / "range.npz", *words)
    yield (
        "calibrate range",
        ("--target-m", 0.5, folder / "cube.npy", "--out", folder / "late.h5", *words),
    )
    yield "info", (folder / "cube.npy",)
    yield "lidar accuracy", ("--trials", 10)
    yield "devices list", ()
    yield "devices info", (TAGGER,)
    yield "devices test", (TAGGER, "--seconds", 0.1)
    yield "record", (TAGGER, "--out", folder / "run.h5", "--seconds", 0.1)
    yield "devices verify", (folder / "run.h5",)
    yield "devices repair", (folder / "run.h5", "--out", folder / "sound.h5")
    yield "info", (folder / "run.h5",)


def run_corners(
    folder: Path, curved: Path, confocal: Path
) -> Iterator[tuple[str, tuple[object, ...]]]:
    """A hidden point before a curved wall and before a planar one."""
    wall = ("--wall-points", 12, "--wall-width-m", 0.8, "--bin-width-ps", 32)
    scene = ("--points", "0.1,-0.05,0.6", *wall)
    yield "nlos simulate", (*scene, "--out", folder / "capture.h5")
    yield "nlos info", (confocal,)
    volume = folder / "volume.h5"
    yield "nlos reconstruct", (confocal, "--method", "rsd", "--out", volume, *COARSE)
    yield (
        "nlos reconstruct",
        (
            confocal,
            "--method",
            "lct",
            "--out",
            folder / "lct.h5",
            *COARSE,
            "--surface",
            folder / "surface.ply",
        ),
    )
    refined = (confocal, "--refine", "l1", "--iterations", 2, "--out", folder / "refined.h5")
    yield "nlos reconstruct", (*refined, "--voxel-mm", 40)
    captures = copy_twice(curved, folder / "captures")
    yield "nlos reconstruct", (captures, "--out", folder / "volumes", *COARSE)
    yield "nlos stream", (captures, "--out", folder / "imaged", *COARSE)
    yield (
        "nlos compare",
        (confocal, "--methods", "rsd,fk", "--out", folder / "compare.png", *COARSE),
    )
    yield "nlos film", (curved, "--instants", 3, "--out", folder / "film.gif", *COARSE)
    yield "info", (volume,)
    yield "info", (confocal,)


def run_light_fields(folder: Path) -> Iterator[tuple[str, tuple[object, ...]]]:
    """A bright square before a dark ground, 4 x 4 views."""
    views = np.array([(v, u) for v in range(-2, 2) for u in range(-2, 2)], float)
    y, x = np.mgrid[:40, :40]
    pictures = [0.2 + (abs(y + v - 20) < 7) * (abs(x + u - 20) < 7) for v, u in views]
    field, measured = folder / "field.h5", folder / "measured.h5"
    write_light_field(LightField(np.array(pictures, np.float32), views), field)
    camera = ("--encoder", "line-even", "--sampling-ratio", 2, "--out", measured)
    yield "clip simulate", (field, *camera)
    words = (measured, "--shear", -1, "--truth", field, "--out", folder / "picture.h5")
    yield "clip recover", words
    surfaces = ("--preset", "surfaces", "--weight", 3e-4, "--all-in-focus", folder / "sharp.h5")
    yield "clip recover", (*words, *surfaces)
    yield "occlusion region", ()
    yield "occlusion demo", ("--scene", "plate", "--side-px", 24, "--out", folder / "occlusion")
    yield "reproduce", ("table1", "--seeds", 1, "--out", folder / "paper")
    yield "bench", ("decode-tags",)


def open_page(file: Path) -> dict[str, Any]:
    """What `tofclip view` says of the page that it serves until it is stopped."""
    words = [sys.executable, "-m", "tofclip", "view", str(file), "--no-browser", "--json"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as page:
        assert page.stdout is not None
        found: dict[str, Any] = json.loads(page.stdout.readline())
        page.terminate()
    return found


@pytest.fixture(scope="module")
def keys(
    tmp_path_factory: pytest.TempPathFactory,
    files: Path,
    curved: Path,
    confocal: Path,
    demonstration: dict[str, Any],
    hidden_letters: dict[str, Any],
) -> dict[str, list[str]]:
    """Lines of the keys that each verb prints, over all that is run of it."""
    folder = tmp_path_factory.mktemp("golden")
    found = {"demo": [*list_keys(demonstration)], "nlos demo": [*list_keys(hidden_letters)]}
    for verb, words in itertools.chain(
        run_streaks(folder, files),
        run_photons(folder),
        run_corners(folder, curved, confocal),
        run_light_fields(folder),
    ):
        found.setdefault(verb, []).extend(list_keys(run_verb(verb, *words)))
    found["view"].extend(list_keys(open_page(folder / "clouds.ply")))
    return {
        verb: [f"{verb}: --json {path}" for path in dict.fromkeys(lines)]
        for verb, lines in found.items()
    }


def read_golden(verb: str) -> list[str]:
    lines = GOLDEN.read_text("utf-8").splitlines()
    return [line for line in lines if line.startswith(f"{verb}: ")]


def compare(made: list[str], kept: list[str]) -> None:
    changed = [f"lost  {line}" for line in kept if line not in made]
    changed += [f"new   {line}" for line in made if line not in kept]
    assert not changed, "\n".join(["against tests/golden/verbs.txt:", *changed])


def is_key(line: str) -> bool:
    return ": --json " in line and not line.endswith(", default False")


def test_verbs_are_those_of_the_file() -> None:
    named = {line.partition(": ")[0] for line in GOLDEN.read_text("utf-8").splitlines()}
    assert named == set(VERBS)


@pytest.mark.parametrize("verb", VERBS)
def test_arguments_and_options(verb: str) -> None:
    compare([*list_options(verb)], [line for line in read_golden(verb) if not is_key(line)])


@pytest.mark.parametrize("verb", VERBS)
def test_keys_of_json(verb: str, keys: dict[str, list[str]]) -> None:
    if verb in NOT_RUN:
        assert verb not in keys, f"{verb} is run: take it off the list"
        return
    assert verb in keys, f"{verb}: run it here on something small, or say why not in NOT_RUN"
    compare(keys[verb], [line for line in read_golden(verb) if is_key(line)])
