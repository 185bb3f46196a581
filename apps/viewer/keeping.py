"""What can be taken along from the page: screenshots, the points that are shown, places to look from; and its keys."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apps.viewer.raster import BACKGROUND
from apps.viewer.server import run_in_page
from apps.viewer.session import Session
from apps.viewer.viewpoint import Viewpoint

if TYPE_CHECKING:
    import viser

Post = Callable[[Callable[[], None]], None]
LONGEST_RENDER = 20.0  # s
LARGEST_SIDE_PX = 1600

ON_QUESTION_MARK = """
if (!window.tofclipKeys) {
  window.tofclipKeys = true;
  document.addEventListener("keydown", (event) => {
    if (event.key !== "?" || ["INPUT", "TEXTAREA"].includes(document.activeElement.tagName)) return;
    for (const button of document.querySelectorAll("button"))
      if (button.textContent.trim() === "keys") button.click();
  });
}
"""


class Keeping:
    """Screenshot, export, bookmarks and keys.

    Parameters
    ----------
    server : ViserServer
    session : Session
    post : callable
    viewpoint : Viewpoint
        Where one looks from at first.
    """

    def __init__(self, server: viser.ViserServer, session: Session, post: Post, viewpoint: Viewpoint) -> None:
        self._server, self._session, self._post = server, session, post
        self._places: dict[str, tuple[Any, Any]] = {"start": (viewpoint.eye, viewpoint.target)}
        gui = server.gui
        gui.add_button("screenshot").on_click(lambda event: self._screenshot(event.client))
        gui.add_button("export", hint="the points that are shown, as PLY").on_click(
            lambda event: self._post(lambda: self._export(event.client))
        )
        self._bookmarks: Any = gui.add_dropdown("view from", ("start",))
        self._bookmarks.on_update(self._look_from)
        gui.add_button("bookmark", hint="remember where one looks from").on_click(
            lambda event: self._bookmark(event.client)
        )
        gui.add_button("keys", hint="also: ?").on_click(lambda event: self._explain(event.client))
        self._keys = self._add_keys()
        run_in_page(server, ON_QUESTION_MARK)

    def _screenshot(self, client: viser.ClientHandle | None) -> None:
        if client is None:
            return
        shrink = min(1.0, LARGEST_SIDE_PX / max(client.camera.image_height, client.camera.image_width, 1))
        height, width = (round(shrink * side) for side in (client.camera.image_height, client.camera.image_width))
        drawn = client.get_render(height, width, transport_format="png", timeout=LONGEST_RENDER)
        client.send_file_download("tofclip.png", _png(drawn), save_immediately=True)

    def _export(self, client: viser.ClientHandle | None) -> None:
        shown = self._session.latest
        if client is None or shown is None:
            return
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "shown.ply"
            shown.cloud.save(path)
            client.send_file_download("tofclip.ply", path.read_bytes(), save_immediately=True)

    def _bookmark(self, client: viser.ClientHandle | None) -> None:
        if client is None:
            return
        name = f"view {len(self._places)}"
        self._places[name] = client.camera.position.copy(), client.camera.look_at.copy()
        self._bookmarks.options = tuple(self._places)
        self._bookmarks.value = name

    def _look_from(self, event: Any) -> None:
        if event.client is not None:
            event.client.camera.position, event.client.camera.look_at = self._places[event.target.value]

    def _explain(self, client: viser.ClientHandle | None) -> None:
        if client is None:
            return
        with client.gui.add_modal("keys") as modal:
            rows = "\n".join(f"| {key} | {label} |" for key, label in self._keys)
            client.gui.add_markdown(f"| key | what it does |\n|---|---|\n{rows}\n| ? | this table |")
            client.gui.add_button("close").on_click(lambda _: modal.close())

    def _add_keys(self) -> list[tuple[str, str]]:
        """Give keys to what is done most."""
        session = self._session
        own = (
            ("space", "play or pause", self._toggle),
            ("arrowleft", "one frame back", lambda: session.step(-1)),
            ("arrowright", "one frame on", lambda: session.step(1)),
            ("pageup", "ten frames back", lambda: session.step(-10)),
            ("pagedown", "ten frames on", lambda: session.step(10)),
            ("home", "first frame", lambda: session.jump(0)),
            ("end", "last frame", lambda: session.jump(len(session.source))),
            ("L", "follow a live source", session.follow),
        )
        for key, label, act in own:
            self._add_key(key, label, self._posting(act))
        self._add_key("S", "screenshot", lambda event: self._screenshot(event.client))
        self._add_key("B", "bookmark this view", lambda event: self._bookmark(event.client))
        return [(key, label) for key, label, _ in own] + [("S", "screenshot"), ("B", "bookmark this view")]

    def _posting(self, act: Callable[[], None]) -> Callable[[Any], None]:
        return lambda _: self._post(act)

    def _add_key(self, key: Any, label: str, act: Callable[[Any], None]) -> None:
        self._server.gui.add_command(label, hotkey=key).on_trigger(act)

    def _toggle(self) -> None:
        if self._session.clock.playing:
            self._session.pause()
        else:
            self._session.play()


def _png(drawn: Any) -> bytes:
    """Put a picture with a transparent ground on a dark one, as on the page."""
    from matplotlib.image import imsave

    share = drawn[..., 3:] / 255.0 if drawn.shape[-1] == 4 else 1.0
    flat = drawn[..., :3] * share + np.array(BACKGROUND) * (1 - share)
    file = io.BytesIO()
    imsave(file, np.rint(flat).astype(np.uint8), format="png")
    return file.getvalue()
