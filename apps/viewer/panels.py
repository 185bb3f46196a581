"""The page's panels: playback, ways of showing, how points look and which of them are shown; points
that are picked, with their waveform; what can be taken along, and the keys.

Each control changes the session by way of `post`, which has that done by the thread that owns it.
"""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apps.figures.style import DOTS_PER_INCH, make_figure
from apps.viewer.html import render_histogram_html, render_scale_html, render_text_html
from apps.viewer.look import (
    PALETTES,
    QUANTITIES,
    Colouring,
    Pick,
    Scale,
    choose_round_values,
    choose_ticks,
    format_length,
    list_quantities,
    make_scale,
)
from apps.viewer.points import NO_SHADOWS, ClipBox, Post, SectionPlane, add_lines
from apps.viewer.session import DisplayedFrame, Session, write_state
from apps.viewer.source import NO_LIMITS, OFF_ON, Choice, Limits, Setting
from apps.viewer.still import BACKGROUND, draw_colour_bar
from apps.viewer.viewpoint import (
    Box,
    Viewpoint,
    measure_point_spacing,
    move_camera,
    read_viewpoint,
)
from tofclip.arrays import AnyArray, FloatArray
from tofclip.lidar import PointCloud
from tofclip.lidar.cloud import fit_plane
from tofclip.units import NANOSECOND, SPEED_OF_LIGHT

if TYPE_CHECKING:
    import viser

SPEEDS = {"1/16": 1 / 16, "1/8": 1 / 8, "1/4": 1 / 4, "1/2": 1 / 2} | {
    str(times): float(times) for times in (1, 2, 4, 8, 16)
}
# The outermost steps are longer than any source; the clock stops at the ends.
FRAME_STEPS = {"|<": -(10**9), "-10": -10, "-1": -1, "+1": 1, "+10": 10, ">|": 10**9}
MAX_TIME_MARKS = 4
MIN_POINT_SIZE_MM, MAX_POINT_SIZE_MM = 0.1, 50.0
HISTOGRAM_PERCENTILES = 0.2, 99.8  # strays do not make the rest narrow


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


