"""The server of the page, for whoever has its address with the token."""

from __future__ import annotations

import contextlib
import http.client
import io
import ipaddress
import socket
from http import HTTPStatus
from typing import TYPE_CHECKING

from apps.viewer.guard import install_guard
from tofclip.errors import InputError, MissingDependencyError

if TYPE_CHECKING:
    import viser

LOOPBACK = "127.0.0.1"
FIRST_PORT = 8080


def start_server(port: int | None = None, host: str = LOOPBACK) -> tuple[viser.ViserServer, str]:
    """Start a server that lets in whoever knows the token in its address.

    `port`: by default the first free one from 8080 on; `host`: an IP address of this computer;
    0.0.0.0 or :: for all of them. Returns `address`: to open in a browser.
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

    _require_free_port(host, port or 0)
    # viser greets on standard output, which belongs to --json.
    with contextlib.redirect_stdout(io.StringIO()):
        server = LocalServer(host=host, port=FIRST_PORT if port is None else port, verbose=False)
    token = install_guard(server.get_port(), is_local(host))
    if token is None or not _refuses_strangers(host, server.get_port()):
        stop_server(server)
        raise MissingDependencyError(
            f"viser {viser.__version__} would show the page to everybody: pip install viser==1.1.1"
        )
    named = socket.gethostname() if _is_everywhere(host) else host
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


def _is_everywhere(host: str) -> bool:
    return ipaddress.ip_address(host).is_unspecified


def _refuses_strangers(host: str, port: int) -> bool:
    """Ask for the page without the token: another version of a library may not ask the guard."""
    if _is_everywhere(host):
        host = "::1" if ":" in host else LOOPBACK
    with contextlib.closing(http.client.HTTPConnection(host, port, timeout=10)) as connection:
        connection.request("GET", "/")
        return connection.getresponse().status == HTTPStatus.FORBIDDEN


def _require_free_port(host: str, port: int) -> None:
    """Refuse a port that is taken: viser would silently take the next one."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as fault:
            raise InputError(f"cannot listen at {host}, port {port}: {fault}") from fault
