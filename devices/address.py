"""Addresses of sources: ``scheme://place?name=value&...``, with every value checked and none
ignored.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeVar
from urllib.parse import parse_qsl, unquote, urlsplit

from tofclip.errors import InputError

T = TypeVar("T")


@dataclass(frozen=True)
class Uri:
    """A parsed address."""

    text: str  # the address as it was given, for messages
    scheme: str  # lower case, e.g. ``"sim+timetag"``
    location: str  # all between ``://`` and ``?``: a serial number, ``HOST:PORT`` or a path
    values: Mapping[str, str] = field(default_factory=dict)  # the query

    @classmethod
    def parse(cls, text: str) -> Uri:
        """Take an address apart."""
        if not text.isprintable():
            raise InputError(f"{text!r} holds control characters, which no address has")
        scheme, separator, rest = text.partition("://")
        if not separator or not scheme:
            raise InputError(
                f"'{text}' is not the address of a source; it looks like sim+timetag://?seed=1 or file://run.h5"
            )
        place, _, query = rest.partition("?")
        try:
            pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=True) if query else []
        except ValueError as fault:
            raise InputError(f"'{text}': after the ? come name=value pairs joined by &") from fault
        if len({name for name, _ in pairs}) != len(pairs):
            raise InputError(f"'{text}': a name is given twice")
        return cls(text, scheme.lower(), unquote(place), dict(pairs))

    def reject_unknown(self, *names: str) -> None:
        """Refuse values of other names than these."""
        for name in self.values:
            if name not in names:
                known = ", ".join(names) or "nothing"
                raise InputError(f"'{self.text}': '{name}' is unknown; {self.scheme} takes {known}")

    def value(self, name: str, kind: Callable[[str], T], default: T) -> T:
        """Return value `name` turned into a `kind` (``int``, ``float``, ``str``), `default` where
        it is not given.

        `kind`: from a text to a value.
        """
        if name not in self.values:
            return default
        try:
            return kind(self.values[name])
        except ValueError as fault:
            raise InputError(f"'{self.text}': {name} cannot be '{self.values[name]}'") from fault

    def choice(self, name: str, *words: str) -> str:
        """Return value `name`, one of `words`; the first is the default."""
        found = self.values.get(name, words[0])
        if found not in words:
            raise InputError(f"'{self.text}': {name} must be {' or '.join(words)}, got '{found}'")
        return found

    def host_and_port(self, default_port: int) -> tuple[str, int]:
        """Return the place as ``HOST[:PORT]``."""
        try:
            parts = urlsplit(f"//{self.location}")
            host, port = parts.hostname, parts.port
        except ValueError as fault:
            raise InputError(
                f"'{self.text}': a port must be a whole number within 1..65535"
            ) from fault
        if not host or port == 0:
            raise InputError(
                f"'{self.text}': name a computer, as in {self.scheme}://192.168.0.2:{default_port}"
            )
        return host, default_port if port is None else port