class Handles:
    """A histogram, two handles below it and two boxes to type into, for the limits of a quantity. `act`
    is called with what a user sets, in the quantity's unit; it is shown in the unit of its legend.
    """

    def __init__(
        self, gui: Any, names: tuple[str, str], post: Post, act: Callable[[Limits], object]
    ) -> None:
        self._bars = gui.add_html("")
        self._slider = gui.add_multi_slider(names[0], 0.0, 1.0, 0.01, (0.0, 1.0))
        hint = "least and most, in the unit of the histogram"
        self._boxes = gui.add_vector2(names[1], (0.0, 1.0), step=0.01, hint=hint)
        self._factor = 1.0
        self._known: tuple[Any, ...] = ()

        def set_limits(value: Any) -> None:
            low, high = (float(side) / self._factor for side in value)
            act((low, high))

        for handle in (self._slider, self._boxes):
            bind_user_input(handle, post, set_limits)

    def show(self, values: AnyArray, limits: Limits, scale: Scale, coloured: bool) -> None:
        """Bring it up to date. `scale`: says the unit; `coloured`: whether the bars have its colours."""
        known = values.size, values[:1].tobytes(), limits, scale.title, coloured and scale.palette
        if known == self._known:
            return
        self._known, self._factor = known, scale.factor
        finite = values[np.isfinite(values)].astype(np.float64)
        ends = np.percentile(finite, HISTOGRAM_PERCENTILES) if finite.size else np.array([0.0, 1.0])
        set_ones = [side for side in limits if np.isfinite(side)]
        low, high = min([ends[0], *set_ones]), max([ends[1], *set_ones])
        step = 10.0 ** np.floor(np.log10(max(high - low, 1e-9) * self._factor / 100))
        digits = max(0, -round(np.log10(step)))
        low = float(np.floor(low * self._factor / step) * step)
        high = max(float(np.ceil(high * self._factor / step) * step), low + step)
        span = low / self._factor, high / self._factor
        self._bars.content = render_histogram_html(
            finite, span, limits, scale if coloured else None
        )
        least, most = (round(end, digits) for end in (low, high))
        value = tuple(
            round(float(np.clip(side * self._factor, least, most)), digits) for side in limits
        )
        self._slider.min, self._slider.max, self._slider.step = least, most, step
        self._slider.precision = self._boxes.precision = digits
        self._slider._marks = None
        for handle in (self._slider, self._boxes):
            if tuple(handle.value) != value:
                handle.value = value


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
        groups: dict[str, Any] = {"": contextlib.nullcontext()}
        for setting in session.source.settings:
            if setting.group not in groups:
                groups[setting.group] = self._gui.add_folder(setting.group)
            with groups[setting.group]:
                self._add_setting(setting)
        with self._gui.add_folder("colours"):
            self._add_colours(first, resize)
        with self._gui.add_folder("filters", expand_by_default=False):
            clip = ClipBox(server.scene, lambda box: post(partial(self._take_clip_box, box)))
            self._add_filters(first, clip)
        with self._gui.add_folder("section and plane", expand_by_default=False):
            self._add_section(SectionPlane(server.scene, lambda: post(self._take_section)))

    @property
    def point_size(self) -> float:
        return float(self._size.value) / 1e3

    def show(self, shown: DisplayedFrame, status: str) -> None:
        """Bring texts and controls up to date with what is shown."""
        session, view = self._session, shown.whole
        name = self._field.value
        values = QUANTITIES[name][1](view)
        limits = session.filters.limits.get(name, NO_LIMITS)
        of_field = make_scale(view, Colouring(name)) if values.size else shown.scale
        self._kept.show(values, limits, of_field, False)
        values = QUANTITIES[shown.scale.quantity][1](view)
        self._limits.show(values, shown.scale.limits, shown.scale, True)
        scale = render_scale_html(shown.scale)
        for text, content in ((self._status, status), (self._scale, scale)):
            if text.content != content:
                text.content = content
        if self._frame is not None:
            last = max(2, len(self._session.source))
            if self._frame.max != last:
                self._frame.max = last
            self._frame.value = shown.frame + 1

    def _on(self, handle: Any, act: Callable[[Any], object]) -> None:
        bind_user_input(handle, self._post, act)

    def _add_setting(self, setting: Setting | Choice) -> None:
        gui: Any = self._gui
        handle: Any

        def set_value(value: Any) -> None:
            setting.value = OFF_ON[value] if isinstance(value, bool) else value
            # what follows may take seconds, in which nothing is shown
            self._status.content = self._status.content.replace(
                f">{self._session.label}<", ">WORKING<"
            )

        if isinstance(setting, Setting):
            extent = (setting.low, setting.high, setting.step, setting.value)
            handle = gui.add_slider(setting.name, *extent, hint=setting.hint)
        elif setting.options == OFF_ON:
            handle = gui.add_checkbox(setting.name, setting.value == "on", hint=setting.hint)
        else:
            words: Any = {"initial_value": setting.value, "hint": setting.hint}
            handle = gui.add_dropdown(setting.name, setting.options, **words)
        self._on(handle, set_value)

    def _add_playback(self) -> None:
        source, clock, gui = self._session.source, self._session.clock, self._gui
        # A slider needs two different ends, even for a single frame.
        last = max(2, len(source))
        marks = None if source.times is None else mark_times(source.times)
        now = min(clock.frame + 1, last)
        self._frame = gui.add_slider(source.frame_name, 1, last, 1, now, marks=marks)
        self._on(self._frame, lambda number: clock.jump(number - 1))
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

        def set_automatic(is_on: bool) -> None:
            look(limits=None if is_on or session.latest is None else session.latest.scale.limits)

        self._scale = gui.add_html(render_scale_html(first.scale))
        names = list_quantities(first.whole, session.source.quantity)
        quantity = gui.add_dropdown("colour", names, initial_value=colouring.quantity)
        # Limits of one quantity mean nothing for another, which may have another unit.
        self._on(quantity, lambda name: look(quantity=name, limits=None))
        palette = gui.add_dropdown("palette", PALETTES, initial_value=colouring.palette)
        self._on(palette, lambda name: look(palette=name))
        self._limits = Handles(
            gui, ("limits", "from, to"), self._post, lambda limits: look(limits=limits)
        )
        hint, is_on = "limits that suit nearly all points", colouring.limits is None
        automatic = gui.add_checkbox("automatic", is_on, hint=hint)
        self._on(automatic, set_automatic)
        hint = "give every colour to equally many points"
        equalise = gui.add_checkbox("equalise", colouring.equalised, hint=hint)
        self._on(equalise, lambda on: look(equalised=on))
        shade = gui.add_checkbox("shade", colouring.shaded, hint="draw dim points darker")
        self._on(shade, lambda on: look(shaded=on))
        side_mm = 5.0 if session.point_size is None else 1e3 * session.point_size
        if session.point_size is None and len(first.cloud) > 1:  # neighbours about touch
            own = first.layers == first.layers[0] if first.layers.size else slice(None)
            side_mm = 1e3 * measure_point_spacing(first.cloud.xyz[own])
        side_mm = round(min(max(side_mm, MIN_POINT_SIZE_MM), MAX_POINT_SIZE_MM), 1)
        extent = (MIN_POINT_SIZE_MM, MAX_POINT_SIZE_MM, 0.1, side_mm)
        self._size = gui.add_slider("point size", *extent, hint="mm")
        session.point_size = side_mm / 1e3

        def set_size(side_mm: float) -> None:
            session.point_size = side_mm / 1e3
            resize(side_mm / 1e3)

        self._on(self._size, set_size)

    def _add_filters(self, first: DisplayedFrame, clip: ClipBox) -> None:
        session, gui = self._session, self._gui

        def show_clip_box(is_shown: bool) -> None:
            if not is_shown:
                clip.hide()
            elif session.latest is not None:
                view = session.latest.whole
                limits = [session.filters.limits.get(axis, NO_LIMITS) for axis in "xyz"]
                low, high = np.array(limits, float).T
                whole = Box(view.cloud.xyz.min(axis=0), view.cloud.xyz.max(axis=0))
                clip.show(Box(np.maximum(low, whole.low), np.minimum(high, whole.high)))

        def reset() -> None:
            session.filters = replace(session.filters, limits={})
            show_clip_box(clip.is_shown)

        def keep(limits: Limits) -> None:
            session.filters = session.filters.limit(self._field.value, limits)

        names = list_quantities(first.whole, session.source.quantity)
        hint = "points are left out by any of these, by all that were set"
        self._field = gui.add_dropdown("quantity", names, initial_value=names[0], hint=hint)
        self._kept = Handles(gui, ("keep", "keep from, to"), self._post, keep)
        hint = "drag the corners of a box in the scene; same as x, y and z"
        self._on(gui.add_checkbox("clip box", False, hint=hint), show_clip_box)
        gui.add_button("reset filters").on_click(lambda _: self._post(reset))

    def _take_clip_box(self, box: Box) -> None:
        for axis, low, high in zip("xyz", box.low.tolist(), box.high.tolist(), strict=True):
            self._session.filters = self._session.filters.limit(axis, (low, high))

    def _add_section(self, plane: SectionPlane) -> None:
        session, gui, self._plane = self._session, self._gui, plane

        def find_cloud() -> PointCloud:
            """Of what the filters leave, also beyond the section."""
            assert session.latest is not None
            view = session.latest.whole
            return view.cloud[replace(session.filters, section=None).select(view)]

        def show_plane(is_shown: bool) -> None:
            cloud, section = find_cloud(), session.filters.section
            plane.hide()
            if is_shown and len(cloud):
                point, normal = np.median(cloud.xyz, axis=0).astype(float), np.eye(3)[2]
                if section is not None:
                    normal = np.array(section.normal)
                    point += (section.offset - normal @ point) * normal
                plane.show(point, normal, Box.around(cloud.xyz).reach / 2)
            self._take_section()

        def fit() -> None:
            cloud = find_cloud()
            found = fit_plane(cloud, self._thickness.value / 2e3)
            away = np.degrees(np.arccos(min(1.0, abs(float(found.normal[2])))))
            x, y, z = found.normal
            words = (
                f"{found.inliers.sum():,} of {len(cloud):,} points, "
                f"residual {format_length(found.rms)} rms\n"
                f"normal {x:.3f}, {y:.3f}, {z:.3f}, {away:.1f}° from z\n"
                f"{abs(found.offset):.4f} m from the origin"
            )
            self._fitted.content = render_text_html("plane", words)
            if plane.is_shown:
                middle = cloud.xyz[found.inliers].mean(axis=0).astype(float)
                plane.show(middle, found.normal, Box.around(cloud.xyz).reach / 2)
                self._take_section()

        section = session.filters.section
        hint = "drag and turn a plane in the scene; only points close to it are shown"
        switch = gui.add_checkbox("section", section is not None, hint=hint)
        self._on(switch, show_plane)
        thick_mm = 20.0 if section is None else 1e3 * section.thickness
        hint = "mm: of the section, and of what counts as on a fitted plane"
        self._thickness = gui.add_slider("thickness", 0.5, 200.0, 0.5, thick_mm, hint=hint)
        self._on(self._thickness, lambda _: self._take_section())
        hint = "through most of the points that are shown; a section goes there"
        gui.add_button("fit plane", hint=hint).on_click(lambda _: self._post(fit))
        self._fitted = gui.add_html(render_text_html("plane", "no plane fitted yet\n \n "))
        if section is not None:
            show_plane(True)

    def _take_section(self) -> None:
        section = self._plane.find_section(self._thickness.value / 1e3)
        self._session.filters = replace(self._session.filters, section=section)


