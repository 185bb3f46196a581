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
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apps.figures.style import DOTS_PER_INCH, make_figure
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
from apps.viewer.points import NO_SHADOWS, ClipBox, Post, add_lines
from apps.viewer.session import DisplayedFrame, Filters, Session, list_filtered
from apps.viewer.source import NO_LIMITS, Choice, FloatArray, Limits
from apps.viewer.still import BACKGROUND, draw_colour_bar
from apps.viewer.viewpoint import Box, Viewpoint, measure_point_spacing, move_camera
from tofclip.units import NANOSECOND, SPEED_OF_LIGHT

if TYPE_CHECKING:
    import viser

GRADIENT_STOPS, LABEL_MARGIN = 24, 0.04
TEXT_STYLE = "padding:0.2em 0.8em 0.6em;font-size:0.85em"
HTML_STYLE = f"{TEXT_STYLE};line-height:1.5"
LINE_STYLE = (
    "white-space:nowrap;overflow:hidden;text-overflow:ellipsis;font-variant-numeric:tabular-nums"
)
RED, BLUE, AMBER = "#e5484d", "#3e8ed0", "#ffb020"
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


def render_status_html(
    session: Session, shown: DisplayedFrame, frame_rate: float, drawn: int | None = None
) -> str:
    """Return the lines at the top, with ids for scripts. Each is as high whatever it says, so that
    nothing below moves while frames pass. `frame_rate`: frames per second that are sent to the page;
    `drawn`: points that a browser gets that would be slow with all of them.
    """
    source, label, inflow = session.source, session.label, session.source.inflow
    is_live, frames = label == "LIVE", len(session.source)
    what = html.escape(shown.whole_name or source.frame_name)
    if not shown.whole_name and (frames > 1 or is_live):
        what += f" <b id='frame-number'>{shown.frame}</b> of {frames}"
    colour = RED if is_live else BLUE
    lines = [f"<b id='label' style='color:{colour}'>{label}</b> <span id='what'>{what}</span>"]
    if np.isfinite(shown.time):
        instant = f"{shown.time / NANOSECOND:.2f} ns, range {SPEED_OF_LIGHT * shown.time / 2:.3f} m"
        lines.append(f"<span id='instant'>{instant}</span>")
    if shown.text:
        lines.append(f"<span id='depth'>{html.escape(shown.text)}</span>")
    part = f" ({drawn} drawn)" if drawn is not None and drawn < shown.points else ""
    lines.append(f"<span id='points'>{shown.points}</span> points{part}")
    if frames > 1 or is_live:
        coming = f"data {inflow.data_rate:.1f}/s, " if inflow.data_rate > 0 else ""
        rate = f"shown {frame_rate:.1f}/s" if frame_rate > 0 else "standing still"
        lines.append(f"<span id='rates'>{coming}{rate}</span>")
    is_known = np.isfinite(inflow.latency)
    if is_live or is_known:
        delay = f"{1e3 * inflow.latency:.0f} ms" if is_known else "not known yet"
        lines.append(f"shot to cloud {delay}, {inflow.lost} dropped")
    parts = [f"<div style='{LINE_STYLE}'>{line}</div>" for line in lines]
    amber = f"<div class='note' style='color:{AMBER}'>"
    parts += [f"{amber}{html.escape(note)}</div>" for note in session.notes]
    if inflow.failure_text:
        parts.append(f"<div style='color:{RED}'>{html.escape(inflow.failure_text)}</div>")
    return f"<div style='{HTML_STYLE}'>{''.join(parts)}</div>"


def render_scale_html(scale: Scale) -> str:
    """Return the colours in a row, with the values of some of them below."""
    stops = np.linspace(0, PALETTE_SIZE - 1, GRADIENT_STOPS).round().astype(int)
    colours = ",".join(
        f"rgb({r},{g},{b})" for r, g, b in load_palette(scale.palette)[stops].tolist()
    )
    places, title = choose_ticks(scale)
    ticks = ""
    for place, label in places:
        # at the ends a label stays inside
        shift = 0 if place < LABEL_MARGIN else 100 if place > 1 - LABEL_MARGIN else 50
        style = f"position:absolute;left:{100 * place:.1f}%;transform:translateX(-{shift}%)"
        ticks += f"<span style='{style}'>{label}</span>"
    return (
        f"<div id='scale' style='{HTML_STYLE}'>{title}"
        f"<div style='height:0.9em;background:linear-gradient(to right,{colours})'></div>"
        f"<div style='position:relative;height:1.5em'>{ticks}</div></div>"
    )


