"""How objects show themselves in a notebook: a table of what they hold, and a picture."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

PICTURE_COLOURMAP = "inferno"
PICTURE_WIDTH_PX = 240


def render_html(title: str, rows: Mapping[str, str], picture: NDArray[np.floating] | None) -> str:
    """Return a table beside a picture, in HTML.

    Parameters
    ----------
    title : str
    rows : mapping of str to str
        Names and values.
    picture : (y, x) array or None
        Brightness; NaN is drawn black.

    Returns
    -------
    str
    """
    cells = "".join(
        f"<tr><th style='text-align:left'>{html.escape(name)}</th><td>{html.escape(value)}</td></tr>"
        for name, value in rows.items()
    )
    drawn = "" if picture is None else f"<td>{_encode_picture(picture)}</td>"
    return (
        f"<b>{html.escape(title)}</b><table><tr><td><table>{cells}</table></td>{drawn}</tr></table>"
    )


def _encode_picture(picture: NDArray[np.floating]) -> str:
    from matplotlib.image import imsave  # slow to load, and only notebooks need it

    file = io.BytesIO()
    imsave(file, np.nan_to_num(picture), cmap=PICTURE_COLOURMAP, format="png")
    data = base64.b64encode(file.getvalue()).decode()
    return f"<img width={PICTURE_WIDTH_PX} src='data:image/png;base64,{data}'>"
