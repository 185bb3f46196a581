"""From compressed measurements of a wall to the hidden scene, with no iteration on the way
(supplement Note 13).

A CLIP camera reads the wall at every instant through an operator F with far fewer measurements than
wall points. For imaging around corners the wall is only an aperture, which bears artefacts: the
adjoint F'f, in O(Nt N^2 m), is often enough.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nlos.capture import Capture
from nlos.method import Method, Plan
from nlos.volume import Grid, Volume
from tofclip.arrays import Float32Array, FloatArray, require_numpy
from tofclip.errors import InputError, ShapeError
from tofclip.operators import LinearOperator
from tofclip.solvers import Backprojection
from tofclip.solvers import Method as Recovery


@dataclass(frozen=True, eq=False)
class CompressedCapture:
    """Measurements ``f = F h`` of a wall's transient pictures h, one column per time bin."""

    measurements: Float32Array  # (measurements, t), kept as float32
    operator: LinearOperator  # f, from pictures (rows, columns) to (measurements,)
    wall: FloatArray  # (rows, columns, 3), the wall point of every pixel, m; NaN where unknown
    laser: FloatArray  # (3,), laser spot, or one per wall point, m
    bin_width: float  # as of `Capture`: the ways to and from the devices are taken off
    start: float = 0.0  # as of `Capture`: the ways to and from the devices are taken off
    provenance: Mapping[str, Any] = field(default_factory=dict)  # how it came about

    def __post_init__(self) -> None:
        require_numpy("imaging straight from compressed measurements", self.measurements)
        measurements = np.asarray(self.measurements, dtype=np.float32)
        wall = np.asarray(self.wall, dtype=np.float64)
        if measurements.ndim != 2 or measurements.shape[:1] != self.operator.shape_out:
            raise ShapeError("measurements", (*self.operator.shape_out, "t"), measurements.shape)
        if wall.shape != (*self.operator.shape_in, 3):
            raise ShapeError("wall", (*self.operator.shape_in, 3), wall.shape)
        if not np.all(np.isfinite(measurements)):
            raise InputError("measurements must not hold NaN or infinity; set bad ones to 0")
        object.__setattr__(self, "measurements", np.ascontiguousarray(measurements))
        object.__setattr__(self, "wall", wall)

    @classmethod
    def of(cls, capture: Capture, operator: LinearOperator) -> CompressedCapture:
        """Read a capture (t, rows, columns) through an operator from pictures (rows, columns), as a
        CLIP camera does; masked wall points are dark.
        """
        if capture.signal.shape[1:] != operator.shape_in:
            raise ShapeError("signal", ("t", *operator.shape_in), capture.signal.shape)
        require_numpy("reading through a CLIP camera", capture.signal)
        pictures = np.where(capture.valid, capture.signal, np.float32(0))
        measurements = operator(np.ascontiguousarray(np.moveaxis(pictures, 0, -1)))
        place = (capture.wall, capture.laser, capture.bin_width, capture.start)
        return cls(measurements, operator, *place, capture.provenance)

    def recover_transients(self, method: Recovery | None = None) -> Capture:
        """Recover the wall's transients by the adjoint, or by a method of `tofclip.solvers`."""
        method = method or Backprojection()
        frames = method.recover(self.operator, self.measurements).frames
        recovery = {"method": method.name, "readings": len(self.measurements)}
        history = {**self.provenance, "recovery": recovery}
        return Capture(frames, self.wall, self.laser, self.bin_width, self.start, history)


@dataclass(frozen=True)
class AdjointImaging:
    """Imaging straight from compressed measurements: recover each instant, image, and cut off what
    is weak.

    Memory for the recovered transients, besides what the solver needs.

    X. Feng, Y. Ma, L. Gao, Nat. Commun. 13, 3333 (2022), supplement Note 13, Eq. 22.
    """

    solver: Method  # any method of this package
    # the adjoint, or another of `tofclip.solvers`
    recovery: Recovery = field(default_factory=Backprojection)
    # voxels weaker than this fraction of the brightest become 0; 0 keeps all
    threshold: float = 0.3

    def __post_init__(self) -> None:
        if not 0 <= self.threshold <= 1:
            raise InputError(f"a threshold is a fraction between 0 and 1, got {self.threshold}")

    def plan(self, capture: CompressedCapture, grid: Grid) -> Plan:
        """Make the solver ready for transients recovered from such measurements."""
        blank = np.zeros((capture.measurements.shape[1], *capture.wall.shape[:-1]), np.float32)
        place = capture.wall, capture.laser, capture.bin_width, capture.start
        return self.solver.plan(Capture(blank, *place), grid)

    def reconstruct(self, capture: CompressedCapture, grid: Grid) -> Volume:
        """Image the hidden scene. Returns weak voxels are zero."""
        plan = self.plan(capture, grid)
        volume = plan.image(capture.recover_transients(self.recovery))
        return volume.threshold(self.threshold)
