"""Where the inactive region behind an occluder ends (Supp. Fig. 14b): the formula against
recoveries.
"""

from __future__ import annotations

from typing import NamedTuple

from apps.occlusion.probe import DISTANCE_FACTORS, ProbeResult, probe_target
from apps.occlusion.scenes import BASELINE_M, make_upright_bar
from apps.studies.cases import run_in_parallel
from apps.studies.library import Library
from apps.studies.outcome import Advance, Outcome, Panel, Row, Study
from tofclip.occlusion import InactiveRegion
from tofclip.units import MILLIMETRE

WIDTHS_MM = (2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0)
DISTANCES_MM = (30.0, 40.0, 50.0, 60.0)
DISPLAYED_BAR_MM = (6.0, 50.0)


class TargetPosition(NamedTuple):
    """A target: behind which occluder, and how far in lengths of its inactive region."""

    width_mm: float
    distance_mm: float
    factor: float


def run_inactive_region(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Put small targets behind bars of several widths and at several distances, inside the region
    and beyond.

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
    places = [
        TargetPosition(width, distance, factor)
        for width in WIDTHS_MM
        for distance in DISTANCES_MM
        for factor in DISTANCE_FACTORS
    ]

    def probe_position(place: TargetPosition) -> list[ProbeResult]:
        region = InactiveRegion(
            BASELINE_M, place.width_mm * MILLIMETRE, place.distance_mm * MILLIMETRE
        )
        found = []
        for seed in range(seeds):
            found.append(
                probe_target(
                    (make_upright_bar(region.width, region.distance),), region, place.factor, seed
                )
            )
            advance(1)
        return found

    rows, pictures = [], []
    for place, found in zip(places, run_in_parallel(probe_position, places), strict=True):
        length = found[0].distance / MILLIMETRE - place.distance_mm
        said = f"{place.factor:g} l = {length:.1f} mm behind"
        promise = "visible" if found[0].expected_visible else "hidden"
        labels = (f"{place.width_mm:g}", f"{place.distance_mm:g}", said, promise)
        rows.append(Row(labels, tuple(one.correlation for one in found)))
        if place[:2] == DISPLAYED_BAR_MM:
            pictures.append(
                Panel(
                    f"{place.factor:g} l\ncorrelation {found[0].correlation:.2f}", found[0].picture
                )
            )
            pictures += (
                [Panel("without occluder", found[0].truth)]
                if place.factor == DISTANCE_FACTORS[-1]
                else []
            )
    columns = ("occluder's width, mm", "its distance, mm", "target", "the formula says")
    return Outcome(
        columns, "correlation with the target unoccluded", tuple(rows), (tuple(pictures),)
    )


STUDY = Study(
    "fig14",
    ("inactive-region",),
    "Where the inactive region ends",
    "Seven views in a row of 15 mm, a lamp beside each; cast rays, time gate, photon noise. A target is a letter 0.15 "
    "of the occluder's width wide: inside, at 0.8 of the region's length l, all of it is hidden from all views; from "
    "1.2 on the outermost views see all of it. Recovered means a correlation of at least 0.8; 0: no view got "
    "significant light. Exposures give the brightest reading of the target alone 2000 photons, over 20 of background; "
    "the prior's weight is fixed.",
    45,
    len(WIDTHS_MM) * len(DISTANCES_MM) * len(DISTANCE_FACTORS),
    run_inactive_region,
)
