"""The verbs as the command line shows them: each with its help, made from its docstring.

The list of commands and the completion of a verb's name come from a table of names and one-line
helps; a verb's module is imported when it is called. Its docstring ends in a paragraph that begins
with ``Example:``; several such paragraphs are several examples.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Mapping, Sequence
from functools import partial
from importlib import import_module
from typing import Any, cast

import typer
from typer.core import TyperCommand, TyperGroup, TyperOption

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

Command = TyperCommand | TyperGroup


class VerbGroup(TyperGroup):
    """The program's verbs, of which only the one that is called is imported. A verb of two words,
    such as ``calibrate range``, stands beside one called by the first alone.
    """

    verbs: Mapping[str, str]
    homes: Mapping[str, str]

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        for name, line in self.verbs.items():
            self.add_command(TyperCommand(name, help=line, short_help=line))
        self.rich_markup_mode = None

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the options, those of completion too, which typer adds later."""
        return _hide_types_of_flags(super().get_params(ctx))

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the verb that is called, and import it."""
        if " ".join(args[:2]) in self.verbs:
            args = [" ".join(args[:2]), *args[2:]]
        name, listed, further = super().resolve_command(ctx, args)
        return name, (name and self.load_verb(name)) or listed, further

    def load_verb(self, name: str) -> Command:
        """Import a verb and return its command, which is a group if that is what its module has."""
        own = re.sub("[- ]", "_", name)
        home = import_module(f"apps.verbs.{self.homes.get(name, own)}")
        is_group = not hasattr(home, own)
        app: typer.Typer = home.app if is_group else typer.Typer()
        if not is_group:
            app.command(name)(getattr(home, own))
        for verb in app.registered_commands:
            _set_help(verb)
        group = typer.main.get_group(app)
        group.name = name
        command = group if is_group else cast("TyperCommand", group.commands[name])
        simplify_help(command)
        return command

    def shell_complete(self, ctx: Any, incomplete: str) -> Any:
        """Complete single words, as shells take them."""
        return [item for item in super().shell_complete(ctx, incomplete) if " " not in item.value]


def make_verb_group(verbs: Mapping[str, str], homes: Mapping[str, str]) -> type[VerbGroup]:
    """Return the class of the group of all verbs, for the ``cls`` of a ``typer.Typer``. `verbs`:
    their lines in the list of commands, in its order; `homes`: modules of `apps.verbs` that are not
    called like their verb. A module has a function called like the verb, or a group ``app``.
    """
    return type("Verbs", (VerbGroup,), {"verbs": verbs, "homes": homes})


def make_group(meaning: str) -> typer.Typer:
    """Return a group of verbs that alone shows its help."""
    app = typer.Typer()

    def show_help(context: typer.Context) -> None:
        if context.invoked_subcommand is None:
            print(context.get_help())

    app.callback(invoke_without_command=True, help=meaning)(show_help)
    return app


def walk_verbs(group: VerbGroup) -> dict[str, TyperCommand]:
    """Import every verb and return the commands by the words that call them, such as ``lidar scene``,
    in the order of the help.
    """
    found: dict[str, TyperCommand] = {}
    for name in group.verbs:
        command = group.load_verb(name)
        if isinstance(command, TyperGroup):
            found |= {f"{name} {word}": verb for word, verb in command.commands.items()}  # type: ignore[misc]
        else:
            found[name] = command
    return found


def find_help(app: typer.Typer, words: Sequence[str]) -> str | None:
    """Return the help that words ask for and nothing else, without what typer parses options with,
    which takes longer to import than all the rest.
    """
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
