"""A queue of bytes whose cost does not grow with its length."""

from __future__ import annotations

from collections import deque

from devices.codec import ByteView


class ByteQueue:
    """Bytes in the order in which they came, kept in the pieces in which they came."""

    def __init__(self) -> None:
        self._pieces: deque[memoryview] = deque()
        self._length = 0

    def __len__(self) -> int:
        return self._length

    def append(self, piece: ByteView) -> None:
        """Add bytes at the end; they are not copied."""
        if len(piece):
            self._pieces.append(piece.data)
            self._length += len(piece)

    def read_into(self, buffer: memoryview) -> int:
        """Move bytes from the front into `buffer`, as many as fit, and return how many."""
        taken = 0
        while self._pieces and taken < len(buffer):
            piece = self._pieces.popleft()
            part = piece[: len(buffer) - taken]
            buffer[taken : taken + len(part)] = part
            taken += len(part)
            if len(part) < len(piece):
                # A view of the rest: no bytes are copied.
                self._pieces.appendleft(piece[len(part) :])
        self._length -= taken
        return taken

    def truncate(self, length: int) -> None:
        """Forget everything behind the first `length` bytes."""
        while self._length > length:
            piece = self._pieces.pop()
            self._length -= len(piece)
            if self._length < length:
                kept = piece[: length - self._length]
                self._pieces.append(kept)
                self._length += len(kept)

    def clear(self) -> None:
        """Forget everything."""
        self._pieces.clear()
        self._length = 0
