"""The page's panels: playback, ways of showing, how points look and which of them are shown; points
that are picked, with their waveform; what can be taken along, and the keys; the texts in them.

Each control changes the session by way of `post`, which has that done by the thread that owns it.
"""

from __future__ import annotations

import html
import io
import tempfile
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apps.figures.style import DOTS_PER_INCH, make_figure
from apps.viewer.clock import MAX_SPEED, MIN_SPEED
from apps.viewer.look import (
    PALETTE_SIZE,
    PALETTES,
    QUANTITIES,
    Pick,
    Scale,
    choose_round_values,
    choose_ticks,
    format_length,
    load_palette,
)
from apps.viewer.points import ClipBox, Post
from apps.viewer.session import GATE_MODES, NO_LIMITS, DisplayedFrame, Filters, Limits, Session
from apps.viewer.source import Inflow, Waveform
from apps.viewer.still import BACKGROUND
from apps.viewer.viewpoint import Box, Viewpoint, measure_point_spacing, move_camera
from tofclip.units import NANOSECOND, SPEED_OF_LIGHT

if TYPE_CHECKING:
    import viser


GRADIENT_STOPS, LABEL_MARGIN = 24, 0.04
HTML_STYLE = "padding:0.2em 0.8em 0.6em;font-size:0.85em;line-height:1.5"
LINE_STYLE = (
    "white-space:nowrap;overflow:hidden;text-overflow:ellipsis;font-variant-numeric:tabular-nums"
)

# The page dims its panels and takes no clicks while its connection is down; the words in them are
# shown by that very style, which needs no script.
LOST_STYLE = """
.tofclip-lost {display: none}
div[style*="pointer-events: none"] .tofclip-lost {
  display: block; position: fixed; z-index: 1000; top: 1em; left: 50%; transform: translateX(-50%);
  padding: 0.8em 1.2em; border-radius: 0.4em; background: #e5484d; color: white; font-size: 1.1em}
"""
LOST_TEXT = (
    "Connection lost: tofclip view has ended, or cannot be reached. What you see is the last "
    "picture. This page goes on by itself once it reaches the program again; a new tofclip view has "
    "a new address."
)
SHARED_TEXT = (
    "Every browser at this address shows the same frame, colours, filters and picked points; where "
    "you look from is your own."
)
BLANK_PIXEL = "data:image/gif;base64,R0lGODlhAQABAIAAAAAAAP///yH5BAEAAAAALAAAAAABAAEAAAIBRAA7"


@dataclass(frozen=True)
class Status:
    """What the line at the top says."""

    label: str  # ``"LIVE"`` or ``"REPLAY"``
    frame: int
    frames: int
    points: int
    frame_rate: float  # frames per second that are sent to the page
    inflow: Inflow = field(default_factory=Inflow)
    time: float = float("nan")  # time of flight of the frame, s; NaN where frames have none
    frame_name: str = "frame"  # what a frame is: frame, slice, shot or cloud
    depth_text: str = ""  # where a slice lies; empty where frames are not slices
    # what has to be known about the picture, such as that its ranges have no time zero
    notes: tuple[str, ...] = ()
    # what is shown where it is not one frame but all of them, instead of the frame's number
    whole_name: str = ""
    # of a large cloud, by a browser that would be slow with all of them
    drawn_points: int | None = None

    @property
    def html(self) -> str:
        """Its lines, with ids for scripts. Each is as high whatever it says, so that nothing below
        moves while frames pass.
        """
        colour = "#e5484d" if self.label == "LIVE" else "#3e8ed0"
        what = html.escape(self.whole_name or self.frame_name)
        if not self.whole_name and (self.frames > 1 or self.label == "LIVE"):
            what += f" <b id='frame-number'>{self.frame}</b> of {self.frames}"
        lines = [
            f"<b id='label' style='color:{colour}'>{self.label}</b> <span id='what'>{what}</span>"
        ]
        if np.isfinite(self.time):
            distance = SPEED_OF_LIGHT * self.time / 2
            lines.append(
                f"<span id='instant'>{self.time / NANOSECOND:.2f} ns, range {distance:.3f} m</span>"
            )
        if self.depth_text:
            lines.append(f"<span id='depth'>{html.escape(self.depth_text)}</span>")
        drawn = self.points if self.drawn_points is None else self.drawn_points
        part = f" ({drawn} drawn)" if drawn < self.points else ""
        lines.append(f"<span id='points'>{self.points}</span> points{part}")
        if self.frames > 1 or self.label == "LIVE":
            coming = f"data {self.inflow.data_rate:.1f}/s, " if self.inflow.data_rate > 0 else ""
            shown_words = (
                f"shown {self.frame_rate:.1f}/s" if self.frame_rate > 0 else "standing still"
            )
            lines.append(f"<span id='rates'>{coming}{shown_words}</span>")
        if self.label == "LIVE" or np.isfinite(self.inflow.latency):
            delay = (
                f"{1e3 * self.inflow.latency:.0f} ms"
                if np.isfinite(self.inflow.latency)
                else "not known yet"
            )
            lines.append(f"shot to cloud {delay}, {self.inflow.lost} dropped")
        shown = "".join(f"<div style='{LINE_STYLE}'>{line}</div>" for line in lines)
        shown += "".join(
            f"<div class='note' style='color:#ffb020'>{html.escape(note)}</div>"
            for note in self.notes
        )
        trouble = (
            f"<div style='color:#e5484d'>{html.escape(self.inflow.failure_text)}</div>"
            if self.inflow.failure_text
            else ""
        )
        return f"<div style='{HTML_STYLE}'>{shown}{trouble}</div>"


