"""Blocks: pieces of a stream that carry their own length, number and checksums.

All numbers are little-endian::

    magic  recording  number  kind  gap  time_ns  records  length  payload's  header's  payload
                                                                   CRC-32     CRC-32
    8 B    8 B        8 B     2 B   2 B  8 B      8 B      8 B     4 B        4 B       length B

``recording`` is a random number that all blocks of a file share, so that a block of one recording
inside a piece of another is not mistaken. ``number`` counts the blocks from 0.

Version 0.1.0 wrote a shorter header without these two (`LEGACY_MAGIC`).
"""

from __future__ import annotations

import enum
import struct
import zlib
from dataclasses import dataclass

from devices.ring import Gap

MAGIC = b"\x89ToFrec\n"
LEGACY_MAGIC = b"TFcB"
MAX_PAYLOAD_BYTES = 1 << 28
"""No block is larger; a length beyond it is damage."""

_LAYOUT = struct.Struct("<8sQQHHqQQI")
_LEGACY_LAYOUT = struct.Struct("<4sHHqQQI")
_CHECKSUM_BYTES = 4
HEADER_BYTES = _LAYOUT.size + _CHECKSUM_BYTES
LEGACY_HEADER_BYTES = _LEGACY_LAYOUT.size + _CHECKSUM_BYTES


class BlockKind(enum.IntEnum):
    """What a block's payload is."""

    HEAD = 1
    """An HDF5 record: all that was known before the first piece."""
    PIECE = 2
    """Whole records as they came from the instrument."""
    END = 3
    """JSON: the accounts, written when the recording was ended in order."""


@dataclass(frozen=True)
class BlockHeader:
    """What stands before a payload."""

    kind: BlockKind
    gap: Gap  # what is missing before it
    time_ns: int  # when it was recorded, in ns since 1970, by this computer's clock
    records: int
    length: int  # bytes of the payload
    checksum: int  # CRC-32 of the payload
    # number of the block in its recording, from 0; -1 in recordings of version 0.1.0
    number: int = 0
    recording: int = 0  # the random number that the blocks of a recording share

    @classmethod
    def of(
        cls,
        kind: BlockKind,
        payload: bytes,
        time_ns: int,
        records: int = 0,
        gap: Gap = Gap.NONE,
        number: int = 0,
        recording: int = 0,
    ) -> BlockHeader:
        """Describe a payload; the parameters are those of the class.

        `time_ns`: ns since 1970; `number`: of the block; `recording`: of the recording, a random
        number.
        """
        checksum = zlib.crc32(payload)
        return cls(kind, gap, time_ns, records, len(payload), checksum, number, recording)

    @property
    def is_legacy(self) -> bool:
        """Whether version 0.1.0 wrote it."""
        return self.number < 0

    @property
    def header_bytes(self) -> int:
        """Bytes of the header itself."""
        return LEGACY_HEADER_BYTES if self.is_legacy else HEADER_BYTES

    def pack(self) -> bytes:
        """Return the header as it lies in the file."""
        front = _LAYOUT.pack(
            MAGIC,
            self.recording,
            self.number,
            self.kind,
            self.gap,
            self.time_ns,
            self.records,
            self.length,
            self.checksum,
        )
        return front + struct.pack("<I", zlib.crc32(front))

    @classmethod
    def unpack(cls, data: bytes) -> BlockHeader | None:
        """Read a header from the first bytes of `data`; None if they are not a sound one."""
        is_legacy = data[: len(LEGACY_MAGIC)] == LEGACY_MAGIC
        layout = _LEGACY_LAYOUT if is_legacy else _LAYOUT
        front = data[: layout.size]
        own = data[layout.size : layout.size + _CHECKSUM_BYTES]
        if len(own) != _CHECKSUM_BYTES or not (is_legacy or data.startswith(MAGIC)):
            return None
        # a header that passes by chance is one in 2^32: the search for blocks may rely on it
        if zlib.crc32(front) != int.from_bytes(own, "little"):
            return None
        recording, number = 0, -1
        if is_legacy:
            _, kind, gap, time_ns, records, length, checksum = layout.unpack(front)
        else:
            _, recording, number, kind, gap, time_ns, records, length, checksum = layout.unpack(
                front
            )
        if kind not in set(BlockKind) or gap not in set(Gap) or length > MAX_PAYLOAD_BYTES:
            return None
        return cls(BlockKind(kind), Gap(gap), time_ns, records, length, checksum, number, recording)

    def matches(self, payload: bytes) -> bool:
        """Whether a payload is the one that was described."""
        return len(payload) == self.length and zlib.crc32(payload) == self.checksum
