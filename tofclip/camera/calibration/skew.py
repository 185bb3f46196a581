"""Time skew of the views, read off the shot itself.

Every view sees the same scene, so every view receives the same energy at the same instant: where
the sweep is skewed, its curve of energy versus row is shifted and stretched against the reference
view's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera, SkewSweep, estimate_dark_level, require_width
from tofclip.errors import CalibrationError

FloatArray = NDArray[np.float64]

MAX_OFFSET_FRACTION = 0.08  # of the rows; beyond it a picture's start or end would be lost anyway
TREND_ROWS = (
    40  # slower changes than this are the scene's fall-off with range, not structure to match
)
MIN_CORRELATION = 0.6


@dataclass(frozen=True)
class SkewEstimate:
    """A sweep found from energy curves.

    Parameters
    ----------
    sweep : SkewSweep
    correlations : (views,) array
        Agreement of each view's curve with the reference view's; 1 at the reference.
    """

    sweep: SkewSweep
    correlations: FloatArray


def estimate_skew(counts: NDArray[np.float32], camera: Camera) -> SkewEstimate:
    """Match each view's energy curve to the reference view's by ``row_k = offset_k + (1 +
    stretch_k) * row``.

    Parameters
    ----------
    counts : (rows, columns) array
        Raw streak image.
    camera : Camera
        Its centres say where the views are; the view whose position is nearest 0 is the reference.

    Returns
    -------
    SkewEstimate
        Offsets in rows and stretches, and each view's correlation with the reference view.

    Raises
    ------
    CalibrationError
        A view's curve does not resemble the reference's, or the picture is not as wide as the
        camera's slit.
    """
    curves = _extract_structure(sum_view_energies(counts, camera))
    reference = int(np.argmin(np.abs(camera.view_positions)))
    offsets, stretches, correlations = (
        np.zeros(camera.views),
        np.zeros(camera.views),
        np.ones(camera.views),
    )
    for view in range(camera.views):
        if view != reference:
            offsets[view], stretches[view], correlations[view] = _match_curves(
                curves[view], curves[reference]
            )
    worst = int(np.argmin(correlations))
    if not correlations[worst] > MIN_CORRELATION:
        raise CalibrationError(
            f"view {worst} does not follow the reference view in time (correlation {correlations[worst]:.2f}): "
            "check the slit centres, or give the camera a measured sweep"
        )
    return SkewEstimate(SkewSweep(camera.centres_px, offsets, stretches), correlations)


def sum_view_energies(counts: NDArray[np.float32], camera: Camera) -> FloatArray:
    """Sum of each row over each view's part of the slit, above the dark level; (views, rows).

    `counts` (rows, columns): raw streak image; `camera`: centres of the views, px. Returns (views,
    rows): counts above the dark level.
    """
    require_width(counts, camera)
    # Without its dark level, which would swamp the correlation with a constant.
    signal = counts - np.float32(estimate_dark_level(counts))
    # No wider than half the way to the neighbour, whose light comes at other rows.
    half = min(camera.image_shape[1] // 2, _half_pitch_px(camera))
    edges = [(max(0, round(c) - half), round(c) + half + 1) for c in camera.centres_px]
    return np.array([signal[:, first:last].sum(axis=1, dtype=np.float64) for first, last in edges])


def _half_pitch_px(camera: Camera) -> int:
    """Half the distance between neighbouring views, so that the windows do not overlap."""
    if camera.views == 1:
        return camera.slit_width_px
    return int(np.min(np.diff(np.sort(camera.centres_px)))) // 2


def _extract_structure(energies: FloatArray) -> FloatArray:
    """Compress the range (near objects outshine far ones by 1/r^2) and take the slow trend away."""
    from scipy.ndimage import gaussian_filter1d

    # The root gives bright and dim returns the same noise, so that a single bright one does not
    # decide.
    compressed = np.sqrt(np.maximum(energies, 0))
    detail: FloatArray = compressed - gaussian_filter1d(compressed, TREND_ROWS, axis=1)
    return detail


def _match_curves(curve: FloatArray, reference: FloatArray) -> tuple[float, float, float]:
    """Offset, stretch and correlation that bring `curve` onto `reference`."""
    from scipy.optimize import minimize

    rows = np.arange(reference.size, dtype=np.float64)

    def disagreement(skew: FloatArray) -> float:
        shifted = np.interp(skew[0] + (1 + skew[1]) * rows, rows, curve)
        spread = float(np.std(shifted) * np.std(reference))
        if spread == 0:
            return 1.0
        return -float(np.mean((shifted - shifted.mean()) * (reference - reference.mean()))) / spread

    reach = max(2, round(MAX_OFFSET_FRACTION * rows.size))
    # The correlation has a maximum wherever two returns meet: whole rows first, or the search would
    # stay at the nearest one.
    coarse = min(range(-reach, reach + 1), key=lambda offset: disagreement(np.array([offset, 0.0])))
    # Small enough to stay on the hill that the coarse search found: 3 rows, 1 % of stretch.
    simplex = np.array([[coarse, 0.0], [coarse + 3.0, 0.0], [coarse, 0.01]])
    options = {"initial_simplex": simplex, "xatol": 1e-4, "fatol": 1e-8}
    best = minimize(disagreement, simplex[0], method="Nelder-Mead", options=options)
    return float(best.x[0]), float(best.x[1]), -float(best.fun)