def render_scale_html(scale: Scale) -> str:
    """Return the colours in a row, with the values of some of them below."""
    colours = load_palette(scale.palette)[
        np.linspace(0, PALETTE_SIZE - 1, GRADIENT_STOPS).round().astype(int)
    ]
    stops = ",".join(f"rgb({red},{green},{blue})" for red, green, blue in colours.tolist())
    places, title = choose_ticks(scale)
    ticks = "".join(
        f"<span style='position:absolute;left:{100 * place:.1f}%;transform:translateX(-{_find_label_shift(place)}%)'>"
        f"{label}</span>"
        for place, label in places
    )
    return (
        f"<div id='scale' style='{HTML_STYLE}'>{title}"
        f"<div style='height:0.9em;background:linear-gradient(to right,{stops})'></div>"
        f"<div style='position:relative;height:1.5em'>{ticks}</div></div>"
    )


def _find_label_shift(place: float) -> int:
    """Share of a label's width by which it stands left of its place, %: at the ends it stays inside."""
    return 0 if place < LABEL_MARGIN else 100 if place > 1 - LABEL_MARGIN else 50


def render_page_html(title: str) -> str:
    """Return what is said at the foot of the controls, and what names the browser's tab."""
    name = html.escape(format_page_title(title), quote=True)
    # a picture's event is the one script that runs in a text put into a page
    tab = f'<img hidden src="{BLANK_PIXEL}" data-name="{name}" onload="document.title=this.dataset.name">'
    return (
        f"<style>{LOST_STYLE}</style>{tab}<div class='tofclip-lost'>{LOST_TEXT}</div>"
        f"<div id='shared' style='{HTML_STYLE};opacity:0.7'>{SHARED_TEXT}</div>"
    )


def render_waiting_html(words: str) -> str:
    """Return what is said while there is nothing to look at yet."""
    return f"<div id='waiting' style='{HTML_STYLE}'>{html.escape(words)} ...</div>"


def format_page_title(title: str) -> str:
    """Return what stands above the controls."""
    return f"tofclip · {title}"[:60]


SPEEDS = ("1/16", "1/8", "1/4", "1/2", "1", "2", "4", "8", "16")
# The outermost steps are longer than any source; the clock stops at the ends.
FRAME_STEPS = {"|<": -(10**9), "-10": -10, "-1": -1, "+1": 1, "+10": 10, ">|": 10**9}
MAX_HALF_GATE_FRAMES = 200
MAX_TIME_MARKS = 4
GATE_HINT = "which points of the transient are shown: those whose light has come back by the current frame, ..."
HALF_GATE_HINT = "frames before and after the current one, for 'around the frame'"
SHEAR_HINT = "recovers the gate once more, at this shear in pixels per view step; 0: as it was"
THRESHOLD_HINT = "share of the brightest voxel below which nothing is shown"

