"""ToF-CLIP: compact light-field photography with time of flight.

Conventions, used everywhere: SI units in public signatures (pixels or bins only where a name ends
in ``_px`` or ``_bin``); float32 arrays unless float64 is asked for; transient cubes are ``(time, y,
x)`` with y pointing down; shear s in pixels per view step, negative for near objects.
"""

import lazy_loader as lazy

# `__init__.pyi` beside this file lists the public names.
__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
