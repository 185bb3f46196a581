"""Non-local means."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofclip.solvers.denoisers.denoiser import Picture


@dataclass(frozen=True)
class NonlocalMeans:
    """Means over patches that look alike (scikit-image).

    A. Buades, B. Coll, J.-M. Morel, CVPR 2005, 60.

    Parameters
    ----------
    patch_px : int
        Side of a patch.
    reach_px : int
        How far away patches are looked for, each way.
    filtering : float
        Decay of a patch's say with its distance, over the noise's deviation.
    """

    patch_px: int = 5
    reach_px: int = 10
    filtering: float = 0.6

    def __call__(self, noisy: Picture, pilot: Picture, deviation: float) -> Picture:
        """Return the picture without its noise; the pilot is not needed."""
        from skimage.restoration import denoise_nl_means

        clean: Picture = denoise_nl_means(
            noisy,
            patch_size=self.patch_px,
            patch_distance=self.reach_px,
            h=self.filtering * deviation,
            sigma=deviation,
            fast_mode=True,
        )
        return np.asarray(clean, noisy.dtype)
