"""Linear operators: the base with its adjoint, composition and stacking, and the encoders of a
camera.
"""

from tofclip.operators.base import (
    Adjoint,
    Composition,
    Diagonal,
    Identity,
    LinearOperator,
    Reshape,
    estimate_squared_norm,
)
from tofclip.operators.coded_lines import SliceConvolution
from tofclip.operators.coded_views import MaskedViews, ShearedViews, WeightedViews
from tofclip.operators.composition import (
    BlockDiagonal,
    Integration,
    MeanWeighting,
    Stack,
    ViewSelection,
)
from tofclip.operators.convolution import PointSpreadConvolution
from tofclip.operators.radon import RadonProjection
from tofclip.operators.sensors import DenseSensor, MaskedSensor, PitchedSensor
from tofclip.operators.shear import FourierShear, LinearShear
from tofclip.operators.single_pixel import HadamardCodes, RandomCodes
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
