"""Sequences: a folder, a glob pattern or an HDF5 stack of shots or frames, turned into as many results.

What is done to one of them stands here once; one file, a sequence here and a sequence on a cluster take the same way.
"""

from tofclip.sequences.clouds import Clouds
from tofclip.sequences.inputs import FileShot, Shot, StackShot, files_in, is_sequence, shots_in
from tofclip.sequences.ranging import Ranging
from tofclip.sequences.recovering import Recovery
from tofclip.sequences.sweep import variants

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
