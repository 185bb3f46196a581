"""Controls of how points look and which of them are shown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from apps.viewer.colouring import PALETTES, QUANTITIES
from apps.viewer.filters import EVERYTHING, Filters, Limits
from apps.viewer.session import Session, Shown
from apps.viewer.words import scale_html

if TYPE_CHECKING:
    import viser

SMALLEST_POINT, LARGEST_POINT = 0.1, 50.0
"""mm."""

FEW = 20_000
"""Points among which neighbours are looked for."""

SIDES = ("range", "intensity", "x", "y", "z")


class Looks:
    """Colours, scale, point size and filters.

    Parameters
    ----------
    server : ViserServer
    session : Session
    post : callable
    first : Shown
        Its extent is that of the filters as long as nobody narrows them.
    """

    def __init__(
        self, server: viser.ViserServer, session: Session, post: Callable[[Callable[[], None]], None], first: Shown
    ) -> None:
        self._gui, self._session, self._post = server.gui, session, post
        self._points = server
        with self._gui.add_folder("colours"):
            self._colours(first)
        with self._gui.add_folder("filters", expand_by_default=False):
            self._filters(first)

    @property
    def point_size(self) -> float:
        """Side of a point, m."""
        return float(self._size.value) / 1e3

    def show(self, shown: Shown) -> None:
        """Bring the scale up to date."""
        content = scale_html(shown.scale)
        if self._scale.content != content:
            self._scale.content = content
        if self._session.colouring.limits is None:
            low, high = shown.scale.limits
            self._limits.value = (round(low, 4), round(high, 4))

    def _colours(self, first: Shown) -> None:
        gui, colouring = self._gui, self._session.colouring
        self._scale = gui.add_html(scale_html(first.scale))
        self._change(gui.add_dropdown("colour", tuple(QUANTITIES), initial_value="range"), self._set_quantity)
        self._change(gui.add_dropdown("palette", PALETTES, initial_value=colouring.palette), self._set_palette)
        self._limits: Any = gui.add_vector2("limits", first.scale.limits, hint="in the unit of the scale")
        self._change(self._limits, self._set_limits)
        self._automatic: Any = gui.add_checkbox("automatic", True, hint="limits that suit nearly all points")
        self._change(self._automatic, lambda on: self._set_limits(None if on else self._limits.value))
        hint = "give every colour to equally many points"
        self._change(gui.add_checkbox("equalise", colouring.equalised, hint=hint), self._set_equalised)
        hint = "draw dim points darker"
        self._change(gui.add_checkbox("shade", colouring.shaded, hint=hint), self._set_shaded)
        self._size = gui.add_slider("point size", SMALLEST_POINT, LARGEST_POINT, 0.1, _handy_size(first), hint="mm")
        self._change(self._size, lambda _: self._redraw())

    def _filters(self, first: Shown) -> None:
        columns = {"range": first.cloud.range, "intensity": first.cloud.intensity}
        columns |= dict(zip("xyz", first.cloud.xyz.T, strict=True))
        self._sides: dict[str, tuple[Any, Limits]] = {}
        for name in SIDES:
            whole = _rounded_outwards(columns[name])
            handle = self._gui.add_vector2(name, whole, hint="least and most; in m, intensities in counts")
            self._sides[name] = handle, whole
            self._change(handle, lambda _: self._set_filters())
        button = self._gui.add_button("reset filters")
        button.on_click(lambda _: self._post(self._reset_filters))

    def _set_filters(self) -> None:
        sides = {name: _narrowed(handle.value, whole) for name, (handle, whole) in self._sides.items()}
        self._session.filters = Filters(**sides)

    def _reset_filters(self) -> None:
        for handle, whole in self._sides.values():
            handle.value = whole
        self._session.filters = Filters()

    def _set_quantity(self, quantity: str) -> None:
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

    def _redraw(self) -> None:
        handle = self._points.scene.get_handle_by_name("/points")
        if handle is not None:
            handle.point_size = self.point_size  # type: ignore[attr-defined]

    def _change(self, handle: Any, act: Callable[[Any], None]) -> None:
        from apps.viewer.controls import on_user

        on_user(handle, self._post, act)


def _handy_size(first: Shown) -> float:
    """Side of a point, mm, at which neighbours about touch."""
    if len(first.cloud) < 2:
        return 5.0
    from scipy.spatial import cKDTree

    thinned = first.cloud.xyz[:: max(1, len(first.cloud) // FEW)]
    apart, _ = cKDTree(thinned).query(thinned, 2)
    # Of points on surfaces, n times as many are sqrt(n) times closer.
    side = 1e3 * float(np.median(apart[:, 1]) * np.sqrt(len(thinned) / len(first.cloud)))
    return round(min(max(side, SMALLEST_POINT), LARGEST_POINT), 1)


def _rounded_outwards(values: Any) -> Limits:
    if len(values) == 0:
        return 0.0, 1.0
    return float(np.floor(values.min() * 100) / 100), float(np.ceil(values.max() * 100) / 100)


def _narrowed(given: Limits, whole: Limits) -> Limits:
    """A side that was not moved is no limit, whatever comes later."""
    low = given[0] if given[0] > whole[0] else EVERYTHING[0]
    high = given[1] if given[1] < whole[1] else EVERYTHING[1]
    return low, high
