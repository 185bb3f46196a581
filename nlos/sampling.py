"""Whether a wall is sampled finely enough for the waves that it is imaged with."""

from __future__ import annotations

import inspect
import warnings

import numpy as np

from nlos.band import Band
from nlos.capture import Capture
from nlos.illumination_groups import is_confocal

PACKAGE = __name__.partition(".")[0]


class AliasingWarning(UserWarning):
    """Wall points lie so far apart that false images of bright things may appear beside them."""


def warn_of_aliasing(capture: Capture, band: Band) -> None:
    """Warn if neighbouring wall points lie more than half the band's shortest wavelength apart.

    In a confocal scan the path grows on both legs from point to point, so that a quarter is the
    limit.

    Parameters
    ----------
    capture : Capture
    band : Band
        Wavenumbers of the virtual pulse.
    """
    shortest = 2 * np.pi / float(band.wavenumbers[-1])
    finest = shortest / 4 if is_confocal(capture) else shortest / 2
    # A wall drawn exactly at the limit must not be warned of for a rounding error.
    if np.isfinite(capture.spacing) and capture.spacing > finest * (1 + 1e-6):
        warnings.warn(
            f"wall points {capture.spacing:.3g} m apart are too coarse for waves of {shortest:.3g} m, the shortest of "
            f"the virtual pulse: false images may appear; use points at most {finest:.3g} m apart, or a wavelength "
            f"{capture.spacing / finest:.2g} times longer",
            AliasingWarning,
            stacklevel=_count_levels_to_caller(),
        )


def _count_levels_to_caller() -> int:
    """How far up the first line stands that is not this package's: what the user wrote."""
    level = 1
    frame = inspect.currentframe()
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] == PACKAGE:
        frame = frame.f_back
        level += 1
    # The first frame here is this function's own, which `warnings` does not see.
    return max(level - 1, 1)
