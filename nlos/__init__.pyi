# The public names of this package and their homes; they are imported on first use.

from .backprojection import Backprojection as Backprojection
from .backprojection import FilteredBackprojection as FilteredBackprojection
from .capture import Capture as Capture
from .confocal import FKMigration as FKMigration
from .confocal import LightCone as LightCone
from .imaging import reconstruct as reconstruct
from .imaging import settings_for as settings_for
from .method import Method as Method
from .method import Plan as Plan
from .phasor.plan import Hybrid as Hybrid
from .phasor.plan import PlanarRSD as PlanarRSD
from .phasor.propagate import propagate as propagate
from .refinement.l1 import Refinement as Refinement
from .settings import Settings as Settings
from .settings import register_method as register_method
from .video import TransientImaging as TransientImaging
from .video import TransientVideo as TransientVideo
from .volume import Grid as Grid
from .volume import Volume as Volume
