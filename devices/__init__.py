"""Instruments: one interface to those that are connected, recorded or simulated.

::

    with devices.open("sim+timetag://?seed=1") as source:
        for batch in source:
            batch.records      # NumPy structured array, one row per record
    source.stats               # acquired = delivered + unread + dropped_host + lost_device + malformed

    streak = devices.read_transient("sim+linospad2://?seed=1")  # what tofclip.recover takes

Which address opens which instrument is written down in `devices.registry`.
"""

import lazy_loader as lazy

# `__init__.pyi` beside this file lists the public names.
__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
