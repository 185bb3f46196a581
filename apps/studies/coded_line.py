"""Coded lines for 1D sensors (supplement Note 4): why one slice is not enough, and what rotating
the lines gains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError
from tofclip.operators.coded_lines import SliceConvolution, make_coded_line
from tofclip.solvers import TotalVariation

MAX_ANGLE_RAD = np.pi / 4
TV_WEIGHTS = (1e-3, 3e-4, 1e-4)
"""Regularisations tried for each recovery, relative to the largest A'f."""
ITERATIONS, RELATIVE_CHANGE = 800, 1e-5


@dataclass(frozen=True)
class RotationSweep:
    """Quality of recovery over the width of coded lines.

    Parameters
    ----------
    widths_px : (widths,) array
        N_p.
    upright_db, rotated_db : (widths, seeds) arrays
        PSNR with all lines upright, and with their angles evenly from -45 to 45 degrees.
    """

    widths_px: NDArray[np.int64]
    upright_db: NDArray[np.float64]
    rotated_db: NDArray[np.float64]

    @property
    def gain_db(self) -> NDArray[np.float64]:
        """What rotation gains, (widths, seeds)."""
        return self.rotated_db - self.upright_db


def make_coded_line_sensors(
    image_shape: tuple[int, int], lines: int, width_px: int, steepest: float, seed: int
) -> SliceConvolution:
    """Build 1D sensors behind coded lines, each with a code of its own.

    Parameters
    ----------
    image_shape : (int, int)
    lines : int
        M.
    width_px : int
        N_p.
    steepest : float
        Angles run evenly from minus this to this, rad; 0 keeps all lines upright.
    seed : int

    Returns
    -------
    SliceConvolution
        Its sensors are long enough for lines of 45 degrees from all of the picture, whatever
        `steepest` is.
    """
    random = np.random.default_rng(seed)
    spreads = [
        make_coded_line(image_shape, width_px, angle, random)
        for angle in np.linspace(-steepest, steepest, lines)
    ]
    return SliceConvolution(image_shape, np.stack(spreads), image_shape[0] + image_shape[1])


def compute_column_ranks(sensors: SliceConvolution) -> NDArray[np.int64]:
    """Rank of G_k at every frequency k along the sensor (Eq. 14 to 16).

    A column of the picture's spectrum has as many unknowns as the picture has rows, and only
    rank(G_k) equations: one for a lone slice, whatever its PSF; at most M for M of them.

    Returns
    -------
    (frequencies,) array
    """
    ranks: NDArray[np.int64] = np.linalg.matrix_rank(
        sensors.spectra.astype(np.complex128), rtol=1e-5
    )
    return ranks


def recover_picture(picture: NDArray[Any], sensors: SliceConvolution) -> NDArray[Any]:
    """Measure a picture and recover it with total variation, at the one of `TV_WEIGHTS` that comes
    closest to it.

    Parameters
    ----------
    picture : (rows, columns) array
    sensors : SliceConvolution

    Returns
    -------
    (rows, columns) float32 array
    """
    measurements = sensors(picture)[:, np.newaxis]
    methods = [TotalVariation(weight, ITERATIONS, RELATIVE_CHANGE) for weight in TV_WEIGHTS]
    tried = [method.recover(sensors, measurements).frames[0] for method in methods]
    return max(tried, key=lambda estimate: compute_psnr_db(estimate, picture))


def sweep_rotation(
    picture: NDArray[Any],
    widths_px: Sequence[int] = (1, 2, 4, 8, 32, 128),
    lines: int = 10,
    seeds: Sequence[int] = range(5),
) -> RotationSweep:
    """Recover a picture from upright and from rotated coded lines of several widths (supplement
    Fig. 5h, i).

    Parameters
    ----------
    picture : (rows, columns) array
    widths_px : sequence of int
        N_p.
    lines : int
        M, PSFs and 1D sensors.
    seeds : sequence of int
        Of the codes; both arms of a seed have the same codes.

    Returns
    -------
    RotationSweep
    """
    shape = (picture.shape[0], picture.shape[1])
    found = [
        [
            [
                compute_psnr_db(
                    recover_picture(
                        picture, make_coded_line_sensors(shape, lines, width, angle, seed)
                    ),
                    picture,
                )
                for seed in seeds
            ]
            for width in widths_px
        ]
        for angle in (0.0, MAX_ANGLE_RAD)
    ]
    return RotationSweep(np.array(widths_px), np.array(found[0]), np.array(found[1]))


def compute_psnr_db(estimate: NDArray[Any], truth: NDArray[Any]) -> float:
    """Peak signal-to-noise ratio in dB, relative to the brightest pixel of the truth.

    Parameters
    ----------
    estimate, truth : (rows, columns) array

    Returns
    -------
    float
        dB.

    Raises
    ------
    InputError
        The estimate equals the truth.
    """
    error = float(np.mean((estimate.astype(np.float64) - truth) ** 2))
    if error == 0:
        raise InputError("the estimate is the truth itself: its PSNR is infinite")
    return float(10 * np.log10(float(truth.max()) ** 2 / error))
