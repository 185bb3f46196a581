"""`tofclip view`: look at clouds, transients, hidden volumes, raw shots and instruments."""

from __future__ import annotations

import contextlib
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from apps.options import JSON, NO_BROWSER, PICTURE_FORMATS, PORT, TIME_ZERO, arg, flag, opt
from apps.progress import show_activity, show_progress
from apps.report import report, require_writable
from tofclip.errors import InputError
from tofclip.files import PICTURE_SUFFIXES
from tofclip.plugins import METHODS

if TYPE_CHECKING:
    from apps.viewer.page import Served
    from apps.viewer.session import Session


def view(
    source: list[str] = arg(
        "SOURCE...",
        "Frames, cloud, volume, raw shot, a folder or stack of clouds or shots, or an instrument's address; "
        "several are layers of one scene. Or a state that the page has saved.",
        read=True,
    ),
    camera: Path | None = opt(
        "H5", "For raw shots; made by calibrate.", shown="the one inside SOURCE"
    ),
    bin_width: float | None = opt(
        "PS", "For raw shots: duration of a row in ps.", name="--bin-width-ps"
    ),
    time_zero: float | None = TIME_ZERO,
    method: str | None = opt(
        "NAME",
        f"For shots and frames: {', '.join(METHODS.own)}, with few iterations, or one of tofclip plugins; "
        "surfaces for one shot.",
        shown="l1; frames as they were recovered",
        choices=METHODS,
    ),
    port: int | None = PORT,
    host: str = opt(
        "ADDRESS",
        "Where the page is served: an IP address of this computer; 0.0.0.0 for all of them.",
        "127.0.0.1",
    ),
    no_browser: bool = NO_BROWSER,
    desktop: bool = flag("--desktop", "Open a window instead of a page."),
    png: Path | None = opt(
        "PNG", f"Write a picture, without a screen: {PICTURE_FORMATS}.", shown="none"
    ),
    mp4: Path | None = opt("MP4", "Write a film, without a screen.", shown="none"),
    as_json: bool = JSON,
) -> None:
    """Look at a source: on a page of the browser, in a window, as a picture or as a film.

    The page is for this computer, and for anyone who has its address with the token. Through ssh:
    ssh -L 8080:localhost:8080 HOST, then tofclip view SOURCE --port 8080 --no-browser there, and
    the address that it prints here. On the page, K shows the keys.

    Example: tofclip view frames.h5 --png scene.png
    """
    from apps.viewer.session import Session, read_state, restore_state
    from apps.viewer.source import LayeredSource
    from apps.viewer.source_factory import ShotOptions, open_source
    from apps.viewer.still import (
        choose_frames,
        choose_renderer,
        open_window,
        save_film,
        save_picture,
    )

    # Truth values add up: more than one was asked for.
    if desktop + (png is not None) + (mp4 is not None) > 1:
        raise InputError("choose one of --desktop, --png and --mp4")
    for out, suffixes in ((png, PICTURE_SUFFIXES), (mp4, (".mp4",))):
        if out is not None:
            require_writable(out, *suffixes, inputs=(*source, camera))
    known, state = ShotOptions(camera, bin_width, time_zero, method), None
    if len(source) == 1 and source[0].endswith(".json"):
        state_file = Path(source[0])
        state = read_state(state_file)
        source, known = state["sources"], ShotOptions.from_dict(state.get("options", {}))
    started = time.perf_counter()
    is_page = not (desktop or png or mp4)
    door = PageDoor(host, port, no_browser, as_json)
    # Closing stops a live source and its threads, however the view ends.
    with contextlib.closing(door), contextlib.ExitStack() as opened:
        title = ", ".join(one if "://" in one else Path(one).name for one in source)
        with show_activity(f"opening {title}"):
            announce = partial(door.open_waiting, title) if is_page else lambda _: None
            found = [
                opened.enter_context(contextlib.closing(open_source(one, known, announce)))
                for one in source
            ]
            session = Session(found[0] if len(found) == 1 else LayeredSource(found))
            names = [one if "://" in one else str(Path(one).resolve()) for one in source]
            session.opened = {"sources": names, "options": known.to_dict()}
            if state is not None:
                restore_state(session, state, state_file)
        if is_page:
            door.serve(session)
            return
        if desktop:
            open_window(session)
            return
        renderer, points, further = choose_renderer(), 0, {}
        if png is not None:
            points = save_picture(session, renderer, png)
        elif mp4 is not None:
            further = {"pictures": len(choose_frames(session))}
            with show_progress("filming", further["pictures"]) as advance:
                points = save_film(session, renderer, mp4, advance)
        figures = {"points": points, "backend": renderer.name}
        figures |= {"seconds": time.perf_counter() - started, **further}
        report(figures, as_json, [path for path in (png, mp4) if path is not None])


@dataclass
class PageDoor:
    """Where the page is served, and how a browser comes there: at once where a source takes seconds,
    so that the page is loaded by then.
    """

    host: str  # an IP address of this computer, or ``"localhost"``
    port: int | None = None  # A free one by default
    no_browser: bool = False  # whether the page is not opened here
    as_json: bool = False  # whether its address is reported as JSON
    _waiting: Served | None = None

    def open_waiting(self, title: str, words: str) -> None:
        """Serve a page that says what is being done, if there is none yet."""
        from apps.viewer.page import parse_host, say_waiting, serve_waiting

        if self._waiting is not None:
            say_waiting(self._waiting[0], words)
            return
        self._waiting = serve_waiting(title, words, self.port, parse_host(self.host))
        self._show_address(self._waiting[1])

    def serve(self, session: Session) -> None:
        """Serve a session until Ctrl-C."""
        from apps.viewer.page import Page, parse_host

        page = Page(session, self.port, parse_host(self.host), self._waiting)
        was_waiting, self._waiting = self._waiting is not None, None
        with contextlib.closing(page):
            if not was_waiting:
                self._show_address(page.address)
            page.run()

    def close(self) -> None:
        """Stop serving a page that still waits: there will be nothing to look at."""
        if self._waiting is not None:
            from apps.viewer.page import stop_server

            stop_server(self._waiting[0])

    def _show_address(self, address: str) -> None:
        import webbrowser

        from apps.viewer.page import is_local, parse_host

        report({"address": address}, self.as_json)
        sys.stdout.flush()  # a program that reads the address waits for it
        if not is_local(parse_host(self.host)):
            print(
                "tofclip: other computers can reach this page, unencrypted: anyone who has its address, "
                "with the token, can see and control it",
                file=sys.stderr,
            )
        if not self.no_browser:
            webbrowser.open(address)
