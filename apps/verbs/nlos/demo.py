"""`tofclip nlos demo`: two hidden characters before a curved wall, imaged quickly, slowly, and without the curve."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from apps.options import AsJson

if TYPE_CHECKING:
    from collections.abc import Mapping

    from apps.nlos.measure import Measured
    from apps.nlos.truth import HiddenTruth
    from nlos import Capture, Grid

WALL, WALL_POINTS = "cylinder", 64
FACET = 0.03
CHARACTERS = (("3", -0.27, 0.9, 0.5), ("D", 0.27, 1.15, 1.0))
"""Text, x and depth in m, and albedo: the nearer one is of grey paper, or it would outshine the other."""

HEIGHT = 0.62
BINS, BIN_WIDTH, JITTER = 480, 32e-12, 25e-12
PEAK_COUNTS, BACKGROUND = 200.0, 0.5
WAVELENGTH, VOXEL = 0.125, 0.012
BOX = ((-0.8, 0.8), (-0.5, 0.5), (0.72, 1.32))


@dataclass(frozen=True)
class DemoRun:
    """Everything that a demonstration made.

    Parameters
    ----------
    capture : Capture
    truth : HiddenTruth
    images : mapping
        By method; ``flat`` is the hybrid method for a wall without its depth.
    """

    capture: Capture
    truth: HiddenTruth
    images: Mapping[str, Measured]


def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the results; made if missing.")] = Path(
        "nlos-demo-output"
    ),
    png: Annotated[
        Path | None, typer.Option(metavar="PNG", help="The picture to write.", show_default="nlos_demo.png in --out")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Of the photon noise.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Hide two characters before a curved wall, simulate what the wall shows, and image them by two methods.

    The hybrid method and back-projection give the same picture; the times are those of this run, on this machine. As if
    the wall were flat, the same signal gives none. Writes capture.h5, hybrid.h5, backprojection.h5 and the picture.

    Example: tofclip nlos demo --out nlos-demo-output
    """
    from apps.figures.nlos_demo import demo_figure
    from apps.figures.style import save
    from apps.files import PICTURE_SUFFIXES, make_folder, require_writable
    from apps.report import report

    started = time.perf_counter()
    make_folder(out)
    picture = out / "nlos_demo.png" if png is None else png
    require_writable(picture, *PICTURE_SUFFIXES)
    run = _run(seed)
    written = [out / f"{name}.h5" for name in ("capture", "hybrid", "backprojection")]
    run.truth.record_with(run.capture).save(written[0])
    for path in written[1:]:
        run.images[path.stem].volume.save(path)
    save(demo_figure(run), picture)
    report({"seed": seed, **_figures(run), "seconds": time.perf_counter() - started}, as_json, [*written, picture])


def _run(seed: int) -> DemoRun:
    """The whole way, from a scene to three images."""
    from apps.files import history
    from apps.nlos.measure import measured
    from nlos import Backprojection, Grid, Hybrid

    capture, truth = _simulated(seed)
    capture = replace(capture, provenance=history({"verb": "nlos demo", "seed": seed}, earlier=capture.provenance))
    grid = Grid.box(*BOX, VOXEL)
    hybrid = Hybrid(WAVELENGTH)
    images = {
        "hybrid": measured("hybrid", hybrid, capture, grid),
        "backprojection": measured("backprojection", Backprojection(WAVELENGTH), capture, grid),
        "flat": measured("as if flat", hybrid, _flattened(capture), grid),
    }
    return DemoRun(capture, truth, images)


def _simulated(seed: int) -> tuple[Capture, HiddenTruth]:
    import numpy as np

    from apps.nlos.scene import spot_on
    from apps.nlos.truth import HiddenTruth
    from nlos.simulate import HiddenScene, Lambert, Surface, counted, relay_wall
    from nlos.time_axis import TimeAxis

    surfaces = [Surface.letters(text, (x, 0.0, z), HEIGHT, FACET, Lambert(albedo)) for text, x, z, albedo in CHARACTERS]
    wall = relay_wall(WALL, WALL_POINTS)
    axis = TimeAxis(BINS, BIN_WIDTH)
    expected = HiddenScene(surfaces).seen_from(wall, spot_on(wall, (0.0, 0.0)), axis, JITTER)
    truth = HiddenTruth(np.concatenate([surface.positions for surface in surfaces]), FACET)
    return counted(expected, PEAK_COUNTS, BACKGROUND, seed), truth


def _flattened(capture: Capture) -> Capture:
    """Take the wall for a plane: the same signals, at points without their depth."""
    wall, laser = capture.wall.copy(), capture.laser.copy()
    wall[..., 2] = laser[..., 2] = 0.0
    return replace(capture, wall=wall, laser=laser)


def _figures(run: DemoRun) -> dict[str, Any]:
    from apps.nlos.measure import truth_figures
    from apps.studies.hidden_scene_adjoint import correlation

    reference = run.images["backprojection"]
    figures: dict[str, Any] = {
        name: {
            **image.costs,
            "correlation": correlation(image.volume, reference.volume),
            **truth_figures(image.volume, run.truth),
        }
        for name, image in run.images.items()
    }
    grid: Grid = reference.volume.grid
    times_faster = reference.seconds / run.images["hybrid"].seconds
    return {"wall_points": len(run.capture.points), "voxels": grid.shape, **figures, "times_faster": times_faster}
