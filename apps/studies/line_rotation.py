"""Coded lines upright and rotated (Supp. Fig. 5h, i)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from apps.studies.cases import run_in_parallel
from apps.studies.coded_line import (
    MAX_ANGLE_RAD,
    compute_psnr_db,
    make_coded_line_sensors,
    recover_picture,
)
from apps.studies.library import Library
from apps.studies.outcome import Advance, Outcome, Panel, Row, Study
from tofclip.light_field import LightField

WIDTHS_PX = (1, 2, 4, 8, 16, 32, 64)
LINES = 10
SCENE = "printed-letters"
MAX_ANGLES_RAD = {"upright": 0.0, "rotated": MAX_ANGLE_RAD}


def run_line_rotation(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Recover letters through ten coded lines of several widths, with and without rotation.

    Parameters
    ----------
    library : Library
        Light fields and recordings by name.
    seeds : int
        Repeats with other random numbers.
    advance : callable
        Called with the number of steps just done.

    Returns
    -------
    Outcome
        A row of figures for each case, and the pictures to show.
    """
    picture = _make_reference(library.light_field(SCENE))
    shape = (picture.shape[0], picture.shape[1])

    def one(job: tuple[int, float, int]) -> tuple[float, Panel]:
        width, angle, seed = job
        found = recover_picture(picture, make_coded_line_sensors(shape, LINES, width, angle, seed))
        advance(1)
        decibel = compute_psnr_db(found, picture)
        return decibel, Panel(f"{width} px wide\n{decibel:.1f} dB", found)

    arms = [(width, arm) for arm in MAX_ANGLES_RAD for width in WIDTHS_PX]
    found = run_in_parallel(
        one, [(width, MAX_ANGLES_RAD[arm], seed) for width, arm in arms for seed in range(seeds)]
    )
    by_arm = [found[number * seeds : (number + 1) * seeds] for number in range(len(arms))]
    rows = tuple(
        Row((arm, str(width)), tuple(decibel for decibel, _ in some))
        for (width, arm), some in zip(arms, by_arm, strict=True)
    )
    shown = [some[0][1] for some in by_arm]
    half = len(WIDTHS_PX)
    panels = (
        (Panel("true; right: upright", picture), *shown[:half]),
        (Panel("true; right: rotated", picture), *shown[half:]),
    )
    return Outcome(("lines", "N_p, px"), "PSNR, dB", rows, panels)


def _make_reference(light_field: LightField) -> NDArray[Any]:
    """The view (0, 0), halved on both axes, its brightest pixel 1."""
    picture = light_field.pictures[int(np.argmin((light_field.views**2).sum(axis=1)))]
    rows, columns = (side // 2 for side in picture.shape)
    halved: NDArray[Any] = (
        picture[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2).mean(axis=(1, 3))
    )
    bright: NDArray[Any] = halved / halved.max()
    return bright


STUDY = Study(
    "fig5",
    (),
    "Ten coded lines, upright and rotated over -45 to 45 degrees",
    "The paper has a plot: rotation gains more than 4 dB at every width. Pictures here are halved to 64 x 64.",
    10,
    2 * len(WIDTHS_PX),
    run_line_rotation,
)
