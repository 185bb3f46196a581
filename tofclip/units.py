"""Physical constants and the few unit factors used where a name says so (``_ps``, ``_mm``,
``_deg``).

Public signatures are in SI units; these factors belong to file formats, command-line flags and axis
labels.
"""

from __future__ import annotations

from typing import Final

SPEED_OF_LIGHT: Final = 299_792_458.0
"""Speed of light in vacuum, m/s (exact)."""

PICOSECOND: Final = 1e-12
NANOSECOND: Final = 1e-9
MILLIMETRE: Final = 1e-3
