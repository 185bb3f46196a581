"""Linear operators: the base with its adjoint, composition and stacking, and the encoders of a camera."""

from tofclip.operators.base import (
    Adjoint,
    Composition,
    Diagonal,
    LinearOperator,
    Stack,
    squared_norm,
)
from tofclip.operators.projection import LineProjection
from tofclip.operators.sparse import SparseMatrix

__all__ = [
    "Adjoint",
    "Composition",
    "Diagonal",
    "LineProjection",
    "LinearOperator",
    "SparseMatrix",
    "Stack",
    "squared_norm",
]
