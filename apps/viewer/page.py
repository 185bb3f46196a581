"""The page: what is shown, kept up to date in every browser that looks at it; and its server, for anyone
who has its address with the token, and none of the browser's other pages.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import http.client
import io
import ipaddress
import queue
import secrets
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

from apps.report import report
from apps.viewer.html import (
    format_page_title,
    render_page_html,
    render_status_html,
    render_text_html,
)
from apps.viewer.look import render_pictures
from apps.viewer.panels import Controls, add_export, add_selection
from apps.viewer.points import POINT_STYLE, FramePacer, Points, draw_furniture
from apps.viewer.session import DisplayedFrame, Session
from apps.viewer.viewpoint import (
    Box,
    Viewpoint,
    make_presets,
    move_camera,
    place_viewpoint,
    read_viewpoint,
)
from tofclip.errors import InputError, MissingDependencyError, TofclipError

if TYPE_CHECKING:
    import viser
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

LOOPBACK, FIRST_PORT = "127.0.0.1", 8080
ANYWHERE = {"0.0.0.0": LOOPBACK, "::": "::1"}  # all addresses of this computer, and its nearest
REFUSAL = "Open the address that tofclip printed, with its token.\n"
# They keep the token of the address to this page, and the page out of another's frame.
ANSWER_HEADERS = {
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "frame-ancestors 'none'",
}


def start_server(port: int | None = None, host: str = LOOPBACK) -> tuple[viser.ViserServer, str]:
    """Start a server that lets in anyone who knows the token in its address, which is returned too.

    `port`: by default the first free one from 8080 on; `host`: an IP address of this computer;
    0.0.0.0 or :: for all of them.
    """
    try:
        import viser
    except ImportError as fault:
        raise MissingDependencyError(
            f"the page needs viser: pip install viser ({fault})"
        ) from fault

    class LocalServer(viser.ViserServer):
        """A server that stays local, even if a page asks it to open a tunnel to the internet."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            """Open no tunnel."""
            return None

    # A port that is taken is refused: viser would silently take the next one.
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port or 0))
        except (OSError, OverflowError) as fault:
            raise InputError(f"cannot listen at {host}, port {port or 0}: {fault}") from fault
    # viser greets on standard output, which belongs to --json.
    with contextlib.redirect_stdout(io.StringIO()):
        server = LocalServer(host=host, port=FIRST_PORT if port is None else port, verbose=False)
    token, everywhere = install_guard(server.get_port(), is_local(host)), host in ANYWHERE
    # Another version of a library may not ask the guard: the page is asked for without the token.
    nearest = ANYWHERE.get(host, host)
    stranger = http.client.HTTPConnection(nearest, server.get_port(), timeout=10)
    with contextlib.closing(stranger):
        stranger.request("GET", "/")
        is_guarded = stranger.getresponse().status == HTTPStatus.FORBIDDEN
    if token is None or not is_guarded:
        stop_server(server)
        raise MissingDependencyError(
            f"viser {viser.__version__} would show the page to everybody: pip install viser==1.1.1"
        )
    named = socket.gethostname() if everywhere else host
    name = f"[{named}]" if ":" in named else named
    return server, f"http://{name}:{server.get_port()}/?token={token}"


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server and its threads."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def parse_host(host: str) -> str:
    """Return the IP address to listen at for what ``--host`` was given."""
    if host == "localhost":
        return LOOPBACK
    try:
        return str(ipaddress.ip_address(host))
    except ValueError as fault:
        raise InputError(
            f"--host takes an IP address of this computer, 0.0.0.0 for all of them, not '{host}'"
        ) from fault


def is_local(host: str) -> bool:
    """Say whether only this computer reaches what listens at an IP address."""
    return ipaddress.ip_address(host).is_loopback


class Guard:
    """Sees every request first, that for a WebSocket as well, and refuses it or passes it on.

    Browsers send the cookie to every port of this computer and with what any page there asks for:
    hence Origin has to be the page's own. The name in Host has to be this computer's, for anybody's
    DNS can point another one here.

    `serve`: answers what is passed on; websockets' ``process_request``; `is_local`: whether only
    this computer reaches the server.
    """

    def __init__(self, serve: Any, is_local: bool) -> None:
        self.token = secrets.token_urlsafe()
        self._serve, self._is_local = serve, is_local

    def __call__(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer a request, or return None for a WebSocket that may be opened."""
        cookie = self._admit(request)
        if cookie is None:
            return connection.respond(HTTPStatus.FORBIDDEN, REFUSAL)
        answer: Response | None = self._serve(connection, request)
        if answer is not None:
            answer.headers["Set-Cookie"] = (
                f"{cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"
            )
            answer.headers.update(ANSWER_HEADERS)
        return answer

    def _admit(self, request: Request) -> str | None:
        """Return the name of the cookie, or None where the request is refused."""
        try:
            (host,) = request.headers.get_all("Host")
            place = urlsplit(f"http://{host}")
            # The port that the browser sees: through ssh it may be another one.
            cookie = f"tofclip-{place.port or 80}"
            tokens = parse_qs(urlsplit(request.path).query).get("token", [])
        except ValueError:
            return None
        # SimpleCookie would drop all of them for one of another server's that it cannot read.
        for header in request.headers.get_all("Cookie"):
            pairs = (pair.strip().partition("=") for pair in header.split(";"))
            tokens += [value for name, _, value in pairs if name == cookie]
        own = self.token.encode()
        is_admitted = (
            self._is_own_name(place.hostname or "")
            and all(origin == f"http://{host}" for origin in request.headers.get_all("Origin"))
            and any(secrets.compare_digest(t.encode(errors="replace"), own) for t in tokens)
        )
        return cookie if is_admitted else None

    def _is_own_name(self, name: str) -> bool:
        try:
            return ipaddress.ip_address(name).is_loopback or not self._is_local
        except ValueError:
            is_own = not self._is_local and name == socket.gethostname().lower()
            return name == "localhost" or is_own


