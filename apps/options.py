"""Options and arguments of the verbs, a line each: name, unit and meaning stand together, and what
is given in ps, ns or mm is in s or m once it is inside.

Settings are given in a TOML file or by flags, and written beside the result. They are a frozen
dataclass of the library, or one that adds the verb's own. A field's name with the unit that it is
written with is the key in the file and, with dashes, the flag: `wavelength`, m, is ``wavelength_mm``
and ``--wavelength-mm``. Flags win over the file; inside everything is in SI units.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args, get_type_hints

import tomli_w
import typer

from apps.report import PRINTS_JSON, holding
from tofclip.errors import InputError, StorageError
from tofclip.files import PICTURE_SUFFIXES, atomic_path, read_toml, suggest_name
from tofclip.plugins import READERS
from tofclip.units import MILLIMETRE, NANOSECOND, PICOSECOND

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

UNITS = {"mm": MILLIMETRE, "ns": NANOSECOND, "ps": PICOSECOND}
"""By the last word of an option's name."""


def name_any(names: Iterable[str]) -> str:
    """Name things of which one is chosen: "a, b or c"."""
    *others, last = names
    return f"{', '.join(others)} or {last}"


def make_completer(names: Iterable[str]) -> Callable[[str], list[str]] | None:
    """Return what completes a value in the shell: the names that begin as it does so far."""
    if names == ():
        return None
    return lambda incomplete: [name for name in names if name.startswith(incomplete)]


def opt(
    metavar: str | None,
    meaning: str,
    default: Any = None,
    name: str | None = None,
    shown: str | None = None,
    choices: Iterable[str] = (),
    **further: Any,
) -> Any:
    """Declare an option, needed where the default is ``...``. `name`: where it is not that of the
    parameter; if it ends in a unit, the verb gets SI units; `shown`: the default in words;
    `choices`: what shells offer; `further`: of `typer.Option`.
    """
    unit = UNITS.get((name or "").rpartition("-")[2])
    if unit is not None:
        further["callback"] = lambda value: None if value is None else value * unit
    return typer.Option(
        default,
        *([name] if name else []),
        metavar=metavar,
        help=meaning,
        show_default=True if shown is None else shown,
        autocompletion=make_completer(choices),
        **further,
    )


def flag(name: str, meaning: str) -> Any:
    """Declare an option that takes no value."""
    return typer.Option(False, name, help=meaning)


def arg(metavar: str, meaning: str, default: Any = ..., read: bool = False) -> Any:
    """Declare an argument; one that is read has to be there, unless it is an address or a pattern."""
    return typer.Argument(
        default,
        metavar=metavar,
        help=meaning,
        callback=_require_there if read else None,
    )


def _require_there(value: Any) -> Any:
    for source in value if isinstance(value, list) else [value]:
        name = str(source)
        if "://" not in name and not set("*?[") & set(name) and not Path(name).exists():
            raise StorageError(f"{name}: no such file")
    return value


SEED = opt("N", "Of the photon noise.", 0, min=0)
BIN_WIDTH = opt(
    "PS",
    "Duration of a row in ps; overrides the file's own time axis.",
    name="--bin-width-ps",
)
TIME_ZERO = opt(
    "NS",
    "Reading of the time axis at which light of range 0 would arrive, in ns; e.g. -10.784.",
    name="--time-zero-ns",
    shown="the camera's",
)
STREAK_IMAGE = f"A streak image ({', '.join(READERS.own)}, or another of tofclip plugins)"
CAMERA = opt("H5", "Made by calibrate.", shown="the one inside the shot")
FOCUS = opt("SHEAR", "depth-locked or fixed:S.", "fixed:0")
PICTURE_FORMATS = name_any(PICTURE_SUFFIXES)
PREVIEW = opt("PNG", f"Where the picture goes: {PICTURE_FORMATS}.", shown="beside --out, .png")
TOPIC = opt(
    "NAME", "Of the ROS 2 messages.", shown="/tofclip/points; of a bag that is read, its only one"
)
FRAME_ID = opt("NAME", "Frame of reference of the ROS 2 messages.", "tofclip_optical")
SUFFIX = opt(".EXT", "Format of the clouds.", ".ply")
PORT = opt("N", "Of the page.", shown="a free one", min=1, max=65535)
NO_BROWSER = flag("--no-browser", "Print the page's address; open nothing.")
SETTINGS = opt("TOML", "Settings that no flag gives; written beside each result.")
CLUSTER = opt(
    "WHERE",
    "Share a sequence among workers: local, local:N or tcp://HOST:PORT.",
    shown="one after the other, here",
)
DEVICE = opt(
    "WHERE",
    "Where to compute: cpu (compiled loops), cuda or cuda:N (through CuPy or PyTorch), auto (cuda where there is one), "
    "or any device of PyTorch such as torch:cpu.",
    "cpu",
    choices=("cpu", "cuda", "auto", "torch:cpu"),
)


HELP_PANEL = "Settings (keys of the TOML file, there with _ for -)"
METAVARS = {
    **dict.fromkeys(("letters",), "TEXT"),
    **dict.fromkeys(("material", "method", "refine", "scan", "wall"), "NAME"),
    **dict.fromkeys(("point_fraction", "prior_weight", "tolerance"), "SHARE"),
    "methods": "A,B,...",
    "x": "M M",
    "y": "M M",
    "laser": "X Y",
    "points": "'X,Y,Z; ...'",
    "mesh": "FILE",
    "flip": "AXIS",
    "set": "NAME=VALUE",
    "falloff": "POWER",
    "signal_to_noise": "RATIO",
}
"""Of settings; the others show their unit, or N for a number without one."""

