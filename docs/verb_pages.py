"""The verbs' pages of the documentation, made from the program itself so that they cannot be out of
date.
"""

from __future__ import annotations

import re
from pathlib import Path

import typer
from typer.core import TyperArgument, TyperCommand, TyperOption

from apps.cli import EPILOG, PROGRAM, VERB_OVERVIEW, split_docstring, walk_verbs

COMPLETION_NOTE = """\
`tofclip --install-completion` teaches the shell that it is called from (bash, zsh or fish) to complete verbs, options
and names of methods with the tab key; `tofclip --show-completion` only shows what it would install."""


def write_pages(folder: Path) -> list[Path]:
    """Write a Markdown page for each verb, and one that lists them.

    Parameters
    ----------
    folder : Path
        Made if missing. Pages of verbs that no longer exist are removed.

    Returns
    -------
    list of Path
        The verbs' pages, then the list.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pages = {
        f"{name.replace(' ', '-')}.md": render_page(name, command)
        for name, command in walk_verbs().items()
    }
    pages["index.md"] = _render_index(list(pages))
    for old in folder.glob("*.md"):
        if old.name not in pages:
            old.unlink()
    for name, text in pages.items():
        path = folder / name
        if (
            not path.exists() or path.read_text(encoding="utf-8") != text
        ):  # what is the same is not built again
            path.write_text(text, encoding="utf-8")
    return [folder / name for name in pages]


def render_page(name: str, command: TyperCommand) -> str:
    """Return a verb's page in Markdown: what it does, an example, its arguments and options, the
    exit statuses.
    """
    context = typer.Context(command, info_name=f"{PROGRAM} {name}")
    prose, examples = split_docstring(command.callback.__doc__ if command.callback else None)
    usage = " ".join([PROGRAM, name, *command.collect_usage_pieces(context)])
    parts = [f"# {PROGRAM} {name}", *map(_escape_markdown, prose), f"```text\n{usage}\n```"]
    parts += [f"```sh\n{example}\n```" for example in examples]
    for heading, entries in _collect_panels(command, context).items():
        parts += [f"## {_escape_markdown(heading)}", *entries]
    return "\n\n".join(
        [*parts, "## Exit status", _escape_markdown(EPILOG.removeprefix("Exit status: ")), ""]
    )


def _collect_panels(command: TyperCommand, context: typer.Context) -> dict[str, list[str]]:
    """Return the descriptions of arguments and options, under the headings that they have in the help."""
    panels: dict[str, list[str]] = {}
    for param in command.get_params(context):
        if isinstance(param, TyperArgument | TyperOption) and not param.hidden:
            usual = "Arguments" if isinstance(param, TyperArgument) else "Options"
            panels.setdefault(param.rich_help_panel or usual, []).append(
                _format_entry(param, context)
            )
    return panels


def _format_entry(param: TyperArgument | TyperOption, context: typer.Context) -> str:
    """Return one term of a definition list."""
    name, description = param.get_help_record(context) or (param.name, "")
    return f"`{name}`\n: {_escape_markdown(description)}"


def _render_index(pages: list[str]) -> str:
    names = "\n".join(page.removesuffix(".md") for page in pages)
    contents = f"```{{toctree}}\n:maxdepth: 1\n\n{names}\n```\n"
    return f"# Verbs\n\n```text\n{VERB_OVERVIEW}\n```\n\n{COMPLETION_NOTE}\n\n{contents}"


def _escape_markdown(text: str) -> str:
    """Keep Markdown from seeing anything but words."""
    return re.sub(r"([\\`*_<>$\[\]{}|])", r"\\\1", " ".join(text.split()))