def install_guard(port: int, is_local: bool) -> str | None:
    """Guard the server of websockets that listens at a port of this process, which only this computer
    reaches where it `is_local`. Return the token; None where there is no such server.

    viser has no parameter for ``process_request`` and keeps its server of websockets to itself.
    Behind a proxy its own port would stay open to every page, hence that server is looked for.
    """
    from websockets.asyncio.server import Server

    for server in gc.get_objects():
        if (
            type(server) is Server
            and not isinstance(server.process_request, Guard)
            and port in [listener.getsockname()[1] for listener in server.sockets]
        ):
            break
    else:
        return None
    guard = Guard(server.process_request, is_local)

    async def begin() -> None:
        server.process_request = guard
        for early in list(server.handlers):
            early.transport.abort()

    asyncio.run_coroutine_threadsafe(begin(), server.get_loop()).result()
    return guard.token


TICK_S = 1 / 60  # between two looks at the clock
# words, controls and flat pictures need not follow every frame: they cost the browser more than the
# points do
STATUS_PERIOD_S, PICTURES_PERIOD_S = 0.25, 0.5
# width over height of the scene between two panels, on a usual screen: until a browser says its own
SCENE_ASPECT = 0.9
PANEL_PX, PICTURES_PANEL_PX = 352, 240
MANY_POINTS = 10**9  # more than any cloud has
AMBIENT_INTENSITY = 2.0  # light from everywhere, so that no side of a surface is black


Served = tuple["viser.ViserServer", str]  # a server and its address


