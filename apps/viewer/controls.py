"""The panel of controls: labels that stay, and what each of them does to the session."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apps.viewer.appearance_panel import AppearancePanel
from apps.viewer.clock import MAX_SPEED, MIN_SPEED
from apps.viewer.colouring import choose_round_values
from apps.viewer.page_text import Status
from apps.viewer.session import GATE_MODES, DisplayedFrame, Session
from apps.viewer.source import Setting
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

    Parameters
    ----------
    server : ViserServer
    session : Session
    post : callable
        Takes what is to be done by the thread that owns the session.
    first : DisplayedFrame
    resize : callable
        Called when points are to have another size.
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

        Parameters
        ----------
        shown : DisplayedFrame
        status : Status
            Its text as HTML.
        """
        if self._status.content != status.html:
            self._status.content = status.html
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
        self._frame: Any = gui.add_slider(
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
        hint = "recovers the gate once more by the linear inverse, at this shear in pixels per view step; 0: as it was"
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

    Parameters
    ----------
    times : (frames,) array
        Time of flight, s; rising.

    Returns
    -------
    tuple of (int, str)
    """
    in_ns = times / NANOSECOND
    places = choose_round_values(in_ns[0], in_ns[-1], MAX_TIME_MARKS)
    frames = np.abs(in_ns - places[:, np.newaxis]).argmin(axis=1)
    return tuple((int(frame), f"{place:g} ns") for frame, place in zip(frames, places, strict=True))


def bind_user_input(handle: Any, post: Post, act: Callable[[Any], None]) -> None:
    """Have `act` called with a control's new value when a user, not this program, has changed it.

    Parameters
    ----------
    handle : viser input handle
    post : callable
        Takes what is to be done by the viewer's own thread.
    act : callable
        Called with the new value.
    """

    def changed(event: Any) -> None:
        # events without a client come from this program's own changes
        if event.client is not None:
            value = event.target.value
            post(lambda: act(value))

    (handle.on_update if hasattr(handle, "on_update") else handle.on_click)(changed)
