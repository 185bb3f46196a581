"""Points that are picked on the page: marked in the scene, described beside it, with their
waveform.

What can be taken along from the page: screenshots, the points that are shown, places to look
from; and its keys.

The panel of controls: playback, ways of showing, how points look and which of them are shown; what
each of them does to the session.
"""

from __future__ import annotations

import html
import io
import tempfile
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apps.figures.style import DOTS_PER_INCH, make_figure
from apps.viewer.clock import MAX_SPEED, MIN_SPEED
from apps.viewer.colouring import (
    PALETTES,
    QUANTITIES,
    choose_round_values,
    choose_ticks,
    format_length,
    load_palette,
)
from apps.viewer.furniture import ClipBox
from apps.viewer.page_text import Status, render_scale_html
from apps.viewer.picking import Pick
from apps.viewer.render import BACKGROUND
from apps.viewer.session import GATE_MODES, NO_LIMITS, DisplayedFrame, Filters, Limits, Session
from apps.viewer.source import Setting
from apps.viewer.viewpoint import Box, Viewpoint, measure_point_spacing, move_camera
from tofclip.units import NANOSECOND, SPEED_OF_LIGHT

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


Post = Callable[[Callable[[], None]], None]
RENDER_TIMEOUT_S = 60.0  # s; a software renderer takes ten for millions of points
MAX_SIDE_PX = 1600
LEGEND_PX = 70  # below the picture


