"""Physical constants and the few unit factors used where a name says so (``_ps``, ``_mm``,
``_deg``).

Public signatures are in SI units; these factors belong to file formats, command-line flags and axis
labels.
"""

from __future__ import annotations

from typing import Final

from tofclip.errors import InputError

SPEED_OF_LIGHT: Final = 299_792_458.0
"""Speed of light in vacuum, m/s (exact)."""

PICOSECOND: Final = 1e-12
NANOSECOND: Final = 1e-9
MILLIMETRE: Final = 1e-3

FWHM_PER_SIGMA: Final = 2.354820045030949  # of a Gaussian: 2 sqrt(2 ln 2)
# of Gaussian numbers: standard deviation over median absolute deviation
MAD_TO_SIGMA: Final = 1.4826

MIN_BIN_WIDTH_S = 1e-15
MAX_BIN_WIDTH_S = 1e-7
"""s; shortest and longest credible time bin of a picture of ranges: 0.3 um and 30 m of path."""


def require_credible_bin_width(
    bin_width: float, shortest: float = MIN_BIN_WIDTH_S, longest: float = MAX_BIN_WIDTH_S
) -> None:
    """Refuse a time bin, s, that was not given in seconds."""
    if not shortest <= bin_width <= longest:
        raise InputError(
            f"a bin width of {bin_width:g} s is not credible; check the unit of `bin_width` "
            "(16 ps are 16e-12 s)"
        )
