"""Linear operators: the base with its adjoint, composition and stacking, and the encoders of a
camera.
"""

from tofclip.operators.base import (
    Adjoint,
    BlockDiagonal,
    Composition,
    Diagonal,
    Identity,
    Integration,
    LinearOperator,
    MeanWeighting,
    Reshape,
    Stack,
    ViewSelection,
    estimate_squared_norm,
)
from tofclip.operators.codes import (
    DenseSensor,
    HadamardCodes,
    MaskedSensor,
    MaskedViews,
    PitchedSensor,
    RandomCodes,
    ShearedViews,
    WeightedViews,
)
from tofclip.operators.convolution import PointSpreadConvolution, SliceConvolution
from tofclip.operators.radon import RadonProjection
from tofclip.operators.shear import FourierShear, LinearShear
from tofclip.operators.sparse import LineProjection, SparseMatrix

__all__ = [
    "Adjoint",
    "BlockDiagonal",
    "Composition",
    "DenseSensor",
    "Diagonal",
    "FourierShear",
    "HadamardCodes",
    "Identity",
    "Integration",
    "LineProjection",
    "LinearOperator",
    "LinearShear",
    "MaskedSensor",
    "MaskedViews",
    "MeanWeighting",
    "PitchedSensor",
    "PointSpreadConvolution",
    "RadonProjection",
    "RandomCodes",
    "Reshape",
    "ShearedViews",
    "SliceConvolution",
    "SparseMatrix",
    "Stack",
    "ViewSelection",
    "WeightedViews",
    "estimate_squared_norm",
]
