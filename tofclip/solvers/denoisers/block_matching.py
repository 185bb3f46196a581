"""BM3D, from a package that is free for non-commercial use only and therefore not installed by
default.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofclip.errors import MissingDependencyError
from tofclip.solvers.denoisers.denoiser import Picture


@dataclass(frozen=True)
class BlockMatching:
    """Block matching and 3D filtering by its authors' package `bm3d`.

    K. Dabov, A. Foi, V. Katkovnik, K. Egiazarian, IEEE Trans. Image Process. 16, 2080 (2007).

    Raises
    ------
    MissingDependencyError
        The package is not installed.
    """

    def __call__(self, noisy: Picture, pilot: Picture, deviation: float) -> Picture:
        """Return the picture without its noise; the pilot is not needed."""
        try:
            from bm3d import bm3d
        except ImportError as fault:
            raise MissingDependencyError(
                "BM3D needs the package bm3d (free for non-commercial use only): pip install 'tofclip[bm3d]'; "
                "without it take the prior 'collaborative'"
            ) from fault
        clean: Picture = np.asarray(bm3d(noisy, deviation), noisy.dtype)
        return clean
