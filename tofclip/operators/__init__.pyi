# The public names of this package and their homes; they are imported on first use.

from .base import Adjoint as Adjoint
from .base import BlockDiagonal as BlockDiagonal
from .base import Composition as Composition
from .base import DenseSensor as DenseSensor
from .base import Diagonal as Diagonal
from .base import HadamardCodes as HadamardCodes
from .base import Identity as Identity
from .base import Integration as Integration
from .base import LinearOperator as LinearOperator
from .base import LinearShear as LinearShear
from .base import MeanWeighting as MeanWeighting
from .base import PitchedSensor as PitchedSensor
from .base import Reshape as Reshape
from .base import Selection as Selection
from .base import Stack as Stack
from .base import WeightedViews as WeightedViews
from .base import estimate_squared_norm as estimate_squared_norm
from .convolution import PointSpreadConvolution as PointSpreadConvolution
from .convolution import SliceConvolution as SliceConvolution
from .sparse import LineProjection as LineProjection
from .sparse import RadonProjection as RadonProjection
from .sparse import SparseMatrix as SparseMatrix
