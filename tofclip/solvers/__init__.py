"""Solvers that know no physics: an operator, a data term and a prior in, pictures out."""

from tofclip.solvers.data_terms import DataTerm, Huber, LeastSquares, Poisson
from tofclip.solvers.direct import Backprojection, LinearInverse, PreparedInverse
from tofclip.solvers.fista import (
    Fista,
    NonnegativeSparsity,
    NonnegativeTotalVariation,
    ProximalMethod,
    Sparse,
    TotalVariation,
    Wavelets,
)
from tofclip.solvers.method import (
    Method,
    Progress,
    Result,
    StoppingRule,
    ignore_progress,
    iterate,
    relative_residual,
)
from tofclip.solvers.plug_and_play import PlugAndPlay, RegularisationByDenoising

__all__ = [
    "Backprojection",
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
    "StoppingRule",
    "TotalVariation",
    "Wavelets",
    "ignore_progress",
    "iterate",
    "relative_residual",
]
