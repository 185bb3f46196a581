"""Solvers that know no physics: an operator, a data term and a prior in, pictures out."""

from tofclip.solvers.data_terms import DataTerm, Huber, LeastSquares, Poisson
from tofclip.solvers.direct import Adjoint, LinearInverse, PreparedInverse
from tofclip.solvers.fista import Fista
from tofclip.solvers.iterative import ProximalMethod, Sparse, TotalVariation, Wavelets
from tofclip.solvers.loop import Progress, Result, Stopping, iterate, silent
from tofclip.solvers.method import Method, relative_residual
from tofclip.solvers.plug_and_play import PlugAndPlay, RegularisationByDenoising
from tofclip.solvers.proximal import NonnegativeSparsity, NonnegativeTotalVariation

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
