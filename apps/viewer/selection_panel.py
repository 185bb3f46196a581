"""Points that are picked on the page: marked in the scene, described beside it, with their
waveform.
"""

from __future__ import annotations

import html
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apps.viewer.picking import Pick
from apps.viewer.session import Session
from tofclip.units import SPEED_OF_LIGHT

if TYPE_CHECKING:
    import viser

MARKER_COLOURS = ((255, 80, 80), (80, 220, 255))
MARKER_RADIUS_FRACTION = 0.006
"""Of the distance."""

RETURN_HALF_WIDTH_BINS = 3.0
"""Bins on either side of a detected return that are filled in its pixel's waveform."""

NO_SHADOWS: Any = {"cast_shadow": False, "receive_shadow": False}


class SelectionPanel:
    """Listens to clicks on points.

    `above`: the docked panel below which this one stays in sight.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        post: Callable[[Callable[[], None]], None],
        above: viser.PanelHandle,
    ) -> None:
        self._server, self._session = server, session
        panel = server.gui.add_panel()
        with panel.add_tab("picked point"):
            self._text = server.gui.add_html(
                _format_html("click a point; a second one gives their distance")
            )
            self._plot: Any = None
            self._container = server.gui.add_folder(None)
        panel.dock_below(above)
        server.scene.on_click()(
            lambda event: post(lambda: self._handle_click(event.ray_origin, event.ray_direction))
        )

    def _handle_click(self, origin: ArrayLike, direction: ArrayLike) -> None:
        pick = self._session.pick(origin, direction)
        if pick is None:
            self._text.content = _format_html("nothing there; click a point")
        else:
            distance = self._session.distance
            apart = "" if distance is None else f"\ndistance {distance:.4f} m"
            self._text.content = _format_html(pick.description + apart)
            self._draw_waveform(pick)
        self._draw_markers(self._session.picks)

    def _draw_markers(self, picks: list[Pick]) -> None:
        scene = self._server.scene
        for number, colour in enumerate(MARKER_COLOURS):
            name = f"/picks/{number}"
            if number < len(picks):
                position = picks[number].position
                radius = MARKER_RADIUS_FRACTION * max(float(np.linalg.norm(position)), 0.1)
                scene.add_icosphere(
                    name, radius=radius, color=colour, position=position, **NO_SHADOWS
                )
            elif scene.get_handle_by_name(name) is not None:
                scene.remove_by_name(name)
        if len(picks) == 2:
            ends = np.array([[picks[0].position, picks[1].position]], np.float32)
            scene.add_line_segments(
                "/picks/between", ends, (255, 255, 255), thickness=2.0, thickness_units="screen"
            )
        elif scene.get_handle_by_name("/picks/between") is not None:
            scene.remove_by_name("/picks/between")

    def _draw_waveform(self, pick: Pick) -> None:
        if pick.waveform is None:
            return
        data = _make_plot_data(pick)
        if self._plot is not None:
            self._plot.data = data
            return
        series: Any = (
            {"label": "range (m)"},
            {"label": "counts", "stroke": "#3dd6c8", "width": 1},
            {"label": "return", "stroke": "#ff5050", "fill": "#ff505066", "width": 1.5},
        )
        axes: Any = (
            {"stroke": "#aab", "label": "range (m), c t / 2", "size": 30, "labelSize": 18},
            {"stroke": "#aab", "label": "counts", "size": 40, "labelSize": 18},
        )
        scales: Any = {"x": {"time": False}}
        with self._container:
            self._plot = self._server.gui.add_uplot(
                data,
                series,
                scales=scales,
                axes=axes,
                legend={"show": False},
                aspect=1.45,
            )


def _make_plot_data(pick: Pick) -> tuple[NDArray[np.float64], ...]:
    """Ranges in m, the pixel's signal, and that signal where its returns were found, else 0."""
    waveform = pick.waveform
    assert waveform is not None
    counts = waveform.counts.astype(np.float64)
    row = float(np.median(np.diff(waveform.times))) if waveform.times.size > 1 else 1.0
    away = np.abs(waveform.times[:, np.newaxis] - np.asarray(pick.return_times)[np.newaxis])
    near = (away <= RETURN_HALF_WIDTH_BINS * row).any(axis=1)
    return SPEED_OF_LIGHT * waveform.times / 2, counts, np.where(near, counts, 0.0)


def _format_html(text: str) -> str:
    lines = "<br>".join(html.escape(text).splitlines())
    return f"<div id='picked' style='padding:0.2em 0.8em 0.6em;font-size:0.85em'>{lines}</div>"
