"""`tofclip demo`: simulate a shot, calibrate from it, recover it, and compare with the truth."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from apps.conventions import JsonOption, build_provenance, make_folder, report
from apps.figures.demo import make_demo_figure
from apps.figures.style import save_figure
from apps.progress import show_progress
from tofclip.lidar import depth, point_cloud
from tofclip.metrics import nmse
from tofclip.recovery import open_shot, plan_recovery
from tofclip.simulate import (
    make_default_instrument,
    make_default_scene,
    make_nominal_camera,
    render_true_frames,
    score_returns,
    simulate_shot,
)

if TYPE_CHECKING:
    from tofclip.lidar import PointCloud, Returns
    from tofclip.shots import Frames, Streak
    from tofclip.simulate import SimulatedShot

BORDER_PX = 12  # views leave the slit there, so the picture's rim is not scored


def demo(
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder for the results; made if missing.")
    ] = Path("demo-output"),
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Of the photon noise.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Simulate a scene of letters and plates, recover it from one streak image, and compare with
    the truth.

    Skew, gains and slit centres are found from the shot itself. Surfaces are recovered from the whole shot at
    once; the picture shows them beside total variation of each frame. Writes streak.h5, frames.h5,
    cloud.ply and preview.png. The first run on a machine compiles the loops that it needs, once.

    Example: tofclip demo --out demo-output
    """
    started = time.perf_counter()
    make_folder(out)
    run = _run_demo(seed)
    written = [out / name for name in ("streak.h5", "frames.h5", "cloud.ply", "preview.png")]
    run.streak.save(written[0])
    run.frames.save(written[1])
    run.cloud.save(written[2])
    save_figure(
        make_demo_figure(
            run.streak, run.frames, run.returns, run.cloud, run.shot.truth, run.compared
        ),
        written[3],
    )
    report(
        {"seed": seed, **_collect_metrics(run), "seconds": time.perf_counter() - started},
        as_json,
        written,
    )


@dataclass(frozen=True)
class DemoRun:
    """Everything that a demonstration made, and the truth behind it."""

    shot: SimulatedShot
    truth: Frames
    streak: Streak
    frames: Frames
    compared: Frames
    returns: Returns
    cloud: PointCloud


def _run_demo(seed: int) -> DemoRun:
    """The whole way, from a scene to a point cloud."""
    scene, instrument = make_default_scene(), make_default_instrument()
    shot = simulate_shot(scene, instrument, seed)
    streak = replace(shot.streak, camera=make_nominal_camera(shot.camera))
    surfaces = plan_recovery(open_shot(streak), "surfaces")
    with show_progress("recovering", surfaces.work) as advance:
        frames = surfaces.run(advance)
    # The sweep found by the first recovery serves the second, so that only the methods differ.
    by_frames = plan_recovery(open_shot(streak, frames.camera))
    with show_progress("for comparison", by_frames.work) as advance:
        compared = by_frames.run(advance)
    frames = replace(
        frames,
        provenance=build_provenance({"verb": "demo", "seed": seed}, earlier=frames.provenance),
    )
    returns = depth(frames) if frames.returns is None else frames.returns
    truth = render_true_frames(scene, instrument, shot.exposure)
    return DemoRun(shot, truth, streak, frames, compared, returns, point_cloud(returns))


def _collect_metrics(run: DemoRun) -> dict[str, Any]:
    # Light of all instants together: the picture a camera without time of flight would take.
    picture, truth = run.frames.values.sum(axis=0), run.truth.values.sum(axis=0)
    return {
        **score_returns(run.returns, run.shot.truth),
        "image_nmse": nmse(picture, truth),
        "image_nmse_inner": nmse(picture, truth, BORDER_PX),
        "relative_residual": run.frames.figures["relative_residual"],
        "points": len(run.cloud),
    }
