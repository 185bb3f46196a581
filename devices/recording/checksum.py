"""The checksum that HDF5 puts behind its own metadata."""

from __future__ import annotations

import struct

_MASK = 0xFFFFFFFF


def lookup3(data: bytes) -> int:
    """Return Jenkins's lookup3 hash (``hashlittle``, 2006, public domain; HDF5 file format
    specification, III.G).
    """
    a = b = c = 0xDEADBEEF + len(data) & _MASK
    last = max(0, (len(data) - 1) // 12 * 12)
    for at in range(0, last, 12):
        x, y, z = struct.unpack_from("<III", data, at)
        a, b, c = _mix(a + x & _MASK, b + y & _MASK, c + z & _MASK)
    if not data:
        return c
    x, y, z = struct.unpack("<III", data[last:].ljust(12, b"\0"))
    return _finalize(a + x & _MASK, b + y & _MASK, c + z & _MASK)


def _rotate_left(value: int, bits: int) -> int:
    return (value << bits | value >> 32 - bits) & _MASK


def _mix(a: int, b: int, c: int) -> tuple[int, int, int]:
    for bits in (4, 6, 8, 16, 19, 4):
        a = (a - c & _MASK) ^ _rotate_left(c, bits)
        c = c + b & _MASK
        a, b, c = b, c, a
    return a, b, c


def _finalize(a: int, b: int, c: int) -> int:
    for bits in (14, 11, 25, 16, 4, 14, 24):
        c = (c ^ b) - _rotate_left(b, bits) & _MASK
        a, b, c = b, c, a
    return b
