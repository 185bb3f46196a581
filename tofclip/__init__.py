"""ToF-CLIP: compact light-field photography with time of flight.

Conventions, used everywhere: SI units in public signatures (pixels or bins only where a name ends
in ``_px`` or ``_bin``); float32 arrays unless float64 is asked for; transient cubes are ``(time, y,
x)`` with y pointing down; shear s in pixels per view step, negative for near objects.
"""


def __getattr__(name):
    """Find a public name; `__init__.pyi` beside this file lists them and their homes. What finds
    them is loaded with the first one: the program `tofclip` needs none, and cannot catch a Ctrl-C
    before this package is there.
    """
    import lazy_loader as lazy

    find, list_names, names = lazy.attach_stub(__name__, __file__)
    globals().update(__getattr__=find, __dir__=list_names, __all__=names)
    return names if name == "__all__" else find(name)


def __dir__():
    """List the public names."""
    return sorted(__getattr__("__all__"))
