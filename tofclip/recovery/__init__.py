"""Solvers that know no physics: an operator, a data term and a prior in, pictures out."""

from tofclip.recovery.data_terms import LeastSquares
from tofclip.recovery.direct import Adjoint, LinearInverse, PreparedInverse
from tofclip.recovery.fista import Fista
from tofclip.recovery.iterative import Sparse, TotalVariation
from tofclip.recovery.loop import Progress, Result, Stopping, iterate, silent
from tofclip.recovery.method import Method, relative_residual
from tofclip.recovery.proximal import NonnegativeSparsity, NonnegativeTotalVariation

__all__ = [
    "Adjoint",
    "Fista",
    "LeastSquares",
    "LinearInverse",
    "Method",
    "NonnegativeSparsity",
    "NonnegativeTotalVariation",
    "PreparedInverse",
    "Progress",
    "Result",
    "Sparse",
    "Stopping",
    "TotalVariation",
    "iterate",
    "relative_residual",
    "silent",
]
