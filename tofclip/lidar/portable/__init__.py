"""The search for returns in frames of other libraries than NumPy, all pixels at once."""

from tofclip.lidar.portable.search import PortableSearch, PortableTraces

__all__ = ["PortableSearch", "PortableTraces"]
