"""The console program `tofclip`: one verb, one function in a module of `apps.verbs`, and its help, made from
its docstring.

A verb's module is imported when the verb is called or listed, and imports little itself. A docstring ends in
a paragraph that begins with ``Example:``; several such paragraphs are several examples.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import gc
import inspect
import logging
import os
import re
import signal
import sys
import textwrap
import threading
import traceback
import warnings
from _thread import interrupt_main
from collections.abc import Iterator, Sequence
from functools import cache, partial
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup, TyperOption

from apps.options import take_json
from apps.progress import silence
from apps.report import REPLACES, holding, name_options
from tofclip.errors import InputError, TofclipError
from tofclip.files import DISK_IS_FULL, describe_missing_package
from tofclip.version import __version__

PROGRAM = "tofclip"
HELP_OPTIONS = ["-h", "--help"]
DEBUG_FLAG, OVERWRITE_FLAG = "--debug", "--overwrite"
QUIET_FLAGS, VERBOSE_FLAGS = ("-q", "--quiet"), ("-v", "--verbose")

EXIT_INPUT_ERROR = 2
EXIT_DEFECT = 1
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as shells report it
EXIT_BROKEN_PIPE = 141  # 128 + SIGPIPE
EPILOG = (
    f"Exit status: 0 done; {EXIT_INPUT_ERROR} unusable input, with one line on standard error that says what to do; "
    f"{EXIT_INTERRUPTED} interrupted; {EXIT_DEFECT} some of a sequence failed, or a defect of this program. "
    f"Anywhere: {OVERWRITE_FLAG} replaces results that exist; {QUIET_FLAGS[0]} prints errors only, "
    f"{VERBOSE_FLAGS[0]} what the libraries say as well, {DEBUG_FLAG} where an error came from."
)

EXAMPLE_MARK = "Example:"
AS_WRITTEN = "\b\n"  # before a paragraph whose lines typer must not join
MAX_EXAMPLE_WIDTH = 72  # columns, which with the indentation fit the narrowest usual terminal
MAX_HELP_WIDTH = 100  # columns, on a terminal that has them

POWERS = {
    "length": {"um": -6, "mm": -3, "cm": -2, "m": 0},
    "time": {"fs": -15, "ps": -12, "ns": -9, "us": -6, "ms": -3, "s": 0},
}
QUANTITIES = {
    unit: (kind, 10.0**power) for kind, units in POWERS.items() for unit, power in units.items()
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

VERBS = (
    *("demo", "calibrate", "calibrate range", "recover", "cloud", "view", "stream"),
    *("lidar", "nlos", "clip", "occlusion", "reproduce", "design", "bench", "devices"),
    *("record", "convert", "warm-up", "plugins", "doctor", "info"),
)
"""The verbs, and groups of them, in the order of the list of commands."""

HOMES = {
    **dict.fromkeys(("demo", "warm-up", "plugins", "doctor"), "installation"),
    **dict.fromkeys(("reproduce", "bench"), "proof"),
    **dict.fromkeys(("convert", "info"), "files"),
    **dict.fromkeys(("calibrate range", "design"), "calibrate"),
    **dict.fromkeys(("cloud", "stream"), "recover"),
    "record": "devices",
}
"""Modules in `apps.verbs` that are not called like their verb; each has its function, or a group
``app``.
"""

Command = TyperCommand | TyperGroup


class VerbGroup(TyperGroup):
    """The program's verbs, of which only the one that is called is imported. A verb of two words,
    such as ``calibrate range``, stands beside one called by the first alone.
    """

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands: Any = dict.fromkeys(VERBS)
        self.rich_markup_mode = None

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the options, those of completion too, which typer adds later."""
        return _hide_types_of_flags(super().get_params(ctx))

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Take the two words of a verb as its name."""
        if " ".join(args[:2]) in VERBS:
            args = [" ".join(args[:2]), *args[2:]]
        return super().resolve_command(ctx, args)

    def get_command(self, ctx: Any, cmd_name: str) -> Command | None:
        return load_verb(cmd_name) if cmd_name in VERBS else None

    def shell_complete(self, ctx: Any, incomplete: str) -> Any:
        """Complete single words, as shells take them."""
        return [item for item in super().shell_complete(ctx, incomplete) if " " not in item.value]


@cache
def load_verb(name: str) -> Command:
    """Import a verb and return its command, which is a group if that is what its module has."""
    own = re.sub("[- ]", "_", name)
    home = import_module(f"apps.verbs.{HOMES.get(name, own)}")
    is_group = not hasattr(home, own)
    app: typer.Typer = home.app if is_group else typer.Typer()
    if not is_group:
        app.command(name)(getattr(home, own))
    for verb in app.registered_commands:
        _set_help(verb)
        verb.callback = take_json(verb.callback)
    group = typer.main.get_group(app)
    group.name, group.short_help = name, group.help
    command: Any = group if is_group else group.commands[name]
    simplify_help(command)
    return command


def make_group(meaning: str) -> typer.Typer:
    """Return a group of verbs that alone shows its help."""
    app = typer.Typer()

    def show_help(context: typer.Context) -> None:
        if context.invoked_subcommand is None:
            print(context.get_help())

    app.callback(invoke_without_command=True, help=meaning)(show_help)
    return app


def walk_verbs() -> dict[str, TyperCommand]:
    """Import every verb and return the commands by the words that call them, as in the help."""
    found: dict[str, TyperCommand] = {}
    for name in VERBS:
        command = load_verb(name)
        if isinstance(command, TyperGroup):
            found |= {f"{name} {word}": verb for word, verb in command.commands.items()}  # type: ignore[misc]
        else:
            found[name] = command
    return found


def find_help(words: Sequence[str]) -> str | None:
    """Return the help that words ask for; what parses options takes longer to import."""
    *names, last = words or ("",)
    if last not in HELP_OPTIONS or not names or any(name.startswith("-") for name in names):
        return None
    command: Any = typer.main.get_group(app)
    context = typer.Context(command, info_name=PROGRAM, **command.context_settings)
    while names and isinstance(command, TyperGroup):
        name, command, names = command.resolve_command(context, names)
        context = typer.Context(command, info_name=name, parent=context)
    return str(command.get_help(context))


def simplify_help(command: Command) -> None:
    """Let a command, and those of a group, show their help as plain text, without Python's types, and
    take ``-o`` for ``--out``. Importing what draws frames around the help takes longer than all the
    rest of showing it.
    """
    command.rich_markup_mode = None
    command.format_options = partial(_write_options, command)  # type: ignore[method-assign]
    usage = command.collect_usage_pieces
    # typer writes ``{SHOT...}...``
    command.collect_usage_pieces = lambda ctx: [  # type: ignore[method-assign]
        re.sub(r"^\{(.*?)(\.\.\.)?\}", r"\1", piece) for piece in usage(ctx)
    ]
    context = typer.Context(command, help_option_names=HELP_OPTIONS)
    for param in _hide_types_of_flags(command.get_params(context)):
        if param.opts == ["--out"]:
            param.opts.insert(0, "-o")
    for further in getattr(command, "commands", {}).values():
        simplify_help(further)


def _write_options(command: Command, ctx: Any, formatter: Any) -> None:
    """Write arguments, options and settings under their headings, and a group's verbs."""
    panels: dict[str, list[tuple[str, str]]] = {}
    for param in command.get_params(ctx):
        entry = param.get_help_record(ctx)
        if entry is not None:
            usual = "Arguments" if param.param_type_name == "argument" else "Options"
            heading = getattr(param, "rich_help_panel", None) or usual
            # typer puts a default in words into brackets of its own
            text = re.sub(r"\[default: \((.*)\)\]$", r"[default: \1]", entry[1])
            name = re.sub(r" <.*>$", "", entry[0])
            panels.setdefault(heading, []).append((name, text.removesuffix("  [default: none]")))
    for heading, entries in panels.items():
        with formatter.section(heading):
            formatter.write_dl(entries)
    if isinstance(command, TyperGroup):
        command.format_commands(ctx, formatter)


