"""A client of RemoteEx: one question at a time, and never the same one twice."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from devices.frames import MOST_FRAME_BYTES
from devices.remoteex.protocol import (
    DATA_GREETING,
    END,
    GREETING,
    LONGEST_MESSAGE,
    Answer,
    Command,
    whole_number,
)
from devices.tcp import TcpLink
from tofclip.errors import DeviceDisconnectedError, DeviceError, DeviceTimeoutError, ProtocolError

MOST_TABLE_BYTES = 1 << 20
_WITH_DATA = ("ImgRingBufferGet", "ImgDataGet")
MOST_MESSAGES = 4096
"""Messages that are kept until somebody asks for them; the oldest go first."""


@dataclass(frozen=True)
class Picture:
    """A picture as it came.

    Parameters
    ----------
    rows, columns : int
    pixel_bytes : int
        1, 2 or 4.
    pixels : bytes
        Row by row, little-endian.
    number : int
        In the ring buffer.
    """

    rows: int
    columns: int
    pixel_bytes: int
    pixels: bytes
    number: int


class RemoteEx:
    """A connection to HPD-TA or HiPic. Not for two threads at once.

    A command that found no answer in time may still be carried out, so it is never sent again: whoever asks next first
    waits for the answer that is owed.

    Parameters
    ----------
    host : str
    port, data_port : int
    timeout : float
        Seconds to wait for an answer.

    Raises
    ------
    DeviceNotFoundError
        Nobody answers there.
    ProtocolError
        Somebody else answers there.
    """

    def __init__(self, host: str, port: int, data_port: int, timeout: float = 5.0) -> None:
        self._timeout = timeout
        self._messages: deque[Answer] = deque(maxlen=MOST_MESSAGES)
        self._owed: deque[Command] = deque()
        self._unread = 0
        self._commands = TcpLink(host, port, timeout)
        try:
            self._expect(self._commands, GREETING)
            self._data = TcpLink(host, data_port, timeout)
        except BaseException:
            self._commands.close()
            raise
        try:
            self._expect(self._data, DATA_GREETING)
        except BaseException:
            self.close()
            raise

    def ask(self, name: str, *arguments: str) -> tuple[str, ...]:
        """Send a command and return its answer's arguments.

        Raises
        ------
        DeviceTimeoutError
            No answer came in time, to this command or to the one before.
        DeviceError
            RemoteEx refused, or the connection broke.
        """
        self._settle()
        command = self.tell(name, *arguments)
        answer = self._owed_answer()
        if answer.name.casefold() != command.name.casefold():
            raise ProtocolError(f"RemoteEx answered {answer.name} when asked {command}")
        return answer.require_done(command)

    def tell(self, name: str, *arguments: str) -> Command:
        """Send a command without waiting, neither for its answer nor for those that are owed."""
        command = Command(name, arguments)
        self._commands.send(command.encode(), self._timeout)
        self._owed.append(command)
        return command

    def conclude(self, *commands: tuple[str, ...]) -> None:
        """Send commands at once, whatever is still owed, and wait until each has been answered.

        Closing without waiting could make the network drop the commands.

        Raises
        ------
        DeviceError
            The first thing that went wrong, after everything else was tried.
        """
        last_words = [self.tell(*words) for words in commands]
        fault: DeviceError | None = None
        while self._owed:
            command = self._owed[0]
            try:
                self._finish_data()
                answer = self._owed_answer()
                if command in last_words:
                    answer.require_done(command)
                elif command.name in _WITH_DATA:
                    self._unread = announced(answer)
            except (DeviceTimeoutError, DeviceDisconnectedError) as failure:
                raise fault or failure from None
            except DeviceError as failure:
                fault = fault or failure
        if fault is not None:
            raise fault

    def message(self, timeout: float) -> Answer:
        """Return the next message that came unasked; `DeviceTimeoutError` if there is none."""
        if self._messages:
            return self._messages.popleft()
        answer = self._next(timeout)
        if not answer.is_message:
            raise ProtocolError(f"RemoteEx answered {answer.name}, which nobody asked")
        return answer

    def picture(self, number: int) -> Picture:
        """Return picture `number` of the ring buffer, or the oldest one where that is gone already.

        Raises
        ------
        ProtocolError
            It is larger than any camera's picture, or of no known depth.
        """
        shape = self.ask("ImgRingBufferGet", "Data", str(number))
        if len(shape) < 5:
            raise ProtocolError(f"RemoteEx described a picture by {len(shape)} words, expected 5 at least")
        columns, rows, depth = (whole_number(text, "a picture's size") for text in shape[:3])
        if depth not in (1, 2, 4):
            raise ProtocolError(f"RemoteEx sent pixels of {depth} bytes, expected 1, 2 or 4")
        pixels = self._take(rows * columns * depth, MOST_FRAME_BYTES)
        return Picture(rows, columns, depth, pixels, whole_number(shape[4], "a picture's number"))

    def scaling_table(self) -> NDArray[np.float32]:
        """Return the vertical scaling of the current picture, one number for each row, in the time range's unit."""
        shape = self.ask("ImgDataGet", "current", "ScalingTable", "Vertical")
        if not shape:
            raise ProtocolError("RemoteEx did not say how long its scaling table is")
        length = whole_number(shape[0], "a table's length") * np.dtype("<f4").itemsize
        return np.frombuffer(self._take(length, MOST_TABLE_BYTES), "<f4")

    def close(self) -> None:
        """Close both connections; closing twice is fine."""
        self._commands.close()
        if hasattr(self, "_data"):
            self._data.close()

    def _expect(self, link: TcpLink, greeting: str) -> None:
        said = link.until(END, LONGEST_MESSAGE, self._timeout)
        if said.strip() != greeting.encode():
            raise ProtocolError(f"{link.name} greeted with {said[:40]!r}, expected '{greeting}'; is RemoteEx there?")

    def _settle(self) -> None:
        """Wait for the answers that are owed, with their data, and forget them."""
        while self._unread or self._owed:
            self._finish_data()
            if self._owed:
                command = self._owed[0]
                answer = self._owed_answer()
                self._unread = announced(answer) if command.name in _WITH_DATA else 0

    def _finish_data(self) -> None:
        """Take the rest of a picture that is late; more than any picture has is given up."""
        length, self._unread = self._unread, 0
        if length:
            self._take(length, MOST_FRAME_BYTES)

    def _owed_answer(self) -> Answer:
        """Return the answer to the first command that is owed one; keep the messages that come before."""
        deadline = monotonic() + self._timeout
        while True:
            try:
                answer = self._next(max(deadline - monotonic(), 0))
            except DeviceTimeoutError as fault:
                raise DeviceTimeoutError(
                    f"RemoteEx did not answer {self._owed[0]} for {self._timeout:g} s; it is not asked again"
                ) from fault
            except ProtocolError:
                self._owed.popleft()  # it was an answer, if one that nobody understands
                raise
            if not answer.is_message:
                self._owed.popleft()
                return answer
            self._messages.append(answer)

    def _next(self, timeout: float) -> Answer:
        return Answer.decode(self._commands.until(END, LONGEST_MESSAGE, timeout))

    def _take(self, length: int, limit: int) -> bytes:
        """Return data that an answer has announced; what is missing at a timeout stays owed."""
        try:
            return self._data.exactly(length, limit, self._timeout)
        except DeviceTimeoutError:
            self._unread = length
            raise


def announced(answer: Answer) -> int:
    """How much data follows an answer that came too late: a picture's size, or a table's length."""
    if answer.code != 0:
        return 0
    numbers = [whole_number(text, "a size") for text in answer.arguments[:3] if text.isdecimal()]
    return numbers[0] * numbers[1] * numbers[2] if len(numbers) == 3 else numbers[0] * 4 if numbers else 0
