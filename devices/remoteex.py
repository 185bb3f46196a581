"""RemoteEx's messages as text, after Hamamatsu's RemoteEx Programmers Handbook (HPD-TA 9.5).

A command is ``Name(argument,argument)`` and a carriage return, its answer
``code,Name,argument,argument`` and another. Answers of code 4 come unasked, when something
happened. Pictures and tables travel on a second connection, as long as the answer says; both
connections begin with a greeting.

What the handbook does not say is taken from a client that is proven on hardware (the driver
``hamamatsurx`` of delmic/odemis): text is Latin-1, names are not case-sensitive, a line of an
answer may begin with a line feed, and texts of errors may hold bare carriage returns.

Then come the client, which asks one question at a time and never the same one twice, and
Hamamatsu's streak cameras as a source of frames.
"""

from __future__ import annotations

import contextlib
import enum
import re
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from sys import maxsize
from time import monotonic, sleep

import numpy as np

from devices.address import Uri, option, parse_numbers
from devices.frames import MAX_FRAME_BYTES, FrameCodec, FrameFeed, make_streak_calibration
from devices.source import Gap, Info
from devices.stream import LiveOptions, StreamSource, Transfer
from devices.tcp import TcpLink
from tofclip.arrays import Float32Array, FloatArray
from tofclip.errors import (
    DeviceBusyError,
    DeviceDisconnectedError,
    DeviceError,
    DeviceTimeoutError,
    InputError,
    ProtocolError,
)
from tofclip.io.hamamatsu import TIME_UNITS
from tofclip.storage import Scalar

COMMAND_PORT = 1001
TERMINATOR = b"\r"
ENCODING = "latin-1"  # Of all text: HPD-TA writes "µ" as one byte
GREETING, DATA_GREETING = "RemoteEx Ready", "RemoteEx Data Ready"
ANNOUNCEMENT = "Livemonitor"  # What a message about a new picture is called
MAX_MESSAGE_BYTES = 1 << 16

_COMMAND = re.compile(r"([A-Za-z]\w*)\((.*)\)", re.ASCII)
_ANSWER = re.compile(r"(\d{1,3}),([^,].*)", re.ASCII | re.DOTALL)
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


# What is raised for a command that was refused, and why it was
REFUSALS: dict[AnswerCode, tuple[type[DeviceError], str]] = {
    AnswerCode.SYNTAX: (ProtocolError, "its syntax is wrong"),
    AnswerCode.UNKNOWN: (ProtocolError, "it, or one of its parameters, is unknown"),
    AnswerCode.NOT_NOW: (DeviceBusyError, "it is not possible now"),
    AnswerCode.MISSING: (ProtocolError, "a parameter is missing"),
    AnswerCode.IMPOSSIBLE: (DeviceError, "it cannot be executed"),
    AnswerCode.FAILED: (DeviceError, "it failed"),
    AnswerCode.NO_DATA_LINK: (DeviceError, "its data cannot be sent"),
    AnswerCode.OUT_OF_RANGE: (ProtocolError, "a value is out of range"),
}


@dataclass(frozen=True)
class Command:
    """Something to do."""

    name: str
    # without commas, parentheses and control characters; the protocol has no way to quote them
    arguments: tuple[str, ...] = ()

    def encode(self) -> bytes:
        return _encode_text(str(self), self)

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
        return self.code in (AnswerCode.MESSAGE, AnswerCode.NOTICE)

    def encode(self) -> bytes:
        return _encode_text(",".join([str(int(self.code)), self.name, *self.arguments]), self)

    @classmethod
    def decode(cls, message: bytes) -> Answer:
        """Read an answer, its end taken off."""
        text = _decode_text(message)
        found = _ANSWER.fullmatch(text)
        if found is None or int(found[1]) not in list(AnswerCode):
            raise ProtocolError(f"{text[:80]!r} is not an answer of RemoteEx")
        name, *arguments = found[2].split(",")
        return cls(AnswerCode(int(found[1])), name, tuple(arguments))

    def require_done(self, command: Command) -> tuple[str, ...]:
        """Return the arguments, or raise what the code means."""
        if self.code is AnswerCode.DONE:
            return self.arguments
        said = f" ({', '.join(self.arguments)[:120]})" if self.arguments else ""
        error, reason = REFUSALS.get(self.code, (ProtocolError, "no reason given"))
        raise error(f"RemoteEx refused {command}: {reason}{said}")


