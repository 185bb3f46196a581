"""How objects show themselves in a notebook, and how they become those of other libraries: a table of
what they hold, a picture, labelled arrays and tables. How figures are lettered and written.
"""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Mapping
from importlib import import_module
from pathlib import Path
from string import ascii_lowercase
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import AnyArray, FloatArray
from tofclip.errors import MissingDependencyError
from tofclip.files import PICTURE_SUFFIXES, atomic_path, describe_missing_package, require_suffix

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PICTURE_COLOURMAP, RANGE_COLOURMAP = "inferno", "turbo"
PICTURE_WIDTH_PX = 240
MAX_PLOTTED_POINTS = 20_000
PRINT_DOTS_PER_INCH = 300


def require_package(name: str) -> Any:
    """Return another library's module."""
    try:
        return import_module(name)
    except ImportError as fault:
        raise MissingDependencyError(describe_missing_package(fault) or str(fault)) from fault


def render_html(title: str, rows: Mapping[str, str], picture: NDArray[np.floating] | None) -> str:
    """Return a table of names and values beside a picture (y, x), whose NaN are drawn black."""
    cells = "".join(
        f"<tr><th style='text-align:left'>{html.escape(name)}</th><td>{html.escape(value)}</td></tr>"
        for name, value in rows.items()
    )
    drawn = "" if picture is None else f"<td>{_encode_picture(picture)}</td>"
    return (
        f"<b>{html.escape(title)}</b><table><tr><td><table>{cells}</table></td>{drawn}</tr></table>"
    )


def plot_picture(
    picture: NDArray[np.floating],
    title: str,
    ax: Axes | None = None,
    *,
    unit: str = "counts",
    sides: tuple[FloatArray, FloatArray] | None = None,
) -> Axes:
    """Draw a picture (y, x) with a scale of its brightness; `sides` (x, y) are places of columns and
    rows, m, which are numbered by default.
    """
    pyplot = require_package("matplotlib.pyplot")
    ax = ax or pyplot.gca()
    extent = None if sides is None else (*sides[0][[0, -1]], *sides[1][[-1, 0]])
    drawn = ax.imshow(picture, cmap=PICTURE_COLOURMAP, extent=extent)
    ax.figure.colorbar(drawn, ax=ax, label=unit)
    length = "px" if sides is None else "m"
    ax.set(title=title, xlabel=f"x ({length})", ylabel=f"y ({length})")
    return ax


def plot_points(
    xyz: NDArray[np.floating], distance: NDArray[np.floating], ax: Axes | None = None
) -> Axes:
    """Draw points (n, 3), m, as the camera sees them, coloured by their range."""
    pyplot = require_package("matplotlib.pyplot")
    ax = ax or pyplot.gca()
    step = max(1, len(xyz) // MAX_PLOTTED_POINTS)
    order = np.argsort(-distance[::step], kind="stable")  # near points are drawn over far ones
    x, y, _ = xyz[::step][order].T
    drawn = ax.scatter(x, y, c=distance[::step][order], s=2, cmap=RANGE_COLOURMAP)
    ax.figure.colorbar(drawn, ax=ax, label="range (m)")
    ax.set(xlabel="x (m)", ylabel="y (m), down", aspect="equal")
    if not ax.yaxis_inverted():
        ax.invert_yaxis()
    return ax


def letter_panels(panels: Iterable[Axes]) -> None:
    """Put (a), (b) and so on before the titles of a figure's panels."""
    for letter, axes in zip(ascii_lowercase, panels, strict=False):
        axes.title.set_text(f"({letter}) {axes.get_title()}".rstrip())


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure for print, PNG, PDF or SVG by the name's suffix, whole or not at all."""
    require_suffix(path, *PICTURE_SUFFIXES)
    engine, panels = figure.get_layout_engine(), figure.get_axes()
    if engine is not None and panels:
        # Saving would draw all twice, the first time only to find the places of the axes.
        for axes in panels:
            for spine in axes.spines.values():
                spine.set_in_layout(False)  # ticks and labels reach further
        engine.execute(figure)
        figure.set_layout_engine(None)
    with atomic_path(path) as temporary:
        kind = Path(path).suffix[1:].lower()
        figure.savefig(temporary, format=kind, dpi=PRINT_DOTS_PER_INCH)


def make_data_array(
    values: AnyArray,
    axes: Mapping[str, tuple[AnyArray, str]],
    name: str,
    unit: str,
    ranges: FloatArray | None = None,
) -> Any:
    """Return an `xarray.DataArray` whose coordinates carry their units; `axes` are coordinates and
    unit of each axis, in order, `ranges` those of the times, m.
    """
    xarray = require_package("xarray")
    places = {axis: (axis, place, {"units": units}) for axis, (place, units) in axes.items()}
    if ranges is not None:
        places["range"] = ("time", ranges, {"units": "m"})
    return xarray.DataArray(
        values, dims=tuple(axes), coords=places, name=name, attrs={"units": unit}
    )


def paint(picture: NDArray[np.floating], name: str = PICTURE_COLOURMAP) -> NDArray[np.uint8]:
    """Return red, green and blue of brightness 0 to 1, in a further axis; NaN is as dark as 0."""
    from matplotlib import colormaps  # slow to load

    return colormaps[name](np.nan_to_num(picture), bytes=True)[..., :3]


def _encode_picture(picture: NDArray[np.floating]) -> str:
    """A page keeps a picture of each cell: as few pixels as it shows, a byte each."""
    from PIL import Image

    shown = Image.fromarray(np.nan_to_num(picture).astype(np.float32))
    small = np.asarray(shown.reduce(-(-shown.width // PICTURE_WIDTH_PX)))
    grey = 255 * (small - small.min()) / (np.ptp(small) or 1.0)
    drawn, file = Image.fromarray(grey.astype(np.uint8)), io.BytesIO()
    drawn.putpalette(paint(np.linspace(0, 1, 256)).tobytes())
    drawn.save(file, format="PNG", optimize=True)
    data = base64.b64encode(file.getvalue()).decode()
    return f"<img width={PICTURE_WIDTH_PX} src='data:image/png;base64,{data}'>"
