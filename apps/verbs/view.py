"""`tofclip view`: look at clouds, transients, hidden volumes, raw shots and instruments."""

from __future__ import annotations

import contextlib
import sys
import time
import webbrowser
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from apps.conventions import JsonOption, TimeZeroOption, make_completer, report, require_writable
from apps.progress import show_activity, show_progress
from apps.viewer.desktop import open_window
from apps.viewer.page import Page, WaitingPage
from apps.viewer.render import choose_renderer
from apps.viewer.scene_figure import choose_frames, save_film, save_picture
from apps.viewer.server import is_local, parse_host
from apps.viewer.session import Session
from apps.viewer.source_factory import (
    LOOK_METHODS,
    SURFACES,
    ShotOptions,
    announce_nothing,
    open_source,
)
from tofclip.errors import InputError
from tofclip.units import NANOSECOND, PICOSECOND


def view(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help="Frames, cloud, volume, raw shot, a folder or stack of clouds or shots, or an instrument's address.",
        ),
    ],
    camera: Annotated[
        Path | None,
        typer.Option(
            metavar="H5",
            help="For raw shots; made by calibrate.",
            show_default="the one inside SOURCE",
        ),
    ] = None,
    bin_width_ps: Annotated[
        float | None, typer.Option(metavar="PS", help="For raw shots: duration of a row in ps.")
    ] = None,
    time_zero_ns: TimeZeroOption = None,
    method: Annotated[
        str | None,
        typer.Option(
            "--method",
            metavar="NAME",
            help="For raw shots: tv, l1, linear or adjoint, with few iterations; surfaces for one shot.",
            show_default="l1 for one shot, linear for many",
            autocompletion=make_completer(*LOOK_METHODS, SURFACES),
        ),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option(min=1, max=65535, metavar="N", help="Of the page.", show_default="a free one"),
    ] = None,
    host: Annotated[
        str,
        typer.Option(
            metavar="ADDRESS",
            help="Where the page is served: an IP address of this computer; 0.0.0.0 for all of them.",
        ),
    ] = "127.0.0.1",
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Print the page's address; open nothing.")
    ] = False,
    desktop: Annotated[
        bool, typer.Option("--desktop", help="Open a window instead of a page.")
    ] = False,
    png: Annotated[
        Path | None,
        typer.Option(metavar="PNG", help="Write a picture, without a screen.", show_default="none"),
    ] = None,
    mp4: Annotated[
        Path | None,
        typer.Option(metavar="MP4", help="Write a film, without a screen.", show_default="none"),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Look at a source: on a page of the browser, in a window, as a picture or as a film.

    The page is for this computer, and for whoever has its address with the token. Through ssh:
    ssh -L 8080:localhost:8080 HOST, then tofclip view SOURCE --port 8080 --no-browser there, and
    the address that it prints here. On the page, K shows the keys.

    Example: tofclip view frames.h5 --png scene.png
    """
    _check_outputs(desktop, png, mp4, source, camera)
    started = time.perf_counter()
    known = ShotOptions(
        camera,
        None if bin_width_ps is None else bin_width_ps * PICOSECOND,
        None if time_zero_ns is None else time_zero_ns * NANOSECOND,
        method,
    )
    is_page = not (desktop or png or mp4)
    door = PageDoor(host, port, no_browser, as_json)
    # Closing stops a live source and its threads, however the view ends.
    with contextlib.closing(door), contextlib.ExitStack() as opened:
        with show_activity(f"opening {source}"):
            announce = partial(door.open_waiting, source) if is_page else announce_nothing
            found = opened.enter_context(contextlib.closing(open_source(source, known, announce)))
            session = Session(found)
        if png is not None:
            _draw_picture(session, png, started, as_json)
        elif mp4 is not None:
            _draw_film(session, mp4, started, as_json)
        elif desktop:
            _open_window(session)
        else:
            door.serve(session)


def _check_outputs(
    desktop: bool, png: Path | None, mp4: Path | None, *inputs: str | Path | None
) -> None:
    # Truth values add up: more than one was asked for.
    if desktop + (png is not None) + (mp4 is not None) > 1:
        raise InputError("choose one of --desktop, --png and --mp4")
    for out, suffix in ((png, ".png"), (mp4, ".mp4")):
        if out is not None:
            require_writable(out, suffix, inputs=inputs)


def _draw_picture(session: Session, out: Path, started: float, as_json: bool) -> None:
    shown, renderer = session.frame_at(0.0), choose_renderer()
    save_picture(session.title, shown, renderer, out)
    report(_collect_metrics(len(shown.cloud), renderer.name, started), as_json, [out])


def _draw_film(session: Session, out: Path, started: float, as_json: bool) -> None:
    renderer, pictures = choose_renderer(), len(choose_frames(session))
    with show_progress("filming", pictures) as advance:
        points = save_film(session, renderer, out, advance)
    report(
        _collect_metrics(points, renderer.name, started) | {"pictures": pictures}, as_json, [out]
    )


def _collect_metrics(points: int, backend: str, started: float) -> dict[str, Any]:
    return {"points": points, "backend": backend, "seconds": time.perf_counter() - started}


def _open_window(session: Session) -> None:
    open_window(session)


@dataclass
class PageDoor:
    """Where the page is served, and how a browser comes there: at once where a source takes seconds,
    so that the page is loaded by then.
    """

    host: str  # an IP address of this computer, or ``"localhost"``
    port: int | None = None  # A free one by default
    no_browser: bool = False  # whether the page is not opened here
    as_json: bool = False  # whether its address is reported as JSON
    _waiting: WaitingPage | None = None

    def open_waiting(self, source: str, words: str) -> None:
        """Serve a page that says what is being done.

        `source`: as the user named it; `words`: what is being done.
        """
        title = source if "://" in source else Path(source).name
        self._waiting = WaitingPage(title, words, self.port, parse_host(self.host))
        self._show_address(self._waiting.address)

    def serve(self, session: Session) -> None:
        """Serve a session until Ctrl-C."""
        page = Page(session, self.port, parse_host(self.host), self._waiting)
        was_waiting, self._waiting = self._waiting is not None, None
        with contextlib.closing(page):
            if not was_waiting:
                self._show_address(page.address)
            page.run()

    def close(self) -> None:
        """Stop serving a page that still waits: there will be nothing to look at."""
        if self._waiting is not None:
            self._waiting.close()

    def _show_address(self, address: str) -> None:
        report({"address": address}, self.as_json)
        sys.stdout.flush()  # a program that reads the address waits for it
        if not is_local(parse_host(self.host)):
            print(
                "tofclip: other computers can reach this page, unencrypted: whoever has its address, "
                "with the token, can see and control it",
                file=sys.stderr,
            )
        if not self.no_browser:
            webbrowser.open(address)
