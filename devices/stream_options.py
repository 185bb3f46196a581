"""Values of an address that every live source takes: how much it holds for a slow reader, and what happens then."""

from __future__ import annotations

from devices.ring import POLICIES
from devices.stream import Buffering
from devices.uri import Uri
from tofclip.errors import InputError

OPTIONS = ("buffer_mib", "policy")

_MEBIBYTE = 1 << 20


def buffering(uri: Uri) -> Buffering:
    """Read ``buffer_mib=64&policy=block`` (or ``drop_oldest``, ``fail``)."""
    capacity = uri.value("buffer_mib", float, Buffering().capacity / _MEBIBYTE) * _MEBIBYTE
    if not 0 < capacity <= 1 << 36:
        raise InputError(f"'{uri.text}': buffer_mib must be within 0 and 65536")
    policy = next(policy for policy in POLICIES if policy == uri.choice("policy", *POLICIES))
    return Buffering(int(capacity), policy)