def parse_integer(text: str, what: str) -> int:
    """Return a whole number that RemoteEx sent; `what` it means is for the message."""
    # Python would convert digits of any length, at a cost that grows with their square
    if not (text.isascii() and text.isdecimal() and len(text) < 16):
        raise ProtocolError(f"RemoteEx sent {text[:40]!r} as {what}, expected a whole number")
    return int(text)


def _encode_text(text: str, message: Command | Answer) -> bytes:
    if not _NAME.fullmatch(message.name):
        raise InputError(f"'{message.name}' is not the name of a RemoteEx command")
    for argument in message.arguments:
        if not _ARGUMENT.fullmatch(argument) or message.arguments == ("",):
            raise InputError(f"RemoteEx cannot carry the argument {argument!r} here")
    return text.encode(ENCODING) + TERMINATOR


def _decode_text(message: bytes) -> str:
    text = message.decode(ENCODING).strip("\n")
    if _CONTROL.search(text):
        raise ProtocolError(f"RemoteEx sent {message[:40]!r}, which holds control characters")
    return text


MAX_TABLE_BYTES = 1 << 20
_COMMANDS_WITH_DATA = ("ImgRingBufferGet", "ImgDataGet")
MAX_MESSAGES = 4096  # Messages that are kept until they are asked for; the oldest go first


@dataclass(frozen=True)
class CameraFrame:
    """A picture as it came."""

    rows: int
    columns: int
    pixel_bytes: int  # 1, 2 or 4
    pixels: bytes  # row by row, little-endian
    number: int  # in the ring buffer


