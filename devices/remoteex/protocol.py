"""RemoteEx's messages as text, after Hamamatsu's RemoteEx Programmers Handbook (HPD-TA 9.5).

A command is ``Name(argument,argument)`` and a carriage return, its answer
``code,Name,argument,argument`` and another. Answers of code 4 come unasked, when something
happened. Pictures and tables travel on a second connection, as long as the answer says; both
connections begin with a greeting.

What the handbook does not say is taken from a client that is proven on hardware (the driver
``hamamatsurx`` of delmic/odemis): text is Latin-1, names are not case-sensitive, a line of an
answer may begin with a line feed, and texts of errors may hold bare carriage returns.
"""

from __future__ import annotations

import enum
import re
from dataclasses import dataclass, field

from tofclip.errors import DeviceBusyError, DeviceError, InputError, ProtocolError

COMMAND_PORT, DATA_PORT = 1001, 1002
TERMINATOR = b"\r"
ENCODING = "latin-1"
"""Of all text: HPD-TA writes "µ" as one byte."""

GREETING, DATA_GREETING = "RemoteEx Ready", "RemoteEx Data Ready"
ANNOUNCEMENT = "Livemonitor"
"""What a message about a new picture is called."""

MAX_MESSAGE_BYTES = 1 << 16

_COMMAND = re.compile(r"([A-Za-z]\w*)\((.*)\)", re.ASCII)
_NAME = re.compile(r"[A-Za-z]\w*", re.ASCII)
_ARGUMENT = re.compile(r"[^,()\x00-\x1f\x7f-\x9f\u0100-\U0010ffff]*")
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")


class AnswerCode(enum.IntEnum):
    """What became of a command."""

    DONE = 0
    SYNTAX = 1
    UNKNOWN = 2
    NOT_NOW = 3
    MESSAGE = 4
    NOTICE = 5
    MISSING = 6
    IMPOSSIBLE = 7
    FAILED = 8
    NO_DATA_LINK = 9
    OUT_OF_RANGE = 10


REFUSAL_REASONS = {
    AnswerCode.SYNTAX: "its syntax is wrong",
    AnswerCode.UNKNOWN: "it, or one of its parameters, is unknown",
    AnswerCode.NOT_NOW: "it is not possible now",
    AnswerCode.MISSING: "a parameter is missing",
    AnswerCode.IMPOSSIBLE: "it cannot be executed",
    AnswerCode.FAILED: "it failed",
    AnswerCode.NO_DATA_LINK: "its data cannot be sent",
    AnswerCode.OUT_OF_RANGE: "a value is out of range",
}
_ERRORS: dict[AnswerCode, type[DeviceError]] = {
    AnswerCode.NOT_NOW: DeviceBusyError,
    AnswerCode.IMPOSSIBLE: DeviceError,
    AnswerCode.FAILED: DeviceError,
    AnswerCode.NO_DATA_LINK: DeviceError,
}


@dataclass(frozen=True)
class Command:
    """Something to do."""

    name: str
    # without commas, parentheses and control characters; the protocol has no way to quote them
    arguments: tuple[str, ...] = ()

    def encode(self) -> bytes:
        """Return the bytes to send."""
        _require_valid(self.name, self.arguments)
        return f"{self.name}({','.join(self.arguments)})".encode(ENCODING) + TERMINATOR

    @classmethod
    def decode(cls, message: bytes) -> Command:
        """Read a command, its end taken off."""
        text = _decode_text(message)
        found = _COMMAND.fullmatch(text)
        if found is None:
            raise ProtocolError(f"{text[:80]!r} is not a command Name(argument,...)")
        return cls(found[1], tuple(found[2].split(",")) if found[2] else ())

    def __str__(self) -> str:
        return f"{self.name}({','.join(self.arguments)})"


@dataclass(frozen=True)
class Answer:
    """What RemoteEx says."""

    code: AnswerCode
    name: str  # the command's, or what a message is about
    arguments: tuple[str, ...] = ()
    received_at: float = field(default=0.0, compare=False)  # when it came, s of `time.monotonic`

    @property
    def is_message(self) -> bool:
        """Whether it came unasked."""
        return self.code in (AnswerCode.MESSAGE, AnswerCode.NOTICE)

    def encode(self) -> bytes:
        """Return the bytes to send."""
        _require_valid(self.name, self.arguments)
        return (
            ",".join([str(int(self.code)), self.name, *self.arguments]).encode(ENCODING)
            + TERMINATOR
        )

    @classmethod
    def decode(cls, message: bytes) -> Answer:
        """Read an answer, its end taken off."""
        text = _decode_text(message)
        code, _, rest = text.partition(",")
        name, *arguments = rest.split(",")
        if not (
            code.isascii()
            and code.isdecimal()
            and len(code) < 4
            and int(code) in list(AnswerCode)
            and name
        ):
            raise ProtocolError(f"{text[:80]!r} is not an answer of RemoteEx")
        return cls(AnswerCode(int(code)), name, tuple(arguments))

    def require_done(self, command: Command) -> tuple[str, ...]:
        """Return the arguments, or raise what the code means."""
        if self.code is AnswerCode.DONE:
            return self.arguments
        said = f" ({', '.join(self.arguments)[:120]})" if self.arguments else ""
        error = _ERRORS.get(self.code, ProtocolError)
        raise error(
            f"RemoteEx refused {command}: {REFUSAL_REASONS.get(self.code, 'no reason given')}{said}"
        )


def parse_integer(text: str, what: str) -> int:
    """Return a whole number that RemoteEx sent.

    `what`: what the number means, for the message.
    """
    # Python would convert digits of any length, at a cost that grows with their square
    if not (text.isascii() and text.isdecimal() and len(text) < 16):
        raise ProtocolError(f"RemoteEx sent {text[:40]!r} as {what}, expected a whole number")
    return int(text)


def _require_valid(name: str, arguments: tuple[str, ...]) -> None:
    if not _NAME.fullmatch(name):
        raise InputError(f"'{name}' is not the name of a RemoteEx command")
    for argument in arguments:
        if not _ARGUMENT.fullmatch(argument):
            raise InputError(f"RemoteEx cannot carry the argument {argument!r}")
    if arguments == ("",):
        raise InputError("RemoteEx cannot carry a single argument that is empty")


def _decode_text(message: bytes) -> str:
    text = message.decode(ENCODING).strip("\n")
    if _CONTROL.search(text):
        raise ProtocolError(f"RemoteEx sent {message[:40]!r}, which holds control characters")
    return text
