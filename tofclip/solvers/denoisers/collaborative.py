"""Joint Wiener filtering of patches that look alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofclip.errors import InputError, ShapeError
from tofclip.solvers.denoisers.denoiser import Picture


@dataclass(frozen=True)
class CollaborativeWiener:
    """Every patch is filtered together with its likes: the second step of non-local Bayes, the
    pilot as its first.

    M. Lebrun, A. Buades, J.-M. Morel, SIAM J. Imaging Sci. 6, 1665 (2013), Eq. 3.6: mean and
    covariance of a group come from the pilot, and ``x = mean + C (C + deviation^2 I)^-1 (y -
    mean)`` is the best linear estimate of each of its patches. In a loop that calls a denoiser
    again and again, the pilot is what the last call returned. About as good as BM3D here and five
    times faster, under our own licence.

    Parameters
    ----------
    patch_px : int
        Side of a patch.
    stride_px : int
        Distance between the patches that groups are made for.
    reach_px : int
        How far away similar patches are looked for, each way.
    group : int
        Patches in a group.
    """

    patch_px: int = 6
    stride_px: int = 3
    reach_px: int = 10
    group: int = 40

    def __call__(self, noisy: Picture, pilot: Picture, deviation: float) -> Picture:
        """Return the picture without its noise.

        Raises
        ------
        InputError
            The picture is smaller than a patch.
        ShapeError
            Picture and pilot differ in shape.
        """
        from tofclip.solvers.denoisers.kernels import filter_patch_groups

        if pilot.shape != noisy.shape:
            raise ShapeError("the pilot picture", noisy.shape, pilot.shape)
        if min(noisy.shape) < self.patch_px:
            raise InputError(
                f"a picture of {noisy.shape} is smaller than a patch of {self.patch_px} px"
            )
        settings = (self.patch_px, self.stride_px, self.reach_px, self.group)
        seen = np.ascontiguousarray(noisy, np.float32)
        clean = filter_patch_groups(
            seen, np.ascontiguousarray(pilot, np.float32), np.float32(deviation), settings
        )
        return np.asarray(clean, noisy.dtype)
