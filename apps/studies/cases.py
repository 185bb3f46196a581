"""Cases of CLIP: measure the true views of a light field, recover the picture at one depth, score
it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from apps.studies.library import Library
from apps.studies.outcome import Advance, Panel, Row
from tofclip.light_field.measurement import (
    CameraSetup,
    ClipMeasurement,
    corrupt_measurement,
    measure,
)
from tofclip.metrics import nmse
from tofclip.recovery.light_field import ClipRecovery
from tofclip.threads import limit_blas_threads, thread_count

BORDER_PX = 12
"""Pixels that are not scored: views leave the picture there."""

CAMERA_NAMES = {
    "line": "CLIP-1D",
    "line-even": "CLIP-1D, even",
    "single-pixel": "CLIP-0D",
    "diffuser": "CLIP-2D",
}

Job = TypeVar("Job")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Case:
    """One figure of a table.

    Parameters
    ----------
    labels : tuple of str
        Of its row.
    scene : str
        As the library knows it.
    encoder : str
    sampling_ratio, shear : float
    paper : float or None
        NMSE in the paper, per cent.
    bad_fraction : float
    photons : float or None
    white_noise : float
        Standard deviation relative to that of the measurements.
    data_term : str
        Of the recovery.
    """

    labels: tuple[str, ...]
    scene: str
    encoder: str
    sampling_ratio: float
    shear: float
    paper: float | None = None
    bad_fraction: float = 0.0
    photons: float | None = None
    white_noise: float = 0.0
    data_term: str = "squares"


@dataclass(frozen=True)
class SolvedCase:
    """A case with what came out.

    Parameters
    ----------
    case : Case
    percent : tuple of float
        NMSE of each seed.
    picture, truth : (rows, columns) arrays
        The first seed's, and shift-and-add of the true views.
    weight : float
        Of the first seed's prior.
    """

    case: Case
    percent: tuple[float, ...]
    picture: NDArray[Any]
    truth: NDArray[Any]
    weight: float

    def row(self) -> Row:
        """Return the row of the table."""
        return Row(self.case.labels, self.percent, self.case.paper)

    def panel(self, title: str) -> Panel:
        """Return the picture, its error under the title."""
        return Panel(f"{title}\n{np.mean(self.percent):.1f} %", self.picture)


def solve_cases(
    cases: Sequence[Case], library: Library, seeds: int, advance: Advance
) -> list[SolvedCase]:
    """Solve every case for every seed, cases on all cores; advances once for each case and seed.

    The prior's weight is chosen by cross-validation with the first seed, and kept for the others.

    Parameters
    ----------
    cases : sequence of Case
    library : Library
        Light fields by name.
    seeds : int
        Repeats with other cameras and noise.
    advance : callable
        Called with 1 after each case and seed.

    Returns
    -------
    list of SolvedCase
        In the order of the cases.
    """
    truths = {
        (case.scene, case.shear): library.light_field(case.scene).refocus(case.shear)
        for case in cases
    }

    def solve_case(case: Case) -> SolvedCase:
        truth = truths[case.scene, case.shear]
        recovery, found = ClipRecovery(data_term=case.data_term), []
        for seed in range(seeds):
            found.append(recovery.recover(measure_case(case, library, seed), case.shear))
            recovery = replace(recovery, weight=found[0].weight)
            advance(1)
        percent = tuple(100 * nmse(recovered.picture, truth, BORDER_PX) for recovered in found)
        return SolvedCase(case, percent, found[0].picture, truth, found[0].weight)

    return run_in_parallel(solve_case, cases)


def run_in_parallel(work: Callable[[Job], Result], jobs: Sequence[Job]) -> list[Result]:
    """Run independent jobs on all cores, each on one; the first exception is raised and no further
    job started.

    Parameters
    ----------
    work : callable
        From a job to its result; called in threads.
    jobs : sequence

    Returns
    -------
    list
        Results in the order of the jobs.
    """
    pool = ThreadPoolExecutor(min(thread_count(), max(len(jobs), 1)), thread_name_prefix="tofclip")
    try:
        with limit_blas_threads():
            return list(pool.map(work, jobs))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def measure_case(case: Case, library: Library, seed: int) -> ClipMeasurement:
    """Measure the true views as a case asks for.

    Parameters
    ----------
    case : Case
    library : Library
    seed : int
        Of camera and noise.

    Returns
    -------
    ClipMeasurement
    """
    setup = CameraSetup(case.encoder, case.sampling_ratio, seed)
    clean = measure(library.light_field(case.scene), setup)
    # another stream of random numbers than the camera's, which starts from the same seed
    noise = np.random.default_rng([seed, 2]).standard_normal(clean.values.size, np.float32)
    noisy = clean.values + np.float32(case.white_noise) * clean.values.std() * noise
    return corrupt_measurement(replace(clean, values=noisy), case.photons, case.bad_fraction)
