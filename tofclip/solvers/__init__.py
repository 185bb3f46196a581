"""Solvers that know no physics: an operator, a data term and a prior in, pictures out."""

from tofclip.solvers.data_terms import (
    ClippedSquares,
    DataTerm,
    DataTermMaker,
    Huber,
    LeastSquares,
    Poisson,
)
from tofclip.solvers.denoisers import Denoiser
from tofclip.solvers.direct import Backprojection, LinearInverse, PreparedInverse
from tofclip.solvers.fista import (
    Fista,
    NonnegativeSparsity,
    NonnegativeTotalVariation,
    ProximalMethod,
    ProximalStep,
    Regulariser,
    Sparse,
    TotalVariation,
    Wavelets,
)
from tofclip.solvers.method import (
    IterationHistory,
    IterativeSolver,
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
    "ClippedSquares",
    "DataTerm",
    "DataTermMaker",
    "Denoiser",
    "Fista",
    "Huber",
    "IterationHistory",
    "IterativeSolver",
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
    "ProximalStep",
    "RegularisationByDenoising",
    "Regulariser",
    "Result",
    "Sparse",
    "StoppingRule",
    "TotalVariation",
    "Wavelets",
    "ignore_progress",
    "iterate",
    "relative_residual",
]
