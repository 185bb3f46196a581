"""Options that several verbs share, so that they are spelt and explained alike."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON object of figures and nothing else.")
]
TimeZeroOption = Annotated[
    float | None,
    typer.Option(
        "--time-zero-ns",
        metavar="NS",
        help="Reading of the time axis at which light of range 0 would arrive, in ns; e.g. -10.784.",
        show_default="the camera's",
    ),
]
PreviewOption = Annotated[
    Path | None,
    typer.Option(
        "--preview",
        metavar="PNG",
        help="Where the picture goes.",
        show_default="beside --out, .png",
    ),
]

ClusterOption = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        metavar="WHERE",
        help="Share a sequence among workers: local, local:N or tcp://HOST:PORT.",
        show_default="one after the other, here",
    ),
]

DEVICE_NAMES = ("cpu", "cuda", "auto", "torch:cpu")
"""Some of the names that `tofclip.arrays.parse_device` understands."""


def make_completer(*names: str) -> Callable[[str], list[str]]:
    """Return what completes an option's value in the shell: the names that begin as it does so far."""

    def beginning(incomplete: str) -> list[str]:
        return [name for name in names if name.startswith(incomplete)]

    return beginning


DeviceOption = Annotated[
    str,
    typer.Option(
        "--device",
        metavar="WHERE",
        help="Where to compute: cpu (compiled loops), cuda or cuda:N (through CuPy or PyTorch), auto (cuda where there "
        "is one), or any device of PyTorch such as torch:cpu.",
        autocompletion=make_completer(*DEVICE_NAMES),
    ),
]
