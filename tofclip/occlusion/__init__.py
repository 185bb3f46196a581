"""Seeing through occluders: which places no view can see, and what is recovered of the others
(supplement Note 10).

Light that an occluder sends back arrives earlier than what comes from behind it. A time gate takes
it away, and says where the occluder stands, so that the recovery knows which view cannot have seen
what.
"""

from tofclip.occlusion.region import InactiveRegion

__all__ = ["InactiveRegion"]
