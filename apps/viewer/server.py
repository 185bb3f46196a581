"""The server of the page, for browsers of this computer only."""

from __future__ import annotations

import contextlib
import io
import ipaddress
import socket
from typing import TYPE_CHECKING

from tofclip.errors import InputError, MissingDependencyError

if TYPE_CHECKING:
    import viser

LOOPBACK = "127.0.0.1"
FIRST_PORT = 8080


def start_server(port: int | None = None, host: str = LOOPBACK) -> viser.ViserServer:
    """Start a server that only this computer can reach.

    Parameters
    ----------
    port : int, optional
        By default the first free one from 8080 on.
    host : str
        A loopback address.

    Returns
    -------
    ViserServer

    Raises
    ------
    InputError
        The port is taken.
    MissingDependencyError
        viser is not installed.
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
        return LocalServer(host=host, port=FIRST_PORT if port is None else port, verbose=False)


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server and its threads."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def get_address(server: viser.ViserServer, host: str = LOOPBACK) -> str:
    """Return the address to open in a browser.

    Parameters
    ----------
    server : ViserServer
    host : str
        That it listens at.

    Returns
    -------
    str
    """
    name = f"[{host}]" if ":" in host else host
    return f"http://{name}:{server.get_port()}/"


def parse_loopback(host: str) -> str:
    """Return the address to listen at for what ``--host`` was given.

    Raises
    ------
    InputError
        Other computers could reach it. viser lets in everyone who reaches it, so ssh has to decide.
    """
    if host == "localhost":
        return LOOPBACK
    with contextlib.suppress(ValueError):
        if ipaddress.ip_address(host).is_loopback:
            return host
    raise InputError(
        f"the page is served to this computer only, not at '{host}'; from another one: "
        f"ssh -L {FIRST_PORT}:localhost:{FIRST_PORT} THIS_COMPUTER, then http://localhost:{FIRST_PORT}"
    )


def _require_free_port(host: str, port: int) -> None:
    """Refuse a port that is taken: viser would silently take the next one."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as fault:
            raise InputError(f"cannot listen at {host}, port {port}: {fault}") from fault
