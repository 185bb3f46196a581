"""The adjoint's images of an office at three exposures and two sampling ratios (supplement Note 13,
Fig. 20 d-f).

``python -m apps.studies.hidden_scene_adjoint`` prints the table; ``--write docs/nlos.md`` puts it
there, between the marks.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nlos.capture import Capture, TimeAxis
from nlos.compressed import AdjointImaging, CompressedCapture
from nlos.method import Method
from nlos.phasor.plan import PlanarRSD
from nlos.simulate import HiddenScene, Lambert, Surface, add_poisson_noise, build_relay_wall
from nlos.volume import Grid, Volume
from tofclip.errors import InputError
from tofclip.files import atomic_path, translate_read_errors
from tofclip.operators import RadonProjection
from tofclip.solvers import Backprojection, LinearInverse

# largest count in the data set at each exposure, as Note 13 gives them
EXPOSURES = {"20 ms": 19.0, "5 ms": 15.0, "1 ms": 6.0}
SAMPLING_RATIOS = (0.1, 0.05)
WAVELENGTH_M, CYCLES = 0.12, 5.0
THRESHOLD = 0.15
PEAK_FRACTION = 0.1  # of the brightest: what is expected to be weaker is never the largest
BISECTION_STEPS = 12
DOCUMENT_MARK = "<!-- adjoint study -->"


@dataclass(frozen=True)
class StudyRow:
    """What one exposure and sampling ratio give."""

    exposure: str
    largest_count: float
    sampling_ratio: float
    # correlation of the front view with that of all wall points at the same exposure
    adjoint: float  # recovered by the adjoint
    cut: float  # the same, both volumes cut off at the threshold
    linear: float  # recovered by the linear inverse
    full: float  # correlation of that reference itself with the noiseless one


def build_office(spacing: float = 0.06) -> HiddenScene:
    """Build a shelf with boards, a chair, a box and two letters, 1 to 2.1 m from the wall."""
    boards = [
        Surface.rectangle([-0.55, y, 1.45], (0.5, 0.07), spacing, Lambert(0.8))
        for y in (-0.6, -0.2, 0.2, 0.6)
    ]
    posts = [
        Surface.rectangle([x, 0.0, 1.45], (0.06, 1.27), spacing, Lambert(0.8))
        for x in (-0.83, -0.27)
    ]
    seat = Surface.rectangle([0.45, 0.25, 1.1], (0.45, 0.09), spacing, Lambert(0.3))
    legs = [
        Surface.rectangle([x, 0.5, 1.1], (0.06, 0.4), spacing, Lambert(0.3)) for x in (0.27, 0.63)
    ]
    back = Surface.rectangle([0.63, -0.05, 1.12], (0.07, 0.5), spacing, Lambert(0.3))
    sign = Surface.letters("44", [0.35, -0.6, 1.9], 0.55, spacing, Lambert(1.0))
    return HiddenScene([*boards, *posts, seat, *legs, back, sign])


def simulate_office(points: int = 96) -> Capture:
    """Simulate the office without noise: one laser spot, a planar wall of 2 m, bins of 32 ps."""
    wall = build_relay_wall("planar", points)
    return build_office().simulate_capture(
        wall, [0.0, 0.0, 0.0], TimeAxis(512, 32e-12, 0.0), 35e-12
    )


def build_office_grid() -> Grid:
    """Voxels of 2.5 cm around the office."""
    return Grid.box((-1.0, 1.0), (-1.0, 1.0), (0.9, 2.1), 0.025)


def build_tomography(points: int, sampling_ratio: float) -> RadonProjection:
    """Line projections of a picture at ``sampling_ratio * points`` angles, evenly over half a turn:
    (points, points) to (angles * points,).
    """
    angles = round(sampling_ratio * points)
    if angles < 1:
        raise InputError(
            f"a sampling ratio of {sampling_ratio} leaves no projection of {points} x {points} points"
        )
    return RadonProjection(
        (points, points), points, np.pi * np.arange(angles) / angles, np.zeros(angles)
    )


def find_expected_peak(capture: Capture, largest_count: float, seed: int) -> float:
    """Expected counts in the brightest bin for which chance makes `largest_count` the largest count
    of all. With millions of measurements the largest count lies far above the largest expected one:
    6 where that is about 1. Found by bisection; `capture`: expected signal, of any scale.
    """
    relative = capture.signal / capture.signal.max()
    relative = relative[relative > PEAK_FRACTION]
    low, high = 0.0, largest_count
    for _ in range(BISECTION_STEPS):
        middle = (low + high) / 2
        reached = np.random.default_rng(seed).poisson(relative * middle).max() >= largest_count
        low, high = (low, middle) if reached else (middle, high)
    return high


def correlate_views(one: Volume, other: Volume) -> float:
    """Pearson correlation of two volumes' front views, on grids of the same lateral shape."""
    first, second = (volume.maximum_projection().brightness.ravel() for volume in (one, other))
    return float(np.corrcoef(first, second)[0, 1])


