"""Solvers that know no physics: an operator, a data term and a prior in, pictures out."""

from tofclip.recovery.data_terms import DataTerm, Huber, LeastSquares, Poisson
from tofclip.recovery.direct import Adjoint, LinearInverse, PreparedInverse
from tofclip.recovery.fista import Fista
from tofclip.recovery.iterative import ProximalMethod, Sparse, TotalVariation, Wavelets
from tofclip.recovery.loop import Progress, Result, Stopping, iterate, silent
from tofclip.recovery.method import Method, relative_residual
from tofclip.recovery.plug_and_play import PlugAndPlay, RegularisationByDenoising
from tofclip.recovery.proximal import NonnegativeSparsity, NonnegativeTotalVariation

__all__ = [
    "Adjoint",
    "DataTerm",
    "Fista",
    "Huber",
    "LeastSquares",
    "LinearInverse",
    "Method",
    "NonnegativeSparsity",
    "NonnegativeTotalVariation",
    "PlugAndPlay",
    "Poisson",
    "PreparedInverse",
    "Progress",
    "ProximalMethod",
    "RegularisationByDenoising",
    "Result",
    "Sparse",
    "Stopping",
    "TotalVariation",
    "Wavelets",
    "iterate",
    "relative_residual",
    "silent",
]
