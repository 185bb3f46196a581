"""What a target at known distances said: range walk, offsets and response of the pixels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from apps.figures.style import LINE_COLOUR, draw_image, label_axes, make_figure
from tofclip.units import MILLIMETRE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tofclip.lidar.range_calibration import RangeFit

MAX_DRAWN_POINTS = 20_000
SHOWN_PERCENTILES = (1.0, 99.0)


def make_range_calibration_figure(found: RangeFit) -> Figure:
    """Draw the fitted walk over what was measured, and the pictures of the pixels' own numbers."""
    known = found.calibration
    pictures = [
        (known.offsets / MILLIMETRE, "offset (mm)"),
        (known.offset_sigma / MILLIMETRE, "its standard deviation (mm)"),
        (known.response, "response"),
    ]
    drawn = [(picture, title) for picture, title in pictures if picture.size]
    figure = make_figure(4 * (1 + len(drawn)), 3.6)
    panels = np.atleast_1d(figure.subplots(1, 1 + len(drawn)))
    walk = panels[0]
    some = slice(None, None, -(-found.signal.size // MAX_DRAWN_POINTS))
    walk.plot(
        found.signal[some], found.excess[some] / MILLIMETRE, ".", color="#999999", markersize=2
    )
    weakest, strongest = known.signal_range
    signal = np.geomspace(weakest, strongest, 100)
    fitted, sigma = (part / MILLIMETRE for part in known.compute_walk(signal))
    walk.fill_between(signal, fitted - sigma, fitted + sigma, color=LINE_COLOUR, alpha=0.3)
    walk.plot(signal, fitted, color=LINE_COLOUR)
    walk.set_xscale("log")
    label_axes(walk, "range walk", "counts of a return", "measured too long (mm)")
    for panel, (picture, title) in zip(panels[1:], drawn, strict=True):
        low, high = np.percentile(picture, SHOWN_PERCENTILES)
        figure.colorbar(draw_image(panel, picture, vmin=low, vmax=high), ax=panel)
        label_axes(panel, title, "x (px)", "y (px), down")
    return figure
