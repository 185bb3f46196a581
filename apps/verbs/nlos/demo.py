"""`tofclip nlos demo`: two hidden characters before a curved wall, imaged quickly, slowly, and
without the curve.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from apps.conventions import (
    PICTURE_SUFFIXES,
    JsonOption,
    build_provenance,
    make_folder,
    report,
    require_writable,
)
from apps.figures.nlos_demo import make_demo_figure
from apps.figures.style import save_figure
from apps.nlos.measure import compare_with_truth, measure_imaging
from apps.nlos.scene import find_nearest_wall_point
from apps.nlos.truth import HiddenTruth
from apps.progress import show_activity
from apps.studies.hidden_scene_adjoint import correlate_views
from nlos import Backprojection, Grid, Hybrid
from nlos.capture import TimeAxis
from nlos.simulate import HiddenScene, Lambert, Surface, add_poisson_noise, build_relay_wall

if TYPE_CHECKING:
    from collections.abc import Mapping

    from apps.nlos.measure import MeasuredVolume
    from nlos import Capture

WALL_SHAPE, WALL_POINTS = "cylinder", 64
FACET_M = 0.03
LETTERS = (("3", -0.27, 0.9, 0.5), ("D", 0.27, 1.15, 1.0))
"""Text, x and depth in m, and albedo: the nearer one is of grey paper, or it would outshine the
other.
"""

LETTER_HEIGHT_M = 0.62
BINS, BIN_WIDTH_S, JITTER_S = 480, 32e-12, 25e-12
PEAK_COUNTS, BACKGROUND_COUNTS = 200.0, 0.5
WAVELENGTH_M, VOXEL_M = 0.125, 0.012
BOX_M = ((-0.8, 0.8), (-0.5, 0.5), (0.72, 1.32))


@dataclass(frozen=True)
class DemoRun:
    """Everything that a demonstration made."""

    capture: Capture
    truth: HiddenTruth
    # by method; ``flat`` is the hybrid method for a wall without its depth
    images: Mapping[str, MeasuredVolume]


def demo(
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder for the results; made if missing.")
    ] = Path("nlos-demo-output"),
    png: Annotated[
        Path | None,
        typer.Option(
            metavar="PNG", help="The picture to write.", show_default="nlos_demo.png in --out"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Of the photon noise.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Hide two characters before a curved wall, simulate what the wall shows, and image them by two
    methods.

    The hybrid method and back-projection give the same picture; the times are those of this run, on
    this machine. As if the wall were flat, the same signal gives none. Writes capture.h5,
    hybrid.h5, backprojection.h5 and the picture.

    Example: tofclip nlos demo --out nlos-demo-output
    """
    started = time.perf_counter()
    make_folder(out)
    picture = out / "nlos_demo.png" if png is None else png
    # Before the simulation and three images, which take a while.
    require_writable(picture, *PICTURE_SUFFIXES)
    run = _run_demo(seed)
    written = [out / f"{name}.h5" for name in ("capture", "hybrid", "backprojection")]
    run.truth.attach_to_record(run.capture).save(written[0])
    for path in written[1:]:
        run.images[path.stem].volume.save(path)
    save_figure(make_demo_figure(run), picture)
    report(
        {"seed": seed, **_collect_metrics(run), "seconds": time.perf_counter() - started},
        as_json,
        [*written, picture],
    )


def _run_demo(seed: int) -> DemoRun:
    """The whole way, from a scene to three images."""
    with show_activity("simulating"):
        capture, truth = _simulate_capture(seed)
    capture = replace(
        capture,
        provenance=build_provenance(
            {"verb": "nlos demo", "seed": seed}, earlier=capture.provenance
        ),
    )
    grid = Grid.box(*BOX_M, VOXEL_M)
    hybrid = Hybrid(WAVELENGTH_M)
    images = {
        "hybrid": measure_imaging("hybrid", hybrid, capture, grid),
        "backprojection": measure_imaging(
            "backprojection", Backprojection(WAVELENGTH_M), capture, grid
        ),
        # The same capture with the curve ignored shows what knowing the wall is worth.
        "flat": measure_imaging("as if flat", hybrid, _flatten_wall(capture), grid),
    }
    return DemoRun(capture, truth, images)


def _simulate_capture(seed: int) -> tuple[Capture, HiddenTruth]:
    from apps.nlos.truth import HiddenTruth

    surfaces = [
        Surface.letters(text, (x, 0.0, z), LETTER_HEIGHT_M, FACET_M, Lambert(albedo))
        for text, x, z, albedo in LETTERS
    ]
    wall = build_relay_wall(WALL_SHAPE, WALL_POINTS)
    axis = TimeAxis(BINS, BIN_WIDTH_S)
    expected = HiddenScene(surfaces).simulate_capture(
        wall, find_nearest_wall_point(wall, (0.0, 0.0)), axis, JITTER_S
    )
    truth = HiddenTruth(np.concatenate([surface.positions for surface in surfaces]), FACET_M)
    return add_poisson_noise(expected, PEAK_COUNTS, BACKGROUND_COUNTS, seed), truth


def _flatten_wall(capture: Capture) -> Capture:
    """Take the wall for a plane: the same signals, at points without their depth."""
    # Copies: the curved capture is still needed.
    wall, laser = capture.wall.copy(), capture.laser.copy()
    wall[..., 2] = laser[..., 2] = 0.0
    return replace(capture, wall=wall, laser=laser)


def _collect_metrics(run: DemoRun) -> dict[str, Any]:
    reference = run.images["backprojection"]
    figures: dict[str, Any] = {
        name: {
            **image.costs,
            "correlation": correlate_views(image.volume, reference.volume),
            **compare_with_truth(image.volume, run.truth),
        }
        for name, image in run.images.items()
    }
    grid: Grid = reference.volume.grid
    times_faster = reference.seconds / run.images["hybrid"].seconds
    return {
        "wall_points": len(run.capture.points),
        "voxels": grid.shape,
        **figures,
        "times_faster": times_faster,
    }
