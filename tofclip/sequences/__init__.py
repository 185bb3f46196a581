"""Sequences: a folder, a glob pattern or an HDF5 stack of shots or frames, turned into as many
results.

What is done to one of them stands here once; one file, a sequence here and a sequence on a cluster
take the same way.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
