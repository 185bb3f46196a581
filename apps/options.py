"""Options and arguments of the verbs, a line each: name, unit and meaning stand together, and what
is given in ps, ns or mm is in s or m once it is inside.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import typer

from tofclip.errors import StorageError
from tofclip.units import MILLIMETRE, NANOSECOND, PICOSECOND

UNITS = {"mm": MILLIMETRE, "ns": NANOSECOND, "ps": PICOSECOND}
"""By the last word of an option's name."""


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


def arg(
    metavar: str, meaning: str, default: Any = ..., choices: Iterable[str] = (), read: bool = False
) -> Any:
    """Declare an argument; one that is read has to be there, unless it is an address or a pattern."""
    return typer.Argument(
        default,
        metavar=metavar,
        help=meaning,
        autocompletion=make_completer(choices),
        callback=_require_there if read else None,
    )


def _require_there(value: Any) -> Any:
    for source in value if isinstance(value, list) else [value]:
        name = str(source)
        if "://" not in name and not set("*?[") & set(name) and not Path(name).exists():
            raise StorageError(f"{name}: no such file")
    return value


JSON = flag("--json", "Print one JSON object of figures and nothing else.")
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
CAMERA = opt("H5", "Made by calibrate.", shown="the one inside the shot")
FOCUS = opt("SHEAR", "depth-locked or fixed:S.", "fixed:0")
PICTURE_FORMATS = ".png, .pdf or .svg"
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
