"""The help of a verb, without importing what only its work needs.

The module of a verb imports all that the verb works with, which takes half a second to more than a
second; its help needs names and texts of options only. So while a help is shown, the names that come
out of `WORK_PACKAGES` are placeholders. Where the help asks one for its value after all, the verb is
imported as for its work.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

import typer
from typer.core import TyperGroup

OWN_PACKAGES = ("tofclip", "nlos", "devices")
WORK_PACKAGES = (
    *(*OWN_PACKAGES, "apps.studies"),
    *("numpy", "scipy", "h5py", "matplotlib", "numba"),
)
NEEDED_MODULES = ("tofclip.errors", "tofclip.units", "tofclip.version")
"""Of these packages, what helps are written with: units, and defaults in them."""

HELP_OPTION = "--help"

UNKNOWN = "\N{REPLACEMENT CHARACTER}"
"""Stands in texts for a value that was not imported."""


class PlaceholderUsedError(Exception):
    """A help needs the value of a name that was not imported."""


class _Placeholder:
    """A name that was not imported; what is made of it is a placeholder as well."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _Placeholder()

    def __mro_entries__(self, bases: tuple[Any, ...]) -> tuple[type, ...]:
        return ()

    def __format__(self, spec: str) -> str:
        return UNKNOWN

    def __str__(self) -> str:
        return UNKNOWN

    __repr__ = __str__

    def _stay(self, *_: Any, **__: Any) -> Any:
        return _Placeholder()

    def _refuse(self, *_: Any) -> Any:
        raise PlaceholderUsedError

    __call__ = __getitem__ = __or__ = __ror__ = _stay
    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __truediv__ = __neg__ = _stay
    __bool__ = __len__ = __iter__ = __contains__ = _refuse
    __int__ = __float__ = __index__ = __eq__ = __lt__ = __gt__ = __le__ = __ge__ = _refuse
    __hash__ = object.__hash__


class _PlaceholderModule(ModuleType):
    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _Placeholder()


class _PlaceholderFinder(MetaPathFinder, Loader):
    """Puts placeholders in the place of modules of `WORK_PACKAGES`."""

    def find_spec(self, name: str, path: Any, target: Any = None) -> ModuleSpec | None:
        is_work = f"{name}.".startswith(tuple(f"{package}." for package in WORK_PACKAGES))
        if not is_work or name in NEEDED_MODULES:
            return None
        return ModuleSpec(name, self, is_package=True)

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return _PlaceholderModule(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Nothing of the module is run."""


@contextlib.contextmanager
def import_placeholders() -> Iterator[None]:
    """Import modules of `WORK_PACKAGES` as placeholders, and forget whatever was made with them."""
    finder, before = _PlaceholderFinder(), set(sys.modules)
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
        for name in set(sys.modules) - before:
            if name.partition(".")[0] in (*WORK_PACKAGES, "apps"):
                module, (parent, _, child) = sys.modules.pop(name), name.rpartition(".")
                if vars(sys.modules.get(parent, finder)).get(child) is module:
                    delattr(sys.modules[parent], child)
        for name in before:
            if name.partition(".")[0] in OWN_PACKAGES:
                _drop_placeholders(sys.modules[name])


def _drop_placeholders(module: ModuleType) -> None:
    for name, value in list(vars(module).items()):
        if isinstance(value, _Placeholder | _PlaceholderModule):
            delattr(module, name)


def show_verb_help(app: typer.Typer, words: Sequence[str]) -> bool:
    """Print a verb's help and say so, if that is what a command line asks for and nothing else.

    `app`: with all verbs; `words`: of the command line: those that call a verb, and ``--help``.
    Returns false: nothing was printed.
    """
    *names, last = words or ("",)
    if last != HELP_OPTION or not names or any(name.startswith("-") for name in names):
        return False
    group = typer.main.get_group(app)
    text = UNKNOWN
    with contextlib.suppress(PlaceholderUsedError), import_placeholders():
        text = _make_help(group, names)
    print(_make_help(group, names) if UNKNOWN in text else text)
    return True


def _make_help(group: TyperGroup, names: Sequence[str]) -> str:
    command: Any = group
    context = typer.Context(command, info_name=group.name, **group.context_settings)
    left = list(names)
    while left and isinstance(command, TyperGroup):
        name, command, left = command.resolve_command(context, left)
        context = typer.Context(command, info_name=name, parent=context)
    return str(command.get_help(context))
