"""What it gains to deal a line camera's angles evenly over the aperture instead of at random (supplement Note 6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofclip.clip_measurement import Setup, measure
from tofclip.clip_recovery import ClipRecovery
from tofclip.light_field import LightField
from tofclip.metrics import nmse

BORDER_PX = 12
"""Left out of the score on every side."""


@dataclass(frozen=True)
class DealingComparison:
    """Errors of both ways to deal, from readings made from the true views.

    Parameters
    ----------
    sampling_ratios : (ratios,) array
    at_random, evenly : (ratios, seeds) arrays
        NMSE against the shift-and-add picture.
    """

    sampling_ratios: NDArray[np.float64]
    at_random: NDArray[np.float64]
    evenly: NDArray[np.float64]


def compare_dealing(
    light_field: LightField,
    shear: float,
    sampling_ratios: Sequence[float] = (2.0, 1.0, 0.5, 0.25),
    seeds: Sequence[int] = range(5),
    recovery: ClipRecovery | None = None,
) -> DealingComparison:
    """Measure with either camera, recover, and compare with the true views' refocused picture.

    Parameters
    ----------
    light_field : LightField
    shear : float
        Depth to refocus on, pixels per view step.
    sampling_ratios, seeds : sequences
    recovery : ClipRecovery, optional
        The default is total variation with an automatic weight.
    """
    method = ClipRecovery() if recovery is None else recovery
    truth = light_field.refocus(shear)

    def error(encoder: str, ratio: float, seed: int) -> float:
        picture = method.recover(measure(light_field, Setup(encoder, ratio, seed)), shear).picture
        return nmse(picture, truth, BORDER_PX)

    found = {
        encoder: np.array([[error(encoder, ratio, seed) for seed in seeds] for ratio in sampling_ratios])
        for encoder in ("line", "line-spread")
    }
    return DealingComparison(np.array(sampling_ratios, np.float64), found["line"], found["line-spread"])
