"""The console program `tofclip`: one verb, one small module in `apps.verbs`.

A verb's module is imported when the verb is called, so that the program's own help appears at once.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import gc
import logging
import os
import re
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import typer

from apps.help import (
    DEBUG_FLAG,
    EPILOG,
    EXIT_BROKEN_PIPE,
    EXIT_DEFECT,
    EXIT_INPUT_ERROR,
    EXIT_INTERRUPTED,
    HELP_OPTIONS,
    MAX_HELP_WIDTH,
    OVERWRITE_FLAG,
    PROGRAM,
    QUIET_FLAGS,
    VERBOSE_FLAGS,
    find_help,
    make_verb_group,
)
from apps.progress import silence
from apps.report import name_options, replace_results
from tofclip.errors import InputError, TofclipError
from tofclip.files import describe_missing_package
from tofclip.version import __version__

QUANTITIES = {
    **{
        name: ("length", 10.0**power)
        for name, power in (("um", -6), ("mm", -3), ("cm", -2), ("m", 0))
    },
    **{
        name: ("time", 10.0**power)
        for name, power in (("fs", -15), ("ps", -12), ("ns", -9), ("us", -6), ("ms", -3), ("s", 0))
    },
}
"""Units that a value may carry, such as 20ps, and that options' names end in: kind, and in SI units."""
QUANTITY = re.compile(r"(?P<number>[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?) ?(?P<unit>[^\W\d_]+)")

COMPILING = "tofclip.compiling"  # its logger; the module itself would import the compiler

UNUSABLE_NAMES = (errno.ENAMETOOLONG, errno.ELOOP)
"""What the operating system says of names that no file can have, whatever is done with them."""

COMPLETION_VARIABLE = "_TOFCLIP_COMPLETE"  # set by shells that ask how a command line may go on

VERB_OVERVIEW = f"""\
tofclip {__version__}: 3D from streak images, through occluders and around corners

                   four focus pictures
                            |
                        calibrate
                            |
                        camera.h5
                            |
  raw streak image -> recover --> frames.h5 --+--> cloud ------------> scene.ply
  or an instrument                            |
                                              +--> nlos reconstruct -> volume.h5

  demo              all of it on a simulated scene, no files needed: start here
  calibrate         a camera's views, from four pictures of a point source
  calibrate range   time zero and range walk, from shots of a target
  recover           streak image to one picture per instant
  cloud             recovered frames to a point cloud
  view              any of these on a page, in a window, as a picture or a film
  stream            shots to clouds while they come, with latencies
  lidar photons     counted photons to a range image and a point cloud
  lidar accuracy    accuracy of ranges from photons, beside the Cramer-Rao bound
  lidar parallax    how views move with range, for recover --focus depth-locked
  lidar scene       recovered frames to a list of objects and a picture
  lidar sequence    a folder or stack of shots to a sequence of clouds
  lidar bag         a sequence of clouds to a ROS 2 bag or an MCAP file
  nlos reconstruct  recovered frames of a wall to what is around the corner
  nlos info         what a capture of a wall can show, and by which method
  nlos stream       captures to volumes while they come, with latencies
  nlos film         the flash passing through the hidden scene, as a film
  nlos compare      several methods on one capture, with time and memory
  nlos simulate     the capture of a known hidden scene
  nlos demo         a hidden scene and a curved wall, a fast and a slow method
  occlusion         what stands behind an occluder: inactive region, demo
  clip              light fields from few measurements: simulate, recover
  reproduce         the paper's tables and figures, made again
  design            an instrument before it is built: what it will see, how well
  bench             how fast and how large all this is on this machine
  devices           instruments and recordings: list, info, test, verify, repair
  record            an instrument's bytes, to be replayed exactly
  convert           any readable streak image to this program's own HDF5
  warm-up           compile everything now, so that no later run waits for it
  plugins           methods, denoisers, readers, instruments, and whose they are
  doctor            what this installation has, and what installs the rest
  info              what a file holds

  tofclip VERB --help explains a verb. Exit status: 0 done, 1 some failed,
  2 unusable input, 130 interrupted."""