def _hide_types_of_flags(params: list[Any]) -> list[Any]:
    for param in params:
        if isinstance(param, TyperOption) and param.is_flag:
            param.metavar = ""
    return params


def _set_help(verb: Any) -> None:
    """Make a verb's help from its docstring; the exit statuses are its last paragraph."""
    prose, examples = split_docstring(verb.callback.__doc__)
    verb.help = "\n\n".join(f"{AS_WRITTEN}{one}" if _is_table(one) else one for one in prose)
    verb.short_help = prose[0] if prose else None  # shown whole, not its first words
    shown = [f"{AS_WRITTEN}{EXAMPLE_MARK}\n    {wrap_command(example)}" for example in examples]
    verb.epilog = "\n\n".join([*shown, EPILOG])


def split_docstring(docstring: str | None) -> tuple[list[str], list[str]]:
    """Split a docstring into its paragraphs of prose and its example commands. Lines of a paragraph
    are joined, since a terminal is narrower than the source; one with indented lines stays.
    """
    paragraphs = [one for one in inspect.cleandoc(docstring or "").split("\n\n") if one.strip()]
    examples = [" ".join(one.split()[1:]) for one in paragraphs if one.startswith(EXAMPLE_MARK)]
    prose = [one for one in paragraphs if not one.startswith(EXAMPLE_MARK)]
    return [one if _is_table(one) else " ".join(one.split()) for one in prose], examples


