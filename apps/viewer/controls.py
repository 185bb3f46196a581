"""The panel of controls: playback, ways of showing, how points look and which of them are shown; what
each of them does to the session.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apps.viewer.clock import MAX_SPEED, MIN_SPEED
from apps.viewer.colouring import PALETTES, QUANTITIES, choose_round_values
from apps.viewer.furniture import ClipBox
from apps.viewer.page_text import Status, render_scale_html
from apps.viewer.session import GATE_MODES, NO_LIMITS, DisplayedFrame, Filters, Limits, Session
from apps.viewer.source import Setting
from apps.viewer.viewpoint import Box, measure_point_spacing
from tofclip.units import NANOSECOND

if TYPE_CHECKING:
    import viser

Post = Callable[[Callable[[], None]], None]

SPEEDS = ("1/16", "1/8", "1/4", "1/2", "1", "2", "4", "8", "16")
# The outermost steps are longer than any source; the clock stops at the ends.
FRAME_STEPS = {"|<": -(10**9), "-10": -10, "-1": -1, "+1": 1, "+10": 10, ">|": 10**9}
MAX_HALF_GATE_FRAMES = 200
MAX_TIME_MARKS = 4


class Controls:
    """Playback, time gate, refocus and ways of showing; how points look is in `AppearancePanel`.

    `post`: takes what is to be done by the thread that owns the session; `resize`: called when
    points are to have another size.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        post: Post,
        first: DisplayedFrame,
        resize: Callable[[], None],
    ) -> None:
        self._gui, self._session, self._post = server.gui, session, post
        self._status = self._gui.add_html("")
        self._frame: Any = None
        if session.source.is_live or len(session.source) > 1:
            self._add_playback()
        if session.source.capabilities.times is not None:
            self._add_time_gate()
        if session.source.capabilities.shears is not None:
            self._add_refocus(*session.source.capabilities.shears)
        if session.source.display_modes.names:
            self._add_display_modes()
        for setting in session.source.settings:
            self._add_setting(setting)
        self._appearance_panel = AppearancePanel(server, session, post, first, resize)

    @property
    def point_size(self) -> float:
        """Side of a point, m."""
        return self._appearance_panel.point_size

    def show(self, shown: DisplayedFrame, status: Status) -> None:
        """Bring texts and controls up to date with what is shown.

        `status`: its text as HTML.
        """
        if self._status.content != status.html:
            self._status.content = status.html
        if self._frame is not None:
            last = max(1, len(self._session.source) - 1)
            if self._frame.max != last:
                self._frame.max = last
            self._frame.value = shown.frame
        self._appearance_panel.show(shown)

    def _add_playback(self) -> None:
        session, gui = self._session, self._gui
        # A slider needs two different ends, even for a single frame.
        last = max(1, len(session.source) - 1)
        times = session.source.capabilities.times
        self._frame = gui.add_slider(
            session.source.frame_name,
            0,
            last,
            1,
            min(session.clock.frame, last),
            marks=None if times is None else mark_times(times),
        )
        self._bind(self._frame, session.jump)
        live = ("play", "pause", "live") if session.source.is_live else ("play", "pause")
        self._bind(gui.add_button_group("playback", live), self._run_playback)
        self._bind(
            gui.add_button_group("step", tuple(FRAME_STEPS)),
            lambda word: session.step(FRAME_STEPS[word]),
        )
        self._bind(gui.add_dropdown("speed", SPEEDS, initial_value="1"), self._set_speed)
        self._bind(gui.add_checkbox("loop", session.clock.loop), self._set_loop)

    def _add_time_gate(self) -> None:
        gui = self._gui
        hint = "which points of the transient are shown: those whose light has come back by the current frame, ..."
        self._bind(
            gui.add_dropdown("time gate", GATE_MODES, initial_value=self._session.gate, hint=hint),
            self._set_gate,
        )
        hint = "frames before and after the current one, for 'around the frame'"
        half = gui.add_slider(
            "half gate", 1, MAX_HALF_GATE_FRAMES, 1, self._session.half_gate, hint=hint
        )
        self._bind(half, self._set_half_gate)

    def _add_refocus(self, least: float, most: float) -> None:
        hint = "recovers the gate once more, at this shear in pixels per view step; 0: as it was"
        slider = self._gui.add_slider("refocus", least, most, 0.1, 0.0, hint=hint)
        self._bind(slider, self._set_shear)

    def _add_display_modes(self) -> None:
        display_modes, gui = self._session.source.display_modes, self._gui
        self._bind(
            gui.add_dropdown("show as", display_modes.names, initial_value=display_modes.current),
            self._set_display_mode,
        )
        hint = "share of the brightest voxel below which nothing is shown"
        self._bind(
            gui.add_slider("threshold", 0.02, 0.98, 0.01, display_modes.threshold, hint=hint),
            self._set_threshold,
        )

    def _add_setting(self, setting: Setting) -> None:
        slider = self._gui.add_slider(
            setting.name, setting.low, setting.high, setting.step, setting.value, hint=setting.hint
        )
        self._bind(slider, lambda value: setattr(setting, "value", value))

    def _run_playback(self, word: str) -> None:
        {"play": self._session.play, "pause": self._session.pause, "live": self._session.follow}[
            word
        ]()

    def _set_speed(self, word: str) -> None:
        over, _, under = word.partition("/")
        self._session.clock.set_speed(
            float(np.clip(float(over) / float(under or 1), MIN_SPEED, MAX_SPEED))
        )

    def _set_loop(self, loop: bool) -> None:
        self._session.clock.loop = loop

    def _set_gate(self, gate: str) -> None:
        self._session.gate = gate

    def _set_half_gate(self, frames: int) -> None:
        self._session.half_gate = frames

    def _set_shear(self, shear: float) -> None:
        self._session.shear = None if shear == 0 else shear

    def _set_display_mode(self, way: str) -> None:
        self._session.source.display_modes.current = way

    def _set_threshold(self, threshold: float) -> None:
        self._session.source.display_modes.threshold = threshold

    def _bind(self, handle: Any, act: Callable[[Any], None]) -> None:
        bind_user_input(handle, self._post, act)