def render_page_html(title: str) -> str:
    """Return what is said at the foot of the controls, and what names the browser's tab."""
    name = html.escape(format_page_title(title), quote=True)
    # a picture's event is the one script that runs in a text put into a page
    tab = f'<img hidden src="{BLANK_PIXEL}" data-name="{name}" onload="document.title=this.dataset.name">'
    return (
        f"<style>{LOST_STYLE}</style>{tab}<div class='tofclip-lost'>{LOST_TEXT}</div>"
        f"<div id='shared' style='{HTML_STYLE};opacity:0.7'>{SHARED_TEXT}</div>"
    )


def render_text_html(name: str, text: str) -> str:
    """Return a text of some lines, with an id for scripts."""
    lines = "<br>".join(html.escape(text).splitlines())
    return f"<div id='{name}' style='{TEXT_STYLE}'>{lines}</div>"


def format_page_title(title: str) -> str:
    """Return what stands above the controls."""
    return f"tofclip · {title}"[:60]


SPEEDS = {"1/16": 1 / 16, "1/8": 1 / 8, "1/4": 1 / 4, "1/2": 1 / 2} | {
    str(times): float(times) for times in (1, 2, 4, 8, 16)
}
# The outermost steps are longer than any source; the clock stops at the ends.
FRAME_STEPS = {"|<": -(10**9), "-10": -10, "-1": -1, "+1": 1, "+10": 10, ">|": 10**9}
MAX_TIME_MARKS = 4
MIN_POINT_SIZE_MM, MAX_POINT_SIZE_MM = 0.1, 50.0
FILTER_NAMES = ("range", "intensity", "x", "y", "z")