def wrap_command(command: str) -> str:
    """Break a long command between its words, as a shell takes it."""
    lines = textwrap.wrap(
        command, MAX_EXAMPLE_WIDTH, break_long_words=False, break_on_hyphens=False
    )
    return " \\\n        ".join(lines)


def _is_table(paragraph: str) -> bool:
    return re.search(r"^( |[*-] )", paragraph, re.MULTILINE) is not None


app = typer.Typer(
    name=PROGRAM,
    cls=VerbGroup,
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
        holding(REPLACES, replacing),
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
        text = find_help(words)
        if text is not None:
            print(text)
        status = 0 if text else app(words, prog_name=PROGRAM, standalone_mode=False)
        sys.stdout.flush()
    except Exception as fault:
        # while a class is made, Python up to 3.11 turns a Ctrl-C into a RuntimeError
        if isinstance(fault.__cause__, KeyboardInterrupt):
            return EXIT_INTERRUPTED
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
    """Says once, on a terminal, why a first run takes longer, and anywhere that no loop is kept."""

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
    sys.unraisablehook = _interrupt_again


def _interrupt_again(lost: Any) -> None:
    """Repeat a Ctrl-C that came where Python lets no exception out, as while an import forgets its
    lock: once in a hundred at start-up the program would go on.
    """
    if lost.exc_type is KeyboardInterrupt:
        again = threading.Timer(0.01, interrupt_main)
        again.daemon = True
        again.start()
    else:
        sys.__unraisablehook__(lost)


def _report_error(fault: Exception) -> int:
    """Print one line about an error and return the exit status."""
    if isinstance(fault, OSError) and fault.errno in (errno.EPIPE, errno.ENOSPC):
        # Python flushes once more at exit; let that go nowhere instead of failing again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if isinstance(fault, BrokenPipeError):
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
    if isinstance(fault, OSError) and fault.errno == errno.ENOSPC:  # of files, their writers say it
        return f"standard output: cannot be written: {DISK_IS_FULL}"
    if isinstance(fault, OSError) and fault.errno in UNUSABLE_NAMES:
        return f"a name cannot be used: {fault.strerror} ({fault.filename})"
    return describe_missing_package(fault) if isinstance(fault, ImportError) else None