def run_study(capture: Capture, grid: Grid, solver: Method, seed: int = 0) -> list[StudyRow]:
    """Image a noiseless capture, of as many rows as columns, at every exposure and sampling ratio.
    The photons of the reference and of the compressed measurements are independent.
    """
    # Without noise: what more light could reach at best.
    clean = solver.reconstruct(capture, grid)
    rows = []
    for exposure, largest_count in EXPOSURES.items():
        peak = find_expected_peak(capture, largest_count, seed)
        # Two exposures of one scene: noise that both shared would correlate the images by itself.
        reference, compressible = (
            add_poisson_noise(capture, peak, seed=2 * seed + number) for number in range(2)
        )
        # All points at the same exposure: what compression is measured against.
        full = solver.reconstruct(reference, grid)
        for ratio in SAMPLING_RATIOS:
            compressed = CompressedCapture.of(
                compressible, build_tomography(capture.signal.shape[1], ratio)
            )
            adjoint, linear = (
                AdjointImaging(solver, method, 0.0).reconstruct(compressed, grid)
                for method in (Backprojection(), LinearInverse())
            )
            pairs = (
                (adjoint, full),
                (adjoint.threshold(THRESHOLD), full.threshold(THRESHOLD)),
                (linear, full),
                (full, clean),
            )
            agreements = (correlate_views(*pair) for pair in pairs)
            rows.append(StudyRow(exposure, largest_count, ratio, *agreements))
    return rows


def format_table(rows: Sequence[StudyRow]) -> str:
    """Set the rows in Markdown."""
    lines = [
        f"| exposure | largest count | SR | adjoint | adjoint, cut at {THRESHOLD} | linear inverse | all points |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r.exposure} | {r.largest_count:.0f} | {r.sampling_ratio} "
        f"| {r.adjoint:.2f} | {r.cut:.2f} | {r.linear:.2f} | {r.full:.2f} |"
        for r in rows
    ]
    return "\n".join(lines) + "\n"


def replace_between_marks(text: str, document: Path) -> None:
    """Replace what stands between the two marks of a document."""
    with translate_read_errors(document):
        parts = document.read_text().split(DOCUMENT_MARK)
    # Two marks cut the text into three parts.
    if len(parts) != 3:
        raise InputError(f"{document} must hold the mark {DOCUMENT_MARK} twice")
    with atomic_path(document) as temporary:
        temporary.write_text(f"{parts[0]}{DOCUMENT_MARK}\n{text}{DOCUMENT_MARK}{parts[2]}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(
        description="Images of an office by the adjoint, over exposures and SR."
    )
    parser.add_argument(
        "--write", type=Path, metavar="MARKDOWN", help="put the table between this document's marks"
    )
    document = parser.parse_args(arguments).write
    result = format_table(
        run_study(simulate_office(), build_office_grid(), PlanarRSD(WAVELENGTH_M, CYCLES))
    )
    print(result)
    if document is not None:
        replace_between_marks(result, document)


if __name__ == "__main__":
    main()
