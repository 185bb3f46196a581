# The public names of this package and their homes; they are imported on first use.

from .recovering import CloudSettings as CloudSettings
from .recovering import RangingPlan as RangingPlan
from .recovering import RangingSettings as RangingSettings
from .recovering import RecoverySettings as RecoverySettings
from .recovering import Shot as Shot
from .recovering import expand_sweep as expand_sweep
from .recovering import is_sequence as is_sequence
from .recovering import list_files as list_files
from .recovering import list_shots as list_shots
from .streaming import CloudPipeline as CloudPipeline
from .streaming import make_pipeline as make_pipeline
