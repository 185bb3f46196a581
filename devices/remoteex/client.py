"""A client of RemoteEx: one question at a time, and never the same one twice."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from devices.frames import MAX_FRAME_BYTES
from devices.remoteex.protocol import (
    ANNOUNCEMENT,
    DATA_GREETING,
    GREETING,
    MAX_MESSAGE_BYTES,
    TERMINATOR,
    Answer,
    AnswerCode,
    Command,
    parse_integer,
)
from devices.tcp import TcpLink
from tofclip.errors import DeviceDisconnectedError, DeviceError, DeviceTimeoutError, ProtocolError

MAX_TABLE_BYTES = 1 << 20
_COMMANDS_WITH_DATA = ("ImgRingBufferGet", "ImgDataGet")
MAX_MESSAGES = 4096
"""Messages that are kept until they are asked for; the oldest go first."""


@dataclass(frozen=True)
class CameraFrame:
    """A picture as it came."""

    rows: int
    columns: int
    pixel_bytes: int  # 1, 2 or 4
    pixels: bytes  # row by row, little-endian
    number: int  # in the ring buffer


class RemoteExClient:
    """A connection to HPD-TA or HiPic. Not for two threads at once.

    A command that found no answer in time may still be carried out, so it is never sent again:
    the next command first waits for the answer that is owed.

    `timeout`: seconds to wait for an answer.
    """

    def __init__(self, host: str, port: int, data_port: int, timeout: float = 5.0) -> None:
        self._timeout = timeout
        self._messages: deque[Answer] = deque(maxlen=MAX_MESSAGES)
        # Commands sent and not answered yet, oldest first: RemoteEx answers in order.
        self._owed: deque[Command] = deque()
        self._unread = 0
        self._may_continue = False
        self._commands = TcpLink(host, port, timeout)
        try:
            self._expect_greeting(self._commands, GREETING)
            self._data = TcpLink(host, data_port, timeout)
        except BaseException:
            self._commands.close()
            raise
        try:
            self._expect_greeting(self._data, DATA_GREETING)
        except BaseException:
            self.close()
            raise

    def ask(self, name: str, *arguments: str) -> tuple[str, ...]:
        """Send a command and return its answer's arguments."""
        answer, command = self._exchange(name, arguments)
        return answer.require_done(command)

    def is_done(self, name: str, *arguments: str) -> bool:
        """Send a command that may be refused.

        Returns false where RemoteEx refused.
        """
        return self._exchange(name, arguments)[0].code is AnswerCode.DONE

    def start_application(self, timeout: float) -> bool:
        """Start HPD-TA where it is not up, which takes a while; False where that is refused.

        `timeout`: seconds to wait.
        """
        usual = self._timeout
        self._timeout = timeout
        try:
            return self.is_done("AppStart", "1")
        finally:
            self._timeout = usual

    def _exchange(self, name: str, arguments: tuple[str, ...]) -> tuple[Answer, Command]:
        # After a timeout the late answer would be taken for that of the next command.
        self._wait_for_owed()
        if name in _COMMANDS_WITH_DATA:
            self._data.discard_available()  # of a client before this one
        command = self.send_command(name, *arguments)
        answer = self._read_answer()
        if answer.name.casefold() != command.name.casefold():
            raise ProtocolError(f"RemoteEx answered {answer.name} when asked {command}")
        return answer, command

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
            command = self._owed[0]
            try:
                self._discard_late_data()
                answer = self._read_answer()
                if command in last_words:
                    answer.require_done(command)
                elif command.name in _COMMANDS_WITH_DATA:
                    self._unread = parse_data_length(answer)
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

    def read_scaling_table(self) -> NDArray[np.float32]:
        """Return the vertical scaling of the current picture, one number for each row, in the time
        range's unit.
        """
        shape = self.ask("ImgDataGet", "current", "ScalingTable", "Vertical")
        if not shape:
            raise ProtocolError("RemoteEx did not say how long its scaling table is")
        length = parse_integer(shape[0], "a table's length") * np.dtype("<f4").itemsize
        return np.frombuffer(self._read_data(length, MAX_TABLE_BYTES), "<f4")

    def close(self) -> None:
        """Close both connections; closing twice is fine."""
        self._commands.close()
        if hasattr(self, "_data"):
            self._data.close()

    def _expect_greeting(self, link: TcpLink, greeting: str) -> None:
        said = link.read_until(TERMINATOR, MAX_MESSAGE_BYTES, self._timeout)
        if said.strip() != greeting.encode():
            raise ProtocolError(
                f"{link.name} greeted with {said[:40]!r}, expected '{greeting}'; is RemoteEx there?"
            )

    def _wait_for_owed(self) -> None:
        """Wait for the answers that are owed, with their data, and forget them."""
        while self._unread or self._owed:
            self._discard_late_data()
            if self._owed:
                command = self._owed[0]
                answer = self._read_answer()
                self._unread = (
                    parse_data_length(answer) if command.name in _COMMANDS_WITH_DATA else 0
                )

    def _discard_late_data(self) -> None:
        """Take the rest of a picture that is late; more than any picture has is given up."""
        length, self._unread = self._unread, 0
        if length:
            self._read_data(length, MAX_FRAME_BYTES)

    def _read_answer(self) -> Answer:
        """Return the answer to the first command that is owed one; keep the messages that come
        before.
        """
        deadline = monotonic() + self._timeout
        while True:
            try:
                answer = self._receive(max(deadline - monotonic(), 0))
            except DeviceTimeoutError as fault:
                raise DeviceTimeoutError(
                    f"RemoteEx did not answer {self._owed[0]} for {self._timeout:g} s; it is not asked again"
                ) from fault
            except ProtocolError:
                self._owed.popleft()  # it was an answer, if one that cannot be understood
                raise
            if not answer.is_message:
                self._owed.popleft()
                return answer
            self._messages.append(answer)

    def _receive(self, timeout: float) -> Answer:
        """Return the next answer or message.

        Answers of several lines, and errors whose text holds carriage returns, fall apart at these;
        what is not the beginning of an answer is passed over.
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
    return (
        numbers[0] * numbers[1] * numbers[2]
        if len(numbers) == 3
        else numbers[0] * 4
        if numbers
        else 0
    )
