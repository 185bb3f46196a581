"""`tofclip demo`: simulate a shot, calibrate from it, recover it, and compare with the truth."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from apps.options import JSON, SEED, opt
from apps.progress import show_progress
from apps.report import build_provenance, make_folder, report, require_new

BORDER_PX = 12  # views leave the slit there, so the picture's rim is not scored


def demo(
    out: Path = opt("DIR", "Folder for the results; made if missing.", Path("demo-output")),
    seed: int = SEED,
    as_json: bool = JSON,
) -> None:
    """Simulate a scene of letters and plates, recover it from one streak image, and compare with
    the truth.

    Skew, gains and slit centres are found from the shot itself. Surfaces are recovered from the whole shot at
    once; the picture shows them beside total variation of each frame. Writes streak.h5, frames.h5,
    cloud.ply and preview.png. The first run on a machine compiles the loops that it needs, once.

    Example: tofclip demo --out demo-output
    """
    from apps.figures.shot import make_demo_figure
    from tofclip.lidar import depth, point_cloud
    from tofclip.metrics import nmse
    from tofclip.notebook import save_figure
    from tofclip.recovery import open_shot, plan_recovery
    from tofclip.simulate import (
        make_default_instrument,
        make_default_scene,
        make_nominal_camera,
        render_true_frames,
        score_returns,
        simulate_shot,
    )

    started = time.perf_counter()
    make_folder(out)
    written = [out / name for name in ("streak.h5", "frames.h5", "cloud.ply", "preview.png")]
    require_new(*written)
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
    past = build_provenance({"verb": "demo", "seed": seed}, earlier=frames.provenance)
    frames = replace(frames, provenance=past)
    returns = depth(frames)
    cloud = point_cloud(returns)
    streak.save(written[0])
    frames.save(written[1])
    cloud.save(written[2])
    figure = make_demo_figure(streak, frames, returns, cloud, shot.truth, compared)
    save_figure(figure, written[3])
    # Light of all instants together: the picture a camera without time of flight would take.
    picture = frames.values.sum(axis=0)
    truth = render_true_frames(scene, instrument, shot.exposure).values.sum(axis=0)
    figures = {
        "seed": seed,
        **score_returns(returns, shot.truth),
        "image_nmse": nmse(picture, truth),
        "image_nmse_inner": nmse(picture, truth, BORDER_PX),
        "relative_residual": frames.figures["relative_residual"],
        "points": len(cloud),
        "seconds": time.perf_counter() - started,
    }
    report(figures, as_json, written)
