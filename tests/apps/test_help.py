"""Every verb explains itself, and shells complete it; verbs are found in the program, so that none
is forgotten.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from small_instrument import Run
from verb_pages import collect_verbs, render_page, write_pages

import tofclip
from apps.cli import COMPLETION_VARIABLE, VERB_OVERVIEW, app
from apps.cli import VERBS as LINES
from apps.help import split_docstring, wrap_command
from apps.studies.report import find_studies

ROOT = Path(tofclip.__file__).parents[1]
VERBS = collect_verbs()


@pytest.mark.parametrize("name", VERBS)
def test_help_of_a_verb(run: Run, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv("TERMINAL_WIDTH", "100")
    outcome = run(*name.split(), "--help")
    assert outcome.status == 0
    assert f"Usage: tofclip {name} " in outcome.out
    assert "--json" in outcome.out
    assert "Exit status: 0 done; 2 unusable input" in outcome.out
    for example in split_docstring(VERBS[name].callback.__doc__)[1]:
        assert f"Example:\n      {wrap_command(example).splitlines()[0]}\n" in outcome.out
        assert all(line.strip() in outcome.out for line in wrap_command(example).splitlines())


@pytest.mark.parametrize("words", [[], ["lidar"]])
def test_the_list_of_commands_is_shown_whole(run: Run, words: list[str]) -> None:
    shown = " ".join(run(*words, "--help").out.split())
    assert "..." not in shown.partition("Commands:")[2]


def test_the_list_of_commands_says_what_the_verbs_say() -> None:
    """It is written down, so that no verb needs to be imported for it."""
    group = typer.main.get_group(app)
    for verb, line in LINES.items():
        text = group.load_verb(verb).help or ""
        assert line == " ".join(text.split("\n\n")[0].split()), verb


@pytest.mark.parametrize("name", VERBS)
def test_examples_of_a_verb_are_understood(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every word of an example is one the verb takes, and none that it needs is missing."""
    monkeypatch.chdir(tmp_path)
    _, examples = split_docstring(VERBS[name].callback.__doc__)
    assert examples, f"the docstring of '{name}' needs a paragraph 'Example: tofclip {name} ...'"
    for example in examples:
        program, *words = shlex.split(example)
        depth = len(name.split())
        assert (program, " ".join(words[:depth])) == ("tofclip", name)
        for word in words[depth:]:  # what is read has to be there
            if "://" not in word and not word.startswith("-"):
                Path(word).mkdir(parents=True, exist_ok=True)
        with VERBS[name].make_context(name, words[depth:]) as context:
            assert context.params


@pytest.mark.parametrize("name", VERBS)
def test_the_map_shows_the_verb(name: str) -> None:
    group = name.split()[0]
    assert f"\n  {name} " in VERB_OVERVIEW or f"\n  {group} " in VERB_OVERVIEW


def test_the_overview_fits_a_terminal_of_eighty_columns() -> None:
    assert max(map(len, VERB_OVERVIEW.splitlines())) <= 80


def test_prose_is_joined_and_examples_are_taken_out() -> None:
    prose, examples = split_docstring(
        "Do a\nthing.\n\n  a  table\n\nExample: tofclip do\n    it --now\n\nMore."
    )
    assert prose == ["Do a thing.", "  a  table", "More."]
    assert examples == ["tofclip do it --now"]
    assert split_docstring(None) == ([], [])


def test_a_long_example_is_still_one_command_for_a_shell() -> None:
    command = "tofclip calibrate " + " ".join(
        f"--picture-number-{n} picture_{n}.tif" for n in range(6)
    )
    assert len(wrap_command(command).splitlines()) > 2
    assert shlex.split(wrap_command(command).replace("\\\n", "")) == shlex.split(command)


def asked(run: Run, monkeypatch: pytest.MonkeyPatch, shell: str, line: str) -> str:
    """Ask for completions of a command line as the shell's function does."""
    words = line.split(" ")
    monkeypatch.setenv(COMPLETION_VARIABLE, f"complete_{shell}")
    monkeypatch.setenv("COMP_WORDS", line)
    monkeypatch.setenv("COMP_CWORD", str(len(words) - 1))
    monkeypatch.setenv("_TYPER_COMPLETE_ARGS", line)
    monkeypatch.setenv("_TYPER_COMPLETE_FISH_ACTION", "get-args")
    outcome = run()
    assert (outcome.status, outcome.err) == (0, "")
    return outcome.out


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_complete_verbs_options_and_names(
    run: Run, monkeypatch: pytest.MonkeyPatch, shell: str
) -> None:
    assert "lidar" in asked(run, monkeypatch, shell, "tofclip lid")
    assert "parallax" in asked(run, monkeypatch, shell, "tofclip lidar ")
    assert "--sampling-ratio" in asked(run, monkeypatch, shell, "tofclip clip simulate --samp")
    assert "adjoint" in asked(run, monkeypatch, shell, "tofclip recover --method ad")
    assert "tv" not in asked(run, monkeypatch, shell, "tofclip recover --method ad")