VERBS = {
    "demo": "Simulate a scene of letters and plates, recover it from one streak image, and compare with the truth.",
    "calibrate": "Find every view's slit centre and line angle, and draw the fits over the data.",
    "calibrate range": "Find time zero, range walk, offsets, response and reflectance from shots of a target.",
    "recover": "Recover every transient frame of a raw streak image, or of each one of a sequence.",
    "cloud": "Find each pixel's returns and place them in space: x right, y down, z forward, in metres.",
    "view": "Look at a source: on a page of the browser, in a window, as a picture or as a film.",
    "stream": "Make a cloud of each shot while the next ones come; report method, rate and latencies.",
    "lidar": "How well a range can be known, and how the views' parallax grows with it; many shots in a row.",
    "nlos": "Image the scene hidden around a corner.",
    "clip": "Light fields from few nonlocal measurements.",
    "occlusion": "See through occluders: which places no view can see, and a demonstration of the others.",
    "reproduce": "Make tables and figures of the paper again, its figures beside ours.",
    "design": "Say what a CLIP instrument will see before it is built, by theory and by simulated shots.",
    "bench": "Measure time and memory, each beside the least that the work needs.",
    "devices": "Streak cameras, SPAD sensors, time taggers and their recordings, which tofclip record makes.",
    "record": "Record an instrument: its bytes as they come, with clock, accounts and calibration.",
    "convert": "Turn a streak image into this program's HDF5, with its time axis, camera, text and relay wall inside.",
    "warm-up": "Run everything that is compiled on first use once, on small data.",
    "plugins": "List methods, denoisers, readers and instruments, by whom they are, and what does not load.",
    "doctor": "Say what this installation has: packages, GPU, USB, compiled loops, graphics, disk and memory.",
    "info": "Say what kind of thing a file holds: shapes, axes, units, text, and how it came about.",
}
"""The verbs, and groups of them, with their lines in the list of commands."""

HOMES = {
    **dict.fromkeys(("demo", "warm-up", "plugins", "doctor"), "installation"),
    **dict.fromkeys(("reproduce", "bench"), "proof"),
    **dict.fromkeys(("convert", "info"), "files"),
    **dict.fromkeys(("calibrate range", "design"), "calibrate"),
    **dict.fromkeys(("cloud", "stream"), "recover"),
    "record": "devices",
}
"""Modules in `apps.verbs` that are not called like their verb."""

app = typer.Typer(
    name=PROGRAM,
    cls=make_verb_group(VERBS, HOMES),
    pretty_exceptions_enable=False,
    context_settings={"max_content_width": MAX_HELP_WIDTH, "help_option_names": HELP_OPTIONS},
    epilog=EPILOG,
)


@app.callback(invoke_without_command=True)
def _show_overview(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False,
) -> None:
    """From raw streak images to transient frames, point clouds and scenes around corners."""
    if version:
        print(__version__)
        raise typer.Exit
    if context.invoked_subcommand is None:
        print(VERB_OVERVIEW)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program and return its exit status. `arguments`: defaults to the command line's."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug, verbose, quiet, replacing = (
        not {*words}.isdisjoint(flags)
        for flags in ([DEBUG_FLAG], VERBOSE_FLAGS, QUIET_FLAGS, [OVERWRITE_FLAG])
    )
    own = {DEBUG_FLAG, OVERWRITE_FLAG, *QUIET_FLAGS, *VERBOSE_FLAGS}
    words = [word for word in words if word not in own]
    _heed_end_signals()
    # The interpreter's last search for unused objects takes a quarter of a second, and frees nothing
    # that the system would not.
    atexit.register(gc.freeze)
    with (
        _keep_to_one_line(debug or verbose),
        replace_results(replacing),
        silence() if quiet else contextlib.nullcontext(),
    ):
        status = int(_run(words, debug) or 0)
    if status == EXIT_INTERRUPTED:
        print("tofclip: interrupted; no unfinished file was left behind", file=sys.stderr)
    return status


def _run(words: Sequence[str], debug: bool) -> Any:
    """Run a verb and return its exit status."""
    try:
        words = convert_quantities(words)
        text = find_help(app, words)
        if text is not None:
            print(text)
        status = 0 if text else app(words, prog_name=PROGRAM, standalone_mode=False)
        sys.stdout.flush()
    except Exception as fault:
        if debug:
            traceback.print_exc()
        return _report_error(fault)
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except SystemExit as end:  # typer's answer to a broken pipe, and the end of shell completion
        completes = end.code == 0 or COMPLETION_VARIABLE in os.environ
        return end.code if completes else EXIT_BROKEN_PIPE
    return status


