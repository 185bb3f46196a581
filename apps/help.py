"""The verbs as the command line shows them: imported when they are called, each with its help.

The list of commands and the completion of a verb's name come from a table of names and one-line
helps; everything else comes from the verb itself. Its docstring ends in a paragraph that begins
with ``Example:``; several such paragraphs are several examples.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import typer
from typer.core import TyperCommand, TyperGroup, TyperOption

from tofclip.errors import StorageError

PROGRAM = "tofclip"

EXIT_INPUT_ERROR = 2
EXIT_DEFECT = 1
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as shells report it
EXIT_BROKEN_PIPE = 141  # 128 + SIGPIPE

DEBUG_FLAG = "--debug"
EPILOG = (
    f"Exit status: 0 done; {EXIT_INPUT_ERROR} unusable input, with one line on standard error that says what to do; "
    f"{EXIT_INTERRUPTED} interrupted; {EXIT_DEFECT} some of a sequence failed, or a defect of this program. "
    f"{DEBUG_FLAG} anywhere shows where an error came from."
)

EXAMPLE_MARK = "Example:"
AS_WRITTEN = "\b\n"  # before a paragraph whose lines typer must not join
MAX_EXAMPLE_WIDTH = (
    72  # of an example, so that it fits the narrowest usual terminal with its indentation
)

MAX_HELP_WIDTH = 100  # columns, on a terminal that has them

VerbTable = Mapping[str, str]
"""The one-line help of each verb, by its name; its module has _ for -."""

Command = TyperCommand | TyperGroup


def make_lazy_group(
    package: str, verbs: VerbTable, readers: Collection[str] = ()
) -> type[TyperGroup]:
    """Return the class of a group whose verbs are modules of a package.

    `package`: where the modules are. A module holds a function named like the verb, or a group of
    verbs called ``app``; `verbs`: in the order of the help. A verb of two words, such as
    ``"calibrate range"``, stands beside one that is called by the first word alone; `readers`:
    verbs, of one word or two, whose first argument is a file, a folder, a pattern or an address.
    Returns for the ``cls`` of a ``typer.Typer``.
    """

    class LazyGroup(TyperGroup):
        def __init__(self, **attributes: Any) -> None:
            super().__init__(**attributes)
            # what the list of commands shows until a verb is called
            for name, line in verbs.items():
                self.add_command(TyperCommand(name, help=line, short_help=line))
            self.rich_markup_mode = None

        def get_params(self, ctx: Any) -> list[Any]:
            """Return the options, those of completion too, which typer adds later."""
            params = super().get_params(ctx)
            _hide_types_of_flags(params)
            return params

        def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
            """Refuse a source that is not there, before typer loads what it reads options with."""
            if not ctx.resilient_parsing:
                _require_source(args, readers)
            return super().parse_args(ctx, args)

        def resolve_command(self, ctx: Any, args: list[str]) -> Any:
            """Find the verb that is called; only this one is imported."""
            pair = " ".join(args[:2])
            if pair in verbs:  # before the verb that is called by the first word alone
                args = [pair, *args[2:]]
            name, listed, further = super().resolve_command(ctx, args)
            return name, (name and self.load_verb(name)) or listed, further

        def load_verb(self, name: str) -> Command:
            """Import a verb and return its command."""
            return load_command(f"{package}.{re.sub('[- ]', '_', name)}", name)

        def shell_complete(self, ctx: Any, incomplete: str) -> Any:
            """Complete single words, as shells take them."""
            found = super().shell_complete(ctx, incomplete)
            return [item for item in found if " " not in item.value]

    return LazyGroup


def _require_source(words: Sequence[str], readers: Collection[str]) -> None:
    """Refuse the source of a verb among `readers` that is plainly a file's name and not there."""
    length = next((n for n in (2, 1) if " ".join(words[:n]) in readers), None)
    if length is None:
        return
    words = words[length:]
    source = words[0] if words and not {"--help", "-h"} & set(words) else "-"
    if len(words) > 1 and not words[1].startswith("-"):
        return  # one name too many, about which the verb itself complains
    is_name = not source.startswith("-") and "://" not in source and not set("*?[") & set(source)
    if is_name and not Path(source).exists():
        raise StorageError(f"{source}: no such file")


def load_command(module: str, name: str) -> Command:
    """Import a verb's module and return its command, which is a group if the module has an ``app``.

    `module`: such as ``apps.verbs.recover``; `name`: of the verb. Returns with its help set from
    its docstring.
    """
    home = import_module(module)
    is_group = hasattr(home, "app")
    app: typer.Typer = home.app if is_group else typer.Typer()
    if not is_group:
        app.command(name)(getattr(home, module.rpartition(".")[2]))
    set_help_texts(app)
    group = typer.main.get_group(app)
    group.name = name
    # A verb on its own is taken out of the group that it was registered in.
    command: Command = group if is_group else cast("TyperCommand", group.commands[name])
    simplify_help(command)
    return command