class RemoteExClient:
    """A connection to HPD-TA or HiPic. Not for two threads at once. A command that found no answer
    in time may still be carried out, so it is never sent again: the next command first waits for
    the answer that is owed.
    """

    def __init__(self, host: str, port: int, data_port: int, timeout: float = 5.0) -> None:
        self._timeout = timeout
        self._messages: deque[Answer] = deque(maxlen=MAX_MESSAGES)
        # Commands sent and not answered yet, oldest first: RemoteEx answers in order.
        self._owed: deque[Command] = deque()
        self._unread = 0
        self._may_continue = False
        with contextlib.ExitStack() as opened:
            self._commands = opened.enter_context(TcpLink(host, port, timeout))
            self._expect_greeting(self._commands, GREETING)
            self._data = opened.enter_context(TcpLink(host, data_port, timeout))
            self._expect_greeting(self._data, DATA_GREETING)
            opened.pop_all()

    def ask(self, name: str, *arguments: str) -> tuple[str, ...]:
        """Send a command and return its answer's arguments."""
        return self._exchange(name, arguments).require_done(Command(name, arguments))

    def is_done(self, name: str, *arguments: str, timeout: float | None = None) -> bool:
        """Send a command that may be refused; False where it was."""
        return self._exchange(name, arguments, timeout).code is AnswerCode.DONE

    def _exchange(
        self, name: str, arguments: tuple[str, ...], timeout: float | None = None
    ) -> Answer:
        # After a timeout the late answer would be taken for that of the next command.
        while self._owed:
            self._settle_oldest()
        self._discard_late_data()
        if name in _COMMANDS_WITH_DATA:
            self._data.discard_available()  # of a client before this one
        command = self.send_command(name, *arguments)
        answer = self._read_answer(timeout)
        if answer.name.casefold() != command.name.casefold():
            raise ProtocolError(f"RemoteEx answered {answer.name} when asked {command}")
        return answer

    def send_command(self, name: str, *arguments: str) -> Command:
        """Send a command without waiting, neither for its answer nor for those that are owed."""
        command = Command(name, arguments)
        self._commands.send(command.encode(), self._timeout)
        self._owed.append(command)
        return command

    def send_and_wait(self, *commands: tuple[str, ...]) -> None:
        """Send commands at once, whatever is still owed, and wait until each has been answered.
        Closing without waiting could make the network drop the commands.
        """
        last_words = [self.send_command(*words) for words in commands]
        fault: DeviceError | None = None
        while self._owed:
            try:
                command, answer = self._settle_oldest()
                if command in last_words:
                    answer.require_done(command)
            except (DeviceTimeoutError, DeviceDisconnectedError) as failure:
                raise fault or failure from None
            except DeviceError as failure:
                fault = fault or failure
        if fault is not None:
            raise fault

    def read_message(self, timeout: float) -> Answer:
        """Return the next message that came unasked; `DeviceTimeoutError` if there is none."""
        if self._messages:
            return self._messages.popleft()
        answer = self._receive(timeout)
        if not answer.is_message:
            raise ProtocolError(f"RemoteEx answered {answer.name}, unasked")
        return answer

    def read_frame(self, number: int) -> CameraFrame:
        """Return picture `number` of the ring buffer, or the oldest one where that is gone already."""
        shape = self.ask("ImgRingBufferGet", "Data", str(number))
        if len(shape) < 5:
            raise ProtocolError(
                f"RemoteEx described a picture by {len(shape)} words, expected 5 at least"
            )
        columns, rows, depth = (parse_integer(text, "a picture's size") for text in shape[:3])
        if depth not in (1, 2, 4):
            raise ProtocolError(f"RemoteEx sent pixels of {depth} bytes, expected 1, 2 or 4")
        pixels = self._read_data(rows * columns * depth, MAX_FRAME_BYTES)
        return CameraFrame(
            rows, columns, depth, pixels, parse_integer(shape[4], "a picture's number")
        )

    def read_scaling_table(self) -> Float32Array:
        """Return the picture's vertical scaling, a number per row, in the time range's unit."""
        shape = self.ask("ImgDataGet", "current", "ScalingTable", "Vertical")
        if not shape:
            raise ProtocolError("RemoteEx did not say how long its scaling table is")
        length = parse_integer(shape[0], "a table's length") * np.dtype("<f4").itemsize
        return np.frombuffer(self._read_data(length, MAX_TABLE_BYTES), "<f4")

    def close(self) -> None:
        self._commands.close()
        self._data.close()

    def _expect_greeting(self, link: TcpLink, greeting: str) -> None:
        said = link.read_until(TERMINATOR, MAX_MESSAGE_BYTES, self._timeout)
        if said.strip() != greeting.encode():
            raise ProtocolError(
                f"{link.name} greeted with {said[:40]!r}, expected '{greeting}'; is RemoteEx there?"
            )

    def _settle_oldest(self) -> tuple[Command, Answer]:
        """Wait for the answer that is owed longest, and note how much data is owed with it."""
        self._discard_late_data()
        command = self._owed[0]
        answer = self._read_answer()
        if command.name in _COMMANDS_WITH_DATA:
            self._unread = parse_data_length(answer)
        return command, answer

    def _discard_late_data(self) -> None:
        """Take the rest of a picture that is late; more than any picture has is given up."""
        length, self._unread = self._unread, 0
        if length:
            self._read_data(length, MAX_FRAME_BYTES)

    def _read_answer(self, timeout: float | None = None) -> Answer:
        """Return the answer to the first command that is owed one; messages before it are kept."""
        timeout = timeout or self._timeout
        deadline = monotonic() + timeout
        while True:
            try:
                answer = self._receive(max(deadline - monotonic(), 0))
            except DeviceTimeoutError as fault:
                raise DeviceTimeoutError(
                    f"RemoteEx did not answer {self._owed[0]} for {timeout:g} s; it is not asked again"
                ) from fault
            except ProtocolError:
                self._owed.popleft()  # it was an answer, if one that cannot be understood
                raise
            if not answer.is_message:
                self._owed.popleft()
                return answer
            self._messages.append(answer)

    def _receive(self, timeout: float) -> Answer:
        """Return the next answer or message. Answers of several lines, and errors whose text holds
        carriage returns, fall apart at these; what is not the beginning of an answer is passed
        over.
        """
        deadline = monotonic() + timeout
        while True:
            left = max(deadline - monotonic(), 0)
            message = self._commands.read_until(TERMINATOR, MAX_MESSAGE_BYTES, left)
            try:
                answer = replace(Answer.decode(message), received_at=monotonic())
            except ProtocolError:
                # Rest of a text that held a bare carriage return, which looks like the end of a
                # message.
                if self._may_continue or message.startswith(b"\n"):
                    continue
                raise
            is_announcement = answer.name.casefold() == ANNOUNCEMENT.casefold()
            self._may_continue = answer.code is not AnswerCode.DONE and not is_announcement
            return answer

    def _read_data(self, length: int, limit: int) -> bytes:
        """Return data that an answer has announced; what is missing at a timeout stays owed."""
        try:
            return self._data.read_exactly(length, limit, self._timeout)
        except DeviceTimeoutError:
            self._unread = length
            raise


