"""How hidden surfaces scatter light: bidirectional reflectance for an incoming and an outgoing
direction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tofclip.errors import InputError


class Material(Protocol):
    """Reflectance ``diffuse / pi + retro * exp(-angle^2 / (2 * spread^2)) / (2 * pi * spread^2)``
    per steradian.

    `angle` is that between the directions towards the light and towards the observer.
    """

    @property
    def diffuse(self) -> float:
        """Share of light that is scattered evenly (Lambert's law)."""
        ...

    @property
    def retro(self) -> float:
        """Share that goes back to where it came from."""
        ...

    @property
    def spread(self) -> float:
        """Standard deviation of the latter about the way back, rad."""
        ...


@dataclass(frozen=True)
class Lambert:
    """Scatters evenly: paper, plaster, cloth.

    Parameters
    ----------
    albedo : float
        Share of light that comes back, 0 to 1.
    """

    albedo: float = 1.0

    def __post_init__(self) -> None:
        _require_albedo(self.albedo)

    @property
    def diffuse(self) -> float:
        return self.albedo

    @property
    def retro(self) -> float:
        return 0.0

    @property
    def spread(self) -> float:
        return 1.0


@dataclass(frozen=True)
class Retroreflector:
    """Sends light back to where it came from: traffic signs, safety vests.

    Parameters
    ----------
    albedo : float
        Share of light that comes back, 0 to 1.
    spread : float
        Standard deviation about the way back, rad.
    """

    albedo: float = 1.0
    spread: float = 0.1

    def __post_init__(self) -> None:
        _require_albedo(self.albedo)
        if not (np.isfinite(self.spread) and self.spread > 0):
            raise InputError(
                f"the spread of a retroreflector must be a positive angle, got {self.spread}"
            )

    @property
    def diffuse(self) -> float:
        return 0.0

    @property
    def retro(self) -> float:
        return self.albedo


def _require_albedo(albedo: float) -> None:
    if not 0 <= albedo <= 1:
        raise InputError(f"an albedo is a share between 0 and 1, got {albedo}")
