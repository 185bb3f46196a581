"""No output is an input, for every verb that has both and however the two are spelt: refused in one
line, with nothing written.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import typer
from small_instrument import Outcome, Run

from apps.cli import app
from apps.help import walk_verbs
from tofclip.errors import InputError
from tofclip.files import require_apart

OUTPUTS = {
    "out": "--out",
    "preview": "--preview",
    "cloud": "--cloud",
    "png": "--png",
    "mp4": "--mp4",
    "surface": "--surface",
    "volumes": "--volumes",
    "all_in_focus": "--all-in-focus",
    "page": "--page",
}
INPUTS = {
    *("streak", "shots", "frames", "source", "file", "clouds", "uri", "measurement", "light_field"),
    *("line", "line_background", "dot", "dot_background", "camera", "pulse", "background"),
    *("truth", "depth_map", "settings", "mesh", "recording", "data", "peers"),
}
NO_FILES = {"name"}
"""Arguments that name something else."""

FILE_METAVARS = {"FILE", "SOURCE"}
"""Of options that name a file and are texts, because they may name something else as well."""

HARMLESS = {
    (
        "lidar bag",
        "out",
        "clouds",
    ): "clouds come from a folder or pattern; see the tests of folders",
    ("occlusion demo", "out", "recording"): "goes with --live, which refuses --out",
    ("occlusion demo", "out", "camera"): "goes with --live, which refuses --out",
    ("reproduce", "out", "data"): "data are a folder; see the tests of folders",
}
"""Pairs of an output and an input of a verb that cannot be the same, and why."""

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


def is_file(param: Any) -> bool:
    """Whether a parameter's value names a file or a folder, or may."""
    descriptor = getattr(param, "type_descriptor", None)
    if descriptor is None or param.name in NO_FILES:
        return False
    is_path = "Path" in str(descriptor.annotation)
    return is_path or param.param_type_name == "argument" or param.metavar in FILE_METAVARS


VERBS = walk_verbs(typer.main.get_group(app))
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


def spell(path: Path) -> dict[str, Path]:
    """Other names of a file or a folder of the working directory; links are made beside it."""
    symbolic, hard = path.with_stem("symbolic"), path.with_stem("hard")
    symbolic.symlink_to(path)
    names = {
        "as it is": path,
        "relative": Path(path.name),
        "through a folder": Path(f"sub/../../{path.parent.name}/{path.name}"),
        "symbolic link": symbolic,
    }
    if path.is_dir():
        return names
    hard.hardlink_to(path)
    return names | {"hard link": hard}


def take_stock(folder: Path) -> dict[str, bytes | None]:
    """All that is in a folder: files with their content, and folders."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


def assert_refused(outcome: Outcome, said: str = "is an input too") -> None:
    assert outcome.status == 2, outcome
    assert outcome.out == ""
    assert outcome.err.count("\n") == 1
    assert said in outcome.err


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, with a folder in it."""
    folder = tmp_path / "here"
    (folder / "sub").mkdir(parents=True)
    monkeypatch.chdir(folder)
    return folder


def make_input(path: Path) -> Path:
    # A comment in TOML, too: settings are read before any other file is.
    path.write_text("# an input\n")
    return path


def build_words(verb: str, out: str, name: str, given: Path) -> list[object]:
    """Everything but the output under test; files that are not under test do not matter."""
    words: list[object] = [*verb.split(), *FURTHER_WORDS.get(verb, "").split()]
    for param in VERBS[verb].params:
        is_argument = param.param_type_name == "argument"
        if param.name == name:
            words += [given] if is_argument else [param.opts[0], given]
        elif param.name in INPUTS and is_argument:
            words.append(make_input(given.parent / "other.h5"))
        elif param.name in OUTPUTS and param.required and param.name != out:
            words += [param.opts[0], f"new{ENDINGS.get(param.metavar, '.h5')}"]
    return words


def test_every_file_of_every_verb_is_known_to_be_read_or_written() -> None:
    """A new verb, or a new option, has to be named above; its pairs are then tried below."""
    for verb, names in FILES.items():
        assert set(names) <= set(OUTPUTS) | INPUTS, verb
    assert set(HARMLESS) <= set(PAIRS)


