"""The program as a process: exit statuses, what it loads, interruptions, pipes, terminals, packages
that are missing, and loops compiled beforehand.
"""

import json
import os
import pty
import re
import shlex
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

import tofclip
from apps import cli
from apps.verbs import installation
from nlos.settings import METHODS
from tofclip.files import describe_missing_package

PROGRAM = [sys.executable, "-m", "tofclip"]
ROOT = Path(tofclip.__file__).parents[1]
LONGEST_WAIT_S = 120.0  # compiling the kernels on a slow, cold machine
VERBS = cli.walk_verbs()


def start(command, folder=ROOT, path=ROOT, **environment):
    """Run a command until it ends, with a folder before all others on Python's path."""
    return subprocess.run(
        [*map(str, command)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": f"{path}{os.pathsep}{ROOT}", **environment},
        capture_output=True,
        text=True,
        timeout=LONGEST_WAIT_S,
        check=False,
    )


def start_python(code, *words):
    return start([sys.executable, "-c", code, *words])


HEAVY = {
    *("numpy", "scipy", "numba", "h5py", "matplotlib", "tifffile", "open3d", "pyvista"),
    *("rich", "pydantic"),  # a frame around the help, and typer's reading of options
}


class TestLoading:
    def list_heavy(self, commands):
        """Heavy packages that the program loads."""
        run = f"[main(words) for words in {commands}]"
        done = start_python(f"import sys; from apps.cli import main; {run}; print(*sys.modules)")
        return HEAVY & set(done.stdout.splitlines()[-1].split())

    def test_helps_load_nothing_heavy(self):
        assert not self.list_heavy([["--help"], *([*verb.split(), "--help"] for verb in VERBS)])

    def test_a_refusal_loads_no_more_than_the_options(self):
        refused = [["info", "absent.h5"], ["nlos", "info", "absent.h5"]]
        assert self.list_heavy(refused) <= {"pydantic", "rich"}

    def test_an_unrelated_package_called_apps_does_not_take_its_place(self, tmp_path):
        (tmp_path / "apps").mkdir()
        (tmp_path / "apps" / "__init__.py").write_text("raise RuntimeError('not this one')\n")
        done = start([*PROGRAM, "--version"], tmp_path, tmp_path)
        assert (done.returncode, done.stdout) == (0, f"{tofclip.__version__}\n")
        assert done.stderr == ""


# verbs that read a file, a folder, a pattern or an address
READERS = [
    verb
    for verb, command in VERBS.items()
    if any(one.param_type_name == "argument" and one.callback for one in command.params)
]


class TestErrors:
    def test_libraries_say_nothing_before_the_one_line(self):
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
        plain, whole = start_python(code), start_python(code, "--debug")
        assert (plain.returncode, plain.stdout) == (2, "")
        assert plain.stderr == "tofclip: error: photon counts must be finite\n"
        assert "RuntimeWarning: invalid value" in whole.stderr
        assert "read of 5 bytes" in whole.stderr

    def test_debug_shows_where_an_error_came_from(self, shell):
        plain, traced = shell.refuses("info absent"), shell("info absent --debug")
        assert traced.status == 2
        assert traced.err.startswith("Traceback")
        assert traced.err.endswith(plain)

    def test_a_defect_is_one_line_as_well(self, shell, monkeypatch):
        def fail(*_):
            raise ZeroDivisionError("a defect\nin two lines")

        monkeypatch.setattr("tofclip.loading.outline", fail)
        outcome = shell("info {files}/camera.h5")
        said = "tofclip: error: unforeseen ZeroDivisionError: a defect in two lines"
        assert outcome.status == cli.EXIT_DEFECT
        assert outcome.err.startswith(said)
        assert outcome.err.count("\n") == 1

    def test_a_reader_that_goes_away(self, files):
        read, write = os.pipe()
        os.close(read)  # nobody will ever read
        words = [*PROGRAM, "info", files / "camera.h5"]
        done = subprocess.run(words, cwd=ROOT, stdout=write, stderr=subprocess.PIPE, check=False)
        os.close(write)
        assert (done.returncode, done.stderr) == (cli.EXIT_BROKEN_PIPE, b"")

    def test_a_disk_without_room(self, files, tmp_path):
        """A limit on the size of files stands for the disk: both refuse to write on, in the middle
        of a file.
        """
        words = [*PROGRAM, "convert", files / "streak.h5", "--out", tmp_path / "copy.h5"]
        done = start(["bash", "-c", f"ulimit -f 8; exec {shlex.join(map(str, words))}"])
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
        assert "copy.h5: cannot be written" in done.stderr
        assert list(tmp_path.iterdir()) == []
        with open("/dev/full", "w") as full:
            words = [*PROGRAM, "info", files / "camera.h5"]
            done = subprocess.run(words, cwd=ROOT, stdout=full, stderr=subprocess.PIPE, check=False)
        assert (done.returncode, done.stderr.count(b"\n")) == (2, 1)

    @pytest.mark.parametrize("verb", READERS)
    def test_a_missing_file_is_refused_before_anything_else(self, shell, verb):
        said = shell.refuses(f"{verb} absent.h5")
        assert said == "tofclip: error: absent.h5: no such file\n"
        assert len(READERS) == 22


def read_terminal(terminal, until=""):
    """What is written on a terminal: until a text appears, or up to the end."""
    seen = ""
    while not until or until not in seen:
        try:
            seen += os.read(terminal, 4096).decode(errors="replace")
        except OSError:  # the other side is closed and everything has been read
            assert not until, f"{until!r} never appeared on the terminal: {seen!r}"
            break
    return seen


def start_on_terminal(command, **options):
    """Start a command whose messages go to a terminal; return both."""
    ours, its = pty.openpty()
    process = subprocess.Popen(command, cwd=ROOT, stderr=its, text=True, **options)
    os.close(its)
    return process, ours


RAISE = "raise KeyboardInterrupt\n"


class TestInterruption:
    @pytest.mark.parametrize(
        ("line", "bar"),
        [
            ("recover {files}/streak.h5 --iterations 1000000", "recovering"),
            ("nlos reconstruct {curved} --method backprojection --everywhere --voxel-mm 3", "imag"),
        ],
    )
    def test_ctrl_c_leaves_nothing_behind(self, files, curved, tmp_path, line, bar):
        words = f"{line} --out {tmp_path}/out.h5".format(files=files, curved=curved).split()
        process, terminal = start_on_terminal([*PROGRAM, *words], stdout=subprocess.PIPE)
        read_terminal(terminal, bar)  # it is drawn, so the work has begun
        process.send_signal(signal.SIGINT)
        pressed = time.monotonic()
        out, _ = process.communicate(timeout=LONGEST_WAIT_S)
        assert (process.returncode, out) == (130, "")
        # The work would take an hour; the end must not wait for it. The margin is for a busy machine.
        assert time.monotonic() - pressed < 20
        assert "Traceback" not in read_terminal(terminal, "tofclip: interrupted")
        os.close(terminal)
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize(
        ("module", "code"),
        [
            ("pathlib", RAISE),  # the first module of all
            ("h5py", RAISE),  # one that a verb imports
            # while a class is made
            ("h5py", f"class Late:\n def __set_name__(*_): {RAISE}class Owner:\n late = Late()\n"),
            # where Python drops exceptions, as in what is called when an object goes
            ("h5py", f"import time\nclass Gone:\n def __del__(_): {RAISE}Gone()\ntime.sleep(20)\n"),
        ],
    )
    def test_ctrl_c_while_the_program_starts_shows_no_traceback(self, tmp_path, module, code):
        (tmp_path / f"{module}.py").write_text(code)
        (tmp_path / "there.h5").touch()
        done = start([*PROGRAM, "info", "there.h5"], tmp_path, tmp_path)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (130, "", 1)
        assert done.stderr.startswith("tofclip: interrupted")

    def test_little_is_loaded_before_a_ctrl_c_can_be_caught(self, tmp_path):
        (tmp_path / "lazy_loader.py").write_text(RAISE)
        done = start([*PROGRAM, "--version"], tmp_path, tmp_path)
        assert (done.returncode, done.stdout) == (0, f"{tofclip.__version__}\n")


class TestProgress:
    CODE = """
import time
from apps.progress import show_activity, show_progress
with show_progress("choosing the weight", 4) as advance:
    for _ in range(4):
        advance(1)
        time.sleep(0.15)
with show_activity("simulating"):
    time.sleep(0.3)
print("done")
"""

    def test_a_bar_shows_what_is_done_how_long_it_took_and_what_is_left(self):
        terminal = os.environ | {"TERM": "xterm", "COLUMNS": "100", "PYTHONPATH": str(ROOT)}
        process, ours = start_on_terminal([sys.executable, "-c", self.CODE], env=terminal)
        seen = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", read_terminal(ours))
        assert process.wait(LONGEST_WAIT_S) == 0
        os.close(ours)
        lines = [line for line in re.split(r"[\r\n]+", seen) if "choosing the weight" in line]
        assert any("50%" in line for line in lines)
        assert all(re.search(r"\d:\d\d:\d\d left", line) for line in lines)
        assert re.search(r"simulating .*0:00:00", seen)

    def test_without_a_terminal_there_is_none(self):
        ended = start_python(self.CODE)
        assert (ended.stdout, ended.stderr) == ("done\n", "")


RECOVER = "recover {files}/streak.h5 --out {new}/frames.h5 --method linear"
# For each package, the name to install, or none if all works without, and what needs it.
NEEDED = {
    "h5py": ("h5py", "info {files}/camera.h5"),
    "matplotlib": ("matplotlib", RECOVER),
    "numba": ("numba", RECOVER),
    "numpy": ("numpy", "info {files}/camera.h5"),
    # it fits planes, in Python and on the page
    "open3d": (None, "cloud {frames} --out {new}/scene.ply --drop-outliers"),
    "OpenEXR": ("OpenEXR", "cloud {frames} --out {new}/depth.exr"),
    "pyfftw": (None, "info {files}/camera.h5"),  # images: tests/nlos
    "pyvista": (None, "view {frames} --png {new}/view.png"),
    "scipy": ("scipy", RECOVER),
    "tifffile": ("tifffile", "info {files}/streak.tif"),
    "typer": ("typer", "--version"),
    "usb": ("pyusb", "devices info timetag://1"),
    "viser": ("viser", "view {frames} --no-browser"),
}
AT_TIMES = ("open3d", "OpenEXR", "pyfftw", "pyvista", "tifffile", "usb", "viser")
"""Those that only some verbs need: they may all be absent at once."""


class TestMissingPackages:
    """One line says which, where it is needed, and everything else works."""

    ABSENT = """
import os, sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in os.environ["ABSENT"].split():
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
"""

    RUN = """
import contextlib, io, json, sys
from apps.cli import main
for line in sys.argv[1:]:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(line.split())
    print(json.dumps([status, out.getvalue(), err.getvalue()]))
"""

    @pytest.fixture(scope="class")
    @classmethod
    def hook(cls, tmp_path_factory):
        """Folder whose presence on the path hides packages, also from what the program starts."""
        folder = tmp_path_factory.mktemp("absent")
        (folder / "sitecustomize.py").write_text(cls.ABSENT)
        return folder

    @pytest.fixture(scope="class")
    @classmethod
    def frames(cls, files, tmp_path_factory):
        out = tmp_path_factory.mktemp("frames") / "frames.h5"
        tofclip.recover(tofclip.read_streak(files / "streak.h5"), method="linear").save(out)
        return out

    @pytest.fixture(scope="class")
    @classmethod
    def outcomes(cls, hook, files, frames, tmp_path_factory):
        """Status, output and messages by line, of one process without all that some verbs need."""
        new = tmp_path_factory.mktemp("new")
        lines = [NEEDED[name][1].format(files=files, frames=frames, new=new) for name in AT_TIMES]
        words = [sys.executable, "-c", cls.RUN, *lines, "doctor --json"]
        done = start(words, path=hook, ABSENT=" ".join(AT_TIMES))
        assert done.returncode == 0, done.stderr
        found = map(json.loads, done.stdout.splitlines())
        return dict(zip([*AT_TIMES, "doctor"], found, strict=True))

    @pytest.mark.parametrize("package", NEEDED)
    def test_without_a_package(self, hook, outcomes, package, files, tmp_path):
        distribution, line = NEEDED[package]
        if package in AT_TIMES:
            status, _, said = outcomes[package]
        else:
            words = line.format(files=files, new=tmp_path).split()
            done = start([*PROGRAM, *words], path=hook, ABSENT=package)
            status, said = done.returncode, done.stderr
        # What takes long on a busy machine is announced.
        said = "".join(line for line in said.splitlines(True) if not line.endswith(" ...\n"))
        if distribution is None:
            assert (status, said) == (0, "")
        else:
            assert (status, said.count("\n")) == (2, 1), said
            assert said.startswith("tofclip: error: ")
            assert f"install {distribution}" in said
            assert "unforeseen" not in said

    def test_the_small_installation_leaves_out_open3d_and_pyvista_only(self):
        project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
        small = (ROOT / "requirements-core.txt").read_text().splitlines()[1:]
        left_out = {*project["dependencies"]} - {*small}
        assert {*small} <= {*project["dependencies"]}
        assert all(one.startswith(("open3d", "pyvista")) for one in left_out)

    def test_doctor_names_what_is_missing(self, outcomes):
        status, out, _ = outcomes["doctor"]
        found = json.loads(out)
        missing = {fault.split("'")[1] for fault in found["faults"]}
        assert (status, missing) == (1, {"tifffile", "viser"})
        assert "the package 'viser' is missing: pip install viser" in found["faults"]
        assert "pyusb" in found["usb"]

    def test_help_needs_none_of_them(self, hook):
        hidden = " ".join(set(NEEDED) - {"typer"})
        done = start([*PROGRAM, "--help"], path=hook, ABSENT=hidden)
        assert (done.returncode, done.stderr) == (0, "")
        assert "recover" in done.stdout

    def test_a_module_of_our_own_that_is_missing_is_a_defect(self):
        gone = ModuleNotFoundError("gone", name="tofclip.gone")
        assert describe_missing_package(gone) is None
        assert describe_missing_package(ImportError("no name")) is None
        broken = ImportError("libGL.so.1: not found", name="pyvista")
        said = "the package 'pyvista' does not load on this machine: libGL.so.1: not found"
        assert describe_missing_package(broken) == said


class TestWarmUp:
    def test_every_step_is_a_command_that_the_program_takes(self, tmp_path):
        steps = [step.replace("@", f"{tmp_path}/").split() for step in installation.list_steps()]
        for words in steps:
            for word in words:
                if word.startswith(str(tmp_path)):
                    Path(word).mkdir(parents=True, exist_ok=True)
            depth = 1 if words[0] in VERBS else 2
            with VERBS[" ".join(words[:depth])].make_context("step", words[depth:]) as context:
                assert context.params
        named = {words[words.index("--method") + 1] for words in steps if "--method" in words}
        assert named >= {"tv", "l1", "linear", "adjoint", *METHODS}

    def test_it_runs_its_steps(self, shell, monkeypatch):
        quick = ("linear", "adjoint", "cloud @frames")
        steps = [one for one in installation.list_steps() if any(word in one for word in quick)]
        monkeypatch.setattr(installation, "list_steps", lambda: steps)
        found = shell.figures("warm-up")
        assert found["steps"] == 3
        assert found["seconds"] > 0

    def test_a_step_that_fails_is_named(self, shell, monkeypatch):
        monkeypatch.setattr(installation, "list_steps", lambda: ["info absent.h5"])
        shell.refuses("warm-up", "info absent.h5 failed: absent.h5: no such file")
