"""The inactive region: what lies so close behind a solid occluder that no view can see it
(supplement Note 10).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofclip.errors import InputError


@dataclass(frozen=True)
class InactiveRegion:
    """The shadow that a solid occluder on the axis throws, were the whole aperture one lamp: its
    umbra.

    Everything happens in the plane of the axis and the aperture's width. A point is seen from
    somewhere on the aperture exactly if it is seen from one of its ends; hence views that stand at
    both ends and anywhere between see as far as a lens that fills the aperture would.

    Parameters
    ----------
    baseline : float
        L, distance between the outermost views, m.
    width : float
        D, width of the occluder's solid part along the baseline, m.
    distance : float
        d, from the views to the occluder, m.

    Raises
    ------
    InputError
        A length is not positive and finite.
    """

    baseline: float
    width: float
    distance: float

    def __post_init__(self) -> None:
        for name in ("baseline", "width", "distance"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InputError(
                    f"the {name} must be a positive length, got {getattr(self, name)} m"
                )

    @property
    def is_bounded(self) -> bool:
        """Whether anything behind the occluder's middle is promised to be seen: D < L."""
        return self.width < self.baseline

    @property
    def length(self) -> float:
        """How far the region reaches behind the occluder, m: ``l_d = d D / (L - D)``; infinite
        where D >= L.
        """
        if not self.is_bounded:
            return float("inf")
        return self.distance * self.width / (self.baseline - self.width)

    def sees(self, place: ArrayLike, across: ArrayLike, behind: ArrayLike) -> NDArray[Any]:
        """Return whether the line of sight passes the occluder.

        Parameters
        ----------
        place : array
            Of a view on the aperture, m from the axis.
        across, behind : arrays
            A point: m from the axis, and m behind the occluder. All three are broadcast.

        Returns
        -------
        bool array
            Of the broadcast shape.
        """
        behind = np.asarray(behind, np.float64)
        passed = np.asarray(across) * self.distance + np.asarray(place) * behind
        seen: NDArray[Any] = 2 * abs(passed) >= self.width * (self.distance + behind)
        return seen

    def contains(self, across: ArrayLike, behind: ArrayLike) -> NDArray[Any]:
        """Return whether a point is hidden from the whole aperture.

        Parameters
        ----------
        across, behind : array_like
            As in `sees`, metres.

        Returns
        -------
        bool array
        """
        # a convex occluder on the axis hides a point from the whole aperture if it hides it from
        # both ends
        left, right = (self.sees(end * self.baseline / 2, across, behind) for end in (-1, 1))
        hidden: NDArray[Any] = ~(left | right)
        return hidden
