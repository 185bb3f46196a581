"""The range image that counted photons show: range, deviation, photons and doubt side by side."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from apps.figures.style import DEPTH_COLOURMAP, draw_image, label_axes, make_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tofclip.lidar.photons import SurfaceImage

SHOWN_PERCENTILES = (1.0, 99.0)  # percent of the pixels that span the colours


def make_range_figure(found: SurfaceImage) -> Figure:
    """Draw a range image with what it is worth."""
    figure = make_figure(12, 9)
    axes = figure.subplots(2, 2)
    panels: tuple[tuple[Any, str, dict[str, Any]], ...] = (
        (found.range, "range (m)", {"cmap": DEPTH_COLOURMAP}),
        (found.range_sigma * 1e3, "one standard deviation (mm)", {}),
        (found.intensity, "photons", {}),
        (found.outlier_probability, "probability of an outlier", {"vmin": 0, "vmax": 1}),
    )
    for panel, (picture, title, look) in zip(axes.flat, panels, strict=True):
        finite = picture[np.isfinite(picture)]
        if finite.size and "vmin" not in look:
            low, high = np.percentile(finite, SHOWN_PERCENTILES)
            look = {**look, "vmin": low, "vmax": high}
        figure.colorbar(draw_image(panel, picture, **look), ax=panel)
        label_axes(panel, title, "x (px)", "y (px), down")
    return figure
