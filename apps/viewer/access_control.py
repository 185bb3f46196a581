"""Who may talk to the page's server, and what they may say.

The server (viser) trusts everybody who reaches it: it would take messages from any web site that
the browser has open, open a tunnel to the internet when asked to, and accept files. Here it is told
otherwise:

* only the page itself is served, nothing else; query strings that point it at another server are
  refused;
* requests must be addressed to this computer by a name of its own (no DNS rebinding), and a page's
  messages must come from the page that was served here (no cross-site WebSocket);
* beyond loopback, whoever connects needs the token in the address that was printed;
* messages larger than any that the page sends, unknown ones, and known ones that this viewer never
  needs, end the connection.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from tofclip.errors import InputError

LOOPBACK = "127.0.0.1"
MAX_SCREENSHOT_BYTES = 16 << 20
"""Bytes of the largest message: a screenshot."""

MAX_MESSAGE_BYTES = 1 << 16
"""Bytes of the largest message that is no screenshot."""

SCREENSHOT_MESSAGE = "GetRenderResponseMessage"
ALLOWED_MESSAGES = frozenset(
    {
        SCREENSHOT_MESSAGE,
        "CommandTriggerMessage",
        "GuiUpdateMessage",
        "LocalStorageGetItemResponseMessage",
        "SceneNodeClickMessage",
        "ScenePointerMessage",
        "ViewerCameraMessage",
    }
)
"""All that the page has to say: keys, controls, clicks, where its camera is, that a frame was
drawn, screenshots.
"""

SERVED_PATHS = ("/", "/index.html")
COOKIE_NAME = "tofclip"


@dataclass(frozen=True)
class AccessControl:
    """Decides about requests.

    Parameters
    ----------
    host : str
        Address that the server listens at.
    token : str
        What a visitor has to know; empty on loopback, where only users of this computer can come.
    """

    host: str = LOOPBACK
    token: str = ""

    @classmethod
    def for_host(cls, host: str) -> AccessControl:
        """Make a door for an address, with a fresh token unless it is loopback.

        Raises
        ------
        InputError
            It is no address of a network interface.
        """
        if host == "localhost":
            return cls(LOOPBACK)
        try:
            address = ipaddress.ip_address(host)
        except ValueError as fault:
            raise InputError(
                f"--host takes an IP address such as 192.168.0.2, got '{host}'"
            ) from fault
        return cls(host) if address.is_loopback else cls(host, secrets.token_urlsafe(24))

    def check_request(self, path: str, headers: Mapping[str, str]) -> str:
        """Return why a request is refused, in a few words; empty where it is granted.

        Parameters
        ----------
        path : str
            Of the request, with its query.
        headers : mapping
            Of the request; names in lower case.
        """
        target = urlsplit(path)
        if target.path not in SERVED_PATHS or path.startswith("//"):
            return "no such page"
        query = dict(parse_qsl(target.query, keep_blank_values=True))
        if set(query) - {"token"}:
            return "unknown query"
        host = headers.get("host", "")
        if not self._is_own_host(host):
            return "another computer's name"
        if (
            headers.get("upgrade", "").lower() == "websocket"
            and urlsplit(headers.get("origin", "")).netloc != host
        ):
            return "another page's request"
        if self.token and not self._has_token(query.get("token", ""), headers.get("cookie", "")):
            return "no token: use the whole address that was printed"
        return ""

    def make_cookie(self, path: str) -> str:
        """Return the cookie to set for a granted request, so that the page's messages are let in;
        empty for none.
        """
        given = dict(parse_qsl(urlsplit(path).query)).get("token", "")
        if not self.token or not given:
            return ""
        return f"{COOKIE_NAME}={self.token}; Path=/; HttpOnly; SameSite=Strict"

    def _is_own_host(self, host: str) -> bool:
        """Whether a Host header names this computer. Ports are not compared: a tunnel's differs."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        if self.token:
            return bool(name)  # the token keeps strangers out, whatever name they use
        return name == "localhost" or _is_loopback(name)

    def _has_token(self, given: str, cookies: str) -> bool:
        try:
            kept = SimpleCookie(cookies).get(COOKIE_NAME)
        except CookieError:
            kept = None
        known = self.token.encode()
        return any(
            hmac.compare_digest(word.encode(), known)
            for word in (given, kept.value if kept else "")
        )


def check_message(data: Any) -> str:
    """Return why a message of the page is refused, in a few words; empty where it is passed on.

    Parameters
    ----------
    data : bytes
        As it came; msgpack of a mapping with its kind under ``"type"``.
    """
    import msgspec

    if not isinstance(data, bytes):
        return "text"
    if len(data) > MAX_SCREENSHOT_BYTES:
        return "too large"
    try:
        content = msgspec.msgpack.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return "no message"
    kind = content.get("type") if isinstance(content, dict) else None
    if not isinstance(kind, str) or kind not in ALLOWED_MESSAGES:
        return "unknown command"
    return "too large" if kind != SCREENSHOT_MESSAGE and len(data) > MAX_MESSAGE_BYTES else ""


def _is_loopback(name: str) -> bool:
    try:
        return ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False
