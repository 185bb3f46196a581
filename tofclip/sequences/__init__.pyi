# The public names of this package and their homes; they are imported on first use.

from .inputs import Shot as Shot
from .inputs import is_sequence as is_sequence
from .inputs import list_files as list_files
from .inputs import list_shots as list_shots
from .ranging import RangingPlan as RangingPlan
from .ranging import RangingSettings as RangingSettings
from .recovering import CloudSettings as CloudSettings
from .recovering import RecoverySettings as RecoverySettings
from .recovering import expand_sweep as expand_sweep
from .streaming import CloudPipeline as CloudPipeline
from .streaming import make_pipeline as make_pipeline
