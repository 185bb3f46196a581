"""Sequences: a folder, a glob pattern or an HDF5 stack of shots or frames, turned into as many results.

What is done to one of them stands here once; one file, a sequence here and a sequence on a cluster take the same way.
"""

from tofclip.batch.clouds import Clouds
from tofclip.batch.inputs import FileShot, Shot, StackShot, files_in, is_sequence, shots_in
from tofclip.batch.ranging import Ranging
from tofclip.batch.recovery import Recovery
from tofclip.batch.sweep import variants

__all__ = [
    "Clouds",
    "FileShot",
    "Ranging",
    "Recovery",
    "Shot",
    "StackShot",
    "files_in",
    "is_sequence",
    "shots_in",
    "variants",
]
