"""What can be taken along from the page: screenshots, the points that are shown, places to look
from; and its keys.
"""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apps.figures.style import DOTS_PER_INCH, make_figure
from apps.viewer.colouring import choose_ticks, format_length, load_palette
from apps.viewer.render import BACKGROUND
from apps.viewer.session import Session
from apps.viewer.viewpoint import Box, Viewpoint, move_camera

if TYPE_CHECKING:
    import viser

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
