"""What the help of every verb says beyond its options: an example that can be pasted, and the exit
statuses.

A verb's docstring ends in a paragraph that begins with ``Example:``; several such paragraphs are
several examples.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import typer

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
MAX_EXAMPLE_WIDTH = (
    72  # of an example, so that it fits the narrowest usual terminal with its indentation
)


def set_help_texts(app: typer.Typer) -> None:
    """Give every verb its help, made from its docstring; the exit statuses are its last paragraph."""
    for verb in app.registered_commands:
        prose, examples = split_docstring(verb.callback.__doc__ if verb.callback else None)
        shown = [f"{EXAMPLE_MARK}\n    {wrap_command(example)}" for example in examples]
        verb.help = _escape_markup("\n\n".join(prose))
        verb.epilog = _escape_markup("\n\n".join([*shown, EPILOG]))
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
    return (
        paragraph if re.search(r"^[ *-]", paragraph, re.MULTILINE) else " ".join(paragraph.split())
    )


def _escape_markup(text: str) -> str:
    """Keep rich from taking brackets, as of extras, for its markup."""
    return re.sub(r"(?=\[[a-z#/@])", r"\\", text)
