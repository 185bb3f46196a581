"""Denoisers that serve as priors: each takes a picture and the noise to remove, and knows nothing of any camera."""

from tofclip.recovery.denoisers.block_matching import BlockMatching
from tofclip.recovery.denoisers.collaborative import CollaborativeWiener
from tofclip.recovery.denoisers.denoiser import Denoiser
from tofclip.recovery.denoisers.nonlocal_means import NonlocalMeans

__all__ = ["BlockMatching", "CollaborativeWiener", "Denoiser", "NonlocalMeans"]
