"""Denoisers that serve as priors: each takes a picture and the noise to remove, and knows nothing
of any camera.
"""

from tofclip.solvers.denoisers.block_matching import BlockMatching
from tofclip.solvers.denoisers.collaborative import CollaborativeWiener
from tofclip.solvers.denoisers.denoiser import Denoiser
from tofclip.solvers.denoisers.nonlocal_means import NonlocalMeans

__all__ = ["BlockMatching", "CollaborativeWiener", "Denoiser", "NonlocalMeans"]