def convert_quantities(words: Sequence[str]) -> list[str]:
    """Write quantities in the unit that their option's name ends in.

    Examples
    --------
    >>> convert_quantities(["--bin-width-ps", "0.02ns", "--gate-m=30mm"])
    ['--bin-width-ps', '20', '--gate-m=0.03']
    """
    converted: list[str] = []
    if "" in words:  # as a path it would be the folder that one is in
        raise InputError("an argument is empty; is a variable of the shell not set?")
    for word in words:
        option, equals, value = word.partition("=")
        if not equals:
            option, value = (converted or [""])[-1], word
        wanted, found = option.rpartition("-")[2], QUANTITY.fullmatch(value)
        if option.startswith("--") and wanted in QUANTITIES and found:
            (kind, unit), (given, factor) = (
                QUANTITIES.get(name, ("", 1.0)) for name in (wanted, found["unit"])
            )
            if kind != given:
                known = ", ".join(name for name, (of, _) in QUANTITIES.items() if of == kind)
                raise InputError(
                    f"{option} {value}: give a {kind}, such as {found['number']}{wanted} (units: {known})"
                )
            value = f"{float(found['number']) * factor / unit:.15g}"
            word = f"{option}={value}" if equals else value
        converted.append(word)
    return converted


@contextlib.contextmanager
def _keep_to_one_line(verbose: bool) -> Iterator[None]:
    """Say what the compiler has to say, and keep the libraries' warnings and log lines off the
    screen, where they would stand before the one line about an error, unless they are asked for.
    """
    root, compiling, show = logging.getLogger(), logging.getLogger(COMPILING), warnings.showwarning
    notes, silence, level = _CompileNotes(), logging.NullHandler(), compiling.level
    compiling.addHandler(notes)
    compiling.setLevel(logging.INFO)
    if not verbose:
        root.addHandler(silence)
        warnings.showwarning = lambda *_, **__: None
    try:
        yield
    finally:
        warnings.showwarning = show
        root.removeHandler(silence)
        compiling.setLevel(level)
        compiling.removeHandler(notes)


class _CompileNotes(logging.Handler):
    """Says once, on a terminal, why a first run takes longer, and anywhere what keeps compiled
    loops from being kept.
    """

    def __init__(self) -> None:
        super().__init__()
        # Not what it is later: `warm-up` redirects what its steps print.
        self._stream, self._given = sys.stderr, False

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if record.levelno >= logging.WARNING:
            print(f"tofclip: warning: {text}", file=self._stream)
        elif not self._given and sys.stderr.isatty():
            self._given = True
            print(
                f"compiling loops for this processor, once ({text} and others; "
                "tofclip warm-up does all beforehand)",
                file=self._stream,
            )


def _heed_end_signals() -> None:
    """Let SIGTERM and SIGHUP end the program as Ctrl-C does, so that instruments are switched off
    and files closed; where it was started to ignore one of them, it still does.
    """
    if threading.current_thread() is not threading.main_thread():
        return
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, signal.default_int_handler)


def _report_error(fault: Exception) -> int:
    """Print one line about an error and return the exit status."""
    if isinstance(fault, BrokenPipeError):
        # Python flushes once more at exit; let that go nowhere instead of failing again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_BROKEN_PIPE
    message, status = _describe_unusable_input(fault), EXIT_INPUT_ERROR
    if message is None:
        message = f"unforeseen {type(fault).__name__}: {fault} ({DEBUG_FLAG} shows where; please report it)"
        status = EXIT_DEFECT
    print(f"tofclip: error: {' '.join(message.split())}", file=sys.stderr)
    return status


def _describe_unusable_input(fault: Exception) -> str | None:
    """Say what the user can do about an error; None where it is a defect of this program."""
    if isinstance(fault, typer.TyperException):
        return f"{fault.format_message().rstrip(' .')} (see --help)"
    if isinstance(fault, TofclipError):
        return name_options(str(fault))
    if isinstance(fault, MemoryError):
        return f"this computer's memory does not suffice: {fault}"
    if isinstance(fault, OSError) and fault.errno in UNUSABLE_NAMES:
        return f"a name cannot be used: {fault.strerror} ({fault.filename})"
    return describe_missing_package(fault) if isinstance(fault, ImportError) else None
