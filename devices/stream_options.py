"""Values of an address that live sources share: times to wait, and what is held for a slow reader."""

from __future__ import annotations

from devices.ring import OVERFLOW_POLICIES
from devices.stream import BufferSettings
from devices.uri import Uri
from tofclip.errors import InputError

OPTIONS = ("buffer_mib", "policy")

_MEBIBYTE = 1 << 20


def parse_buffer_settings(uri: Uri) -> BufferSettings:
    """Read ``buffer_mib=64&policy=block`` (or ``drop_oldest``, ``fail``)."""
    capacity = uri.value("buffer_mib", float, BufferSettings().capacity / _MEBIBYTE) * _MEBIBYTE
    if not 0 < capacity <= 1 << 36:
        raise InputError(f"'{uri.text}': buffer_mib must be within 0 and 65536")
    policy = next(
        policy for policy in OVERFLOW_POLICIES if policy == uri.choice("policy", *OVERFLOW_POLICIES)
    )
    return BufferSettings(int(capacity), policy)


def parse_seconds(uri: Uri, name: str, default: float) -> float:
    """Read a time to wait, within 0 and 600 s.

    Parameters
    ----------
    uri : Uri
    name : str
    default : float
        Seconds.

    Returns
    -------
    float

    Raises
    ------
    InputError
        It is not a number, or outside 0 to 600 s.
    """
    found = uri.value(name, float, default)
    if not 0 < found <= 600:
        raise InputError(f"'{uri.text}': {name} must be above 0 and at most 600")
    return found
