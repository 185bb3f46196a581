"""Controls of how points look and which of them are shown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from apps.viewer.colouring import PALETTES, QUANTITIES
from apps.viewer.filters import NO_LIMITS, Filters, Limits
from apps.viewer.furniture import ClipBox
from apps.viewer.page_text import render_scale_html
from apps.viewer.session import DisplayedFrame, Session
from apps.viewer.viewpoint import Box

if TYPE_CHECKING:
    import viser

MIN_POINT_SIZE_MM, MAX_POINT_SIZE_MM = 0.1, 50.0
"""mm."""

MAX_NEIGHBOUR_POINTS = 20_000
"""Points among which neighbours are looked for."""

FILTER_NAMES = ("range", "intensity", "x", "y", "z")


class AppearancePanel:
    """Colours, scale, point size and filters.

    Parameters
    ----------
    server : ViserServer
    session : Session
    post : callable
    first : DisplayedFrame
        Its extent is that of the filters until they are narrowed.
    resize : callable
        Called when points are to have another size.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        post: Callable[[Callable[[], None]], None],
        first: DisplayedFrame,
        resize: Callable[[], None],
    ) -> None:
        self._gui, self._session, self._post = server.gui, session, post
        with self._gui.add_folder("colours"):
            self._add_colours(first, resize)
        self._clip = ClipBox(server.scene, lambda box: post(lambda: self._take_clip_box(box)))
        with self._gui.add_folder("filters", expand_by_default=False):
            self._add_filters(first)

    @property
    def point_size(self) -> float:
        """Side of a point, m."""
        return float(self._size.value) / 1e3

    def show(self, shown: DisplayedFrame) -> None:
        """Bring the scale up to date."""
        content = render_scale_html(shown.scale)
        if self._scale.content != content:
            self._scale.content = content
        # Limits that the user has set are not overwritten.
        if self._session.colouring.limits is None:
            low, high = shown.scale.limits
            self._limits.value = (round(low, 4), round(high, 4))

    def _add_colours(self, first: DisplayedFrame, resize: Callable[[], None]) -> None:
        gui, colouring = self._gui, self._session.colouring
        self._scale = gui.add_html(render_scale_html(first.scale))
        self._bind(
            gui.add_dropdown("colour", tuple(QUANTITIES), initial_value="range"), self._set_quantity
        )
        self._bind(
            gui.add_dropdown("palette", PALETTES, initial_value=colouring.palette),
            self._set_palette,
        )
        self._limits: Any = gui.add_vector2(
            "limits", first.scale.limits, hint="in the unit of the scale"
        )
        self._bind(self._limits, self._set_limits)
        self._automatic: Any = gui.add_checkbox(
            "automatic", True, hint="limits that suit nearly all points"
        )
        self._bind(self._automatic, lambda on: self._set_limits(None if on else self._limits.value))
        hint = "give every colour to equally many points"
        self._bind(
            gui.add_checkbox("equalise", colouring.equalised, hint=hint), self._set_equalised
        )
        hint = "draw dim points darker"
        self._bind(gui.add_checkbox("shade", colouring.shaded, hint=hint), self._set_shaded)
        self._size = gui.add_slider(
            "point size",
            MIN_POINT_SIZE_MM,
            MAX_POINT_SIZE_MM,
            0.1,
            _suggest_point_size(first),
            hint="mm",
        )
        self._bind(self._size, lambda _: resize())

    def _add_filters(self, first: DisplayedFrame) -> None:
        columns = {"range": first.cloud.range, "intensity": first.cloud.intensity}
        columns |= dict(zip("xyz", first.cloud.xyz.T, strict=True))
        self._filter_handles: dict[str, tuple[Any, Limits]] = {}
        for name in FILTER_NAMES:
            whole = _round_outwards(columns[name])
            handle = self._gui.add_vector2(
                name, whole, hint="least and most; in m, intensities in counts"
            )
            self._filter_handles[name] = handle, whole
            self._bind(handle, lambda _: self._set_filters())
        self._clip_shown: Any = self._gui.add_checkbox(
            "clip box", False, hint="drag the corners of a box in the scene; same as x, y and z"
        )
        self._bind(self._clip_shown, self._show_clip_box)
        button = self._gui.add_button("reset filters")
        button.on_click(lambda _: self._post(self._reset_filters))

    def _show_clip_box(self, shown: bool) -> None:
        if not shown:
            self._clip.hide()
            return
        sides = np.array([self._filter_handles[axis][0].value for axis in "xyz"], float)
        self._clip.show(Box(sides[:, 0], sides[:, 1]))

    def _take_clip_box(self, box: Box) -> None:
        """Filter by a box that was dragged."""
        for axis, low, high in zip("xyz", box.low, box.high, strict=True):
            self._filter_handles[axis][0].value = (round(float(low), 4), round(float(high), 4))
        self._set_filters()

    def _set_filters(self) -> None:
        sides = {
            name: _narrow_limits(handle.value, whole)
            for name, (handle, whole) in self._filter_handles.items()
        }
        self._session.filters = Filters(**sides)

    def _reset_filters(self) -> None:
        for handle, whole in self._filter_handles.values():
            handle.value = whole
        self._session.filters = Filters()
        self._show_clip_box(self._clip.is_shown)

    def _set_quantity(self, quantity: str) -> None:
        # Limits of one quantity mean nothing for another, which may have another unit.
        self._session.colouring = replace(self._session.colouring, quantity=quantity, limits=None)
        self._automatic.value = True

    def _set_palette(self, palette: str) -> None:
        self._session.colouring = replace(self._session.colouring, palette=palette)

    def _set_limits(self, limits: Limits | None) -> None:
        if limits is not None:
            limits = (float(limits[0]), float(limits[1]))
        self._session.colouring = replace(self._session.colouring, limits=limits)
        self._automatic.value = limits is None

    def _set_equalised(self, equalised: bool) -> None:
        self._session.colouring = replace(self._session.colouring, equalised=equalised)

    def _set_shaded(self, shaded: bool) -> None:
        self._session.colouring = replace(self._session.colouring, shaded=shaded)

    def _bind(self, handle: Any, act: Callable[[Any], None]) -> None:
        from apps.viewer.controls import bind_user_input

        bind_user_input(handle, self._post, act)


def _suggest_point_size(first: DisplayedFrame) -> float:
    """Side of a point, mm, at which neighbours about touch."""
    if len(first.cloud) < 2:
        return 5.0
    from scipy.spatial import cKDTree

    thinned = first.cloud.xyz[:: max(1, len(first.cloud) // MAX_NEIGHBOUR_POINTS)]
    apart, _ = cKDTree(thinned).query(thinned, 2)
    # Of points on surfaces, n times as many are sqrt(n) times closer.
    side = 1e3 * float(np.median(apart[:, 1]) * np.sqrt(len(thinned) / len(first.cloud)))
    return round(min(max(side, MIN_POINT_SIZE_MM), MAX_POINT_SIZE_MM), 1)


def _round_outwards(values: Any) -> Limits:
    if len(values) == 0:
        return 0.0, 1.0
    return float(np.floor(values.min() * 100) / 100), float(np.ceil(values.max() * 100) / 100)


def _narrow_limits(given: Limits, whole: Limits) -> Limits:
    """A side that was not moved does not limit later frames."""
    low = given[0] if given[0] > whole[0] else NO_LIMITS[0]
    high = given[1] if given[1] < whole[1] else NO_LIMITS[1]
    return low, high
