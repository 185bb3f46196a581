"""Files of the instruments, turned once, at this border, into the objects that the other rooms work
with.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
