"""No output is an input, for every verb that has both and however the two are spelt: refused in one
line, with nothing written. And what the program writes, `tofclip.load`, `info` and `view` open.
"""

from pathlib import Path

import numpy as np
import pytest
from small_instrument import Outcome, Shell

import tofclip
from apps.cli import walk_verbs
from tofclip.errors import InputError
from tofclip.files import require_apart
from tofclip.storage import Record

OUTPUTS = {
    name: f"--{name.replace('_', '-')}"
    for name in [
        "out",
        "preview",
        "cloud",
        "png",
        "mp4",
        "surface",
        "volumes",
        "all_in_focus",
        "page",
    ]
}
INPUTS = {
    *("streak", "shots", "frames", "source", "file", "clouds", "uri", "measurement", "light_field"),
    *("line", "line_background", "dot", "dot_background", "camera", "pulse", "background"),
    *("truth", "depth_map", "settings", "mesh", "recording", "data", "peers", "compare"),
}
NO_FILES = {"name"}
"""Arguments that name something else."""

FILE_METAVARS = {"FILE", "SOURCE"}
"""Of options that name a file and are texts, because they may name something else as well."""

HARMLESS = {
    ("lidar bag", "out", "clouds"),  # from a folder or pattern; see the tests of folders
    ("occlusion demo", "out", "recording"),  # goes with --live, which refuses --out
    ("occlusion demo", "out", "camera"),  # goes with --live, which refuses --out
    ("reproduce", "out", "data"),  # a folder; see the tests of folders
}
"""Pairs of an output and an input of a verb that cannot be the same."""

ENDINGS = {"PNG": ".png", "PLY": ".ply", "MD": ".md", "MP4": ".mp4"}
"""Of outputs, by the names of their values in the help; others may end in .h5."""

FURTHER_WORDS = {
    "calibrate": "--line a --line-background b --dot c --dot-background d",
    "calibrate range": "--target-m 1",
    "lidar photons": "--single-pixel",
    "nlos simulate": "--letters T",
    "clip simulate": "--encoder line",
    "clip recover": "--shear 0",
    "reproduce": "table2",
    "bench": "decode",
}
"""What a verb has to be given besides its arguments and --out."""


def is_file(param):
    """Whether a parameter's value names a file or a folder, or may."""
    descriptor = getattr(param, "type_descriptor", None)
    if descriptor is None or param.name in NO_FILES:
        return False
    is_path = "Path" in str(descriptor.annotation)
    return is_path or param.param_type_name == "argument" or param.metavar in FILE_METAVARS


VERBS = walk_verbs()
FILES = {
    verb: [param.name for param in command.params if is_file(param)]
    for verb, command in VERBS.items()
}
PAIRS = [
    (verb, out, given)
    for verb, names in FILES.items()
    for out in names
    for given in names
    if out in OUTPUTS and given not in OUTPUTS
]
"""Every verb's outputs with each of its inputs."""


def spell(path):
    """All names of a file or a folder of the working directory; links are made beside it."""
    symbolic, hard = path.with_stem("symbolic"), path.with_stem("hard")
    symbolic.symlink_to(path)
    through = Path(f"sub/../../{path.parent.name}/{path.name}")
    names = [path, Path(path.name), through, symbolic]
    if path.is_file():
        hard.hardlink_to(path)
        names.append(hard)
    return names


