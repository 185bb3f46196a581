"""Settings of a verb: declared once, set in a TOML file or by flags, and written beside the result.

A verb's settings are a frozen dataclass whose fields `setting_field` makes. The name of a field is
the key in the file and, with dashes, the flag. Flags win over the file. A field that is None has a
value that the verb has to find.
"""

from __future__ import annotations

import dataclasses
import difflib
import inspect
import math
import tomllib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import tomli_w
import typer

from apps.conventions import make_completer
from tofclip.errors import FileFormatError, InputError
from tofclip.files import atomic_path, translate_read_errors

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

HELP_PANEL = "Settings (keys of the TOML file, there with _ for -)"

SettingsOption = Annotated[
    Path | None,
    typer.Option(
        "--settings",
        metavar="TOML",
        help="Settings that no flag gives; written beside each result.",
    ),
]

Settings = TypeVar("Settings", bound="DataclassInstance")
Verb = TypeVar("Verb", bound=Callable[..., None])


def setting_field(
    metavar: str | None,
    meaning: str,
    default: Any = None,
    shown: str | None = None,
    choices: Iterable[str] = (),
) -> Any:
    """Declare a setting.

    `metavar, meaning`: for the help; `default`: its value if neither file nor flag sets it; None if
    it has to be found, or may be absent; `shown`: the default in words, for the help; `choices`:
    names that shells offer to complete.
    """
    option = {
        "metavar": metavar,
        "help": meaning,
        "show_default": str(default) if shown is None else shown,
    }
    completed = {"autocompletion": make_completer(*choices)} if choices else {}
    return dataclasses.field(default=default, metadata={**option, **completed})


def add_setting_flags(kind: type[DataclassInstance]) -> Callable[[Verb], Verb]:
    """Give a verb a flag for every setting; they reach its ``**flags``, None where absent."""

    def with_flags(verb: Verb) -> Verb:
        known = inspect.signature(verb, eval_str=True)
        own = [one for one in known.parameters.values() if one.kind is not one.VAR_KEYWORD]
        verb.__signature__ = known.replace(parameters=[*own, *_make_flags(kind)])  # type: ignore[attr-defined]
        return verb

    return with_flags


def load_settings(kind: type[Settings], file: Path | None, flags: Mapping[str, Any]) -> Settings:
    """Return the settings of a file and of flags; flags win.

    `kind`: the verb's settings; `file`: TOML; `flags`: by the names of the settings; None where a
    flag was not given.
    """
    by_file = {} if file is None else _read_file(kind, file)
    return kind(
        **{**by_file, **{name: value for name, value in flags.items() if value is not None}}
    )


def settings_to_dict(settings: DataclassInstance) -> dict[str, Any]:
    """Name every setting that has a value."""
    return {
        name: value for name, value in dataclasses.asdict(settings).items() if value is not None
    }


def save_settings(settings: DataclassInstance, path: Path, heading: str) -> None:
    """Write the settings that have a value, whole or not at all; read back, they are the same to
    the last bit.

    `path`: TOML; `heading`: A comment in the first line.
    """
    text = f"# {heading}\n{tomli_w.dumps(settings_to_dict(settings))}"
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _make_flags(kind: type[DataclassInstance]) -> list[inspect.Parameter]:
    """A class's own settings come before those that it inherits."""
    hints, own = get_type_hints(kind), inspect.get_annotations(kind)
    ordered = sorted(dataclasses.fields(kind), key=lambda field: field.name not in own)
    flags = []
    for field in ordered:
        option = typer.Option(rich_help_panel=HELP_PANEL, **field.metadata)
        annotated: Any = Annotated  # with a computed type, which no type checker can follow
        annotation = annotated[hints[field.name] | None, option]
        flags.append(
            inspect.Parameter(
                field.name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation
            )
        )
    return flags


def _read_file(kind: type[DataclassInstance], file: Path) -> dict[str, Any]:
    with translate_read_errors(file), open(file, "rb") as opened:
        try:
            found = tomllib.load(opened)
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as fault:
            raise FileFormatError(file, f"is not a TOML file of settings ({fault})") from fault
    hints = get_type_hints(kind)
    for name in found:
        if name not in hints:
            like = difflib.get_close_matches(name, hints, 1)
            hint = f"did you mean '{like[0]}'?" if like else f"known are {', '.join(hints)}"
            raise InputError(f"{file}: no setting is called '{name}'; {hint}")
    return {
        name: _convert_value(value, hints[name], f"{file}: {name}") for name, value in found.items()
    }


def _convert_value(value: Any, hint: Any, where: str) -> Any:
    """Return a value of the file as the type that the field asks for."""
    wanted = (
        next(one for one in get_args(hint) if one is not NoneType)
        if NoneType in get_args(hint)
        else hint
    )
    if get_origin(wanted) is tuple:
        count = len(get_args(wanted))
        if isinstance(value, list) and len(value) == count and all(map(_is_number, value)):
            return tuple(map(float, value))
        raise InputError(f"{where} must be a list of {count} finite numbers, got {value!r}")
    if wanted is float and _is_number(value):
        return float(value)
    if type(value) is wanted and wanted is not float:
        return value
    names = {
        float: "a finite number",
        int: "a whole number",
        str: "a text in quotes",
        bool: "true or false",
    }
    raise InputError(f"{where} must be {names[wanted]}, got {value!r}")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
