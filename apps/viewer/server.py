"""The server of the page, behind its door. All that reaches into viser's inner parts is here."""

from __future__ import annotations

import contextlib
import http
import io
import itertools
import socket
import threading
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from apps.viewer.door import LARGEST_PICTURE, Door, refused_message
from tofclip.errors import InputError, MissingDependencyError

if TYPE_CHECKING:
    import viser

FIRST_PORT = 8080
ECHO, ECHOES = "tofclip-drawn", 4
POLICY_VIOLATION = 1008  # RFC 6455, 7.4.1
_STARTING = threading.Lock()


def start_server(door: Door, port: int | None = None) -> viser.ViserServer:
    """Start a server that lets in whom `door` lets in.

    Parameters
    ----------
    door : Door
    port : int, optional
        By default the first free one from 8080 on.

    Raises
    ------
    InputError
        The port is taken, or the address is none of this computer's.
    MissingDependencyError
        viser does not load.
    """
    try:
        import viser
    except ImportError as fault:
        raise MissingDependencyError(f"the page needs viser, which does not load: {fault}") from fault
    _require_free(door.host, port or 0)
    # viser greets on standard output, which belongs to whoever asked for JSON.
    with _STARTING, _guarded(door), contextlib.redirect_stdout(io.StringIO()):
        return viser.ViserServer(host=door.host, port=FIRST_PORT if port is None else port, verbose=False)


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server and its threads."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def address_of(server: viser.ViserServer, door: Door) -> str:
    """Return the address to open in a browser."""
    host = f"[{door.host}]" if ":" in door.host else door.host
    query = f"?token={door.token}" if door.token else ""
    return f"http://{host}:{server.get_port()}/{query}"


def run_in_page(server: viser.ViserServer, script: str) -> None:
    """Run JavaScript in every page, now and whenever one connects."""
    from viser import _messages

    server._websock_server.queue_message(_messages.RunJavascriptMessage(source=script))


def echoes(server: viser.ViserServer, answered: Callable[[], None]) -> Callable[[], None]:
    """Return a function that asks every page to answer once all that was sent so far is drawn.

    Parameters
    ----------
    server : ViserServer
    answered : callable
        Called, by the server's thread, for every page that answers.
    """
    from viser import _messages

    def heard(_: int, message: Any) -> None:
        if message.request_uuid.startswith(ECHO):
            answered()

    server._websock_server.register_handler(_messages.LocalStorageGetItemResponseMessage, heard)
    # Among all messages to the page that are kept in order, this is the one that is answered and changes nothing.
    # A question replaces an earlier one of its name that has not left yet: frames on their way need different ones.
    names = itertools.cycle(f"{ECHO}-{number}" for number in range(ECHOES))

    def ask() -> None:
        name = next(names)
        server._websock_server.queue_message(_messages.LocalStorageGetItemRequestMessage(name, name))

    return ask


def _require_free(host: str, port: int) -> None:
    """Refuse a port that is taken: viser would silently take the next one."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as fault:
            raise InputError(f"cannot listen at {host}, port {port}: {fault}") from fault


@contextlib.contextmanager
def _guarded(door: Door) -> Iterator[None]:
    """Let a server that starts within the block ask `door`; viser itself has no setting for that."""
    import websockets.asyncio.server as web

    original = web.serve

    def serve(handler: Any, host: str, port: int, **settings: Any) -> Any:
        page = settings.pop("process_request")
        settings |= {"max_size": LARGEST_PICTURE, "create_connection": _guarded_connection()}
        return original(handler, host, port, process_request=_asking(door, page), **settings)

    web.serve = serve  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        web.serve = original  # type: ignore[misc]


def _asking(door: Door, page: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Put the door before what answers requests."""

    def answer(connection: Any, request: Any) -> Any:
        headers = {name.lower(): value for name, value in request.headers.raw_items()}
        refusal = door.refusal(request.path, headers)
        if refusal:
            status = http.HTTPStatus.NOT_FOUND if refusal == "no such page" else http.HTTPStatus.FORBIDDEN
            return connection.respond(status, refusal + "\n")
        response = page(connection, request)
        cookie = door.cookie(request.path)
        if response is not None:
            response.headers["Referrer-Policy"] = "no-referrer"  # the address holds the token
            response.headers["X-Frame-Options"] = "DENY"
            if cookie:
                response.headers["Set-Cookie"] = cookie
        return response

    return answer


def _guarded_connection() -> type:
    from websockets.asyncio.server import ServerConnection

    class GuardedConnection(ServerConnection):
        """A connection that ends with the first message that is not expected of the page."""

        async def recv(self, decode: bool | None = None) -> Any:
            data = await super().recv(decode)
            refusal = refused_message(data)
            if refusal:
                await self.close(POLICY_VIOLATION, refusal)
                return await super().recv(decode)  # raises: the connection is closed
            return data

    return GuardedConnection
