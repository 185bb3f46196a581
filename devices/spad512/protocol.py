"""Commands of the SPAD512S server, and how long its answers are.

A command is ASCII without an end: what comes at once is one command. The answers to ``I`` (pictures
of all the light) and ``G`` (pictures behind a gate that moves from step to step) are all pictures
and then the four letters `DONE_MARK`. Pixels may hold those letters as well, so that only the
computed length tells where an answer ends. Instead of pictures, or behind the first of them, may
come a text that ends in `ERROR_MARK`, or begins with it and ends in `DONE_MARK`. Other answers are
texts of no known length, which some versions end with `DONE_MARK`.

Single bits come turned by a quarter, as the vendor's own class knows: ``rot90`` of what came is the
picture that the other depths show.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from devices.frames import FrameCodec
from devices.gate_scan import GateScan
from tofclip.errors import InputError, ProtocolError

DEFAULT_PORT = 9999
DONE_MARK, ERROR_MARK = b"DONE", b"ERROR"
ROWS = 512
BIT_DEPTHS = (1, 4, 6, 7, 8, 9, 10, 11, 12)
GATED_BIT_DEPTHS = BIT_DEPTHS[2:]
IMAGE_WIDTHS_PX = (4, 8, 16, 32, 64, 128, 256, 512)
SINGLE_BIT_QUARTER_TURNS = 1
MAX_TEXT_BYTES = 1 << 13
MAX_IMAGES = 1 << 16
GATE_STEP_PS = 18
"""ps by which the gate moves at least."""

INFORMATION_COMMAND = b"D"
BREAKDOWN_BEGINS, BREAKDOWN_ENDS = "The breakdown calibration process", "The breakdown is around"

_NUMBER = rb"\d+(?:\.\d+)?(?:e[+-]?\d{1,2})?"
_INTENSITY = re.compile(
    rb"I,(?P<bits>\d{1,2}),(?P<time>"
    + _NUMBER
    + rb"),(?P<images>\d{1,6}),0,[01],0,1(?:,(?P<width>\d{1,3}))?"
)
_GATED = re.compile(
    rb"G,(?P<bits>\d{1,2}),(?P<time>"
    + _NUMBER
    + rb"),(?P<images>\d{1,6}),(?P<steps>\d{1,5}),(?P<step>"
    + _NUMBER
    + rb"),0,(?P<gate>"
    + _NUMBER
    + rb"),(?P<offset>"
    + _NUMBER
    + rb"),[01],[01],[01],[01]"
)
_ERROR_TEXT = re.compile(rb"[\t\n\r -~]{0,240}\Z")
_MICROSECOND_DEPTHS = (1, 4)  # the others take milliseconds


@dataclass(frozen=True)
class ExposureRequest:
    """A request for pictures."""

    bits: int = 8  # depth of a picture; 1, 4, 6..12, behind a gate 6..12
    seconds: float = 1e-3  # integration time of a picture
    images: int = 1  # pictures of one request, or scans of a gate
    # columns, a power of two within 4..512; 512 for single bits and behind a gate
    width: int = ROWS
    # whether the server corrects counts for photons that came in a pixel's dead time; they have 16
    # bits then
    pile_up: bool = False
    gate: GateScan | None = None

    def __post_init__(self) -> None:
        if self.bits not in BIT_DEPTHS or self.width not in IMAGE_WIDTHS_PX:
            raise InputError(
                f"a SPAD512 has depths of {BIT_DEPTHS} and widths of {IMAGE_WIDTHS_PX}, not {self.bits}, {self.width}"
            )
        if self.bits == 1 and (self.width != ROWS or self.pile_up):
            raise InputError("single bits come at full width and without correction of pile-up")
        if self.gate is not None and (self.bits not in GATED_BIT_DEPTHS or self.width != ROWS):
            raise InputError("pictures behind a gate have full width and 6 to 12 bits")
        if self.gate is not None and self.gate.step_ps < GATE_STEP_PS:
            raise InputError(
                f"a SPAD512's gate moves by at least {GATE_STEP_PS} ps, got {self.gate.step_ps:g}"
            )
        if not (0 < self.seconds <= 3600 and self.images >= 1 and self.frames <= MAX_IMAGES):
            raise InputError(
                f"pictures need an exposure within 0..3600 s, and 1..{MAX_IMAGES} of them, got {self}"
            )

    @property
    def frames(self) -> int:
        """Pictures in the answer: behind a gate all steps of the first scan, then of the second."""
        return self.images * (1 if self.gate is None else self.gate.steps)

    @property
    def codec(self) -> FrameCodec:
        """What the pictures look like: single bits are packed and turned, more than 8 bits take two
        bytes.
        """
        if self.bits == 1:
            return FrameCodec(ROWS, self.width, 1, SINGLE_BIT_QUARTER_TURNS)
        return FrameCodec(ROWS, self.width, 16 if self.bits > 8 or self.pile_up else 8)

    def encode(self) -> bytes:
        """Return the command."""
        unit = 1e-6 if self.bits in _MICROSECOND_DEPTHS else 1e-3
        amount = f"{self.bits},{self.seconds / unit:.9g},{self.images}"
        if self.gate is None:
            return f"I,{amount},0,1,0,1,{self.width}".encode()
        gate = self.gate
        # Even steps; forwards; the laser's own trigger; no reading during exposure; streamed.
        return (
            f"G,{amount},{gate.steps},{gate.step_ps:.9g},0,{gate.width_ns:.9g},{gate.offset_ps:.9g},0,1,0,1"
        ).encode()

    def encode_pile_up(self) -> bytes:
        """Return the command that has to be sent before."""
        return f"PU,{int(self.pile_up)}".encode()

    @classmethod
    def decode(cls, line: bytes, pile_up: bool = False) -> ExposureRequest:
        """Read a command.

        `pile_up`: as in the class.
        """
        found = _INTENSITY.fullmatch(line) or _GATED.fullmatch(line)
        if found is None:
            raise ProtocolError(f"{line[:60]!r} is not a request for pictures")
        said = found.groupdict()
        bits, images = int(said["bits"]), int(said["images"])
        unit = 1e-6 if bits in _MICROSECOND_DEPTHS else 1e-3
        try:
            gate = None
            if "steps" in said:
                numbers = [float(said[name]) for name in ("step", "gate", "offset")]
                gate = GateScan(int(said["steps"]), *numbers)
            width = int(said.get("width") or ROWS)
            return cls(bits, float(said["time"]) * unit, images, width, pile_up, gate)
        except InputError as fault:
            raise ProtocolError(f"{line[:60]!r} requests pictures that cannot be") from fault


def find_error_text(data: bytes | bytearray) -> str | None:
    """Return what the server says instead of the rest of its pictures, None where it says nothing.

    To be asked when nothing more comes although pictures are due: pixels may spell anything.

    `data`: what came for the present picture.
    """
    tail = bytes(data[-256:])
    if tail.endswith(ERROR_MARK):
        begin = 0
    elif tail.rstrip().endswith(DONE_MARK) and ERROR_MARK in tail:
        begin = tail.rindex(ERROR_MARK)
    else:
        return None
    text = _ERROR_TEXT.search(tail, begin)
    return None if text is None else " ".join(text.group().decode("ascii").split())
