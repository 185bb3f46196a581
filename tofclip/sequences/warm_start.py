"""Shot after shot recovered with a prior, each beginning at what the last one showed.

From one shot to the next little changes but the noise. Iterations that begin at the last shot's
pictures need a few steps where those that begin in darkness need forty.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tofclip.lidar.traces import PictureTraces, TraceBins
from tofclip.operators import LinearOperator
from tofclip.solvers import ProximalMethod

WARM_ITERATIONS = 4
"""Of each shot but the first, which has the method's own number."""


class WarmStartedRecovery:
    """Recovers the rows of a shot that hold light, beginning at the same rows of the shot before.

    Shots are taken one after the other, each with all cores: what comes out of a shot depends on
    those before it, and only on them.

    `method`: its iterations are the first shot's; `operator`: of all rows; `alive` (columns,):
    false for slit columns that are never to be trusted; `iterations`: of each further shot.
    """

    def __init__(
        self,
        method: ProximalMethod,
        operator: LinearOperator,
        alive: NDArray[np.bool_],
        iterations: int = WARM_ITERATIONS,
    ) -> None:
        self.method, self.operator, self._alive = method, operator, alive
        # so few iterations end before the gap is looked at
        self._warm = replace(method, iterations=iterations, gap=0.0)
        self._rows = np.zeros(0, np.int64)
        self._pictures = np.zeros((0, *operator.shape_in), np.float32)

    def recover(self, measurements: NDArray[np.float32], bins: TraceBins) -> PictureTraces:
        """Recover some rows of a shot.

        `measurements` (columns, bins): rectified, of these rows; `bins`: rows of which one stands
        for several are dark, and stay so.
        """
        lit = bins.bin_weights == 1
        rows = bins.numbers[lit]
        seen = np.ascontiguousarray(measurements[:, lit])
        valid = None if self._alive.all() else np.repeat(self._alive[:, np.newaxis], rows.size, 1)
        shared, here, before = np.intersect1d(rows, self._rows, True, return_indices=True)
        pictures = np.zeros((bins.numbers.size, *self.operator.shape_in), np.float32)
        if rows.size == 0:
            return PictureTraces(pictures, bins)
        if shared.size == 0:
            found = self.method.recover(self.operator, seen, valid).frames
        else:
            start = self._pictures
            if not np.array_equal(rows, self._rows):
                start = np.zeros((rows.size, *self.operator.shape_in), np.float32)
                start[here] = self._pictures[before]
            found = self._warm.recover(self.operator, seen, valid, start=start).frames
        self._rows, self._pictures = rows, found
        pictures[lit] = found
        return PictureTraces(pictures, bins)
