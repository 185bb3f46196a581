"""Addresses of sources: ``scheme://place?name=value&...``, with every value checked and none
ignored; and `Options`, by which an instrument declares once what values its address takes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field, fields
from math import inf, isfinite
from typing import Any, Self
from urllib.parse import parse_qsl, unquote, urlsplit

from tofclip.errors import InputError, require


@dataclass(frozen=True)
class Uri:
    """A parsed address."""

    text: str  # the address as it was given, for messages
    scheme: str  # lower case, e.g. ``"sim+timetag"``
    location: str  # all between ``://`` and ``?``: a serial number, ``HOST:PORT`` or a path
    values: Mapping[str, str] = field(default_factory=dict)  # the query
    # names that it may hold besides those of its source, which takes its own out of them
    others: set[str] = field(default_factory=set)

    @classmethod
    def parse(cls, text: str) -> Uri:
        require(text.isprintable(), f"{text!r} holds control characters, which no address has")
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
        require(len({name for name, _ in pairs}) == len(pairs), f"'{text}': a name is given twice")
        return cls(text, scheme.lower(), unquote(place), dict(pairs))

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


def option(
    default: Any,
    kind: Callable[[str], Any] | None = None,
    *,
    least: float = -inf,
    above: float = -inf,
    most: float = inf,
    choices: tuple[str, ...] = (),
) -> Any:
    """Declare a field of `Options`: what makes it of a text, and what it may be."""
    bounds = {"least": least, "above": above, "most": most}
    return field(
        default=choices[0] if choices else default,
        metadata={"kind": kind or type(default), "choices": choices, **bounds},
    )


@dataclass(frozen=True)
class Options:
    """Values of an address: every field made by `option` is one, by its own name, in the unit that
    its name ends in. None means that the value is not given.
    """

    def __post_init__(self) -> None:
        for one in self.declared():
            value, known = getattr(self, one.name), one.metadata
            if value is None or not isinstance(value, int | float):
                continue
            least, above, most = known["least"], known["above"], known["most"]
            if not (least <= value <= most and above < value and isfinite(value)):
                low = "positive" if above == 0 else f"at least {least:g}"
                high = f" and at most {most:g}" if most < inf else ""
                raise InputError(f"{one.name} must be {low}{high}, got {value:g}")

    @classmethod
    def declared(cls) -> list[Field[Any]]:
        """Return the fields that are values of an address."""
        return [one for one in fields(cls) if "kind" in one.metadata]

    @classmethod
    def names(cls) -> tuple[str, ...]:
        return tuple(one.name for one in cls.declared())

    @classmethod
    def from_uri(cls, uri: Uri) -> Self:
        """Read an address, which has no values but these and `Uri.others`."""
        names = cls.names()
        uri.others.difference_update(names)
        for name in uri.values:
            if name not in (*names, *uri.others):
                known = ", ".join(names) or "nothing"
                raise InputError(f"'{uri.text}': '{name}' is unknown; {uri.scheme} takes {known}")
        given = [one for one in cls.declared() if one.name in uri.values]
        try:
            return cls(**{one.name: _parse_value(one, uri.values[one.name]) for one in given})
        except InputError as fault:
            raise InputError(f"'{uri.text}': {fault}") from fault


def _parse_value(declared: Field[Any], text: str) -> Any:
    name, kind, choices = declared.name, declared.metadata["kind"], declared.metadata["choices"]
    choices = ("0", "1") if kind is bool else choices
    if choices and text not in choices:
        raise InputError(f"{name} must be {' or '.join(choices)}, got '{text}'")
    try:
        return text == "1" if kind is bool else kind(text)
    except InputError:
        raise
    except ValueError as fault:
        raise InputError(f"{name} cannot be '{text}'") from fault


def parse_integers(text: str) -> tuple[int, ...]:
    """Read whole numbers that are joined by commas."""
    return tuple(int(word) for word in text.split(","))


def parse_shape(text: str) -> tuple[int, int]:
    """Read rows and columns, such as ``8x8``."""
    rows, columns = (int(side) for side in text.split("x"))
    if min(rows, columns) < 1:
        raise ValueError(text)
    return rows, columns


def parse_numbers(text: str) -> tuple[float, ...]:
    """Read numbers that are joined by commas."""
    return tuple(float(word) for word in text.split(","))
