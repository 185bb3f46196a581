"""Parts by their names: methods, denoisers, readers and instruments, ours and those of others.

A package offers parts by entry points (docs/extending.md has a template), a notebook by `Parts.register`.
What is named here is imported when it is asked for, and other packages are looked for when a name is
not one of ours, or all names are.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from tofclip.errors import FileFormatError, InputError, require, require_known
from tofclip.files import translate_read_errors

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

    from tofclip.storage import Record

Found = TypeVar("Found")
SIGNATURE_BYTES = 16  # of a file, by which its reader is found
BY_NAME = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
TYPES: dict[str, Callable[[str], Any]] = {
    "bool": {"yes": True, "no": False}.__getitem__,
    "int": int,
    "float": float,
    "str": str,
}


class Parts(Mapping[str, Any]):
    """The parts of one kind by name: ours, each as ``"module:name"``, whose names nobody else can take;
    those that were registered; and those that packages offer in a group of entry points.
    """

    def __init__(self, group: str, kind: str, own: Mapping[str, str]) -> None:
        self.group, self.kind, self.own = group, kind, own
        self.registered: dict[str, Any] = {}

    def register(self, name: str, part: Any) -> None:
        """Add a `part` of that `name` for as long as this program runs; the same name again replaces
        it. It is what the entry point of a package names: the class or function that makes a method
        or a denoiser of its settings, a `Reader`, or a function from an address to a source.
        `InputError` where we have a part of that name ourselves.
        """
        require(
            name not in self.own, f"the {self.kind} '{name}' is tofclip's own; take another name"
        )
        self.registered[name] = part

    @cached_property
    def _points(self) -> tuple[EntryPoint, ...]:
        from importlib.metadata import entry_points  # takes longer than all the rest of this

        return tuple(entry_points(group=self.group))

    @cached_property
    def offered(self) -> dict[str, EntryPoint]:
        """What other packages offer; of two parts with one name the first."""
        return {one.name: one for one in reversed(self._points) if one.name not in self.own}

    def list_unused(self) -> list[tuple[str, str]]:
        """Return names that were taken already, each with the package that offers it again."""
        found = [one for one in self._points if self.offered.get(one.name) is not one]
        return [(one.name, _name_package(one)) for one in found]

    def __getitem__(self, name: str) -> Any:
        """Import the part of that name; `InputError` where there is none, or it does not load."""
        if name in self.own:
            module, _, part = self.own[name].partition(":")
            return getattr(import_module(module), part)
        if name in self.registered:
            return self.registered[name]
        require_known(self.kind, name, self)
        try:
            return self.offered[name].load()
        except Exception as fault:  # whatever another package does when it is imported
            text = f"{type(fault).__name__}: {fault}"
            raise InputError(
                f"{self.kind} '{name}' of {self.get_origin(name)} does not load: {text}"
            ) from fault

    def __iter__(self) -> Iterator[str]:
        yield from self.own
        yield from self.registered
        yield from (name for name in self.offered if name not in self.registered)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __contains__(self, name: object) -> bool:
        return name in self.own or name in self.registered or name in self.offered

    def get_origin(self, name: str) -> str:
        """Return whose a part is: the name and version of a package."""
        if name in self.own:
            return "tofclip"
        if name in self.registered:
            return "registered"
        return _name_package(self.offered[name])

    def make(self, name: str, settings: Mapping[str, Any], others: Iterable[str] = ()) -> Any:
        """Make a part with settings of its own, texts becoming what it takes; `InputError` where there
        is no such part or setting, which names `others` as well, or a text is not what it takes.
        """
        part, what = self[name], f"{self.kind} '{name}'"
        known = list_settings(part)
        unknown = [one for one in settings if one not in known]
        if unknown:
            takes = (
                f"its settings are {', '.join((*known, *others))}"
                if known
                else "it has no settings"
            )
            raise InputError(f"{what} does not take {', '.join(unknown)}; {takes}")
        return part(
            **{
                one: read_setting(value, known[one], what) if isinstance(value, str) else value
                for one, value in settings.items()
            }
        )


def _name_package(point: EntryPoint) -> str:
    return "a package" if point.dist is None else f"{point.dist.name} {point.dist.version}"


METHODS = Parts(
    "tofclip.methods",
    "method",
    {
        "auto": "tofclip.recovery.surfaces.recovery:recover_automatically",
        "tv": "tofclip.solvers:TotalVariation",
        "l1": "tofclip.solvers:Sparse",
        "linear": "tofclip.solvers:LinearInverse",
        "adjoint": "tofclip.solvers:Backprojection",
        "surfaces": "tofclip.recovery.surfaces:SurfaceRecovery",
        "wavelet": "tofclip.solvers:Wavelets",
        "pnp": "tofclip.solvers:PlugAndPlay",
        "red": "tofclip.solvers:RegularisationByDenoising",
    },
)
DENOISERS = Parts(
    "tofclip.denoisers",
    "denoiser",
    {
        "collaborative": "tofclip.solvers.denoising:CollaborativeWiener",
        "bm3d": "tofclip.solvers.denoising:BlockMatching",
        "nlm": "tofclip.solvers.denoising:NonlocalMeans",
    },
)
READERS = Parts(
    "tofclip.readers",
    "reader",
    {
        "tiff": "tofclip.io.streaks:TIFF",
        "lift": "tofclip.io.streaks:LIFT",
        "hdf5": "tofclip.io.streaks:OWN",
        "itex": "tofclip.io.streaks:ITEX",
    },
)
register_method, register_denoiser = METHODS.register, DENOISERS.register
register_reader = READERS.register


class Reader(NamedTuple):
    """What reads the files that begin with certain bytes: suffixes get lost and lie.

    `signatures`: of at most 16 bytes each; `read`: from the path to a `tofclip.Streak`, or among
    ``nlos.readers`` to a `nlos.Capture`, raising `tofclip.errors.FileFormatError` where the file is
    damaged or of another kind after all; `describe`: from the path to the outline that ``tofclip info``
    shows, without reading pixels.
    """

    signatures: tuple[bytes, ...]
    read: Callable[[Path], Any]
    describe: Callable[[Path], Record] | None = None


def read_by_signature(
    readers: Parts, path: str | Path, use: Callable[[Reader], Found], what: str
) -> Found:
    """Return what `use` makes of the first reader that takes a file. Where those that know its first
    bytes refuse it, the first one's error is raised; `what` the readers make of files, in words.
    """
    with translate_read_errors(path), open(path, "rb") as file:
        start = file.read(SIGNATURE_BYTES)
    if not start:
        raise FileFormatError(path, "is empty")
    refusals, broken = list[FileFormatError](), ""
    for name in readers:
        try:
            reader: Reader = readers[name]
        except InputError as fault:  # another package's: ours go on
            broken = f"; {fault}"
            continue
        if start.startswith(reader.signatures):
            try:
                return use(reader)
            except FileFormatError as fault:
                refusals.append(fault)
    known = f"is not a {what} of a known format ({', '.join(readers)}){broken}"
    raise refusals[0] if refusals else FileFormatError(path, known)


def list_settings(part: Any) -> dict[str, inspect.Parameter]:
    """Return what a class or function takes by name, in its order."""
    found = inspect.signature(part).parameters
    return {name: one for name, one in found.items() if one.kind in BY_NAME}


def find_type(setting: inspect.Parameter) -> str | None:
    """Return which of `TYPES` a setting is, or ``"Denoiser"``; None where no text can stand for it."""
    hint = setting.annotation
    if hint is setting.empty:
        hint = str if setting.default is setting.empty else type(setting.default)
    named = re.findall(r"\w+", str(hint))
    return next((one for one in ("Denoiser", *TYPES) if one in named), None)


def read_setting(text: str, setting: inspect.Parameter, what: str) -> Any:
    """Return the value that a text stands for; `InputError` where it is none."""
    kind = find_type(setting)
    if kind == "Denoiser":
        return DENOISERS.make(text, {})
    if kind is None:
        raise InputError(f"{what}: {setting.name} can be given in Python only")
    try:
        return TYPES[kind](text)
    except (KeyError, ValueError) as fault:
        wanted = {"bool": "yes or no", "int": "a whole number"}.get(kind, "a number")
        raise InputError(f"{what}: {setting.name} must be {wanted}, got '{text}'") from fault


def split_assignments(texts: Sequence[str]) -> dict[str, str]:
    """Return what texts such as ``"strength=0.2"`` assign, by name."""
    found = {
        name.strip(): value.strip() for name, _, value in (one.partition("=") for one in texts)
    }
    for name, value in found.items():
        require(name and value, f"a setting is given as NAME=VALUE, not as '{name}{value}'")
    return found
