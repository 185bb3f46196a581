"""Simulated shots of known scenes: what a streak camera behind a row of lenslets would have
recorded, and the truth.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