class Page:
    """Serves a session. One thread, in `run`, owns the session; whatever the browsers ask for waits
    in a queue. `host`: an IP address of this computer; `waiting`: a server and its
    address, instead of port and host.
    """

    def __init__(
        self,
        session: Session,
        port: int | None = None,
        host: str = LOOPBACK,
        waiting: Served | None = None,
    ) -> None:
        self.session = session
        self._commands: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        self._stopping, self._woken = threading.Event(), threading.Event()
        first = session.frame_at(time.monotonic())
        self.viewpoint = session.viewpoint or place_viewpoint(first.cloud.xyz, SCENE_ASPECT)
        server, self.address = waiting or start_server(port, host)
        server.gui.reset()
        self.server, title = server, session.source.title
        self._pace, self.points = FramePacer(), Points(server, self.post)
        _set_up_panel(server, title)
        self._set_up_scene()
        left = server.gui.add_panel()
        self._pictures_tab = left.add_tab("pictures")
        left.dock_left()
        left.set_width(PICTURES_PANEL_PX)
        self.controls = Controls(server, session, self.post, first, self.points.resize)
        self._show_bar: Callable[[Any], None] = lambda _: None
        if len(first.cloud):
            self._show_bar = draw_furniture(server, Box.around(first.cloud.xyz))
        self._show_picks = add_selection(server, session, self.post, left)
        self._framed_cloud = first.cloud.xyz
        list_views = partial(make_presets, first.cloud.xyz)
        add_export(server, session, self.post, list_views, self.points.drawn_whole)
        server.gui.add_html(render_page_html(title))
        self._pictures: dict[str, Any] = {}
        self._drawn: DisplayedFrame | None = None
        self._pictured: DisplayedFrame | None = None
        self._status_at = self._pictures_at = 0.0
        server.on_client_connect(self._welcome)

    def post(self, command: Callable[[], object]) -> None:
        """Have a command carried out by the thread that owns the session."""
        self._commands.put(command)
        self._woken.set()

    def run(self) -> None:
        """Keep the page up to date until `close`, or Ctrl-C."""
        while not self._stopping.is_set():
            # Cleared before the work: a command that comes meanwhile wakes the next wait at once.
            self._woken.clear()
            self.update(time.monotonic())
            self._woken.wait(TICK_S)

    def close(self) -> None:
        self._stopping.set()
        self._woken.set()
        stop_server(self.server)

    def update(self, now: float) -> None:
        """Carry out commands, and send what has changed."""
        try:
            while not self._commands.empty():
                self._commands.get_nowait()()
            self.session.max_playing_points = self.points.detail.count(MANY_POINTS, moving=True)
            shown = self.session.frame_at(now) if self._pace.can_send(now) else self._drawn
            if shown is not None and shown is not self._drawn:
                self.points.draw(shown, self.controls.point_size)
                self._drawn = shown
                self._pace.record_sent(now, len(shown.cloud))
            self.points.update(now)
            self._show_picks()
            if shown is not None:
                self._describe(shown, now)
        except TofclipError as fault:
            for client in self.server.get_clients().values():
                look: Any = {"auto_close_seconds": 6.0, "color": "red"}
                client.add_notification("that cannot be", str(fault), **look)

    def _set_up_scene(self) -> None:
        scene = self.server.scene
        scene.set_up_direction("-y")
        # Shadows and reflections say nothing here, and take a software renderer ten seconds to
        # prepare for.
        scene.configure_default_lights(enabled=True, cast_shadow=False)
        scene.configure_environment_map(hdri=None)
        scene.add_light_ambient("/light", intensity=AMBIENT_INTENSITY)
        move_camera(self.server.initial_camera, self.viewpoint)
        scene.add_frame("/camera", show_axes=False)
        # The page makes a new material for every frame's points, and forgets the compiled shader
        # with the last old one. Two points that stay keep it: compiling it again for every frame
        # would take twenty times as long as drawing.
        staying = np.zeros((2, 3), np.float32)
        scene.add_point_cloud("/camera/staying", staying, staying, point_size=1e-4, **POINT_STYLE)

    def _welcome(self, client: Any) -> None:
        """Frame the scene for the window of a browser that has just come, until the first move."""
        framed: list[Viewpoint] = []

        def follow_window(camera: Any) -> None:
            self.points.note_movement()
            self._show_bar(client)
            aspect = camera.image_width / max(camera.image_height, 1)
            if framed and not any(
                np.allclose(camera.position, one.eye, atol=1e-4) for one in framed
            ):
                return  # moved by hand
            viewpoint = self.session.viewpoint or place_viewpoint(self._framed_cloud, aspect)
            if not framed or not viewpoint.is_close_to(framed[-1]):
                framed.append(viewpoint)
                self.viewpoint = viewpoint
            # What it says may be older than what it was sent, and hides that more has to be sent.
            if not viewpoint.is_close_to(read_viewpoint(camera)):
                move_camera(camera, viewpoint)

        def redraw_pictures() -> None:
            self._pictures_at, self._pictured = 0.0, None

        follow_window(client.camera)
        client.camera.on_update(follow_window)
        self.post(redraw_pictures)

    def _describe(self, shown: DisplayedFrame, now: float) -> None:
        """Bring words and flat pictures up to date, now and then."""
        if now - self._status_at > STATUS_PERIOD_S:
            self._status_at = now
            drawn = self.points.drawn if shown.surface is None else None
            rate = self._pace.per_second(now)
            self.controls.show(shown, render_status_html(self.session, shown, rate, drawn))
        if now - self._pictures_at > PICTURES_PERIOD_S and shown is not self._pictured:
            self._pictures_at, self._pictured = now, shown
            images = render_pictures(self.session.pictures(shown), shown.scale)
            with self._pictures_tab:
                for name, image in images.items():
                    if name in self._pictures:
                        self._pictures[name].image = image
                    else:
                        handle = self.server.gui.add_image(image, label=name)
                        self._pictures[name] = handle


@dataclass
class PageDoor:
    """Where a page is served, and how a browser comes there: at once where a source takes seconds,
    so that the page is loaded by then.
    """

    host: str  # an IP address of this computer, or ``"localhost"``
    port: int | None = None  # A free one by default
    no_browser: bool = False  # whether the page is not opened here
    waiting: Served | None = None  # what says what is being done

    def open_waiting(self, title: str, words: str) -> None:
        """Say what is being done now on a page, until `serve` takes its place."""
        if self.waiting is None:
            self.waiting = start_server(self.port, parse_host(self.host))
            _set_up_panel(self.waiting[0], title)
            self._show_address(self.waiting[1])
        gui = self.waiting[0].gui
        gui.reset()
        gui.add_html(render_text_html("waiting", f"{words} ..."))

    def serve(self, session: Session) -> None:
        page = Page(session, self.port, parse_host(self.host), self.waiting)
        was_waiting, self.waiting = self.waiting is not None, None
        with contextlib.closing(page):
            if not was_waiting:
                self._show_address(page.address)
            page.run()

    def close(self) -> None:
        """Stop serving a page that still waits: there will be nothing to look at."""
        if self.waiting is not None:
            stop_server(self.waiting[0])

    def _show_address(self, address: str) -> None:
        report({"address": address})
        sys.stdout.flush()  # a program that reads the address waits for it
        if not is_local(parse_host(self.host)):
            print(
                "tofclip: other computers can reach this page, unencrypted: anyone who has its address, "
                "with the token, can see and control it",
                file=sys.stderr,
            )
        if not self.no_browser:
            webbrowser.open(address)


def _set_up_panel(server: viser.ViserServer, title: str) -> None:
    """Dock the panel of controls at the right, under the name of the source."""
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
    server.gui.set_panel_label(format_page_title(title))
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(PANEL_PX)
