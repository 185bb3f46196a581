"""`tofclip occlusion`: what is hidden behind an occluder, and what is seen through it all the same."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from apps.conventions import (
    PICTURE_SUFFIXES,
    JsonOption,
    TimeZeroOption,
    make_folder,
    report,
    require_writable,
)
from apps.figures.occlusion import make_occlusion_figure
from apps.figures.occlusion_film import WALK_STEPS, save_flash_film, save_walk_film
from apps.figures.style import save_figure
from apps.occlusion.experiment import DEFAULT_PHOTONS, Experiment, ExperimentSettings
from apps.occlusion.probe import DISTANCE_FACTORS, probe_target
from apps.occlusion.scenes import make_occlusion_scene, make_walking_scene
from apps.progress import show_activity, show_progress
from tofclip.errors import InputError
from tofclip.metrics import correlation_coefficient, nmse
from tofclip.occlusion import InactiveRegion, SeparatedImages
from tofclip.units import MILLIMETRE, NANOSECOND

if TYPE_CHECKING:
    from apps.occlusion.probe import ProbeResult

SCENE_NAMES = ("v-letter", "plate", "person", "tree", "bush", "trellis", "board")
"""Those of `apps.occlusion.scenes`, named here so that help appears without loading them."""

SIDE_PX, LIVE_SIDE_PX = 128, 64
"""Rows and columns of the picture, unless given: a page shows a step every second."""

app = typer.Typer()


@app.callback(invoke_without_command=True)
def _show_help(context: typer.Context) -> None:
    """See through occluders: which places no view can see, and a demonstration of the others."""
    if context.invoked_subcommand is None:
        print(context.get_help())


@app.command()
def region(
    baseline_mm: Annotated[
        float, typer.Option(metavar="MM", help="Distance between the outermost views.")
    ] = 15.0,
    width_mm: Annotated[
        float, typer.Option(metavar="MM", help="Width of the occluder's solid part.")
    ] = 6.0,
    distance_mm: Annotated[
        float, typer.Option(metavar="MM", help="From the views to the occluder.")
    ] = 50.0,
    out: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Draw it.", show_default="no picture")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Report how far behind a solid occluder nothing can be seen by any view.

    An occluder as wide as the views are apart, or wider, hides what lies behind its middle at every
    distance: nothing is promised then, and inactive_length_m is null.

    Example: tofclip occlusion region --baseline-mm 15 --width-mm 6 --distance-mm 50 --out
    region.png
    """
    if out is not None:
        require_writable(out, *PICTURE_SUFFIXES)
    found = InactiveRegion(
        *(length * MILLIMETRE for length in (baseline_mm, width_mm, distance_mm))
    )
    if out is not None:
        from apps.figures.occlusion_region import make_region_figure
        from apps.figures.style import save_figure

        save_figure(make_region_figure(found), out)
    promise = (
        "seen beyond the inactive length"
        if found.is_bounded
        else "nothing: the occluder is as wide as the baseline"
    )
    length = found.length if found.is_bounded or as_json else "without end"
    figures = {"inactive_length_m": length, "promised": promise}
    report(figures, as_json, [] if out is None else [out])