def parse_data_length(answer: Answer) -> int:
    """How much data follows an answer that came too late: a picture's size, or a table's length."""
    if answer.code != 0:
        return 0
    numbers = [parse_integer(text, "a size") for text in answer.arguments[:3] if text.isdecimal()]
    if len(numbers) == 3:
        return numbers[0] * numbers[1] * numbers[2]
    return numbers[0] * 4 if numbers else 0


INSTRUMENT = "Hamamatsu streak camera (RemoteEx)"
STREAK_TUBE = "TD"
GAIN_PARAMETER = "MCP Gain"
APPLICATION_START_S = 30.0
POLL_INTERVAL_S = 0.05
# Of the scaling table where the time range is a mere number, as of synchroscan units
SYNCHROSCAN_UNIT_S = 1e-12
_PARAMETERS = {"time_range": "Time Range", "mode": "Mode", "mcp_gain": GAIN_PARAMETER}


@dataclass(frozen=True)
class StreakOptions(LiveOptions):
    """Values of an address that say how to acquire."""

    buffers: int = option(16, least=1, most=4096)  # pictures that HPD-TA keeps for a late client
    # of the micro-channel plate, set before the start; None leaves it as it is. It is 0 after the
    # stop in any case: an intensified tube that is not watched must not age in strong light
    mcp_gain: int | None = option(None, int, least=0, most=63)
    # set before the start, as HPD-TA writes it: ``20 ns``, or ``3`` for a synchroscan unit
    time_range: str = option("")
    # how long ranges 1, 2, ... of a synchroscan unit last, for one that gives no scaling table
    time_ranges_ps: tuple[float, ...] = option((), parse_numbers)
    timeout_s: float = option(5.0, above=0, most=600)  # to wait for an answer

    def __post_init__(self) -> None:
        super().__post_init__()
        if any(not 0 < sweep < 1e15 for sweep in self.time_ranges_ps):
            raise InputError("time ranges must be positive numbers of ps, such as 165,500,1000")


@dataclass(frozen=True)
class RemoteExOptions(StreakOptions):
    """The same, of a camera on a computer."""

    data_port: int | None = option(None, int, least=1, most=65535)  # the command's, and 1


