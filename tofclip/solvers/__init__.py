"""Solvers that know no physics: an operator, a data term and a prior in, pictures out."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
