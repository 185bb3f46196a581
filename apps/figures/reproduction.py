"""Pictures of a study, laid out like the paper's."""

from __future__ import annotations

from typing import TYPE_CHECKING

from matplotlib.figure import Figure

from apps.figures.style import DEPTH, SMALL, draw, page

if TYPE_CHECKING:
    from apps.studies.outcome import Outcome

PANEL_INCHES = 1.5
BRIGHTEST = 99.5  # percentile drawn white: a lone bright pixel must not darken the rest
NEAREST, FARTHEST = -1.4, 0.8  # shears


def reproduction_figure(title: str, outcome: Outcome) -> Figure:
    """Draw the panels of an outcome, one line below the other."""
    import numpy as np

    lines = outcome.panels
    columns = max(map(len, lines))
    figure = page(PANEL_INCHES * columns, (PANEL_INCHES + 0.35) * len(lines) + 0.4)
    figure.suptitle(title, fontsize=SMALL + 2)
    axes = figure.subplots(len(lines), columns, squeeze=False)
    for row, line in zip(axes, lines, strict=True):
        for place in row:
            place.set_axis_off()
        for place, panel in zip(row, line, strict=False):
            if panel.is_map:
                draw(place, panel.picture, cmap=DEPTH, vmin=NEAREST, vmax=FARTHEST)
            else:
                brightest = float(np.percentile(panel.picture, BRIGHTEST)) or 1.0
                draw(place, panel.picture, cmap="gray", vmin=0, vmax=brightest)
            place.set_title(panel.title, fontsize=SMALL - 2)
    return figure