def bind_user_input(handle: Any, post: Post, act: Callable[[Any], object]) -> None:
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
    """Playback, ways of showing, colours and filters. `first`: its extent is that of the filters until
    they are narrowed; `resize`: gives points another size, m.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        post: Post,
        first: DisplayedFrame,
        resize: Callable[[float], None],
    ) -> None:
        self._session, self._post = session, post
        self._gui: Any = server.gui
        self._status = self._gui.add_html("")
        self._frame: Any = None
        if session.source.inflow.is_live or len(session.source) > 1:
            self._add_playback()
        handle: Any
        for setting in session.source.settings:
            if isinstance(setting, Choice):
                words: Any = {"initial_value": setting.value, "hint": setting.hint}
                handle = self._gui.add_dropdown(setting.name, setting.options, **words)
            else:
                extent = (setting.low, setting.high, setting.step, setting.value)
                handle = self._gui.add_slider(setting.name, *extent, hint=setting.hint)
            self._on(handle, partial(setattr, setting, "value"))
        with self._gui.add_folder("colours"):
            self._add_colours(first, resize)
        with self._gui.add_folder("filters", expand_by_default=False):
            self._add_filters(first, ClipBox(server.scene, self._take_clip_box))

    @property
    def point_size(self) -> float:
        """Side of a point, m."""
        return float(self._size.value) / 1e3

    def show(self, shown: DisplayedFrame, status: str) -> None:
        """Bring texts and controls up to date with what is shown."""
        for text, content in (
            (self._status, status),
            (self._scale, render_scale_html(shown.scale)),
        ):
            if text.content != content:
                text.content = content
        if self._frame is not None:
            last = max(1, len(self._session.source) - 1)
            if self._frame.max != last:
                self._frame.max = last
            self._frame.value = shown.frame
        # Limits that the user has set are not overwritten.
        if self._session.colouring.limits is None:
            low, high = shown.scale.limits
            self._limits.value = (round(low, 4), round(high, 4))

    def _on(self, handle: Any, act: Callable[[Any], object]) -> None:
        bind_user_input(handle, self._post, act)

    def _add_playback(self) -> None:
        source, clock, gui = self._session.source, self._session.clock, self._gui
        # A slider needs two different ends, even for a single frame.
        last = max(1, len(source) - 1)
        marks = None if source.times is None else mark_times(source.times)
        now = min(clock.frame, last)
        self._frame = gui.add_slider(source.frame_name, 0, last, 1, now, marks=marks)
        self._on(self._frame, clock.jump)
        words = {"play": clock.play, "pause": clock.pause}
        if source.inflow.is_live:
            words["live"] = clock.follow
        self._on(gui.add_button_group("playback", tuple(words)), lambda word: words[word]())
        steps = gui.add_button_group("step", tuple(FRAME_STEPS))
        self._on(steps, lambda word: clock.step(FRAME_STEPS[word]))
        speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1")
        self._on(speed, lambda word: setattr(clock, "speed", SPEEDS[word]))
        self._on(gui.add_checkbox("loop", clock.loop), partial(setattr, clock, "loop"))

    def _add_colours(self, first: DisplayedFrame, resize: Callable[[float], None]) -> None:
        session, gui = self._session, self._gui
        colouring = session.colouring

        def look(**changes: Any) -> None:
            session.colouring = replace(session.colouring, **changes)
            automatic.value = session.colouring.limits is None

        def set_limits(limits: Limits | None) -> None:
            look(limits=None if limits is None else (float(limits[0]), float(limits[1])))

        def add_checkbox(name: str, is_on: bool, hint: str, act: Callable[[bool], object]) -> Any:
            box = gui.add_checkbox(name, is_on, hint=hint)
            self._on(box, act)
            return box

        self._scale = gui.add_html(render_scale_html(first.scale))
        quantity = gui.add_dropdown("colour", tuple(QUANTITIES), initial_value="range")
        # Limits of one quantity mean nothing for another, which may have another unit.
        self._on(quantity, lambda name: look(quantity=name, limits=None))
        palette = gui.add_dropdown("palette", PALETTES, initial_value=colouring.palette)
        self._on(palette, lambda name: look(palette=name))
        limits = gui.add_vector2("limits", first.scale.limits, hint="in the unit of the scale")
        self._limits: Any = limits
        self._on(limits, set_limits)
        automatic = add_checkbox(
            "automatic",
            True,
            "limits that suit nearly all points",
            lambda on: set_limits(None if on else limits.value),
        )
        hint = "give every colour to equally many points"
        add_checkbox("equalise", colouring.equalised, hint, lambda on: look(equalised=on))
        hint = "draw dim points darker"
        add_checkbox("shade", colouring.shaded, hint, lambda on: look(shaded=on))
        side_mm = 5.0
        if len(first.cloud) > 1:  # neighbours about touch
            side_mm = 1e3 * measure_point_spacing(first.cloud.xyz)
        side_mm = round(min(max(side_mm, MIN_POINT_SIZE_MM), MAX_POINT_SIZE_MM), 1)
        extent = (MIN_POINT_SIZE_MM, MAX_POINT_SIZE_MM, 0.1, side_mm)
        self._size = gui.add_slider("point size", *extent, hint="mm")
        self._on(self._size, lambda _: resize(self.point_size))

    def _add_filters(self, first: DisplayedFrame, clip: ClipBox) -> None:
        session, gui = self._session, self._gui
        columns = list_filtered(session.source.view(first.frame).cloud)  # whole, as without filters
        self._filters: dict[str, tuple[Any, Limits]] = {}

        def show_clip_box(is_shown: bool) -> None:
            if not is_shown:
                clip.hide()
                return
            sides = np.array([self._filters[axis][0].value for axis in "xyz"], float)
            clip.show(Box(sides[:, 0], sides[:, 1]))

        def reset() -> None:
            for handle, whole in self._filters.values():
                handle.value = whole
            session.filters = Filters()
            show_clip_box(clip.is_shown)

        hint = "least and most; in m, intensities in counts"
        for name in FILTER_NAMES:
            values, whole = columns[name], (0.0, 1.0)
            if len(values):  # rounded outwards
                whole = (
                    float(np.floor(values.min() * 100) / 100),
                    float(np.ceil(values.max() * 100) / 100),
                )
            low, high = getattr(session.filters, name)
            handle = gui.add_vector2(name, (max(low, whole[0]), min(high, whole[1])), hint=hint)
            self._filters[name] = handle, whole
            self._on(handle, lambda _: self._set_filters())
        hint = "drag the corners of a box in the scene; same as x, y and z"
        self._on(gui.add_checkbox("clip box", False, hint=hint), show_clip_box)
        gui.add_button("reset filters").on_click(lambda _: self._post(reset))

    def _set_filters(self) -> None:
        sides = {}
        for name, (handle, whole) in self._filters.items():
            # A side that was not moved does not limit later frames.
            low = handle.value[0] if handle.value[0] > whole[0] else NO_LIMITS[0]
            high = handle.value[1] if handle.value[1] < whole[1] else NO_LIMITS[1]
            sides[name] = low, high
        self._session.filters = Filters(**sides)

    def _take_clip_box(self, box: Box) -> None:
        """Filter by a box that was dragged."""

        def take() -> None:
            for axis, low, high in zip("xyz", box.low, box.high, strict=True):
                self._filters[axis][0].value = (round(float(low), 4), round(float(high), 4))
            self._set_filters()

        self._post(take)


def mark_times(times: FloatArray) -> tuple[tuple[int, str], ...]:
    """Return the frames at round times of flight, with their times in ns, for a time line. `times`
    (frames,): s; rising.
    """
    in_ns = times / NANOSECOND
    places = choose_round_values(in_ns[0], in_ns[-1], MAX_TIME_MARKS)
    frames = np.abs(in_ns - places[:, np.newaxis]).argmin(axis=1)
    return tuple((int(frame), f"{place:g} ns") for frame, place in zip(frames, places, strict=True))


MARKER_COLOURS = ((255, 80, 80), (80, 220, 255))
MARKER_RADIUS_FRACTION = 0.006  # of the distance
# on either side of a detected return that are filled in its pixel's waveform
RETURN_HALF_WIDTH_BINS = 3.0
PLOT_LOOK: Any = {
    "series": (
        {"label": "range (m)"},
        {"label": "counts", "stroke": "#3dd6c8", "width": 1},
        {"label": "return", "stroke": "#ff5050", "fill": "#ff505066", "width": 1.5},
    ),
    "axes": (
        {"stroke": "#aab", "label": "range (m), c t / 2", "size": 30, "labelSize": 18},
        {"stroke": "#aab", "label": "counts", "size": 40, "labelSize": 18},
    ),
    "scales": {"x": {"time": False}},
    "legend": {"show": False},
    "aspect": 1.45,
}


def add_selection(
    server: viser.ViserServer, session: Session, post: Post, above: viser.PanelHandle
) -> None:
    """Listen to clicks on points, and say what they hit in a panel that stays in sight below the
    docked panel `above`.
    """
    scene, panel = server.scene, server.gui.add_panel()
    with panel.add_tab("picked point"):
        hint = "click a point; a second one gives their distance"
        text = server.gui.add_html(render_text_html("picked", hint))
        container = server.gui.add_folder(None)
    panel.dock_below(above)
    plots: list[Any] = []
    markers: list[Any] = []

    def take_click(origin: Any, direction: Any) -> None:
        pick = session.pick(origin, direction)
        words = "nothing there; click a point"
        if pick is not None:
            distance = session.distance
            words = pick.description + ("" if distance is None else f"\ndistance {distance:.4f} m")
            draw_waveform(pick)
        text.content = render_text_html("picked", words)
        draw_markers()

    def draw_markers() -> None:
        while markers:
            markers.pop().remove()
        positions = np.array([pick.position for pick in session.picks])
        for number, position in enumerate(positions):
            radius = MARKER_RADIUS_FRACTION * max(float(np.linalg.norm(position)), 0.1)
            look: Any = {"color": MARKER_COLOURS[number], "position": position, **NO_SHADOWS}
            markers.append(scene.add_icosphere(f"/picks/{number}", radius=radius, **look))
        if len(positions) == 2:
            white = (255, 255, 255)
            markers.append(add_lines(scene, "/picks/between", positions[np.newaxis], white, 2.0))

    def draw_waveform(pick: Pick) -> None:
        if pick.waveform is None:
            return
        times, counts = pick.waveform
        bin_width = float(np.median(np.diff(times))) if times.size > 1 else 1.0
        away = np.abs(times[:, np.newaxis] - np.asarray(pick.return_times))
        near = (away <= RETURN_HALF_WIDTH_BINS * bin_width).any(axis=1)
        data = (SPEED_OF_LIGHT * times / 2, counts, np.where(near, counts, 0.0))
        if plots:
            plots[0].data = data
            return
        with container:
            plots.append(server.gui.add_uplot(data, **PLOT_LOOK))

    server.scene.on_click()(
        lambda event: post(lambda: take_click(event.ray_origin, event.ray_direction))
    )


RENDER_TIMEOUT_S = 60.0  # a software renderer takes ten for millions of points
MAX_SIDE_PX = 1600
LEGEND_PX = 70  # below the picture


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
    gui, clock = server.gui, session.clock
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
        if session.latest is None:
            return
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "shown.ply"
            session.latest.cloud.save(path)
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

    gui.add_button("screenshot").on_click(for_client(send_screenshot))
    export = gui.add_button("export", hint="the points that are shown, as PLY")
    export.on_click(for_client(lambda client: post(lambda: send_points(client))))
    bookmarks: Any = gui.add_dropdown("view from", tuple(list_views(1.0)))
    bookmarks.on_update(go_to_bookmark)
    bookmark = gui.add_button("bookmark", hint="remember where one looks from")
    bookmark.on_click(for_client(add_bookmark))
    gui.add_button("keys", hint="also: K").on_click(for_client(show_keys))
    toggle = posted(lambda: (clock.pause if clock.playing else clock.play)())
    keys: dict[Any, tuple[str, Callable[[Any], None]]] = {
        "space": ("play or pause", toggle),
        "arrowleft": ("one frame back", posted(lambda: clock.step(-1))),
        "arrowright": ("one frame on", posted(lambda: clock.step(1))),
        "pageup": ("ten frames back", posted(lambda: clock.step(-10))),
        "pagedown": ("ten frames on", posted(lambda: clock.step(10))),
        "home": ("first frame", posted(lambda: clock.jump(0))),
        "end": ("last frame", posted(lambda: clock.jump(len(session.source)))),
        "L": ("follow a live source", posted(clock.follow)),
        "S": ("screenshot", for_client(send_screenshot)),
        "B": ("bookmark this view", for_client(add_bookmark)),
        "K": ("this table", for_client(show_keys)),
    }
    for key, (label, act) in keys.items():
        gui.add_command(label, hotkey=key).on_trigger(act)


def _encode_png(drawn: NDArray[Any], session: Session) -> bytes:
    """Put a picture with a transparent ground on a dark one, as on the page, with the legend of its
    colours below.
    """
    opacity = drawn[..., 3:] / 255.0 if drawn.shape[-1] == 4 else 1.0
    flat = drawn[..., :3] * opacity + np.array(BACKGROUND) * (1 - opacity)
    rows, columns = flat.shape[:2]
    figure = make_figure(columns / DOTS_PER_INCH, (rows + LEGEND_PX) / DOTS_PER_INCH)
    figure.set_layout_engine("none")
    figure.figimage(np.rint(flat).astype(np.uint8), yo=LEGEND_PX, origin="upper")
    shown = session.latest
    if shown is not None:
        axes = figure.add_axes((0.2, 0.6 * LEGEND_PX / (rows + LEGEND_PX), 0.6, 0.012))
        bar = draw_colour_bar(figure, shown.scale, 6, cax=axes, orientation="horizontal")
        title, size = choose_ticks(shown.scale)[1], ""
        if len(shown.cloud):
            box = Box.around(shown.cloud.xyz)
            size = "box " + " x ".join(map(format_length, (box.high - box.low).tolist()))
        bar.set_label(f"{session.title}: {title}; {size}", fontsize=9)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=DOTS_PER_INCH)
    return file.getvalue()
