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

from apps.viewer.access_control import MAX_SCREENSHOT_BYTES, AccessControl, check_message
from tofclip.errors import InputError, MissingDependencyError

if TYPE_CHECKING:
    import viser

FIRST_PORT = 8080
ECHO_PREFIX, ECHO_COUNT = "tofclip-drawn", 4
POLICY_VIOLATION = 1008  # RFC 6455, 7.4.1
_START_LOCK = threading.Lock()


def start_server(access_control: AccessControl, port: int | None = None) -> viser.ViserServer:
    """Start a server that lets in whom `access_control` lets in.

    Parameters
    ----------
    access_control : Door
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
        raise MissingDependencyError(
            f"the page needs viser, which does not load: {fault}"
        ) from fault
    _require_free_port(access_control.host, port or 0)
    # viser greets on standard output, which belongs to whoever asked for JSON.
    with _START_LOCK, _guard_server(access_control), contextlib.redirect_stdout(io.StringIO()):
        return viser.ViserServer(
            host=access_control.host, port=FIRST_PORT if port is None else port, verbose=False
        )


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server and its threads."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def get_address(server: viser.ViserServer, access_control: AccessControl) -> str:
    """Return the address to open in a browser."""
    host = f"[{access_control.host}]" if ":" in access_control.host else access_control.host
    query = f"?token={access_control.token}" if access_control.token else ""
    return f"http://{host}:{server.get_port()}/{query}"


def run_in_page(server: viser.ViserServer, script: str) -> None:
    """Run JavaScript in every page, now and whenever one connects."""
    from viser import _messages

    server._websock_server.queue_message(_messages.RunJavascriptMessage(source=script))


def make_echo_request(
    server: viser.ViserServer, answered: Callable[[], None]
) -> Callable[[], None]:
    """Return a function that asks every page to answer once all that was sent so far is drawn.

    Parameters
    ----------
    server : ViserServer
    answered : callable
        Called, by the server's thread, for every page that answers.
    """
    from viser import _messages

    def heard(_: int, message: Any) -> None:
        if message.request_uuid.startswith(ECHO_PREFIX):
            answered()

    server._websock_server.register_handler(_messages.LocalStorageGetItemResponseMessage, heard)
    # Among all messages to the page that are kept in order, this is the one that is answered and
    # changes nothing. A question replaces an earlier one of its name that has not left yet: frames
    # on their way need different ones.
    names = itertools.cycle(f"{ECHO_PREFIX}-{number}" for number in range(ECHO_COUNT))

    def ask() -> None:
        name = next(names)
        server._websock_server.queue_message(
            _messages.LocalStorageGetItemRequestMessage(name, name)
        )

    return ask


def _require_free_port(host: str, port: int) -> None:
    """Refuse a port that is taken: viser would silently take the next one."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as fault:
            raise InputError(f"cannot listen at {host}, port {port}: {fault}") from fault


@contextlib.contextmanager
def _guard_server(access_control: AccessControl) -> Iterator[None]:
    """Let a server that starts within the block ask `access_control`; viser itself has no setting
    for that.
    """
    import websockets.asyncio.server as web

    original = web.serve

    def serve(handler: Any, host: str, port: int, **settings: Any) -> Any:
        page = settings.pop("process_request")
        settings |= {
            "max_size": MAX_SCREENSHOT_BYTES,
            "create_connection": _make_guarded_connection(),
        }
        return original(
            handler, host, port, process_request=_guard_requests(access_control, page), **settings
        )

    web.serve = serve  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        web.serve = original  # type: ignore[misc]


def _guard_requests(
    access_control: AccessControl, page: Callable[[Any, Any], Any]
) -> Callable[[Any, Any], Any]:
    """Put the door before what answers requests."""

    def answer(connection: Any, request: Any) -> Any:
        headers = {name.lower(): value for name, value in request.headers.raw_items()}
        refusal = access_control.check_request(request.path, headers)
        if refusal:
            status = (
                http.HTTPStatus.NOT_FOUND
                if refusal == "no such page"
                else http.HTTPStatus.FORBIDDEN
            )
            return connection.respond(status, refusal + "\n")
        response = page(connection, request)
        cookie = access_control.make_cookie(request.path)
        if response is not None:
            response.headers["Referrer-Policy"] = "no-referrer"  # the address holds the token
            response.headers["X-Frame-Options"] = "DENY"
            if cookie:
                response.headers["Set-Cookie"] = cookie
        return response

    return answer


def _make_guarded_connection() -> type:
    from websockets.asyncio.server import ServerConnection

    class GuardedConnection(ServerConnection):
        """A connection that ends with the first message that is not expected of the page."""

        async def recv(self, decode: bool | None = None) -> Any:
            data = await super().recv(decode)
            refusal = check_message(data)
            if refusal:
                await self.close(POLICY_VIOLATION, refusal)
                return await super().recv(decode)  # raises: the connection is closed
            return data

    return GuardedConnection