def mark_times(times: FloatArray) -> tuple[tuple[int, str], ...]:
    """Return the frames, from 1, at round times, with these in ns; `times` (frames,) rise, s."""
    in_ns = times / NANOSECOND
    places = choose_round_values(in_ns[0], in_ns[-1], MAX_TIME_MARKS)
    frames = np.abs(in_ns - places[:, np.newaxis]).argmin(axis=1)
    return tuple(
        (int(frame) + 1, f"{place:g} ns") for frame, place in zip(frames, places, strict=True)
    )


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
        {"stroke": "#aab", "label": "range (m), c t / 2", "size": 32, "labelSize": 16, "space": 60},
        {"stroke": "#aab", "label": "counts", "size": 56, "labelSize": 16},
    ),
    "scales": {"x": {"time": False}},
    "legend": {"show": False},
    "aspect": 1.45,
}


def add_selection(
    server: viser.ViserServer, session: Session, post: Post, above: viser.PanelHandle
) -> Callable[[], None]:
    """Listen to clicks on points; return what says which are picked, below the panel `above`."""
    scene, panel = server.scene, server.gui.add_panel()
    with panel.add_tab("picked point"):
        hint = "click a point; a second one gives their distance"
        text = server.gui.add_html(render_text_html("picked", hint))
        container = server.gui.add_folder(None)
    panel.dock_below(above)
    plots: list[Any] = []
    markers: list[Any] = []

    shown = session.picks

    def follow() -> None:
        nonlocal shown
        if shown is session.picks:
            return
        shown, words, distance = session.picks, hint, session.distance
        if shown:
            words = shown[-1].description
            words += "" if distance is None else f"\ndistance {distance:.4f} m"
            draw_waveform(shown[-1])
        text.content = render_text_html("picked", words)
        while markers:
            markers.pop().remove()
        positions = np.array([pick.position for pick in shown])
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
        lambda event: post(lambda: session.pick(event.ray_origin, event.ray_direction))
    )
    return follow


