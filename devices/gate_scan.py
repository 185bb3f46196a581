"""A gate that opens later from picture to picture: what turns a camera's frames into photons counted
in time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from devices.uri import Uri
from tofclip.errors import InputError
from tofclip.storage import Field, Record

GATE_OPTIONS = ("gate_steps", "gate_step_ps", "gate_width_ns", "gate_offset_ps")


@dataclass(frozen=True)
class GateScan:
    """A scan; a picture's number modulo `steps` is its step."""

    steps: int = 72  # pictures of one scan
    step_ps: float = 252.0  # how much later the gate opens from one to the next, ps
    width_ns: float = 5.0  # how long it is open, ns
    offset_ps: float = 5000.0  # when it opens in the first one, ps after the laser's pulse

    def __post_init__(self) -> None:
        if not (
            2 <= self.steps <= 4096
            and 1 <= self.step_ps <= 1e9
            and 0 < self.width_ns <= 1e6
            and 0 <= self.offset_ps <= 1e9
        ):
            raise InputError(
                f"a gate moves in 2 to 4096 steps of 1 ps to 1 ms and is open for up to 1 ms, got {self}"
            )

    @classmethod
    def from_uri(cls, uri: Uri) -> GateScan:
        """Read `GATE_OPTIONS` of an address."""
        usual = cls()
        return cls(
            uri.value("gate_steps", int, usual.steps),
            uri.value("gate_step_ps", float, usual.step_ps),
            uri.value("gate_width_ns", float, usual.width_ns),
            uri.value("gate_offset_ps", float, usual.offset_ps),
        )

    @property
    def opening_times(self) -> NDArray[np.float64]:
        """When the gate opens in each picture of a scan, s after the laser's pulse."""
        steps = np.arange(self.steps, dtype=np.float64)
        return (self.offset_ps + self.step_ps * steps) * 1e-12

    def to_record(self) -> Record:
        """Return the calibration that `devices.photons.read_photons` reads."""
        times = Field(self.opening_times, "s", ("gate_step",))
        return Record("gate_scan", {"gate_times": times}, {"gate_width_s": self.width_ns * 1e-9})
