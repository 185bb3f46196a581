"""The program as a process: help, exit statuses, interruption, pipes."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from small_instrument import Run
from typer.core import TyperArgument
from verb_pages import collect_verbs

import tofclip
from apps import cli

PROGRAM = [sys.executable, "-m", "tofclip"]
ROOT = Path(tofclip.__file__).parents[1]
LONGEST_WAIT_S = 60.0  # compiling the kernels on a slow, cold machine


def ran(*words: object) -> subprocess.CompletedProcess[str]:
    command = [*PROGRAM, *map(str, words)]
    return subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=LONGEST_WAIT_S, check=False
    )


def test_alone_it_shows_the_map_of_verbs(run: Run) -> None:
    outcome = run()
    assert (outcome.status, outcome.err) == (0, "")
    for verb in (
        "demo",
        "calibrate",
        "recover",
        "cloud",
        "lidar accuracy",
        "nlos reconstruct",
        "convert",
        "info",
    ):
        assert f"\n  {verb} " in outcome.out


def test_every_verb_explains_itself(run: Run) -> None:
    for verb in ("demo", "calibrate", "recover", "cloud", "convert", "info"):
        outcome = run(verb, "--help")
        assert outcome.status == 0
        assert f"Usage: tofclip {verb}" in outcome.out
        assert "--json" in outcome.out
    assert "--wavelength-mm" in run("nlos", "reconstruct", "--help").out
    assert "reconstruct" in run("nlos").out


def test_version(run: Run) -> None:
    assert run("--version").out == f"{tofclip.__version__}\n"


HEAVY = {
    *("numpy", "scipy", "numba", "h5py", "matplotlib", "tifffile", "open3d", "pyvista"),
    *("rich", "pydantic"),  # a frame around the help, and typer's reading of options
}


def list_loaded(statement: str) -> set[str]:
    """Modules that a program loads."""
    code = f"import sys; from apps.cli import main; {statement}; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return set(done.stdout.splitlines()[-1].split())


def test_helps_load_nothing_heavy() -> None:
    helps = [["--help"], *([*verb.split(), "--help"] for verb in collect_verbs())]
    assert HEAVY.isdisjoint(list_loaded(f"[main(words) for words in {helps}]"))


def test_a_refusal_loads_no_more_than_the_options() -> None:
    refused = [["info", "absent.h5"], ["nlos", "info", "absent.h5"]]
    loaded = list_loaded(f"[main(words) for words in {refused}]")
    assert loaded & HEAVY <= {"pydantic", "rich"}


def test_libraries_say_nothing_before_the_one_line_about_an_error() -> None:
    code = """
import logging, sys, warnings
from apps import cli
def work(words, **options):
    warnings.warn("invalid value encountered in divide", RuntimeWarning)
    logging.getLogger("ptufile").warning("read of 5 bytes")
    raise cli.InputError("photon counts must be finite")