CHOOSE_VIEW = "..."
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

    def send_state(client: viser.ClientHandle) -> None:
        state = write_state(session, read_viewpoint(client.camera)).encode()
        client.send_file_download("tofclip.json", state, save_immediately=True)

    def add_bookmark(client: viser.ClientHandle) -> None:
        name = f"view {len(bookmarked) + 1}"
        bookmarked[name] = read_viewpoint(client.camera)
        bookmarks.options = (CHOOSE_VIEW, *list_views(1.0), *bookmarked)

    def go_to_bookmark(event: Any) -> None:
        if event.client is not None and event.target.value != CHOOSE_VIEW:
            camera = event.client.camera
            presets = list_views(camera.image_width / max(camera.image_height, 1))
            move_camera(camera, {**presets, **bookmarked}[event.target.value])
            bookmarks.value = CHOOSE_VIEW  # where one looks from is each browser's own

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
    bookmarks: Any = gui.add_dropdown("view from", (CHOOSE_VIEW, *list_views(1.0)))
    bookmarks.on_update(go_to_bookmark)
    bookmark = gui.add_button("bookmark", hint="remember where one looks from")
    bookmark.on_click(for_client(add_bookmark))
    hint = "sources, frame, settings, colours, filters and view: tofclip view FILE opens it"
    save = gui.add_button("save state", hint=hint)
    save.on_click(for_client(lambda client: post(lambda: send_state(client))))
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


def _encode_png(drawn: AnyArray, session: Session) -> bytes:
    """Put a picture on a dark ground, as on the page, with the legend of its colours below."""
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
