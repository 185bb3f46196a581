"""Every verb explains itself, and shells complete it; verbs are found in the program, so that none
is forgotten.
"""

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from verb_pages import write_pages

import tofclip
from apps.cli import COMPLETION_VARIABLE, VERB_OVERVIEW, split_docstring, walk_verbs, wrap_command
from apps.studies.report import find_studies

ROOT = Path(tofclip.__file__).parents[1]
VERBS = walk_verbs()


@pytest.mark.parametrize("name", VERBS)
def test_help_of_a_verb(shell, monkeypatch, name):
    monkeypatch.setenv("TERMINAL_WIDTH", "100")
    outcome = shell(f"{name} --help")
    assert outcome.status == 0
    assert f"Usage: tofclip {name} " in outcome.out
    assert "--json" in outcome.out
    assert "Exit status: 0 done; 2 unusable input" in outcome.out
    for example in split_docstring(VERBS[name].callback.__doc__)[1]:
        assert f"Example:\n      {wrap_command(example).splitlines()[0]}\n" in outcome.out
        assert all(line.strip() in outcome.out for line in wrap_command(example).splitlines())
        assert shlex.split(wrap_command(example).replace("\\\n", "")) == shlex.split(example)


@pytest.mark.parametrize("name", VERBS)
def test_examples_of_a_verb_are_understood(name, tmp_path, monkeypatch):
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


def test_alone_the_program_shows_a_map_of_all_verbs_on_eighty_columns(shell):
    shown = shell("")
    assert (shown.status, shown.err) == (0, "")
    assert max(map(len, VERB_OVERVIEW.splitlines())) <= 80
    assert VERB_OVERVIEW.strip() in shown.out
    for name in VERBS:
        assert f"\n  {name} " in shown.out or f"\n  {name.split()[0]} " in shown.out
    assert shell("--version").out == f"{tofclip.__version__}\n"


@pytest.mark.parametrize("shell_name", ["bash", "zsh", "fish"])
def test_shells_complete_verbs_options_and_names(shell, monkeypatch, shell_name):
    def complete(line):
        """Ask for completions of a command line as the shell's function does."""
        asked = {
            COMPLETION_VARIABLE: f"complete_{shell_name}",
            "COMP_WORDS": line,
            "COMP_CWORD": str(line.count(" ")),
            "_TYPER_COMPLETE_ARGS": line,
            "_TYPER_COMPLETE_FISH_ACTION": "get-args",
        }
        for name, value in asked.items():
            monkeypatch.setenv(name, value)
        outcome = shell("")
        assert (outcome.status, outcome.err) == (0, "")
        return outcome.out

    assert "lidar" in complete("tofclip lid")
    assert "parallax" in complete("tofclip lidar ")
    assert "--sampling-ratio" in complete("tofclip clip simulate --samp")
    assert "adjoint" in complete("tofclip recover --method ad")
    assert "tv" not in complete("tofclip recover --method ad")


@pytest.mark.parametrize("name", VERBS)
def test_completed_names_are_those_of_the_help(name):
    command = VERBS[name]
    context = typer.Context(command, info_name=name)
    for param in command.get_params(context):
        if "..." not in (param.help or ""):  # too many to list
            for item in param.shell_complete(context, ""):
                assert item.value in (param.help or "")


def test_every_completed_study_exists():
    command = VERBS["reproduce"]
    context = typer.Context(command, info_name="reproduce")
    name = next(param for param in command.get_params(context) if param.name == "name")
    completed = [item.value for item in name.shell_complete(context, "table1")]
    assert completed == ["table1", "table10"]
    for word in completed:
        assert find_studies(word)


def test_bash_takes_the_script(tmp_path):
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


def test_completion_is_installed_for_the_shell_that_asks(tmp_path):
    command = f"{shlex.quote(sys.executable)} -m tofclip --install-completion; exit $?"
    there = {**os.environ, "HOME": str(tmp_path)}
    done = subprocess.run(
        ["bash", "-c", command], env=there, cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    script = tmp_path / ".bash_completions" / "tofclip.sh"
    assert f"{COMPLETION_VARIABLE}=complete_bash" in script.read_text()
    assert str(script) in (tmp_path / ".bashrc").read_text()


def test_a_page_for_each_verb(tmp_path):
    (tmp_path / "gone.md").write_text("a verb of an earlier version")
    pages = write_pages(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted(pages)
    assert len(pages) == len(VERBS) + 1
    listed = (tmp_path / "index.md").read_text()
    assert all(f"\n{path.stem}\n" in listed for path in pages[:-1])
    assert "tofclip --install-completion" in listed