MIN_POINT_SIZE_MM, MAX_POINT_SIZE_MM = 0.1, 50.0
FILTER_NAMES = ("range", "intensity", "x", "y", "z")

MARKER_COLOURS = ((255, 80, 80), (80, 220, 255))
MARKER_RADIUS_FRACTION = 0.006  # of the distance
# on either side of a detected return that are filled in its pixel's waveform
RETURN_HALF_WIDTH_BINS = 3.0
NO_SHADOWS: Any = {"cast_shadow": False, "receive_shadow": False}

RENDER_TIMEOUT_S = 60.0  # a software renderer takes ten for millions of points
MAX_SIDE_PX = 1600
LEGEND_PX = 70  # below the picture


def bind_user_input(handle: Any, post: Post, act: Callable[[Any], None]) -> None:
    """Have `act` called with a control's new value when a user, not this program, has changed it."""

    # A coroutine, which viser runs at once and functions later: by then a frame that is just being
    # shown may have set the control to its own number.
    async def changed(event: Any) -> None:
        # events without a client come from this program's own changes
        if event.client is not None:
            value = event.target.value
            post(lambda: act(value))

    (handle.on_update if hasattr(handle, "on_update") else handle.on_click)(changed)


class Controls:
    """Playback, time gate, refocus, ways of showing, colours and filters. `first`: its extent is
    that of the filters until they are narrowed; `resize`: called when points are to have another
    size.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        post: Post,
        first: DisplayedFrame,
        resize: Callable[[], None],
    ) -> None:
        self._server, self._session, self._post = server, session, post
        self._gui: Any = server.gui
        self._status = self._gui.add_html("")
        self._frame: Any = None
        if session.source.inflow.is_live or len(session.source) > 1:
            self._add_playback()
        self._add_ways_of_showing()
        with self._gui.add_folder("colours"):
            self._add_colours(first, resize)
        with self._gui.add_folder("filters", expand_by_default=False):
            self._add_filters(first)

    @property
    def point_size(self) -> float:
        """Side of a point, m."""
        return float(self._size.value) / 1e3

    def show(self, shown: DisplayedFrame, status: Status) -> None:
        """Bring texts and controls up to date with what is shown."""
        for handle, content in (
            (self._status, status.html),
            (self._scale, render_scale_html(shown.scale)),
        ):
            if handle.content != content:
                handle.content = content
        if self._frame is not None:
            last = max(1, len(self._session.source) - 1)
            if self._frame.max != last:
                self._frame.max = last
            self._frame.value = shown.frame
        # Limits that the user has set are not overwritten.
        if self._session.colouring.limits is None:
            low, high = shown.scale.limits
            self._limits.value = (round(low, 4), round(high, 4))

    def _on(self, handle: Any, act: Callable[[Any], None]) -> None:
        bind_user_input(handle, self._post, act)

    def _set_on(self, handle: Any, owner: Any, name: str) -> None:
        """Have a control set an attribute."""
        self._on(handle, lambda value: setattr(owner, name, value))

    def _add_playback(self) -> None:
        session, gui = self._session, self._gui
        # A slider needs two different ends, even for a single frame.
        last = max(1, len(session.source) - 1)
        times = session.source.capabilities.times
        marks = None if times is None else mark_times(times)
        now = min(session.clock.frame, last)
        self._frame = gui.add_slider(session.source.frame_name, 0, last, 1, now, marks=marks)
        self._on(self._frame, session.jump)
        words = {"play": session.play, "pause": session.pause}
        if session.source.inflow.is_live:
            words["live"] = session.follow
        self._on(gui.add_button_group("playback", tuple(words)), lambda word: words[word]())
        steps = gui.add_button_group("step", tuple(FRAME_STEPS))
        self._on(steps, lambda word: session.step(FRAME_STEPS[word]))

        def set_speed(word: str) -> None:
            over, _, under = word.partition("/")
            speed = float(over) / float(under or 1)
            session.clock.set_speed(float(np.clip(speed, MIN_SPEED, MAX_SPEED)))

        self._on(gui.add_dropdown("speed", SPEEDS, initial_value="1"), set_speed)
        self._set_on(gui.add_checkbox("loop", session.clock.loop), session.clock, "loop")

    def _add_ways_of_showing(self) -> None:
        session, gui = self._session, self._gui
        source, modes = session.source, session.source.display_modes
        if source.capabilities.times is not None:
            gate = gui.add_dropdown(
                "time gate", GATE_MODES, initial_value=session.gate, hint=GATE_HINT
            )
            self._set_on(gate, session, "gate")
            half = session.half_gate
            slider = gui.add_slider(
                "half gate", 1, MAX_HALF_GATE_FRAMES, 1, half, hint=HALF_GATE_HINT
            )
            self._set_on(slider, session, "half_gate")
        if source.capabilities.shears is not None:
            slider = gui.add_slider(
                "refocus", *source.capabilities.shears, 0.1, 0.0, hint=SHEAR_HINT
            )
            self._on(slider, lambda shear: setattr(session, "shear", shear or None))
        if modes.names:
            mode = gui.add_dropdown("show as", modes.names, initial_value=modes.current)
            self._set_on(mode, modes, "current")
            threshold = gui.add_slider(
                "threshold", 0.02, 0.98, 0.01, modes.threshold, hint=THRESHOLD_HINT
            )
            self._set_on(threshold, modes, "threshold")
        for setting in source.settings:
            extent = (setting.low, setting.high, setting.step, setting.value)
            slider = gui.add_slider(setting.name, *extent, hint=setting.hint)
            self._set_on(slider, setting, "value")

    def _add_colours(self, first: DisplayedFrame, resize: Callable[[], None]) -> None:
        session, gui = self._session, self._gui
        colouring = session.colouring

        def look(**changes: Any) -> None:
            session.colouring = replace(session.colouring, **changes)
            automatic.value = session.colouring.limits is None

        def set_limits(limits: Limits | None) -> None:
            look(limits=None if limits is None else (float(limits[0]), float(limits[1])))

        self._scale = gui.add_html(render_scale_html(first.scale))
        quantity = gui.add_dropdown("colour", tuple(QUANTITIES), initial_value="range")
        # Limits of one quantity mean nothing for another, which may have another unit.
        self._on(quantity, lambda name: look(quantity=name, limits=None))
        palette = gui.add_dropdown("palette", PALETTES, initial_value=colouring.palette)
        self._on(palette, lambda name: look(palette=name))
        hint = "in the unit of the scale"
        limits: Any = gui.add_vector2("limits", first.scale.limits, hint=hint)
        self._limits = limits
        self._on(limits, set_limits)
        hint = "limits that suit nearly all points"
        automatic: Any = gui.add_checkbox("automatic", True, hint=hint)
        self._on(automatic, lambda on: set_limits(None if on else limits.value))
        hint = "give every colour to equally many points"
        equalise = gui.add_checkbox("equalise", colouring.equalised, hint=hint)
        self._on(equalise, lambda on: look(equalised=on))
        shade = gui.add_checkbox("shade", colouring.shaded, hint="draw dim points darker")
        self._on(shade, lambda on: look(shaded=on))
        extent = (MIN_POINT_SIZE_MM, MAX_POINT_SIZE_MM, 0.1, _suggest_point_size(first))
        self._size = gui.add_slider("point size", *extent, hint="mm")
        self._on(self._size, lambda _: resize())

    def _add_filters(self, first: DisplayedFrame) -> None:
        session, gui = self._session, self._gui
        cloud = session.source.view(first.frame).cloud  # whole, as without filters
        columns = {"range": cloud.range, "intensity": cloud.intensity}
        columns |= dict(zip("xyz", cloud.xyz.T, strict=True))
        handles: dict[str, tuple[Any, Limits]] = {}

        def set_filters() -> None:
            sides = {
                name: _narrow_limits(handle.value, whole)
                for name, (handle, whole) in handles.items()
            }
            session.filters = Filters(**sides)

        def take_clip_box(box: Box) -> None:
            """Filter by a box that was dragged."""
            for axis, low, high in zip("xyz", box.low, box.high, strict=True):
                handles[axis][0].value = (round(float(low), 4), round(float(high), 4))
            set_filters()

        def show_clip_box(shown: bool) -> None:
            if not shown:
                clip.hide()
                return
            sides = np.array([handles[axis][0].value for axis in "xyz"], float)
            clip.show(Box(sides[:, 0], sides[:, 1]))

        def reset() -> None:
            for handle, whole in handles.values():
                handle.value = whole
            session.filters = Filters()
            show_clip_box(clip.is_shown)

        for name in FILTER_NAMES:
            whole = _round_outwards(columns[name])
            low, high = getattr(session.filters, name)
            handle = gui.add_vector2(
                name,
                (max(low, whole[0]), min(high, whole[1])),
                hint="least and most; in m, intensities in counts",
            )
            handles[name] = handle, whole
            self._on(handle, lambda _: set_filters())
        clip = ClipBox(self._server.scene, lambda box: self._post(lambda: take_clip_box(box)))
        hint = "drag the corners of a box in the scene; same as x, y and z"
        self._on(gui.add_checkbox("clip box", False, hint=hint), show_clip_box)
        gui.add_button("reset filters").on_click(lambda _: self._post(reset))


def mark_times(times: NDArray[np.float64]) -> tuple[tuple[int, str], ...]:
    """Return the frames at round times of flight, with their times in ns, for a time line. `times`
    (frames,): s; rising.
    """
    in_ns = times / NANOSECOND
    places = choose_round_values(in_ns[0], in_ns[-1], MAX_TIME_MARKS)
    frames = np.abs(in_ns - places[:, np.newaxis]).argmin(axis=1)
    return tuple((int(frame), f"{place:g} ns") for frame, place in zip(frames, places, strict=True))


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


class SelectionPanel:
    """Listens to clicks on points; stays in sight below the docked panel `above`."""

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        post: Post,
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
            if pick.waveform is not None:
                self._draw_waveform(_make_plot_data(pick, pick.waveform))
        self._draw_markers(self._session.picks)

    def _draw_markers(self, picks: list[Pick]) -> None:
        scene = self._server.scene

        def remove(name: str) -> None:
            if scene.get_handle_by_name(name) is not None:
                scene.remove_by_name(name)

        for number, colour in enumerate(MARKER_COLOURS):
            name = f"/picks/{number}"
            if number < len(picks):
                position = picks[number].position
                radius = MARKER_RADIUS_FRACTION * max(float(np.linalg.norm(position)), 0.1)
                scene.add_icosphere(
                    name, radius=radius, color=colour, position=position, **NO_SHADOWS
                )
            else:
                remove(name)
        if len(picks) == 2:
            ends = np.array([[picks[0].position, picks[1].position]], np.float32)
            scene.add_line_segments(
                "/picks/between", ends, (255, 255, 255), thickness=2.0, thickness_units="screen"
            )
        else:
            remove("/picks/between")

    def _draw_waveform(self, data: tuple[NDArray[np.float64], ...]) -> None:
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
        look: Any = {"scales": {"x": {"time": False}}, "axes": axes, "legend": {"show": False}}
        with self._container:
            self._plot = self._server.gui.add_uplot(data, series, aspect=1.45, **look)


def _make_plot_data(pick: Pick, waveform: Waveform) -> tuple[NDArray[np.float64], ...]:
    """Ranges in m, the pixel's signal, and that signal where its returns were found, else 0."""
    counts = waveform.counts.astype(np.float64)
    row = float(np.median(np.diff(waveform.times))) if waveform.times.size > 1 else 1.0
    away = np.abs(waveform.times[:, np.newaxis] - np.asarray(pick.return_times)[np.newaxis])
    near = (away <= RETURN_HALF_WIDTH_BINS * row).any(axis=1)
    return SPEED_OF_LIGHT * waveform.times / 2, counts, np.where(near, counts, 0.0)


