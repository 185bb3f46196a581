"""How well returns agree with the truth."""

from __future__ import annotations

import numpy as np
import scipy

from tofclip.errors import InputError, ShapeError
from tofclip.lidar import Returns
from tofclip.simulate.ground_truth import GroundTruth
from tofclip.units import SPEED_OF_LIGHT

MEDIAN_PER_SIGMA = 0.6745
"""Median of the absolute value of a normal variate in units of its deviation."""


def score_returns(returns: Returns, truth: GroundTruth) -> dict[str, float]:
    """Compare each target pixel's most intense return with the true range.

    Parameters
    ----------
    returns : Returns
    truth : GroundTruth

    Returns
    -------
    dict
        ``median_depth_error_m``: median absolute range error of the target pixels that have a
        return; ``share_within_one_bin``: fraction of all target pixels whose return is within ``c *
        bin_width / 2`` of the truth, so that a missing return counts against it;
        ``share_with_return``: fraction of the target pixels that have a return;
        ``false_return_share``: fraction of all returns that lie more than a pixel away from anything
        in the scene; ``range_z``: robust standard deviation of the range errors of the target
        pixels in units of what each return says of its own, 1 if that is true; ``bin_m``: ``c *
        bin_width / 2``.

    Raises
    ------
    ShapeError, InputError
        Another picture size, or no target pixel with a return.
    """
    distance = returns.image("range")
    if distance.shape != truth.range.shape:
        raise ShapeError("the returns' picture", truth.range.shape, distance.shape)
    error = np.abs(distance - truth.range)[truth.target]
    found = np.isfinite(error)
    if not found.any():
        raise InputError("no target pixel of the truth has a return")
    sigma = returns.image("confidence")[truth.target]
    surest = np.finfo(np.float32).tiny
    ratio = error[found] / np.maximum(sigma[found], surest)
    z = float(np.median(ratio) / MEDIAN_PER_SIGMA)
    bin_m = SPEED_OF_LIGHT * truth.bin_width / 2
    # a return beside a border may belong to either side
    near_anything = scipy.ndimage.binary_dilation(np.isfinite(truth.range), np.ones((3, 3)))
    return {
        "median_depth_error_m": float(np.median(error[found])),
        "share_within_one_bin": float(np.mean(error <= bin_m)),
        "share_with_return": float(np.mean(found)),
        "false_return_share": float(np.mean(~near_anything[returns.y, returns.x])),
        "range_z": z,
        "bin_m": bin_m,
    }
