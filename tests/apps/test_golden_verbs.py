"""What the command line promises: every verb's words and the keys of its `--json`, in one file.

A line of `golden/verbs.txt` is an argument, an option or a key. Whoever adds or takes away one
changes the file by hand; the failure names the lines.
"""

import contextlib
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from small_instrument import DEEP_CAMERA as CAMERA
from small_instrument import Shell, write_views

from apps.benchmarks import harness
from apps.benchmarks.harness import find_cases
from apps.cli import walk_verbs
from apps.viewer.page import Page
from tofclip.simulate import Instrument, Scene, StreakDetector, make_plate, simulate_shot
from tofclip.simulate.patterns import make_checkerboard

pytestmark = pytest.mark.xdist_group("golden")

GOLDEN = Path(__file__).parents[1] / "golden" / "verbs.txt"
VERBS = walk_verbs()
NOT_RUN = {"warm-up": "compiles every loop of the program; test_program holds its keys"}
"""Verbs whose keys are not recorded, and why."""


def list_options(verb):
    """One line for each argument and option of a verb."""
    for param in VERBS[verb].get_params(typer.Context(VERBS[verb], info_name=verb)):
        if param.name == "help":
            continue
        is_option = param.param_type_name == "option"
        words = [*param.opts, *param.secondary_opts] if is_option else []
        words += [param.metavar] if param.metavar else []
        annotation = param.type_descriptor.annotation
        words.append(annotation.__name__ if isinstance(annotation, type) else str(annotation))
        bounds = {"min": param.min, "max": param.max}
        limits = [f"{name} {value}" for name, value in bounds.items() if value is not None]
        repeated = ["repeated"] if getattr(param, "multiple", False) or param.nargs == -1 else []
        default = str(param.default) if isinstance(param.default, Path) else param.default
        needed = "required" if param.required else f"default {default!r}"
        yield f"{verb}: {' '.join([*words, *limits, *repeated])}, {needed}"


def list_keys(value, path=""):
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


PLATES = [
    make_plate((place, place, distance), (0.09, 0.09), make_checkerboard(3, 0.1, 0.9))
    for distance, place in ((0.8, -0.07), (1.3, 0.0), (2.0, 0.18))
]


def provide(folder, files, curved):
    """Put into a folder what the lines below read."""
    for name, file in (("shots", files / "streak.h5"), ("captures", curved)):
        (folder / name).mkdir()
        for number in range(2):
            shutil.copy(file, folder / name / f"{number}.h5")
    instrument = Instrument(CAMERA, StreakDetector(180, 100e-12))
    simulate_shot(Scene(tuple(PLATES)), instrument, seed=0).streak.save(folder / "deep.h5")
    noise = np.random.default_rng(0)
    cube = noise.poisson(0.03, (12, 14, 100))
    cube[:, :, 40:46] += noise.poisson(2.0, (12, 14, 6))
    np.save(folder / "cube.npy", cube.astype(np.uint8))
    small = "rows_px = 24\ncolumns_px = 24\nfocal_length_px = 105.0\nbins = 250\n"
    (folder / "small.toml").write_text(small + "bin_width_ps = 50.0\npulse_ps = 150.0\n")
    # a bright square before a dark ground, 4 x 4 views
    views = [(v, u) for v in range(-2, 2) for u in range(-2, 2)]
    y, x = np.mgrid[:40, :40]
    write_views(
        folder / "field.h5",
        views,
        lambda v, u: 0.2 + (abs(y + v - 20) < 7) * (abs(x + u - 20) < 7),
    )


