"""Groups of verbs that import a verb's module when the verb is called, not before.

The list of commands and the completion of a verb's name come from a table of names and one-line
helps; everything else comes from the verb itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any, cast

import typer
from typer.core import TyperCommand, TyperGroup

from apps.help import set_help_texts

VerbTable = Mapping[str, str]
"""The one-line help of each verb, by its name; its module has _ for -."""

Command = TyperCommand | TyperGroup


def make_lazy_group(package: str, verbs: VerbTable) -> type[TyperGroup]:
    """Return the class of a group whose verbs are modules of a package.

    Parameters
    ----------
    package : str
        Where the modules are. A module holds a function named like the verb, or a group of verbs
        called ``app``.
    verbs : VerbTable
        In the order of the help.

    Returns
    -------
    type of TyperGroup
        For the ``cls`` of a ``typer.Typer``.
    """

    class LazyGroup(TyperGroup):
        def __init__(self, **attributes: Any) -> None:
            super().__init__(**attributes)
            # what the list of commands shows until a verb is called
            for name, line in verbs.items():
                self.add_command(TyperCommand(name, help=line, rich_markup_mode=None))

        def resolve_command(self, ctx: Any, args: list[str]) -> Any:
            """Find the verb that is called; only this one is imported."""
            name, listed, further = super().resolve_command(ctx, args)
            return name, (name and self.load_verb(name)) or listed, further

        def load_verb(self, name: str) -> Command:
            """Import a verb and return its command."""
            return load_command(f"{package}.{name.replace('-', '_')}", name)

    return LazyGroup


def load_command(module: str, name: str) -> Command:
    """Import a verb's module and return its command, which is a group if the module has an ``app``.

    Parameters
    ----------
    module : str
        Such as ``apps.verbs.recover``.
    name : str
        Of the verb.

    Returns
    -------
    TyperCommand or TyperGroup
        With its help set from its docstring.
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
    return command


def walk_verbs(group: TyperGroup, words: tuple[str, ...] = ()) -> dict[str, TyperCommand]:
    """Import every verb of a group and return the commands by the words that call them.

    Parameters
    ----------
    group : TyperGroup
        Lazy or not.
    words : tuple of str
        That call the group.

    Returns
    -------
    dict
        Such as ``{"lidar scene": command}``, in the order of the help.
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
