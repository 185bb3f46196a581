"""Sequences: a folder, a glob pattern or an HDF5 stack of shots or frames, turned into as many
results.

What is done to one of them stands here once; one file, a sequence here and a sequence on a cluster
take the same way.
"""

from tofclip.sequences.inputs import FileShot, Shot, StackShot, is_sequence, list_files, list_shots
from tofclip.sequences.ranging import RangingPlan, RangingSettings
from tofclip.sequences.recovering import CloudSettings, RecoverySettings, expand_sweep
from tofclip.sequences.streaming import CloudPipeline, make_pipeline

__all__ = [
    "CloudPipeline",
    "CloudSettings",
    "FileShot",
    "RangingPlan",
    "RangingSettings",
    "RecoverySettings",
    "Shot",
    "StackShot",
    "expand_sweep",
    "is_sequence",
    "list_files",
    "list_shots",
    "make_pipeline",
]