cli.app = work
sys.exit(cli.main(sys.argv[1:]))
"""
    command = [sys.executable, "-c", code]
    plain = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (plain.returncode, plain.stdout) == (2, "")
    assert plain.stderr == "tofclip: error: photon counts must be finite\n"
    whole = subprocess.run(
        [*command, "--debug"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert "RuntimeWarning: invalid value" in whole.stderr
    assert "read of 5 bytes" in whole.stderr


def test_statuses_of_the_process(files: Path) -> None:
    good, bad = ran("info", files / "camera.h5", "--json"), ran("info", files / "absent.h5")
    assert (good.returncode, good.stderr, json.loads(good.stdout)["kind"]) == (0, "", "camera")
    assert (bad.returncode, bad.stdout, bad.stderr.count("\n")) == (2, "", 1)


def test_debug_shows_where_an_error_came_from(run: Run, tmp_path: Path) -> None:
    plain, traced = run("info", tmp_path / "absent"), run("info", tmp_path / "absent", "--debug")
    assert "Traceback" not in plain.err
    assert traced.err.startswith("Traceback")
    assert traced.err.endswith(plain.err)
    assert traced.status == 2


def test_a_defect_is_one_line_as_well(
    run: Run, monkeypatch: pytest.MonkeyPatch, files: Path
) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("a defect\nin two lines")

    monkeypatch.setattr("tofclip.loading.outline", fail)
    outcome = run("info", files / "camera.h5")
    assert outcome.status == cli.EXIT_DEFECT
    assert outcome.err.startswith(
        "tofclip: error: unforeseen ZeroDivisionError: a defect in two lines"
    )
    assert outcome.err.count("\n") == 1


def test_a_reader_that_goes_away(files: Path) -> None:
    read, write = os.pipe()
    os.close(read)  # nobody will ever read
    done = subprocess.run(
        [*PROGRAM, "info", files / "camera.h5"],
        cwd=ROOT,
        stdout=write,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    os.close(write)
    assert (done.returncode, done.stderr) == (cli.EXIT_BROKEN_PIPE, "")


def test_a_disk_without_room(files: Path, tmp_path: Path) -> None:
    """A limit on the size of files stands for the disk: both refuse to write on, in the middle of a
    file.
    """
    limited = f"ulimit -f 8; exec {shlex.join(PROGRAM)} convert {files / 'streak.h5'} --out {tmp_path / 'copy.h5'}"
    done = subprocess.run(
        ["bash", "-c", limited], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "copy.h5: cannot be written" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_during_recovery_leaves_nothing_behind(files: Path, tmp_path: Path) -> None:
    import pty  # exists only where the test can run

    words = [
        "recover",
        files / "streak.h5",
        "--out",
        tmp_path / "frames.h5",
        "--iterations",
        "1000000",
    ]
    terminal, child_side = pty.openpty()
    process = subprocess.Popen(
        [*PROGRAM, *map(str, words)], cwd=ROOT, stdout=subprocess.PIPE, stderr=child_side, text=True
    )
    os.close(child_side)
    wait_for(terminal, "recovering")  # the bar is drawn, so the iterations have begun
    process.send_signal(signal.SIGINT)
    pressed = time.monotonic()
    out, _ = process.communicate(timeout=LONGEST_WAIT_S)
    assert process.returncode == 130
    assert out == ""
    # A million iterations would take an hour; the end must not wait for them. The margin is for a
    # busy machine.
    assert time.monotonic() - pressed < 20
    assert wait_for(terminal, "tofclip: interrupted").count("Traceback") == 0
    os.close(terminal)
    assert list(tmp_path.iterdir()) == []


def started_elsewhere(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run the installed program's entry point with a folder before all others on the path."""
    environment = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}
    return subprocess.run(
        [sys.executable, "-m", "tofclip", *words],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=LONGEST_WAIT_S,
        check=False,
    )


@pytest.mark.parametrize("module", ["pathlib", "typer"])  # the first of all, and a later one
def test_ctrl_c_while_the_program_starts_shows_no_traceback(tmp_path: Path, module: str) -> None:
    (tmp_path / f"{module}.py").write_text("raise KeyboardInterrupt\n")
    done = started_elsewhere(tmp_path, "--version")
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "tofclip: interrupted\n"


def test_little_is_loaded_before_a_ctrl_c_can_be_caught(tmp_path: Path) -> None:
    (tmp_path / "lazy_loader.py").write_text("raise KeyboardInterrupt\n")
    done = started_elsewhere(tmp_path, "--version")
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{tofclip.__version__}\n", "")


def test_ctrl_c_while_a_verb_is_imported_shows_no_traceback(tmp_path: Path) -> None:
    (tmp_path / "h5py.py").write_text("raise KeyboardInterrupt\n")
    (tmp_path / "there.h5").touch()
    done = started_elsewhere(tmp_path, "info", "there.h5")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (130, "", 1)


def test_an_unrelated_package_called_apps_does_not_take_its_place(tmp_path: Path) -> None:
    (tmp_path / "apps").mkdir()
    (tmp_path / "apps" / "__init__.py").write_text("raise RuntimeError('not this one')\n")
    done = started_elsewhere(tmp_path, "--version")
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{tofclip.__version__}\n", "")


def wait_for(terminal: int, text: str) -> str:
    """Read from a terminal until `text` appears."""
    seen = ""
    while text not in seen:
        try:
            seen += os.read(terminal, 4096).decode(errors="replace")
        except OSError:  # the other side is closed and everything has been read
            pytest.fail(f"'{text}' never appeared on the terminal: {seen!r}")
    return seen


def is_read(param: TyperArgument) -> bool:
    """Whether an argument names what is read: a file, a folder, a pattern or an address."""
    return param.param_type_name == "argument" and param.callback is not None


READERS = [verb for verb, command in collect_verbs().items() if any(map(is_read, command.params))]


@pytest.mark.parametrize("verb", READERS)
def test_a_missing_file_is_refused_before_anything_else(run: Run, verb: str) -> None:
    outcome = run(*verb.split(), "absent.h5")
    assert (outcome.status, outcome.out) == (2, "")
    assert outcome.err == "tofclip: error: absent.h5: no such file\n"


def test_all_that_read_files_are_among_them() -> None:
    assert {*("recover", "cloud", "view", "stream", "info", "convert", "calibrate range")} < set(
        READERS
    )
    assert len(READERS) == 21
