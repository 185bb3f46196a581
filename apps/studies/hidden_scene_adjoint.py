"""The adjoint's images of an office at three exposures and two sampling ratios (supplement Note 13,
Fig. 20 d-f).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from apps.studies.cases import Advance, Library, Outcome, Panel, Row, study
from nlos.capture import Capture, TimeAxis
from nlos.compressed import AdjointImaging, CompressedCapture
from nlos.known_scenes import correlate_views
from nlos.method import Method
from nlos.phasor.plan import PlanarRSD
from nlos.simulate import HiddenScene, Lambert, Surface, add_poisson_noise, build_relay_wall
from nlos.volume import Grid, Volume
from tofclip.errors import InputError
from tofclip.operators import RadonProjection
from tofclip.solvers import Backprojection, LinearInverse

# largest count in the data set at each exposure, as Note 13 gives them
EXPOSURES = {"20 ms": 19.0, "5 ms": 15.0, "1 ms": 6.0}
SAMPLING_RATIOS = (0.1, 0.05)
WAVELENGTH_M, CYCLES = 0.12, 5.0
THRESHOLD = 0.15
PEAK_FRACTION = 0.1  # of the brightest: what is expected to be weaker is never the largest
BISECTION_STEPS = 12


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


@study(
    "fig20",
    "note13",
    title="A hidden office straight from compressed measurements",
    note="The paper's office was measured; this one is simulated. Correlations are of front views: of what SR * 96 "
    "line projections give with that of all wall points at the same exposure, and of that with no noise's.",
    weight="none: the adjoint and the linear inverse have no prior",
    seconds=20,
    steps=len(EXPOSURES) * len(SAMPLING_RATIOS),
)
def run_adjoint_imaging(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Image the office at every exposure and sampling ratio."""
    wall, bins = build_relay_wall("planar", 96), TimeAxis(512, 32e-12, 0.0)
    capture = build_office().simulate_capture(wall, [0.0, 0.0, 0.0], bins, 35e-12)
    grid = Grid.box((-1.0, 1.0), (-1.0, 1.0), (0.9, 2.1), 0.025)
    return measure_agreement(capture, grid, PlanarRSD(WAVELENGTH_M, CYCLES), seeds, advance)


def measure_agreement(
    capture: Capture, grid: Grid, solver: Method, seeds: int, advance: Advance
) -> Outcome:
    """Image a noiseless capture, of as many rows as columns, at every exposure and sampling ratio."""
    clean = solver.reconstruct(capture, grid)  # what more light could reach at best
    found: dict[tuple[str, ...], list[float]] = {}
    panels = [[Panel("no noise", clean.maximum_projection().brightness)]]
    for seed in range(seeds):
        for labels, volumes in _image_compressed(capture, grid, solver, seed):
            adjoint, linear, full = volumes
            pairs = {
                "adjoint": (adjoint, full),
                f"adjoint, cut at {THRESHOLD:g}": (
                    adjoint.threshold(THRESHOLD),
                    full.threshold(THRESHOLD),
                ),
                "linear inverse": (linear, full),
                "all points": (full, clean),
            }
            for name, pair in pairs.items():
                found.setdefault((*labels, name), []).append(correlate_views(*pair))
            if seed == 0:
                titles = ("adjoint", "linear inverse", "all points")
                where = f"{labels[0]}, SR = {labels[2]}"
                panels.append(
                    [
                        Panel(f"{where}\n{title}", one.maximum_projection().brightness)
                        for title, one in zip(titles, volumes, strict=True)
                    ]
                )
            advance(1)
    rows = [Row(labels, tuple(values)) for labels, values in found.items()]
    columns = ("exposure", "largest count", "SR", "image")
    return Outcome(columns, "correlation", rows, panels)


def _image_compressed(
    capture: Capture, grid: Grid, solver: Method, seed: int
) -> Iterator[tuple[tuple[str, str, str], tuple[Volume, Volume, Volume]]]:
    """Yield exposure, largest count and sampling ratio, and the images by adjoint, linear inverse and
    all wall points.
    """
    for exposure, largest_count in EXPOSURES.items():
        peak = find_expected_peak(capture, largest_count, seed)
        # Two exposures of one scene: noise that both shared would correlate the images by itself.
        reference, compressible = (
            add_poisson_noise(capture, peak, seed=2 * seed + number) for number in range(2)
        )
        full = solver.reconstruct(reference, grid)
        for ratio in SAMPLING_RATIOS:
            tomography = build_tomography(capture.signal.shape[1], ratio)
            compressed = CompressedCapture.of(compressible, tomography)
            adjoint, linear = (
                AdjointImaging(solver, method, 0.0).reconstruct(compressed, grid)
                for method in (Backprojection(), LinearInverse())
            )
            yield (exposure, f"{largest_count:g}", f"{ratio:g}"), (adjoint, linear, full)