def mark_times(times: NDArray[np.float64]) -> tuple[tuple[int, str], ...]:
    """Return the frames at round times of flight, with their times in ns, for a time line.

    `times` (frames,): time of flight, s; rising.
    """
    in_ns = times / NANOSECOND
    places = choose_round_values(in_ns[0], in_ns[-1], MAX_TIME_MARKS)
    frames = np.abs(in_ns - places[:, np.newaxis]).argmin(axis=1)
    return tuple((int(frame), f"{place:g} ns") for frame, place in zip(frames, places, strict=True))


def bind_user_input(handle: Any, post: Post, act: Callable[[Any], None]) -> None:
    """Have `act` called with a control's new value when a user, not this program, has changed it.

    `post`: takes what is to be done by the viewer's own thread; `act`: called with the new value.
    """

    # A coroutine, which viser runs at once and functions later: by then a frame that is just being
    # shown may have set the control to its own number.
    async def changed(event: Any) -> None:
        # events without a client come from this program's own changes
        if event.client is not None:
            value = event.target.value
            post(lambda: act(value))

    (handle.on_update if hasattr(handle, "on_update") else handle.on_click)(changed)


MIN_POINT_SIZE_MM, MAX_POINT_SIZE_MM = 0.1, 50.0
"""mm."""

FILTER_NAMES = ("range", "intensity", "x", "y", "z")


class AppearancePanel:
    """Colours, scale, point size and filters.

    `first`: its extent is that of the filters until they are narrowed; `resize`: called when points
    are to have another size.
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
        cloud = self._session.source.view(first.frame).cloud  # whole, as without filters
        columns = {"range": cloud.range, "intensity": cloud.intensity}
        columns |= dict(zip("xyz", cloud.xyz.T, strict=True))
        self._filter_handles: dict[str, tuple[Any, Limits]] = {}
        for name in FILTER_NAMES:
            whole = _round_outwards(columns[name])
            low, high = getattr(self._session.filters, name)
            handle = self._gui.add_vector2(
                name,
                (max(low, whole[0]), min(high, whole[1])),
                hint="least and most; in m, intensities in counts",
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
        bind_user_input(handle, self._post, act)


def _suggest_point_size(first: DisplayedFrame) -> float:
    """Side of a point, mm, at which neighbours about touch."""
    if len(first.cloud) < 2:
        return 5.0
    side = 1e3 * measure_point_spacing(first.cloud.xyz)
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
