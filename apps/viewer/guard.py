"""Who may see the page: whoever knows its token, and none of the browser's other pages."""

from __future__ import annotations

import asyncio
import gc
import ipaddress
import secrets
import socket
from http import HTTPStatus
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

REFUSAL = "Open the address that tofclip printed, with its token.\n"

ANSWER_HEADERS = {
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "frame-ancestors 'none'",
}
"""They keep the token of the address to this page, and the page out of another's frame."""


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
            told = parse_qs(urlsplit(request.path).query).get("token", [])
        except ValueError:
            return None
        # SimpleCookie would drop all of them for one of another server's that it cannot read.
        for header in request.headers.get_all("Cookie"):
            pairs = (one.strip().partition("=") for one in header.split(";"))
            told += [value for name, _, value in pairs if name == cookie]
        origins = request.headers.get_all("Origin")
        is_admitted = (
            self._is_own_name(place.hostname or "")
            and all(origin == f"http://{host}" for origin in origins)
            and any(self._is_token(one) for one in told)
        )
        return cookie if is_admitted else None

    def _is_own_name(self, name: str) -> bool:
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return name == "localhost" or (
                not self._is_local and name == socket.gethostname().lower()
            )
        return address.is_loopback or not self._is_local

    def _is_token(self, told: str) -> bool:
        return secrets.compare_digest(told.encode(errors="replace"), self.token.encode())


def install_guard(port: int, is_local: bool) -> str | None:
    """Guard the server of websockets that listens at a port of this process.

    viser has no parameter for ``process_request`` and keeps its server of websockets to itself.
    Behind a proxy its own port would stay open to every page, hence that server is looked for.

    `is_local`: whether only this computer reaches the server. Returns the token; None where there
    is no such server.
    """
    from websockets.asyncio.server import Server

    for found in gc.get_objects():
        if (
            type(found) is Server
            and not isinstance(found.process_request, Guard)
            and port in [one.getsockname()[1] for one in found.sockets]
        ):
            break
    else:
        return None
    guard = Guard(found.process_request, is_local)

    async def begin() -> None:
        found.process_request = guard
        for early in list(found.handlers):
            early.transport.abort()

    asyncio.run_coroutine_threadsafe(begin(), found.get_loop()).result()
    return guard.token