TAGGER = "sim+timetag://?seed=1&rate=1e5"
LINES = f"""
calibrate --line {{files}}/line.tif --line-background {{files}}/line_background.tif\
 --dot {{files}}/dot.tif --dot-background {{files}}/dot_background.tif --out camera.h5
recover {{files}}/streak.h5 --out frames.h5 --method l1 --iterations 3
recover {{files}}/streak.h5 --out f.h5 --method linear
recover shots --out frames --method l1 --iterations 3
cloud frames.h5 --out clouds.ply
cloud frames --out clouds
lidar scene frames.h5 --out scene.png --fewest-points 5
lidar sequence shots --out sequence
lidar bag clouds --out clouds.mcap
lidar parallax deep.h5 --out locked.h5 --gates 3
view clouds.ply --png cloud.png
view clouds.ply --no-browser
convert {{files}}/wall.h5 --out wall.h5
info {{files}}/streak.h5
info {{files}}/camera.h5
info frames.h5
info clouds.ply
stream 'sim+remoteex://?seed=1&scene=small&frame_rate=40' --shots 2 --out streamed
lidar photons cube.npy --out range.npz --bin-width-ps 80 --pulse-ps 400
calibrate range --target-m 0.5 cube.npy --out late.h5 --bin-width-ps 80 --pulse-ps 400
info cube.npy
lidar accuracy --trials 10
devices list
plugins
doctor
devices info '{TAGGER}'
devices test '{TAGGER}' --seconds 0.1
record '{TAGGER}' --out run.h5 --seconds 0.1
devices verify run.h5
devices repair run.h5 --out sound.h5
info run.h5
nlos simulate --points 0.1,-0.05,0.6 --wall-points 12 --wall-width-m 0.8 --bin-width-ps 32 --out c.h5
nlos info {{confocal}}
nlos reconstruct {{confocal}} --method rsd --out volume.h5 --voxel-mm 60
nlos reconstruct {{confocal}} --method lct --out lct.h5 --voxel-mm 60 --surface surface.ply
nlos reconstruct {{confocal}} --refine l1 --iterations 2 --out refined.h5 --voxel-mm 40
nlos reconstruct captures --out volumes --voxel-mm 60
nlos stream captures --out imaged --voxel-mm 60
nlos compare {{confocal}} --methods rsd,fk --out compare.png --voxel-mm 60
nlos film {{curved}} --instants 3 --out film.gif --voxel-mm 60
info volume.h5
info {{confocal}}
clip simulate field.h5 --encoder line-even --sampling-ratio 2 --out measured.h5
clip recover measured.h5 --shear -1 --truth field.h5 --out picture.h5
clip recover measured.h5 --shear -1 --truth field.h5 --out surfaces.h5 --preset surfaces\
 --weight 3e-4 --all-in-focus sharp.h5
design small.toml --shots 2 --out small.png
occlusion region
occlusion demo --scene plate --side-px 24 --out occlusion
reproduce table1 --seeds 1 --out paper
bench decode-tags
"""
"""What is run of each verb, one line after the other."""


@pytest.fixture(scope="module")
def keys(request, tmp_path_factory, files, curved, demonstration, hidden_letters):
    """Lines of the keys that each verb prints, over all that is run of it."""
    folder = tmp_path_factory.mktemp("golden")
    provide(folder, files, curved)
    found = {"demo": [*list_keys(demonstration)], "nlos demo": [*list_keys(hidden_letters)]}
    small = [replace(case, sizes=(1,)) for case in find_cases("decode-tags")]
    with contextlib.chdir(folder), pytest.MonkeyPatch.context() as quick:
        quick.setattr(harness, "find_cases", lambda _: small)
        quick.setenv("TOFCLIP_THREADS", "1")  # the bench is run once for each number
        quick.setattr(Page, "run", lambda _: None)  # it would serve until it is stopped
        for line in LINES.strip().replace("\\\n", "").splitlines():
            words = line.split()
            verb = next(name for name in (" ".join(words[:2]), words[0]) if name in VERBS)
            outcome = Shell(request)(f"{line} --json")
            assert outcome.status == 0, outcome
            found.setdefault(verb, []).extend(list_keys(json.loads(outcome.out)))
    return {
        verb: [f"{verb}: --json {path}" for path in dict.fromkeys(lines)]
        for verb, lines in found.items()
    }


def read_golden(verb):
    lines = GOLDEN.read_text("utf-8").splitlines()
    return [line for line in lines if line.startswith(f"{verb}: ")]


def compare(made, kept):
    changed = [f"lost  {line}" for line in kept if line not in made]
    changed += [f"new   {line}" for line in made if line not in kept]
    assert not changed, "\n".join(["against tests/golden/verbs.txt:", *changed])


def is_key(line):
    return ": --json " in line and not line.endswith(", default False")


def test_verbs_are_those_of_the_file():
    named = {line.partition(": ")[0] for line in GOLDEN.read_text("utf-8").splitlines()}
    assert named == set(VERBS)


@pytest.mark.parametrize("verb", VERBS)
def test_arguments_and_options(verb):
    compare([*list_options(verb)], [line for line in read_golden(verb) if not is_key(line)])


@pytest.mark.parametrize("verb", VERBS)
def test_keys_of_json(verb, keys):
    if verb in NOT_RUN:
        assert verb not in keys, f"{verb} is run: take it off the list"
        return
    assert verb in keys, f"{verb}: run it here on something small, or say why not in NOT_RUN"
    compare(keys[verb], [line for line in read_golden(verb) if is_key(line)])