def take_stock(folder):
    """All that is in a folder: files with their content, and folders."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


@pytest.fixture
def here(shell, tmp_path, monkeypatch):
    """The working directory, with a folder in it."""
    folder = tmp_path / "here"
    (folder / "sub").mkdir(parents=True)
    monkeypatch.chdir(folder)
    return folder


def make_input(path):
    # A comment in TOML, too: settings are read before any other file is.
    path.parent.mkdir(exist_ok=True)
    path.write_text("# an input\n")
    return path


def build_line(verb, out, name, given):
    """Everything but the output under test; files that are not under test do not matter."""
    words = [verb, FURTHER_WORDS.get(verb, "")]
    for param in VERBS[verb].params:
        is_argument = param.param_type_name == "argument"
        if param.name == name:
            words += ["" if is_argument else param.opts[0], str(given)]
        elif param.name in INPUTS and is_argument:
            words.append(str(make_input(given.parent / "other.h5")))
        elif param.name in OUTPUTS and param.required and param.name != out:
            words += [param.opts[0], f"new{ENDINGS.get(param.metavar, '.h5')}"]
    return " ".join(words)


def test_every_file_of_every_verb_is_known_to_be_read_or_written():
    """A new verb, or a new option, has to be named above; its pairs are then tried below."""
    for verb, names in FILES.items():
        assert set(names) <= set(OUTPUTS) | INPUTS, verb
    assert set(PAIRS) >= HARMLESS


@pytest.mark.parametrize(("verb", "out", "name"), [pair for pair in PAIRS if pair not in HARMLESS])
def test_an_output_is_never_an_input(shell, here, verb, out, name):
    (param,) = [one for one in VERBS[verb].params if one.name == out]
    given = make_input(here / f"given{ENDINGS.get(param.metavar, '.h5')}")
    line, names, before = build_line(verb, out, name, given), spell(given), take_stock(here)
    for spelling in names:
        shell.refuses(f"{line} {OUTPUTS[out]} {spelling}", "is an input too")
        assert take_stock(here) == before


@pytest.mark.parametrize(
    "line",
    [
        "recover {} --out",
        "cloud {} --out",
        "cloud {} --suffix .h5 --out",
        "stream {} --out",
        "lidar sequence {} --out",
        "nlos reconstruct {} --out",
        "nlos stream {} --out",
        "nlos stream {} --follow-s 0.1 --out",
        "nlos compare {} --out new.png --volumes",
        "reproduce table2 --data {} --out",
        "lidar bag {} --out",
    ],
)
def test_a_folder_of_results_is_not_that_of_the_inputs(shell, here, line):
    folder = here / "inputs"
    for name in ("a.h5", "b.h5", "a_cloud.ply"):
        make_input(folder / name)
    names, before = spell(folder), take_stock(here)
    said = "a bag is a new folder" if "bag" in line else "is an input too"
    for name in names:
        shell.refuses(f"{line.format(folder)} {name}", said)
        assert take_stock(here) == before


@pytest.mark.parametrize(
    "line",
    [
        "recover 'in/*.h5' --out in",
        "recover 'in/[ab].h5' --out in/../in",
        "recover 'in/**/*.h5' --out in",
        "recover other --camera in/a.h5 --out in",
        "recover other --out linked",
        "cloud 'in/*.h5' --suffix .h5 --out in",
        "lidar sequence 'in/*.h5' --suffix .h5 --out in",
        "lidar sequence 'in/pla[n].h5' --out in",
        "lidar sequence other --camera in/plan.h5 --out in",
        "stream 'in/*.h5' --suffix .h5 --out in",
        "stream other --camera in/cloud_000001.h5 --suffix .h5 --out in",
        "nlos stream in/a.h5 --out in",
        "nlos stream in/a.h5 --out ./in/../in",
        "nlos stream other --out linked",
        "nlos stream other --settings in/stream.toml --out in",
        "nlos reconstruct other --out linked",
        "nlos compare in/hybrid.h5 --out new.png --volumes in",
        "nlos compare other/a.h5 --settings in/new.toml --out in/new.png",
        "nlos reconstruct rendering --out rendering/geometry.h5",
        "nlos reconstruct rendering --out new.h5 --png rendering/1.png",
        "nlos stream . --out rendering",
        "recover in/new.png --out in/new.h5",
        "calibrate range in/new.png --target-m 1 --out in/new.h5",
        "nlos simulate --letters T --settings in/new.toml --out in/new.h5",
        "nlos film in/a.h5 --settings in/new.toml --out in/new.gif",
        "clip simulate in --encoder line --out in/a.h5",
        "view in --png in/new.png",
        "record file://in/a.h5?pace=fast --out in/a.h5 --overwrite",
        "recover file://in/a%2eh5 --out in/a.h5",
        "lidar bag in/*.ply --out in/hard.mcap",
    ],
)
def test_inputs_are_not_taken_for_results(shell, here, line):
    """Names of results that follow from others, and inputs that lie where results will."""
    inside = "a.h5 b.h5 plan.h5 cloud_000001.h5 hybrid.h5 a.ply new.png new.toml stream.toml"
    for name in inside.split():
        make_input(here / "in" / name)
    for name in ("other/a.h5", *(f"rendering/{name}" for name in RENDERING)):
        make_input(here / name)
    (here / "linked").mkdir()
    (here / "linked" / "a.h5").symlink_to(here / "other" / "a.h5")
    (here / "in" / "hard.mcap").hardlink_to(here / "in" / "a.ply")
    before = take_stock(here)
    shell.refuses(f"{line} --overwrite", "is an input too")
    assert take_stock(here) == before


RENDERING = ("geometry.toml", "1.png", "1.exr")


class TestRequireApart:
    def test_addresses_are_no_files_but_those_of_files(self, here):
        make_input(here / "run.h5")
        require_apart(["run.h5"], ["sim+linospad2://run.h5"])
        with pytest.raises(InputError, match="choose another name"):
            require_apart(["run.h5"], ["FILE://run.h5?pace=realtime"])

    def test_results_in_a_folder_of_the_inputs_folder_are_none_of_them(self, here):
        make_input(here / "a.h5")
        make_input(here / "sub" / "a.h5")
        require_apart(["sub", "sub/a.h5"], [here, "*.h5"])
        with pytest.raises(InputError, match="choose another folder"):
            require_apart(["sub/..", "sub/a.h5"], [here])

    def test_a_file_whose_name_is_a_pattern_is_that_file(self, here):
        make_input(here / "[a].h5")
        make_input(here / "a.h5")
        require_apart(["a.h5"], ["[a].h5"])
        with pytest.raises(InputError):
            require_apart(["[a].h5"], ["[a].h5"])


CLOUDS = [f"cloud.{suffix}" for suffix in ["ply", "pcd", "csv", "npz", "las", "laz", "e57", "h5"]]
SHOWN = {
    "streak.h5": "streak",
    "frames.h5": "frames",
    "range.npz": "range image",
    "depth.exr": "depth picture",
    "photons.ply": "cloud",
    "volume.h5": "volume",
}
ALIKE = {
    **dict.fromkeys(CLOUDS, "cloud"),
    "returns.npz": "range image",
    "cloud_depth.exr": "depth picture",
}
"""Shown as those above are, or below."""

NOT_SHOWN = {
    "camera.h5": "camera",
    "run.h5": "recording",
    "capture.h5": "capture",
    "volume.toml": "settings",
}
PHOTONS = "lidar photons {folder}/cube.npy --bin-width-ps 80 --pulse-ps 150 --out {folder}"
WRITE = [
    *(f"{PHOTONS}/{name}" for name in ("range.npz", "depth.exr", "photons.ply")),
    f"{PHOTONS}/returns.npz --returns 2",
    "recover {files}/streak.h5 --method linear --time-zero-ns -5 --out {folder}/frames.h5",
    *(f"cloud {{folder}}/frames.h5 --out {{folder}}/{name}" for name in CLOUDS),
    "cloud {folder}/frames.h5 --out {folder}/cloud_depth.exr",
    "record sim+spad512://?seed=1 --seconds 0.2 --out {folder}/run.h5",
    "nlos reconstruct {confocal} --out {folder}/volume.h5",
]


@pytest.fixture(scope="module")
def written(request, files, confocal, tmp_path_factory):
    """Folder with a small output of every verb."""
    folder = tmp_path_factory.mktemp("written")
    cube = np.random.default_rng(0).poisson(0.05, (12, 16, 64)).astype(np.uint8)
    cube[:, :, 30:32] += 4
    np.save(folder / "cube.npy", cube)
    for line in WRITE:
        assert Shell(request)(line, folder=folder).status == 0
    for name in ("streak.h5", "camera.h5"):
        tofclip.load(files / name).save(folder / name)
    (folder / "capture.h5").write_bytes(confocal.read_bytes())
    return folder


@pytest.mark.parametrize(("name", "kind"), (SHOWN | NOT_SHOWN | ALIKE).items())
def test_every_output_is_opened(shell, written, name, kind):
    assert shell.figures("info {written}/{name}", name=name)["kind"] == kind
    loaded = tofclip.load(written / name)
    assert kind == (loaded.kind if isinstance(loaded, Record) else loaded.to_record().kind)
    line = f"view {{written}}/{name} --png view.png"
    if name in SHOWN:
        assert shell(line).status == 0
        assert Path("view.png").stat().st_size > 1000
    elif name in NOT_SHOWN:
        said = shell.refuses(line)
        assert any(word in said for word in ("camera", kind, "is not a streak image"))


OTHERS = {
    "capture": (
        "nlos reconstruct",
        {
            "H": np.ones((9, 4, 4)),
            "wall_xyz": np.random.default_rng(0).random((4, 4, 3)),
            "laser_xyz": np.zeros(3),
            "delta_t_s": 4e-12,
        },
    ),
    "light_field": (
        "clip simulate",
        {"lf": np.arange(64).reshape(2, 2, 4, 4), "u": [-1, 0], "v": [-1, 0], "scale": 0.5},
    ),
}


@pytest.mark.parametrize("kind", OTHERS)
def test_archives_of_others_say_what_they_are(shell, here, kind):
    verb, arrays = OTHERS[kind]
    np.savez("other.npz", **arrays)
    told = shell.figures("info other.npz")
    assert told["kind"] == kind
    assert set(told["fields"]) == set(arrays)
    numbers = {name: one["values"] for name, one in told["fields"].items() if "values" in one}
    assert numbers == {name: one for name, one in arrays.items() if isinstance(one, float)}
    assert tofclip.load("other.npz").to_record().kind == kind
    assert f"tofclip {verb} reads it" in shell.refuses("view other.npz --png view.png")
    assert "so it is no streak image" in shell.refuses("recover other.npz --out f.h5")


def test_clouds_of_every_format_are_layers_of_one_scene(shell, written):
    names = " ".join(f"{written}/{name}" for name in CLOUDS)
    points = len(tofclip.load(written / CLOUDS[0]))
    assert shell.figures(f"view {names} --png view.png")["points"] == points * len(CLOUDS)


def test_a_range_image_keeps_its_ranges(written):
    loaded = tofclip.load(written / "range.npz").fields["range_m"]
    with np.load(written / "range.npz") as expected:
        np.testing.assert_array_equal(loaded.values, expected["range_m"])
    assert loaded.units == "m"
    depth = tofclip.load(written / "depth.exr").fields["Z"].values
    row, column = depth.shape[0] // 2, depth.shape[1] // 2  # on the optical axis
    assert depth[row, column] == pytest.approx(loaded.values[row, column], rel=1e-6)


@pytest.mark.parametrize("given", ["0.02ns", "20 ps", "20"])
def test_quantities_may_carry_a_unit(shell, given):
    figures = "lidar accuracy --photons 50 --background 0.1 --pulse-ps 60 --trials 20"
    line = f"{figures} --bin-width-ps '{given}'"
    assert shell.figures(line) == shell.figures(f"{figures} --bin-width-ps=20ps")
    shell.refuses(line.replace(given, "3mm"), "give a time, such as 3ps")
    for wrong, said in (
        ("20PS", "20ps (units: fs, ps, ns, us, ms, s)"),
        ("1.2.3ps", "valid number"),
    ):
        shell.refuses(f"{figures} --bin-width-ps '{wrong}'", said)


def test_common_words_of_every_verb(shell, here):
    assert shell("lidar accuracy -h").out == shell("lidar accuracy --help").out
    line = "occlusion region --baseline-mm 15 --width-mm 6 --distance-mm 50 -o region.png"
    assert shell(f"{line} -q") == Outcome(0, "", "")
    shell.refuses(line, "region.png: exists already; name another, or give --overwrite")
    assert shell(f"{line} --overwrite").out