@pytest.mark.parametrize("name", VERBS)
def test_completed_names_are_those_of_the_help(name: str) -> None:
    command = VERBS[name]
    context = typer.Context(command, info_name=name)
    for param in command.get_params(context):
        if "..." not in (param.help or ""):  # too many to list
            for item in param.shell_complete(context, ""):
                assert item.value in (param.help or "")


def test_every_completed_study_exists() -> None:
    command = VERBS["reproduce"]
    context = typer.Context(command, info_name="reproduce")
    name = next(param for param in command.get_params(context) if param.name == "name")
    completed = [item.value for item in name.shell_complete(context, "table1")]
    assert completed == ["table1", "table10"]
    for word in completed:
        assert find_studies(word)


def test_bash_takes_the_script(tmp_path: Path) -> None:
    program = tmp_path / "tofclip"
    program.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m tofclip "$@"\n')
    program.chmod(0o755)
    session = f"""
        eval "$({COMPLETION_VARIABLE}=source_bash tofclip)"
        COMP_WORDS=(tofclip devices ver) COMP_CWORD=2
        _tofclip_completion tofclip
        echo "${{COMPREPLY[@]}}"
    """
    there = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        ["bash", "-c", session], env=there, cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert (done.stdout.strip(), done.stderr) == ("verify", "")


def test_completion_is_installed_for_the_shell_that_asks(tmp_path: Path) -> None:
    command = f"{shlex.quote(sys.executable)} -m tofclip --install-completion; exit $?"
    there = {**os.environ, "HOME": str(tmp_path)}
    done = subprocess.run(
        ["bash", "-c", command], env=there, cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    script = tmp_path / ".bash_completions" / "tofclip.sh"
    assert f"{COMPLETION_VARIABLE}=complete_bash" in script.read_text()
    assert str(script) in (tmp_path / ".bashrc").read_text()


def test_a_page_for_each_verb(tmp_path: Path) -> None:
    (tmp_path / "gone.md").write_text("a verb of an earlier version")
    pages = write_pages(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted(pages)
    assert len(pages) == len(VERBS) + 1
    listed = (tmp_path / "index.md").read_text()
    assert all(f"\n{path.stem}\n" in listed for path in pages[:-1])
    assert "tofclip --install-completion" in listed


def test_pages_that_are_the_same_stay_untouched(tmp_path: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in write_pages(tmp_path)}
    assert {path: path.stat().st_mtime_ns for path in write_pages(tmp_path)} == before


def test_what_a_page_says() -> None:
    text = render_page("lidar scene", VERBS["lidar scene"])
    assert text.startswith("# tofclip lidar scene\n\nList a scene's objects")
    assert "```sh\ntofclip lidar scene frames.h5 --out scene.png\n```" in text
    assert "`--reach-mm MM`\n: Points this close belong together. \\[default: 40.0\\]" in text
    assert "## Arguments\n\n`FRAMES" in text
    assert "## Arguments" not in render_page("devices list", VERBS["devices list"])


def test_a_page_keeps_the_headings_of_the_help() -> None:
    text = render_page("nlos info", VERBS["nlos info"])
    headings = [line for line in text.splitlines() if line.startswith("## ")]
    assert headings[:2] == ["## Arguments", "## Options"]
    assert headings[2].startswith("## Settings")
    assert (
        text.index("## Options")
        < text.index("`--json`")
        < text.index("## Settings")
        < text.index("`--cycles")
    )


def test_the_help_has_the_headings_of_the_page(run: Run) -> None:
    """Settings apart from options, defaults in words without brackets of their own, prose as wide as
    the terminal even where a line begins with an option, and arguments by their names.
    """
    shown = run("nlos", "reconstruct", "--help").out
    places = [
        shown.index(word) for word in ("\nOptions:", "  --json ", "\nSettings (", "--cycles N")
    ]
    assert places == sorted(places)
    assert "(None)" not in shown
    assert "[default: (" not in shown
    assert "Usage: tofclip nlos reconstruct [OPTIONS] CAPTURE\n" in shown
    assert "refine photons looks for the albedo" in " ".join(shown.split())
    assert max(map(len, shown.splitlines())) <= 80
    assert "SHOT..." in run("calibrate", "range", "--help").out.splitlines()[0]
    assert "{" not in run("calibrate", "range", "--help").out.splitlines()[0]


def test_a_flag_is_shown_without_a_type(run: Run) -> None:
    for words in ((), ("recover",), ("lidar",), ("lidar", "sequence")):
        shown = run(*words, "--help").out
        assert "--help" in shown
        assert "<bool>" not in shown
