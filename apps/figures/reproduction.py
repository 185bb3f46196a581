"""Pictures of a study, laid out like the paper's."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from apps.figures.style import DEPTH_COLOURMAP, SMALL_FONT_PT, draw_image, make_figure

if TYPE_CHECKING:
    from apps.studies.outcome import Outcome

PANEL_INCHES = 1.5
WHITE_PERCENTILE = 99.5  # percentile drawn white: a lone bright pixel must not darken the rest
MIN_SHEAR, MAX_SHEAR = -1.4, 0.8  # shears


def make_reproduction_figure(title: str, outcome: Outcome) -> Figure:
    """Draw the panels of an outcome, one line below the other.

    `outcome`: its panels, line by line.
    """
    lines = outcome.panels
    columns = max(map(len, lines))
    figure = make_figure(PANEL_INCHES * columns, (PANEL_INCHES + 0.35) * len(lines) + 0.4)
    figure.suptitle(title, fontsize=SMALL_FONT_PT + 2)
    axes = figure.subplots(len(lines), columns, squeeze=False)
    for row, line in zip(axes, lines, strict=True):
        for place in row:
            place.set_axis_off()
        for place, panel in zip(row, line, strict=False):
            if panel.is_map:
                draw_image(
                    place, panel.picture, cmap=DEPTH_COLOURMAP, vmin=MIN_SHEAR, vmax=MAX_SHEAR
                )
            else:
                brightest = float(np.percentile(panel.picture, WHITE_PERCENTILE)) or 1.0
                draw_image(place, panel.picture, cmap="gray", vmin=0, vmax=brightest)
            place.set_title(panel.title, fontsize=SMALL_FONT_PT - 2)
    return figure