def _format_html(text: str) -> str:
    lines = "<br>".join(html.escape(text).splitlines())
    return f"<div id='picked' style='padding:0.2em 0.8em 0.6em;font-size:0.85em'>{lines}</div>"


def add_export(
    server: viser.ViserServer,
    session: Session,
    post: Post,
    list_views: Callable[[float], Mapping[str, Viewpoint]],
    drawn_whole: Callable[[], AbstractContextManager[None]],
) -> None:
    """Add screenshot, export, bookmarks and keys. `list_views`: takes a window's width over its
    height, returns where one can look from, by name; the first is where one looks from at first;
    `drawn_whole`: returns what a screenshot is taken within, so that all points of a large cloud
    are on it.
    """
    gui = server.gui
    bookmarked: dict[str, Viewpoint] = {}

    def send_screenshot(client: viser.ClientHandle) -> None:
        camera = client.camera
        # Large windows are scaled down: the browser sends the whole picture back.
        shrink = min(1.0, MAX_SIDE_PX / max(camera.image_height, camera.image_width, 1))
        sides = (round(shrink * side) for side in (camera.image_height, camera.image_width))
        with drawn_whole():
            drawn = client.get_render(*sides, transport_format="png", timeout=RENDER_TIMEOUT_S)
        picture = _encode_png(drawn, session)
        client.send_file_download("tofclip.png", picture, save_immediately=True)

    def send_points(client: viser.ClientHandle) -> None:
        shown = session.latest
        if shown is None:
            return
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "shown.ply"
            shown.cloud.save(path)
            client.send_file_download("tofclip.ply", path.read_bytes(), save_immediately=True)

    def add_bookmark(client: viser.ClientHandle) -> None:
        name = f"view {len(bookmarked) + 1}"
        camera = client.camera
        # Copied, because the page goes on changing the camera's own arrays.
        bookmarked[name] = Viewpoint(camera.position.copy(), camera.look_at.copy(), camera.fov)
        bookmarks.options = (*list_views(1.0), *bookmarked)
        bookmarks.value = name

    def go_to_bookmark(event: Any) -> None:
        if event.client is not None:
            camera = event.client.camera
            presets = list_views(camera.image_width / max(camera.image_height, 1))
            move_camera(camera, {**presets, **bookmarked}[event.target.value])

    def show_keys(client: viser.ClientHandle) -> None:
        with client.gui.add_modal("keys") as modal:
            rows = "\n".join(f"| {key} | {label} |" for key, (label, _) in keys.items())
            client.gui.add_markdown(f"| key | what it does |\n|---|---|\n{rows}")
            client.gui.add_button("close").on_click(lambda _: modal.close())

    def for_client(act: Callable[[viser.ClientHandle], None]) -> Callable[[Any], None]:
        return lambda event: None if event.client is None else act(event.client)

    def posted(act: Callable[[], None]) -> Callable[[Any], None]:
        return lambda _: post(act)

    def toggle_playback() -> None:
        (session.pause if session.clock.playing else session.play)()

    gui.add_button("screenshot").on_click(for_client(send_screenshot))
    export = gui.add_button("export", hint="the points that are shown, as PLY")
    export.on_click(for_client(lambda client: post(lambda: send_points(client))))
    bookmarks: Any = gui.add_dropdown("view from", tuple(list_views(1.0)))
    bookmarks.on_update(go_to_bookmark)
    bookmark = gui.add_button("bookmark", hint="remember where one looks from")
    bookmark.on_click(for_client(add_bookmark))
    gui.add_button("keys", hint="also: K").on_click(for_client(show_keys))
    keys: dict[Any, tuple[str, Callable[[Any], None]]] = {
        "space": ("play or pause", posted(toggle_playback)),
        "arrowleft": ("one frame back", posted(lambda: session.step(-1))),
        "arrowright": ("one frame on", posted(lambda: session.step(1))),
        "pageup": ("ten frames back", posted(lambda: session.step(-10))),
        "pagedown": ("ten frames on", posted(lambda: session.step(10))),
        "home": ("first frame", posted(lambda: session.jump(0))),
        "end": ("last frame", posted(lambda: session.jump(len(session.source)))),
        "L": ("follow a live source", posted(session.follow)),
        "S": ("screenshot", for_client(send_screenshot)),
        "B": ("bookmark this view", for_client(add_bookmark)),
        "K": ("this table", for_client(show_keys)),
    }
    for key, (label, act) in keys.items():
        gui.add_command(label, hotkey=key).on_trigger(act)


def format_box(xyz: NDArray[np.float32]) -> str:
    """Return the lengths of the box around points (n, 3), m, in words; empty without points."""
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
