"""Points that are picked on the page: marked in the scene, described beside it, with their
waveform.
"""

from __future__ import annotations

import html
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from apps.viewer.picking import Pick
from apps.viewer.session import Session
from tofclip.units import NANOSECOND

if TYPE_CHECKING:
    import viser

MARKER_COLOURS = ((255, 80, 80), (80, 220, 255))
MARKER_RADIUS_FRACTION = 0.006
"""Of the distance."""


NO_SHADOWS: Any = {"cast_shadow": False, "receive_shadow": False}


class SelectionPanel:
    """Listens to clicks on points.

    Parameters
    ----------
    server : ViserServer
    session : Session
    post : callable
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        post: Callable[[Callable[[], None]], None],
    ) -> None:
        self._server, self._session = server, session
        with server.gui.add_folder("picked point"):
            self._text = server.gui.add_html(
                _format_html("click a point; a second one gives their distance")
            )
            self._plot: Any = None
            self._container = server.gui.add_folder(None)
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
        data = (pick.waveform.times / NANOSECOND, pick.waveform.counts.astype(np.float64))
        if self._plot is not None:
            self._plot.data = data
            return
        series: Any = ({"label": "time (ns)"}, {"label": "counts", "stroke": "#3dd6c8", "width": 1})
        axes: Any = ({"stroke": "#aab", "label": "time (ns)"}, {"stroke": "#aab"})
        with self._container:
            self._plot = self._server.gui.add_uplot(
                data, series, title="waveform", scales={"x": {"time": False}}, axes=axes, aspect=1.8
            )


def _format_html(text: str) -> str:
    lines = "<br>".join(html.escape(text).splitlines())
    return f"<div id='picked' style='padding:0.2em 0.8em 0.6em;font-size:0.85em'>{lines}</div>"
