# The public names of this package and their homes; they are imported on first use.

from .backprojection import Backprojection as Backprojection
from .capture import Capture as Capture
from .confocal.light_cone import LightCone as LightCone
from .confocal.migration import FKMigration as FKMigration
from .filtered import FilteredBackprojection as FilteredBackprojection
from .geometry import Grid as Grid
from .hybrid import Hybrid as Hybrid
from .method import Method as Method
from .method import Plan as Plan
from .propagation.propagate import propagate as propagate
from .refinement.refine import Refinement as Refinement
from .rsd.planar import PlanarRSD as PlanarRSD
from .settings import Settings as Settings
from .settings import settings_for as settings_for
from .video import TransientImaging as TransientImaging
from .video import TransientVideo as TransientVideo
from .volume import Volume as Volume