KEYWORD = inspect.Parameter.KEYWORD_ONLY
Settings = TypeVar("Settings", bound="DataclassInstance")
Verb = TypeVar("Verb", bound=Callable[..., None])


@dataclasses.dataclass(frozen=True)
class _Setting:
    """A field as the command line and the file have it."""

    field: dataclasses.Field[Any]
    key: str
    hint: Any
    factor: float  # from the unit that it is written with

    def write(self, value: Any) -> Any:
        """Return a value in that unit, without the rounding errors of the change."""
        changes = value is not None and self.factor != 1
        return float(f"{value / self.factor:.15g}") if changes else value

    def read(self, value: Any) -> Any:
        return value * self.factor if value is not None and self.factor != 1 else value

    def make_flag(self) -> inspect.Parameter:
        """Return the parameter of a verb; None stands for a flag that is not given."""
        known = self.field.metadata
        unit = known.get("written", known["unit"])
        usual = unit.upper() if unit in ("m", "s", *UNITS) else "N"
        is_flag = bool in (self.hint, *get_args(self.hint))
        option = typer.Option(
            metavar=None if is_flag else METAVARS.get(self.field.name, usual),
            help=known["help"],
            show_default=known["shown"],
            autocompletion=make_completer(known.get("choices", ())),
            rich_help_panel=HELP_PANEL,
        )
        annotated: Any = Annotated  # with a computed type, which no type checker can follow
        hint = annotated[self.hint | None, option]
        return inspect.Parameter(self.key, KEYWORD, default=None, annotation=hint)


@functools.cache
def _list_settings(kind: type[DataclassInstance]) -> dict[str, _Setting]:
    """The settings of a class by their keys, its own before those that it inherits."""
    hints, own = get_type_hints(kind), inspect.get_annotations(kind)
    found = {}
    for field in sorted(dataclasses.fields(kind), key=lambda field: field.name not in own):
        if "help" not in field.metadata:
            continue
        unit = field.metadata["unit"]
        written = field.metadata.get("written", unit)
        key = f"{field.name}_{written}" if unit in ("m", "s") else field.name
        found[key] = _Setting(field, key, hints[field.name], UNITS.get(written, 1.0))
    return found


def find_key(kind: type[DataclassInstance], name: str) -> str:
    """Return how a field is called on the command line and in files."""
    return next((key for key, one in _list_settings(kind).items() if one.field.name == name), name)


def take_json(verb: Any) -> Any:
    """Give a verb ``--json``."""

    def run(as_json: bool, **words: Any) -> None:
        with holding(PRINTS_JSON, as_json):
            verb(**words)

    option = flag("--json", "Print one JSON object of figures and nothing else.")
    return _take(run, verb, inspect.Parameter("as_json", KEYWORD, default=option, annotation=bool))


def take_settings(kind: type[DataclassInstance]) -> Callable[[Verb], Verb]:
    """Give a verb a flag for every setting; its first argument is what they and a file say."""

    def with_flags(verb: Verb) -> Verb:
        flags = [one.make_flag() for one in _list_settings(kind).values()]

        def run(settings: Path | None, **words: Any) -> None:
            given = {one.name: words.pop(one.name) for one in flags}
            verb(load_settings(kind, settings, given), settings=settings, **words)

        return _take(run, verb, *flags)

    return with_flags


def _take(run: Callable[..., None], verb: Verb, *further: inspect.Parameter) -> Verb:
    """Return what runs a verb by its own parameters that have a default and by further ones."""
    known = inspect.signature(verb, eval_str=True)
    own = [one for one in known.parameters.values() if one.default is not one.empty]
    taking: Any = functools.wraps(verb)(run)
    taking.__signature__ = known.replace(parameters=[*own, *further])
    return taking


def load_settings(kind: type[Settings], file: Path | None, flags: Mapping[str, Any]) -> Settings:
    """Return the settings of a TOML file and of flags, which win and are None where not given."""
    given = {} if file is None else _read_file(kind, file)
    given |= {key: value for key, value in flags.items() if value not in (None, [])}
    known = _list_settings(kind)
    return kind(**{known[key].field.name: known[key].read(given[key]) for key in given})


def settings_to_dict(settings: DataclassInstance) -> dict[str, Any]:
    """Return every setting that has a value by its key, as it is written."""
    values = {
        key: one.write(getattr(settings, one.field.name))
        for key, one in _list_settings(type(settings)).items()
    }
    return {key: value for key, value in values.items() if value is not None}


def save_settings(settings: DataclassInstance, path: Path, heading: str) -> None:
    """Write the settings that have a value to a TOML file, whole or not at all, below a comment."""
    text = f"# {heading}\n{tomli_w.dumps(settings_to_dict(settings))}"
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _read_file(kind: type[DataclassInstance], file: Path) -> dict[str, Any]:
    from pydantic import ConfigDict, TypeAdapter, ValidationError

    found, known = read_toml(file, "settings"), _list_settings(kind)
    strict = ConfigDict(strict=True, allow_inf_nan=False)
    for key, value in found.items():
        if key not in known:
            hint = suggest_name(key, known)
            raise InputError(f"{file}: no setting is called '{key}'; {hint}")
        try:
            # Of JSON, like TOML, a pair is a list and a whole number one with a point as well.
            text = json.dumps(value, default=str)
            found[key] = TypeAdapter(known[key].hint, config=strict).validate_json(text)
        except ValidationError as fault:
            said = fault.errors()[0]["msg"].replace("Input", key)
            raise InputError(f"{file}: {said}, got {value!r}") from fault
    return found