@app.command()
def demo(
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for the results; made if missing. Required without --live.",
            show_default="nothing is written",
        ),
    ] = None,
    scene: Annotated[str, typer.Option(metavar="NAME", help=f"{', '.join(SCENE_NAMES)}.")] = "tree",
    illumination: Annotated[
        str,
        typer.Option(
            metavar="NAME", help="diodes, one beside each view; oblique; co-located, a single one."
        ),
    ] = "diodes",
    encoder: Annotated[str, typer.Option(metavar="NAME", help="line or single-pixel.")] = "line",
    sampling_ratio: Annotated[
        float, typer.Option(metavar="SR", help="Measurements over pixels of one picture.")
    ] = 0.5,
    side_px: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Rows and columns of the picture.",
            show_default="128; with --live 64",
        ),
    ] = None,
    photons: Annotated[
        float | None,
        typer.Option(
            metavar="N",
            help="Of the largest measurement.",
            show_default="2000; single-pixel 1000000",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Of line angles and photons.")] = 0,
    moving: Annotated[
        bool,
        typer.Option("--moving", help="A second film: the target walks past; half a minute more."),
    ] = False,
    live: Annotated[
        bool,
        typer.Option(
            "--live",
            help="Open a page instead: a person walks behind the occluder, its width and the gate on sliders.",
        ),
    ] = False,
    recording: Annotated[
        str | None,
        typer.Option(
            metavar="SOURCE",
            help="With --live: your own shots, frames or instrument behind a gate, as for view.",
            show_default="a simulated scene",
        ),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            metavar="H5",
            help="With --recording: made by calibrate.",
            show_default="the one inside SOURCE",
        ),
    ] = None,
    time_zero_ns: TimeZeroOption = None,
    port: Annotated[
        int | None,
        typer.Option(min=1, max=65535, metavar="N", help="Of the page.", show_default="a free one"),
    ] = None,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Print the page's address; open nothing.")
    ] = False,
    as_json: JsonOption = False,
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
    started = time.perf_counter()
    _require_sense(live, recording is not None or camera is not None, out is None)
    if encoder not in DEFAULT_PHOTONS:
        raise InputError(f"unknown encoder '{encoder}'; take one of {', '.join(DEFAULT_PHOTONS)}")
    # A single pixel sums a whole picture and so needs more photons.
    usual = DEFAULT_PHOTONS[encoder] if photons is None else photons
    side = side_px or (LIVE_SIDE_PX if live else SIDE_PX)
    rays = 1 if live else ExperimentSettings.samples
    settings = ExperimentSettings(side, encoder, sampling_ratio, illumination, usual, seed, rays)
    if live or out is None:
        zero = None if time_zero_ns is None else time_zero_ns * NANOSECOND
        _show_live(scene, settings, (recording, camera, zero), (port, no_browser, as_json))
        return
    experiment = Experiment(make_occlusion_scene(scene), settings)
    # Before anything is written: this refuses settings of which no camera can be built.
    measurement_count = experiment.rig.camera.measurements
    make_folder(out)
    separated, probes = _run_experiment(experiment)
    written = [out / "occlusion.png", out / "occlusion.gif"]
    save_figure(make_occlusion_figure(experiment, probes), written[0])
    save_flash_film(experiment, written[1])
    if moving:
        written.append(out / "occlusion_moving.gif")
        with show_progress("walking", WALK_STEPS) as advance:
            save_walk_film(experiment, written[2], advance)
    report(
        {
            **_collect_metrics(experiment, separated, probes),
            "readings": measurement_count,
            "seconds": time.perf_counter() - started,
        },
        as_json,
        written,
    )


def _require_sense(live: bool, recorded: bool, writes_nothing: bool) -> None:
    """Refuse options that contradict each other."""
    if live != writes_nothing:
        raise InputError(
            "--live writes nothing; leave --out out"
            if live
            else "give --out DIR, or --live for a page"
        )
    if recorded and not live:
        raise InputError("--recording and --camera are for --live")


def _show_live(
    scene: str,
    settings: ExperimentSettings,
    recorded: tuple[str | None, Path | None, float | None],
    served: tuple[int | None, bool, bool],
) -> None:
    """Serve a page with the walk, or with a recording behind a gate, until Ctrl-C."""
    from apps.occlusion.live import GatedSource, WalkSource
    from apps.verbs.view import PageDoor
    from apps.viewer.server import LOOPBACK
    from apps.viewer.session import Session
    from apps.viewer.source_factory import ShotOptions, open_source

    recording, camera, time_zero = recorded
    port, no_browser, as_json = served
    with show_activity("looking past"):
        source = (
            WalkSource(make_walking_scene(scene), settings)
            if recording is None
            else GatedSource(open_source(recording, ShotOptions(camera, time_zero=time_zero)))
        )
    with contextlib.closing(source) as opened:
        PageDoor(LOOPBACK, port, no_browser, as_json).serve(Session(opened))


def _run_experiment(experiment: Experiment) -> tuple[SeparatedImages, list[ProbeResult]]:
    """Cast the rays, recover, and try small targets inside the inactive region and beyond, if it
    ends.
    """
    scene, probes = experiment.scene, []
    # Without a bound there is no distance beyond the region to try.
    factors = DISTANCE_FACTORS if scene.region.is_bounded else ()
    with show_progress("looking past", 1 + len(factors)) as advance:
        separated = experiment.separated
        advance(1)
        for factor in factors:
            probes.append(
                probe_target(scene.occluder, scene.region, factor, experiment.settings.seed)
            )
            advance(1)
    return separated, probes


def _collect_metrics(
    experiment: Experiment, separated: SeparatedImages, probes: Sequence[ProbeResult]
) -> dict[str, Any]:
    """What is said about a run; correlations are with the target as seen with its occluder taken
    away.
    """
    scene, truth = experiment.scene, experiment.truth
    own = (
        scene.distance,
        correlation_coefficient(separated.target, truth),
        experiment.expected_visible,
    )
    targets = [own, *((one.distance, one.correlation, one.expected_visible) for one in probes)]
    names = ("distance_m", "correlation", "expected_visible")
    return {
        "scene": scene.name,
        "inactive_length_m": scene.region.length,
        "targets": [dict(zip(names, one, strict=True)) for one in sorted(targets)],
        "nmse": nmse(separated.target, truth),
        "correlation": own[1],
        "correlation_without_model_of_occluder": correlation_coefficient(separated.plain, truth),
        "correlation_single_view": correlation_coefficient(
            experiment.single_view, experiment.single_view_truth
        ),
        "correlation_light_field_camera": correlation_coefficient(experiment.conventional, truth),
    }