class RemoteExFeed(FrameFeed):
    """Live pictures in the order of their numbers; see `devices.stream.Feed`. Pictures that fell
    out of the ring buffer before they were asked for are lost by the instrument. When the
    connection breaks, so are those that had been announced. `ports`: of commands and of data.
    """

    def __init__(self, host: str, ports: tuple[int, int], options: StreakOptions) -> None:
        super().__init__()
        self._place, self._options = (host, *ports), options
        self._stamps: dict[int, float] = {}
        self._start_camera()
        try:
            first = self._first
            self.codec = FrameCodec(first.rows, first.columns, 8 * first.pixel_bytes)
            known: dict[str, Scalar] = {}
            for name, parameter in _PARAMETERS.items():
                with contextlib.suppress(ProtocolError):  # HiPic has no streak tube to ask
                    said = self._link.ask("DevParamGet", STREAK_TUBE, parameter)
                    known[name] = ",".join(said)
            times = self._read_row_times(known)
            self.calibration = None if times is None else make_streak_calibration(times)
            self.info = Info(
                INSTRUMENT, "", {**known, "rows": first.rows, "columns": first.columns}
            )
        except BaseException:
            # Also a signal to end: nothing else could turn the gain down now.
            with contextlib.suppress(DeviceError):
                self.close()
            raise

    def pull(self, timeout: float) -> Transfer | None:
        while True:
            try:
                picture = self._read_next_frame(timeout)
            except DeviceDisconnectedError:
                self._count_announced_lost()
                self._link.close()
                self._reconnect(self._start_camera, self._options.reconnect_s)
                continue
            codec = self.codec
            shape = (picture.rows, picture.columns, 8 * picture.pixel_bytes)
            if shape != (codec.rows, codec.columns, codec.bits):
                raise ProtocolError("the pictures' size has changed; open the camera anew")
            transfer = self._hand_over(picture.number, picture.pixels)
            # Afterwards, because a gap that this finds is behind the picture.
            return replace(transfer, taken_at=self._estimate_time(picture.number))

    def stop(self) -> None:
        """Turn the gain down first, whatever the state of the connection, and stop the acquisition.
        Live mode that another program had started goes on, with the gain that it had.
        """
        self._stopped = True
        # Live mode of an operator goes on with the operator's gain; otherwise 0 protects the tube.
        gain, live = self._gain_before if self._has_joined else "0", ("AcqLiveMonitor", "Off")
        turn_down = [("DevParamSet", STREAK_TUBE, GAIN_PARAMETER, gain)] if gain else []
        self._link.send_and_wait(*turn_down, *([] if self._has_joined else [("AcqStop",)]), live)

    def close(self) -> None:
        try:
            if not self._stopped:
                self.stop()
            # What was announced before the stop, and not read by now, is lost.
            with contextlib.suppress(DeviceError):
                while True:
                    self._note_announcement(0)
        finally:
            self._count_announced_lost()
            self._link.close()

    def _start_camera(self) -> None:
        """Connect, start the camera and wait for its first picture."""
        self._link = link = RemoteExClient(*self._place, self._options.timeout_s)
        self._stopped = False
        self._has_joined = False
        self._gain_before: str | None = None
        try:
            try:
                self._prepare_live(link)
            # These say nothing about HPD-TA, so that starting it would not help.
            except (DeviceDisconnectedError, DeviceTimeoutError):
                raise
            except DeviceError:
                # HPD-TA may not be up.
                if not link.is_done("AppStart", "1", timeout=APPLICATION_START_S):
                    raise
                self._prepare_live(link)
            if not link.is_done("AcqStart", "Live"):
                self._join_or_restart(link)
            # Whatever is announced first is below this number, as where live mode is started anew.
            self._announced, self._next, self._newest = maxsize, 0, -1
            self._note_announcement(self._options.timeout_s)
            self._gap = Gap.NONE
            self._first = link.read_frame(self._next)
        except BaseException:
            with contextlib.suppress(DeviceError):
                self.stop()
            link.close()
            raise
        # The first picture was read for its size, and is delivered as well. Where it has fallen out
        # of the ring buffer already, it is an older one's successor.
        self._unread_frame: CameraFrame | None = self._first
        self._newest = max(self._newest, self._first.number)

    def _prepare_live(self, link: RemoteExClient) -> None:
        """Set what has to be set before live mode, and ask to be notified of every picture."""
        options = self._options
        if options.mcp_gain is not None:
            with contextlib.suppress(ProtocolError):
                (self._gain_before,) = link.ask("DevParamGet", STREAK_TUBE, GAIN_PARAMETER)[:1]
            link.ask("DevParamSet", STREAK_TUBE, GAIN_PARAMETER, str(options.mcp_gain))
        if options.time_range:
            link.ask("DevParamSet", STREAK_TUBE, "Time Range", options.time_range)
        link.ask("AcqLiveMonitor", "RingBuffer", str(options.buffers))

    def _join_or_restart(self, link: RemoteExClient) -> None:
        """Join live mode that runs, or wait for what keeps the camera busy, then stop it."""
        with contextlib.suppress(ProtocolError):  # not every version knows the question
            state = [word.strip().casefold() for word in link.ask("AcqStatus")]
            if "live" in state:
                self._has_joined = True
                return
        for is_last in (False, True):
            deadline = monotonic() + self._options.timeout_s
            while link.ask("AsyncCommandStatus")[:1] != ("0",) and monotonic() < deadline:
                sleep(POLL_INTERVAL_S)
            if link.is_done("AcqStart", "Live"):
                return
            if not is_last:
                link.ask("AcqStop")
        raise DeviceBusyError("the streak camera is busy; end what HPD-TA is doing")

    def _read_next_frame(self, timeout: float) -> CameraFrame:
        deadline = monotonic() + timeout
        picture = self._unread_frame
        while picture is None:
            with contextlib.suppress(DeviceTimeoutError):
                while self._newest >= self._next:  # all that has been announced meanwhile
                    self._note_announcement(0)
            while self._newest < self._next:
                self._note_announcement(max(deadline - monotonic(), 0))
            try:
                picture = self._link.read_frame(self._next)
            except (DeviceDisconnectedError, DeviceTimeoutError, ProtocolError):
                raise
            except DeviceError:
                # Refused, as no such picture is there: the numbers begin anew when live mode does,
                # which an announcement says, after those that were under way.
                expected, deadline = self._next, monotonic() + self._options.timeout_s
                while self._next == expected:
                    if monotonic() > deadline:
                        raise
                    self._note_announcement(self._options.timeout_s)
        lost = picture.number - self._next
        if lost < 0:
            raise ProtocolError(f"RemoteEx sent picture {picture.number}, asked for {self._next}")
        self._lose(lost)
        self._unread_frame, self._next = None, picture.number + 1
        self._newest = max(self._newest, picture.number)
        return picture

    def _note_announcement(self, timeout: float) -> None:
        """Wait for the next message that announces a picture, and note it; where its number went back,
        live mode was started anew.
        """
        words: tuple[str, ...] = ()
        while len(words) < 2 or words[0].casefold() != "ringbuffer":
            message = self._link.read_message(timeout)
            words = message.arguments
        number = parse_integer(words[1], "a picture's number")
        if number <= self._announced:
            self._count_announced_lost()
            self._next, self._gap = number, Gap.RESTART
            self._clock.reset()
            self._stamps.clear()
        self._announced = number
        self._newest = max(number, self._next - 1)
        if len(words) > 2 and words[2].isdecimal() and len(words[2]) < 16:
            # by the camera's computer, s since live mode was started
            self._stamps[number] = stamp = int(words[2]) * 1e-3
            self._clock.observe(stamp, message.received_at)

    def _estimate_time(self, number: int) -> float:
        """Return when a picture was taken, s of `time.monotonic`; 0 where that is not known."""
        # A picture that was sent for one that is gone may be announced right before the answer.
        with contextlib.suppress(DeviceTimeoutError):
            while number not in self._stamps and self._announced < number:
                self._note_announcement(0)
        stamp = self._stamps.get(number)
        self._stamps = {later: at for later, at in self._stamps.items() if later > number}
        return 0.0 if stamp is None else self._clock.to_host(stamp)

    def _count_announced_lost(self) -> None:
        """Enter pictures that were announced and will not come."""
        self.ledger.lose(max(0, self._newest - self._next + 1))
        self._newest, self._unread_frame = self._next - 1, None

    def _read_row_times(self, known: Mapping[str, Scalar]) -> FloatArray | None:
        """Return the rows' times, s, None where the camera does not sweep; the table is in the unit of
        the time range, as the files show.
        """
        time_range = str(known.get("time_range", "")).strip()
        is_numbered = time_range.isdecimal() and len(time_range) < 4
        unit = SYNCHROSCAN_UNIT_S if is_numbered else TIME_UNITS.get(time_range.rpartition(" ")[2])
        if unit is None or known.get("mode") == "Focus":
            return None
        try:
            table = self._link.read_scaling_table().astype(np.float64)
        except ProtocolError:
            ranges = self._options.time_ranges_ps
            if not is_numbered or not 1 <= int(time_range) <= len(ranges):
                raise
            rows = self.codec.rows
            sweep = ranges[int(time_range) - 1] * unit
            return np.linspace(0, sweep, rows, endpoint=False) + sweep / (2 * rows)
        if (
            table.shape != (self.codec.rows,)
            or not np.all(np.isfinite(table))
            or np.any(np.diff(table) <= 0)
        ):
            raise ProtocolError("RemoteEx's scaling table does not rise row by row of the picture")
        return table * unit


def open_remoteex(uri: Uri) -> StreamSource:
    """Open ``remoteex://HOST:1001``; `RemoteExOptions` has its values."""
    options = RemoteExOptions.from_uri(uri)
    host, port = uri.host_and_port(COMMAND_PORT)
    return StreamSource(RemoteExFeed(host, (port, options.data_port or port + 1), options), options)