def simplify_help(command: Command) -> None:
    """Let a command, and those of a group, show their help as plain text, and an option that takes no
    value as one, such as ``--json``, where typer writes ``--json <bool>``.

    Importing what draws frames around the help takes longer than all the rest of showing it.
    """
    command.rich_markup_mode = None
    # the settings of a verb stand under a heading of their own
    command.format_options = partial(_write_options, command)  # type: ignore[method-assign]
    usage = command.collect_usage_pieces
    command.collect_usage_pieces = lambda ctx: _simplify_usage(usage(ctx))  # type: ignore[method-assign]
    _hide_types_of_flags(command.get_params(typer.Context(command)))
    for further in getattr(command, "commands", {}).values():
        simplify_help(further)


def _write_options(command: Command, ctx: Any, formatter: Any) -> None:
    """Write arguments and options under their headings, and a group's verbs."""
    panels: dict[str, list[tuple[str, str]]] = {}
    for param in command.get_params(ctx):
        entry = param.get_help_record(ctx)
        if entry is not None:
            usual = "Arguments" if param.param_type_name == "argument" else "Options"
            heading = getattr(param, "rich_help_panel", None) or usual
            panels.setdefault(heading, []).append((entry[0], _simplify_default(entry[1])))
    for heading, entries in panels.items():
        with formatter.section(heading):
            formatter.write_dl(entries)
    if isinstance(command, TyperGroup):
        command.format_commands(ctx, formatter)


def _simplify_usage(pieces: Sequence[str]) -> list[str]:
    """Take the braces off the names of arguments, of which typer writes ``{SHOT...}...``."""
    return [re.sub(r"^\{(.*?)(\.\.\.)?\}", r"\1", piece) for piece in pieces]


def _simplify_default(text: str) -> str:
    """Take the brackets off a default in words, which typer puts around it within its own."""
    return re.sub(r"\[default: \((.*)\)\]$", r"[default: \1]", text)


def _hide_types_of_flags(params: Sequence[Any]) -> None:
    for param in params:
        if isinstance(param, TyperOption) and param.is_flag:
            param.metavar = ""


def walk_verbs(group: TyperGroup, words: tuple[str, ...] = ()) -> dict[str, TyperCommand]:
    """Import every verb of a group and return the commands by the words that call them.

    `group`: lazy or not; `words`: that call the group. Returns such as ``{"lidar scene":
    command}``, in the order of the help.
    """
    found: dict[str, TyperCommand] = {}
    for name, listed in group.commands.items():
        load = getattr(group, "load_verb", None)
        command = listed if load is None else load(name)
        if isinstance(command, TyperGroup):
            found |= walk_verbs(command, (*words, name))
        elif isinstance(command, TyperCommand):
            found[" ".join((*words, name))] = command
    return found


def set_help_texts(app: typer.Typer) -> None:
    """Give every verb its help, made from its docstring; the exit statuses are its last paragraph."""
    for verb in app.registered_commands:
        prose, examples = split_docstring(verb.callback.__doc__ if verb.callback else None)
        shown = [f"{AS_WRITTEN}{EXAMPLE_MARK}\n    {wrap_command(example)}" for example in examples]
        verb.help = "\n\n".join(_keep_table(one) for one in prose)
        verb.short_help = prose[0] if prose else None  # shown whole, not its first words
        verb.epilog = "\n\n".join([*shown, EPILOG])
    for group in app.registered_groups:
        if group.typer_instance is not None:
            set_help_texts(group.typer_instance)


def split_docstring(docstring: str | None) -> tuple[list[str], list[str]]:
    """Split a docstring into its paragraphs of prose and its example commands.

    Lines of a paragraph are joined, since a terminal is narrower than the source; one with indented
    lines stays.
    """
    paragraphs = [one for one in inspect.cleandoc(docstring or "").split("\n\n") if one.strip()]
    examples = [" ".join(one.split()[1:]) for one in paragraphs if one.startswith(EXAMPLE_MARK)]
    return [_join_lines(one) for one in paragraphs if not one.startswith(EXAMPLE_MARK)], examples


def wrap_command(command: str) -> str:
    """Break a long command between its words, as a shell takes it."""
    lines = textwrap.wrap(
        command, MAX_EXAMPLE_WIDTH, break_long_words=False, break_on_hyphens=False
    )
    return " \\\n        ".join(lines)


def _join_lines(paragraph: str) -> str:
    return paragraph if _is_table(paragraph) else " ".join(paragraph.split())


def _keep_table(paragraph: str) -> str:
    return f"{AS_WRITTEN}{paragraph}" if _is_table(paragraph) else paragraph


def _is_table(paragraph: str) -> bool:
    return re.search(r"^( |[*-] )", paragraph, re.MULTILINE) is not None