class ExportPanel:
    """Screenshot, export, bookmarks and keys.

    `list_views`: takes a window's width over its height, returns where one can look from, by name;
    the first is where one looks from at first; `drawn_whole`: returns what a screenshot is taken
    within, so that all points of a large cloud are on it.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        post: Post,
        list_views: Callable[[float], Mapping[str, Viewpoint]],
        drawn_whole: Callable[[], AbstractContextManager[None]],
    ) -> None:
        self._server, self._session, self._post = server, session, post
        self._list_views, self._drawn_whole = list_views, drawn_whole
        self._bookmarked_views: dict[str, Viewpoint] = {}
        self._bookmarks_made = 0
        gui = server.gui
        gui.add_button("screenshot").on_click(lambda event: self._send_screenshot(event.client))
        gui.add_button("export", hint="the points that are shown, as PLY").on_click(
            lambda event: self._post(lambda: self._send_points(event.client))
        )
        self._bookmarks: Any = gui.add_dropdown("view from", tuple(list_views(1.0)))
        self._bookmarks.on_update(self._go_to_bookmark)
        gui.add_button("bookmark", hint="remember where one looks from").on_click(
            lambda event: self._add_bookmark(event.client)
        )
        gui.add_button("keys", hint="also: K").on_click(lambda event: self._show_keys(event.client))
        self._keys = self._add_keys()

    def _send_screenshot(self, client: viser.ClientHandle | None) -> None:
        if client is None:
            return
        # Large windows are scaled down: the browser sends the whole picture back.
        shrink = min(
            1.0, MAX_SIDE_PX / max(client.camera.image_height, client.camera.image_width, 1)
        )
        height, width = (
            round(shrink * side) for side in (client.camera.image_height, client.camera.image_width)
        )
        with self._drawn_whole():
            drawn = client.get_render(
                height, width, transport_format="png", timeout=RENDER_TIMEOUT_S
            )
        client.send_file_download(
            "tofclip.png", _encode_png(drawn, self._session), save_immediately=True
        )

    def _send_points(self, client: viser.ClientHandle | None) -> None:
        shown = self._session.latest
        if client is None or shown is None:
            return
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "shown.ply"
            shown.cloud.save(path)
            client.send_file_download("tofclip.ply", path.read_bytes(), save_immediately=True)

    def _add_bookmark(self, client: viser.ClientHandle | None) -> None:
        if client is None:
            return
        self._bookmarks_made += 1
        name = f"view {self._bookmarks_made}"
        camera = client.camera
        # Copied, because the page goes on changing the camera's own arrays.
        self._bookmarked_views[name] = Viewpoint(
            camera.position.copy(), camera.look_at.copy(), camera.fov
        )
        self._bookmarks.options = (*self._list_views(1.0), *self._bookmarked_views)
        self._bookmarks.value = name

    def _go_to_bookmark(self, event: Any) -> None:
        if event.client is None:
            return
        camera = event.client.camera
        presets = self._list_views(camera.image_width / max(camera.image_height, 1))
        move_camera(camera, {**presets, **self._bookmarked_views}[event.target.value])

    def _show_keys(self, client: viser.ClientHandle | None) -> None:
        if client is None:
            return
        with client.gui.add_modal("keys") as modal:
            rows = "\n".join(f"| {key} | {label} |" for key, label in self._keys)
            client.gui.add_markdown(f"| key | what it does |\n|---|---|\n{rows}")
            client.gui.add_button("close").on_click(lambda _: modal.close())

    def _add_keys(self) -> list[tuple[str, str]]:
        """Give keys to what is done most."""
        session = self._session
        own = (
            ("space", "play or pause", self._toggle_playback),
            ("arrowleft", "one frame back", lambda: session.step(-1)),
            ("arrowright", "one frame on", lambda: session.step(1)),
            ("pageup", "ten frames back", lambda: session.step(-10)),
            ("pagedown", "ten frames on", lambda: session.step(10)),
            ("home", "first frame", lambda: session.jump(0)),
            ("end", "last frame", lambda: session.jump(len(session.source))),
            ("L", "follow a live source", session.follow),
        )
        for key, label, act in own:
            self._add_key(key, label, self._make_handler(act))
        self._add_key("S", "screenshot", lambda event: self._send_screenshot(event.client))
        self._add_key("B", "bookmark this view", lambda event: self._add_bookmark(event.client))
        self._add_key("K", "this table", lambda event: self._show_keys(event.client))
        return [(key, label) for key, label, _ in own] + [
            ("S", "screenshot"),
            ("B", "bookmark this view"),
            ("K", "this table"),
        ]

    def _make_handler(self, act: Callable[[], None]) -> Callable[[Any], None]:
        return lambda _: self._post(act)

    def _add_key(self, key: Any, label: str, act: Callable[[Any], None]) -> None:
        self._server.gui.add_command(label, hotkey=key).on_trigger(act)

    def _toggle_playback(self) -> None:
        if self._session.clock.playing:
            self._session.pause()
        else:
            self._session.play()


def format_box(xyz: NDArray[np.float32]) -> str:
    """Return the lengths of the box around a cloud in words; empty for an empty cloud.

    `xyz` (n, 3): m.
    """
    if len(xyz) == 0:
        return ""
    box = Box.around(xyz)
    return "box " + " x ".join(map(format_length, (box.high - box.low).tolist()))


def _encode_png(drawn: Any, session: Session) -> bytes:
    """Put a picture with a transparent ground on a dark one, as on the page, with the legend of its
    colours below.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap

    opacity = drawn[..., 3:] / 255.0 if drawn.shape[-1] == 4 else 1.0
    flat = drawn[..., :3] * opacity + np.array(BACKGROUND) * (1 - opacity)
    rows, columns = flat.shape[:2]
    figure = make_figure(columns / DOTS_PER_INCH, (rows + LEGEND_PX) / DOTS_PER_INCH)
    figure.set_layout_engine("none")
    figure.figimage(np.rint(flat).astype(np.uint8), yo=LEGEND_PX, origin="upper")
    shown = session.latest
    if shown is not None:
        axes = figure.add_axes((0.2, 0.6 * LEGEND_PX / (rows + LEGEND_PX), 0.6, 0.012))
        ticks, title = choose_ticks(shown.scale)
        mapped = ScalarMappable(cmap=ListedColormap(load_palette(shown.scale.palette) / 255.0))
        bar = figure.colorbar(mapped, cax=axes, orientation="horizontal")
        bar.set_ticks([place for place, _ in ticks], labels=[label for _, label in ticks])
        bar.set_label(f"{session.title}: {title}; {format_box(shown.cloud.xyz)}", fontsize=9)
        axes.tick_params(labelsize=8)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=DOTS_PER_INCH)
    return file.getvalue()


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
