"""Linear operators: the base with its adjoint, composition and stacking, and the encoders of a
camera.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
