"""`tofclip occlusion`: what is hidden behind an occluder, and what is seen through it all the same."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path

from apps.cli import make_group
from apps.options import NO_BROWSER, PICTURE_FORMATS, PORT, TIME_ZERO, flag, opt
from apps.progress import show_activity, show_progress
from apps.report import PRINTS_JSON, make_folder, report, require_new, require_writable
from tofclip.errors import InputError, require_known
from tofclip.files import PICTURE_SUFFIXES

SCENE_NAMES = ("v-letter", "plate", "person", "tree", "bush", "trellis", "board")
"""Those of `apps.occlusion.experiment`, named here so that help appears without loading them."""

SIDE_PX, LIVE_SIDE_PX = 128, 64
"""Rows and columns of the picture, unless given: a page shows a step every second."""

app = make_group(
    "See through occluders: which places no view can see, and a demonstration of the others."
)


@app.command()
def region(
    baseline: float = opt(
        "MM", "Distance between the outermost views.", 15.0, name="--baseline-mm"
    ),
    width: float = opt("MM", "Width of the occluder's solid part.", 6.0, name="--width-mm"),
    distance: float = opt("MM", "From the views to the occluder.", 50.0, name="--distance-mm"),
    out: Path | None = opt("PNG", f"Draw it: {PICTURE_FORMATS}.", shown="no picture"),
) -> None:
    """Report how far behind a solid occluder nothing can be seen by any view.

    An occluder as wide as the views are apart, or wider, hides what lies behind its middle at every
    distance: nothing is promised then, and inactive_length_m is null.

    Example: tofclip occlusion region --baseline-mm 15 --width-mm 6 --distance-mm 50 --out
    region.png
    """
    from tofclip.occlusion import InactiveRegion

    if out is not None:
        require_writable(out, *PICTURE_SUFFIXES)
    found = InactiveRegion(baseline, width, distance)
    if out is not None:
        from apps.figures.occlusion import make_region_figure
        from tofclip.notebook import save_figure

        save_figure(make_region_figure(found), out)
    figures = {
        "inactive_length_m": found.length
        if found.is_bounded or PRINTS_JSON.get()
        else "without end",
        "promised": "seen beyond the inactive length"
        if found.is_bounded
        else "nothing: the occluder is no narrower than the baseline",
    }
    report(figures, [] if out is None else [out])


@app.command()
def demo(
    out: Path | None = opt(
        "DIR",
        "Folder for the results; made if missing. Required without --live.",
        shown="nothing is written",
    ),
    scene: str = opt("NAME", f"{', '.join(SCENE_NAMES)}.", "tree"),
    illumination: str = opt(
        "NAME", "diodes, one beside each view; oblique; co-located, a single one.", "diodes"
    ),
    encoder: str = opt("NAME", "line or single-pixel.", "line"),
    sampling_ratio: float = opt("SR", "Measurements over pixels of one picture.", 0.5),
    side_px: int | None = opt("N", "Rows and columns of the picture.", shown="128; with --live 64"),
    photons: float | None = opt(
        "N", "Of the largest measurement.", shown="2000; single-pixel 1000000"
    ),
    seed: int = opt("N", "Of line angles and photons.", 0, min=0),
    moving: bool = flag("--moving", "A second film: the target walks past; half a minute more."),
    live: bool = flag(
        "--live",
        "Open a page instead: a person walks behind the occluder, its width and the gate on sliders.",
    ),
    recording: str | None = opt(
        "SOURCE",
        "With --live: your own shots, frames or instrument behind a gate, as for view.",
        shown="a simulated scene",
    ),
    camera: Path | None = opt(
        "H5", "With --recording: made by calibrate.", shown="the one inside SOURCE"
    ),
    time_zero: float | None = TIME_ZERO,
    port: int | None = PORT,
    no_browser: bool = NO_BROWSER,
) -> None:
    """Simulate a scene behind an occluder, see through it, and compare with other cameras and with
    the truth.

    Seven views in a row of 15 mm look past an occluder at 50 mm; rays are cast from lamps to
    surfaces to views. Small targets on the axis at 0.8, 1.2 and 2 times the inactive length test
    the formula. Writes occlusion.png, occlusion.gif, a film of the flash, and with --moving
    occlusion_moving.gif.

    With --live nothing is written: a page shows what one camera sees beside what CLIP sees, step by
    step, and the sliders' occluder and gate hold from the next step on. With --recording it is your
    own scene, and the gate takes away what stands in front.

    Example: tofclip occlusion demo --scene plate --out occlusion-output

    Example: tofclip occlusion demo --live --scene bush
    """
    from apps.figures.occlusion import make_occlusion_figure, save_flash_film, save_walk_film
    from apps.occlusion import experiment as trial
    from tofclip.metrics import correlation_coefficient, nmse
    from tofclip.notebook import save_figure

    started = time.perf_counter()
    if live and out is not None:
        raise InputError("--live writes nothing; leave --out out")
    if (recording is not None or camera is not None) and not live:
        raise InputError("--recording and --camera are for --live")
    require_known("encoder", encoder, trial.DEFAULT_PHOTONS)
    # A single pixel sums a whole picture and so needs more photons.
    usual = trial.DEFAULT_PHOTONS[encoder] if photons is None else photons
    side = side_px or (LIVE_SIDE_PX if live else SIDE_PX)
    rays = 1 if live else trial.ExperimentSettings.samples
    settings = trial.ExperimentSettings(
        side, encoder, sampling_ratio, illumination, usual, seed, rays
    )
    if live:
        from apps.occlusion.live import GatedSource, WalkSource
        from apps.viewer.page import LOOPBACK, PageDoor
        from apps.viewer.session import Session
        from apps.viewer.source_factory import ShotOptions, open_source

        with show_activity("looking past"):
            known = ShotOptions(camera, time_zero=time_zero)
            source = (
                WalkSource(trial.make_walking_scene(scene), settings)
                if recording is None
                else GatedSource(open_source(recording, known))
            )
        with contextlib.closing(source) as opened:
            PageDoor(LOOPBACK, port, no_browser).serve(Session(opened))
        return
    if out is None:
        raise InputError("give --out DIR, or --live for a page")
    experiment = trial.Experiment(trial.make_occlusion_scene(scene), settings)
    # Before anything is written: this refuses settings of which no camera can be built.
    measurement_count = experiment.rig.camera.measurements
    make_folder(out)
    require_new(out / "occlusion.png")
    seen, probes = experiment.scene, []
    # Small targets inside the inactive region and beyond; without a bound nothing is beyond.
    factors = trial.DISTANCE_FACTORS if seen.region.is_bounded else ()
    with show_progress("looking past", 1 + len(factors)) as advance:
        separated = experiment.separated
        advance(1)
        for factor in factors:
            probes.append(trial.probe_target(seen.occluder, seen.region, factor, seed))
            advance(1)
    written = [out / "occlusion.png", out / "occlusion.gif"]
    save_figure(make_occlusion_figure(experiment, probes), written[0])
    save_flash_film(experiment, written[1])
    if moving:
        written.append(out / "occlusion_moving.gif")
        with show_progress("walking", len(trial.WALK_PLACES_M)) as advance:
            save_walk_film(experiment, trial.WALK_PLACES_M, written[2], advance)
    # Correlations are with the target as seen with its occluder taken away.
    truth = experiment.truth
    correlation = correlation_coefficient(separated.target, truth)
    targets = [(seen.distance, correlation, experiment.expected_visible)]
    targets += [(one.distance, one.correlation, one.expected_visible) for one in probes]
    names = ("distance_m", "correlation", "expected_visible")
    figures = {
        "scene": seen.name,
        "inactive_length_m": seen.region.length,
        "targets": [dict(zip(names, one, strict=True)) for one in sorted(targets)],
        "nmse": nmse(separated.target, truth),
        "correlation": correlation,
        "correlation_without_model_of_occluder": correlation_coefficient(separated.plain, truth),
        "correlation_single_view": correlation_coefficient(
            experiment.single_view, experiment.single_view_truth
        ),
        "correlation_light_field_camera": correlation_coefficient(experiment.conventional, truth),
        "readings": measurement_count,
        "seconds": time.perf_counter() - started,
    }
    report(figures, written)
