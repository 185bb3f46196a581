"""Light fields: one picture for each view, refocusing, other viewpoints, depth from focus,
everything in focus.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
