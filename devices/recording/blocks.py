"""Blocks: pieces of a stream that carry their own length, account and checksums, one after the
other.

::

    magic  kind  gap  time     records  length   checksum of payload  checksum of all before
    payload 4 B    2 B   2 B  8 B      8 B      8 B      4 B                  4 B
    length B
"""

from __future__ import annotations

import enum
import struct
import zlib
from dataclasses import dataclass

from devices.ring import Gap

MAGIC = b"TFcB"
MAX_PAYLOAD_BYTES = 1 << 28
"""No block is larger; a length beyond it is damage."""

_LAYOUT = struct.Struct("<4sHHqQQI")
HEADER_BYTES = _LAYOUT.size + 4


class BlockKind(enum.IntEnum):
    """What a block's payload is."""

    HEAD = 1
    """The file as it was before the first piece: an HDF5 image, from which a damaged file is
    rebuilt.
    """
    PIECE = 2
    """Whole records as they came from the instrument."""
    END = 3
    """JSON: the accounts, written when the recording was ended in order."""


@dataclass(frozen=True)
class BlockHeader:
    """What stands before a payload.

    Parameters
    ----------
    kind : Kind
    gap : Gap
        What is missing before it.
    time_ns : int
        When it was recorded, in ns since 1970, by this computer's clock.
    records : int
    length : int
        Bytes of the payload.
    checksum : int
        CRC-32 of the payload.
    """

    kind: BlockKind
    gap: Gap
    time_ns: int
    records: int
    length: int
    checksum: int

    @classmethod
    def of(
        cls, kind: BlockKind, payload: bytes, time_ns: int, records: int = 0, gap: Gap = Gap.NONE
    ) -> BlockHeader:
        """Describe a payload."""
        return cls(kind, gap, time_ns, records, len(payload), zlib.crc32(payload))

    def pack(self) -> bytes:
        """Return the header as it lies in the file."""
        front = _LAYOUT.pack(
            MAGIC, self.kind, self.gap, self.time_ns, self.records, self.length, self.checksum
        )
        return front + struct.pack("<I", zlib.crc32(front))

    @classmethod
    def unpack(cls, data: bytes) -> BlockHeader | None:
        """Read a header; None if these bytes are none."""
        if len(data) != HEADER_BYTES or data[:4] != MAGIC:
            return None
        front, own = data[: _LAYOUT.size], data[_LAYOUT.size :]
        if zlib.crc32(front) != int.from_bytes(own, "little"):
            return None
        _, kind, gap, time_ns, records, length, checksum = _LAYOUT.unpack(front)
        if kind not in set(BlockKind) or gap not in set(Gap) or length > MAX_PAYLOAD_BYTES:
            return None
        return cls(BlockKind(kind), Gap(gap), time_ns, records, length, checksum)

    def matches(self, payload: bytes) -> bool:
        """Whether a payload is the one that was described."""
        return len(payload) == self.length and zlib.crc32(payload) == self.checksum
