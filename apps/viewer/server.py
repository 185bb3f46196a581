"""The server of the page, for anyone who has its address with the token, and none of the browser's other
pages.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import http.client
import io
import ipaddress
import secrets
import socket
from http import HTTPStatus
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from tofclip.errors import InputError, MissingDependencyError

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
