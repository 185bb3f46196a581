"""The camera: where each view lies on the slit, how its lenslet projects, how the sweep bends time,
and how all of this is found from pictures and shots.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
