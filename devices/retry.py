"""Trying again until an instrument that went away is back."""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic, sleep
from typing import TypeVar

from tofclip.errors import DeviceDisconnectedError, DeviceNotFoundError, DeviceTimeoutError

T = TypeVar("T")

RETRY_INTERVAL_S = 0.1
"""Seconds between two attempts."""


def retry_connect(connect: Callable[[], T], seconds: float) -> T:
    """Return what `connect` returns, which is called again while the instrument does not answer.

    Parameters
    ----------
    connect : callable
    seconds : float

    Returns
    -------
    object

    Raises
    ------
    DeviceDisconnectedError
        The instrument did not answer for `seconds`.
    """
    deadline = monotonic() + seconds
    while True:
        try:
            return connect()
        except (DeviceNotFoundError, DeviceDisconnectedError, DeviceTimeoutError) as fault:
            # Looked at after the attempt, so that there is always one.
            if monotonic() > deadline:
                raise DeviceDisconnectedError(
                    f"the connection broke and no answer came for {seconds:g} s ({fault})"
                ) from fault
            sleep(RETRY_INTERVAL_S)
