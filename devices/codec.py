"""What a codec is: an instrument's bytes to records and back, with no instrument in sight.

A codec never reads from anywhere and keeps nothing between calls. What a decoder has to remember
from one piece of the stream to the next (how often a counter has wrapped) is an explicit *state*
that goes in and comes out; bytes of a record that is not complete yet stay with the caller, which
asks `Codec.count_complete_bytes` how far the complete ones reach.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from tofclip.storage import Scalar

Records = NDArray[Any]
"""One-dimensional NumPy structured array, one row per record."""

ByteView = NDArray[np.uint8]
"""One-dimensional bytes. `as_bytes` makes one of anything that holds bytes, without a copy."""


def as_bytes(data: bytes | bytearray | memoryview | ByteView) -> ByteView:
    """View anything that holds bytes as an array of them, without a copy."""
    return data if isinstance(data, np.ndarray) else np.frombuffer(data, np.uint8)


@dataclass(frozen=True)
class DecodeResult:
    """What became of a piece of the stream.

    Parameters
    ----------
    records : (n,) structured array
    malformed : int
        Records in the piece that cannot be; they are left out of `records`.
    state : object
        What the next call needs to know. Opaque, immutable.
    """

    records: Records
    malformed: int
    state: Any


class Codec(Protocol):
    """Bytes to records and back, both vectorised.

    ``decode(encode(x), start).records`` equals ``x`` for every array of valid records. A codec
    raises only exceptions of `tofclip.errors`, whatever the bytes; it allocates no more than a
    stated multiple of the bytes that it was given.
    """

    name: ClassVar[str]
    """Name in `devices.registry.CODECS`; a recording keeps it together with `settings`."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of a record; `encode` takes and `decode` gives arrays of it."""

    @property
    def settings(self) -> Mapping[str, Scalar]:
        """Arguments that build this codec again."""

    @property
    def start(self) -> Any:
        """State before the first byte, and after the instrument began anew."""

    def count_complete_bytes(self, data: ByteView) -> int:
        """Return how many bytes at the front of `data` form whole records."""

    def count_records(self, data: ByteView) -> int:
        """Return how many records, malformed ones included, are in `data`, of which
        `count_complete_bytes` is all.
        """

    def decode(self, data: ByteView, state: Any, after_loss: bool = False) -> DecodeResult:
        """Decode whole records; `after_loss` says that some are missing right before them.

        ``len(decoded.records) + decoded.malformed == count(data)``.

        Parameters
        ----------
        data : bytes-like
            Whole records.
        state : object
            What the decoder remembers, from the call before or `start`.
        after_loss : bool

        Returns
        -------
        DecodeResult
            Records, number of malformed ones, and the state for the next call.
        """

    def encode(self, records: Records) -> bytes:
        """Return the bytes that the instrument would have sent."""
