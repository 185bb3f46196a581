"""Commands of the SPAD512S server's intensity mode, and how long its answers are.

A command is a line of ASCII. The answer to ``I,bits,time,images,0,overlap,0,1,width`` is all
pictures and then the four letters ``DONE_MARK``, or a text that ends in ``ERROR_MARK``. Pixels may
hold those letters as well, so that only the computed length tells where an answer ends. The server
greets with a text of its own, of no known length.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from devices.frames import FrameCodec
from tofclip.errors import InputError, ProtocolError

DEFAULT_PORT = 9999
TERMINATOR = b"\n"
DONE_MARK, ERROR_MARK = b"DONE", b"ERROR"
ROWS = 512
BIT_DEPTHS = (1, 4, 6, 7, 8, 9, 10, 11, 12)
IMAGE_WIDTHS_PX = (4, 8, 16, 32, 64, 128, 256, 512)
MAX_TEXT_BYTES = 1 << 13
MAX_IMAGES = 1 << 16

_REQUEST = re.compile(
    rb"I,(?P<bits>\d{1,2}),(?P<time>\d+(\.\d+)?(e[+-]?\d{1,2})?),(?P<images>\d{1,6}),0,1,0,1,(?P<width>\d{1,3})"
)
_MICROSECOND_DEPTHS = (1, 4)  # the others take milliseconds


@dataclass(frozen=True)
class ExposureRequest:
    """A request for pictures.

    Parameters
    ----------
    bits : int
        Depth of a picture; 1, 4, 6..12.
    seconds : float
        Integration time of a picture.
    images : int
        Pictures of one request.
    width : int
        Columns, a power of two within 4..512; 512 for single bits.
    pile_up : bool
        Whether the server corrects counts for photons that came in a pixel's dead time; they have
        16 bits then.

    Raises
    ------
    InputError
        The instrument cannot do that.
    """

    bits: int = 8
    seconds: float = 1e-3
    images: int = 1
    width: int = 512
    pile_up: bool = False

    def __post_init__(self) -> None:
        if self.bits not in BIT_DEPTHS or self.width not in IMAGE_WIDTHS_PX:
            raise InputError(
                f"a SPAD512 has depths of {BIT_DEPTHS} and widths of {IMAGE_WIDTHS_PX}, not {self.bits}, {self.width}"
            )
        if self.bits == 1 and (self.width != ROWS or self.pile_up):
            raise InputError("single bits come at full width and without correction of pile-up")
        if not (0 < self.seconds <= 3600 and 1 <= self.images <= MAX_IMAGES):
            raise InputError(
                f"pictures need an exposure within 0..3600 s, and 1..{MAX_IMAGES} of them, got {self}"
            )

    @property
    def codec(self) -> FrameCodec:
        """What the pictures look like: single bits are packed, more than 8 bits take two bytes."""
        if self.bits == 1:
            return FrameCodec(ROWS, self.width, 1)
        return FrameCodec(ROWS, self.width, 16 if self.bits > 8 or self.pile_up else 8)

    def encode(self) -> bytes:
        """Return the command."""
        unit = 1e-6 if self.bits in _MICROSECOND_DEPTHS else 1e-3
        return (
            f"I,{self.bits},{self.seconds / unit:.9g},{self.images},0,1,0,1,{self.width}".encode()
            + TERMINATOR
        )

    def encode_pile_up(self) -> bytes:
        """Return the command that has to be sent before."""
        return f"PU,{int(self.pile_up)}".encode() + TERMINATOR

    @classmethod
    def decode(cls, line: bytes, pile_up: bool = False) -> ExposureRequest:
        """Read a command, its end taken off.

        Parameters
        ----------
        line : bytes
        pile_up : bool
            As in the class.

        Returns
        -------
        ExposureRequest

        Raises
        ------
        ProtocolError
            It is not such a command.
        """
        found = _REQUEST.fullmatch(line)
        if found is None:
            raise ProtocolError(f"{line[:60]!r} is no request for pictures")
        bits, images, width = int(found["bits"]), int(found["images"]), int(found["width"])
        unit = 1e-6 if bits in _MICROSECOND_DEPTHS else 1e-3
        try:
            return cls(bits, float(found["time"]) * unit, images, width, pile_up)
        except InputError as fault:
            raise ProtocolError(f"{line[:60]!r} requests pictures that cannot be") from fault