@pytest.mark.parametrize(("verb", "out", "name"), [pair for pair in PAIRS if pair not in HARMLESS])
def test_an_output_is_never_an_input(run: Run, here: Path, verb: str, out: str, name: str) -> None:
    (param,) = [one for one in VERBS[verb].params if one.name == out]
    given = make_input(here / f"given{ENDINGS.get(param.metavar, '.h5')}")
    words = build_words(verb, out, name, given)
    names = spell(given)
    before = take_stock(here)
    for spelling in names.values():
        assert_refused(run(*words, OUTPUTS[out], spelling))
        assert take_stock(here) == before


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("recover {} --out", "is an input too"),
        ("cloud {} --out", "is an input too"),
        ("cloud {} --suffix .h5 --out", "is an input too"),
        ("stream {} --out", "is an input too"),
        ("lidar sequence {} --out", "is an input too"),
        ("nlos reconstruct {} --out", "is an input too"),
        ("nlos stream {} --out", "is an input too"),
        ("nlos stream {} --follow-s 0.1 --out", "is an input too"),
        ("nlos compare {} --out new.png --volumes", "is an input too"),
        ("reproduce table2 --data {} --out", "is an input too"),
        ("lidar bag {} --out", "a bag is a new folder"),
    ],
)
def test_a_folder_of_results_is_not_that_of_the_inputs(
    run: Run, here: Path, words: str, said: str
) -> None:
    folder = here / "inputs"
    folder.mkdir()
    for name in ("a.h5", "b.h5", "a_cloud.ply"):
        make_input(folder / name)
    names = spell(folder)
    before = take_stock(here)
    for name in names.values():
        assert_refused(run(*words.format(folder).split(), name), said)
        assert take_stock(here) == before


@pytest.mark.parametrize(
    "words",
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
def test_inputs_are_not_taken_for_results(run: Run, here: Path, words: str) -> None:
    """Names of results that follow from others, and inputs that lie where results will."""
    for folder in ("in", "other", "linked", "rendering"):
        (here / folder).mkdir()
    for name in ("a.h5", "b.h5", "plan.h5", "cloud_000001.h5", "hybrid.h5", "a.ply"):
        make_input(here / "in" / name)
    for name in ("in/new.png", "in/new.toml", "in/stream.toml", "other/a.h5"):
        make_input(here / name)
    for name in ("rendering/geometry.toml", "rendering/1.png", "rendering/1.exr"):
        make_input(here / name)
    (here / "linked" / "a.h5").symlink_to(here / "other" / "a.h5")
    (here / "in" / "hard.mcap").hardlink_to(here / "in" / "a.ply")
    before = take_stock(here)
    assert_refused(run(*words.replace("'", "").split()))
    assert take_stock(here) == before


class TestRequireApart:
    def test_what_is_not_there_is_no_input(self, here: Path) -> None:
        require_apart([here / "new.h5", "also_new"], [here / "absent.h5", None, "absent/*.h5"])

    def test_addresses_are_no_files_but_those_of_files(self, here: Path) -> None:
        make_input(here / "run.h5")
        require_apart(["run.h5"], ["sim+linospad2://run.h5"])
        with pytest.raises(InputError, match="choose another name"):
            require_apart(["run.h5"], ["FILE://run.h5?pace=realtime"])

    def test_results_in_a_folder_of_the_inputs_folder_are_none_of_them(self, here: Path) -> None:
        make_input(here / "a.h5")
        make_input(here / "sub" / "a.h5")
        require_apart(["sub", "sub/a.h5"], [here, "*.h5"])
        with pytest.raises(InputError, match="choose another folder"):
            require_apart(["sub/..", "sub/a.h5"], [here])

    def test_a_file_whose_name_is_a_pattern_is_that_file(self, here: Path) -> None:
        make_input(here / "[a].h5")
        make_input(here / "a.h5")
        require_apart(["a.h5"], ["[a].h5"])
        with pytest.raises(InputError):
            require_apart(["[a].h5"], ["[a].h5"])

    def test_a_folder_that_cannot_be_read_is_still_one(
        self, here: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def refuse(_: Path) -> Any:
            raise PermissionError

        monkeypatch.setattr(Path, "iterdir", refuse)
        require_apart(["new"], ["sub"])
        with pytest.raises(InputError):
            require_apart(["sub"], ["sub"])
