"""`tofclip occlusion`: what is hidden behind an occluder, and what is seen through it all the same."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from apps.options import AsJson
from tofclip.units import MILLIMETRE

if TYPE_CHECKING:
    from apps.occlusion.experiment import Experiment
    from apps.occlusion.probe import Probe

SCENE_NAMES = ("v-letter", "plate", "person", "tree", "bush", "trellis", "board")
"""Those of `apps.occlusion.scenes`, named here so that help appears without loading them."""

app = typer.Typer()


@app.callback(invoke_without_command=True)
def _without_verb(context: typer.Context) -> None:
    """See through occluders: which places no view can see, and a demonstration of the others."""
    if context.invoked_subcommand is None:
        print(context.get_help())


@app.command()
def region(
    baseline_mm: Annotated[float, typer.Option(metavar="MM", help="Distance between the outermost views.")] = 15.0,
    width_mm: Annotated[float, typer.Option(metavar="MM", help="Width of the occluder's solid part.")] = 6.0,
    distance_mm: Annotated[float, typer.Option(metavar="MM", help="From the views to the occluder.")] = 50.0,
    out: Annotated[Path | None, typer.Option(metavar="PNG", help="Draw it.", show_default="no picture")] = None,
    as_json: AsJson = False,
) -> None:
    """Tell how far behind a solid occluder nothing can be seen by any view.

    An occluder as wide as the views are apart, or wider, hides what lies behind its middle at every distance: nothing
    is promised then, and inactive_length_m is null.

    Example: tofclip occlusion region --baseline-mm 15 --width-mm 6 --distance-mm 50 --out region.png
    """
    from apps.files import PICTURE_SUFFIXES, require_writable
    from apps.report import report
    from tofclip.occlusion import InactiveRegion

    if out is not None:
        require_writable(out, *PICTURE_SUFFIXES)
    found = InactiveRegion(*(length * MILLIMETRE for length in (baseline_mm, width_mm, distance_mm)))
    if out is not None:
        from apps.figures.occlusion_region import region_figure
        from apps.figures.style import save

        save(region_figure(found), out)
    promise = "seen beyond the inactive length" if found.ends else "nothing: the occluder is as wide as the baseline"
    length = found.length if found.ends or as_json else "without end"
    figures = {"inactive_length_m": length, "promised": promise}
    report(figures, as_json, [] if out is None else [out])


@app.command()
def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the results; made if missing.")],
    scene: Annotated[str, typer.Option(metavar="NAME", help=f"{', '.join(SCENE_NAMES)}.")] = "tree",
    illumination: Annotated[
        str, typer.Option(metavar="NAME", help="diodes, one beside each view; oblique; co-located, a single one.")
    ] = "diodes",
    encoder: Annotated[str, typer.Option(metavar="NAME", help="line or single-pixel.")] = "line",
    sampling_ratio: Annotated[float, typer.Option(metavar="SR", help="Readings over pixels of one picture.")] = 0.5,
    side_px: Annotated[int, typer.Option(metavar="N", help="Rows and columns of the picture.")] = 128,
    photons: Annotated[
        float | None,
        typer.Option(
            metavar="N", help="Of the brightest reading at its brightest.", show_default="2000; single-pixel 1000000"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Of line angles and photons.")] = 0,
    moving: Annotated[
        bool, typer.Option("--moving", help="A second film: the target walks past; half a minute more.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Simulate a scene behind an occluder, see through it, and compare with other cameras and with the truth.

    Seven views in a row of 15 mm look past an occluder at 50 mm; rays are cast from lamps to surfaces to views. Small
    targets on the axis at 0.8, 1.2 and 2 times the inactive length test the formula. Writes occlusion.png,
    occlusion.gif, a film of the flash, and with --moving occlusion_moving.gif.

    Example: tofclip occlusion demo --scene plate --out occlusion-output
    """
    import time

    from apps.figures.occlusion import occlusion_figure
    from apps.figures.occlusion_film import STEPS, save_flash, save_walk
    from apps.figures.style import save
    from apps.files import make_folder
    from apps.occlusion.experiment import USUAL_PHOTONS, Experiment, Settings
    from apps.occlusion.scenes import occlusion_scene
    from apps.progress import progress
    from apps.report import report
    from tofclip.errors import InputError

    started = time.perf_counter()
    if encoder not in USUAL_PHOTONS:
        raise InputError(f"unknown encoder '{encoder}'; take one of {', '.join(USUAL_PHOTONS)}")
    usual = USUAL_PHOTONS[encoder] if photons is None else photons
    settings = Settings(side_px, encoder, sampling_ratio, illumination, usual, seed)
    experiment = Experiment(occlusion_scene(scene), settings)
    experiment.rig.camera  # noqa: B018 - refuses what no camera can be built from, before anything is written
    make_folder(out)
    probes = _look(experiment)
    written = [out / "occlusion.png", out / "occlusion.gif"]
    save(occlusion_figure(experiment, probes), written[0])
    save_flash(experiment, written[1])
    if moving:
        written.append(out / "occlusion_moving.gif")
        with progress("walking", STEPS) as advance:
            save_walk(experiment, written[2], advance)
    report({**_figures(experiment, probes), "seconds": time.perf_counter() - started}, as_json, written)


def _look(experiment: Experiment) -> list[Probe]:
    """Cast the rays, recover, and try small targets inside the inactive region and beyond, if it ends."""
    from apps.occlusion.probe import FACTORS, probe
    from apps.progress import progress

    scene, probes = experiment.scene, []
    factors = FACTORS if scene.region.ends else ()
    with progress("looking past", 2 + len(factors)) as advance:
        for part in ("readings", "separated"):
            getattr(experiment, part)
            advance(1)
        for factor in factors:
            probes.append(probe(scene.occluder, scene.region, factor, experiment.settings.seed))
            advance(1)
    return probes


def _figures(experiment: Experiment, probes: Sequence[Probe]) -> dict[str, Any]:
    """What is said about a run; correlations are with the target as seen with its occluder taken away."""
    from tofclip.metrics import correlation, nmse

    scene, truth = experiment.scene, experiment.truth
    own = (scene.distance, correlation(experiment.separated.target, truth), experiment.promised)
    targets = [own, *((one.distance, one.correlation, one.expected_visible) for one in probes)]
    names = ("distance_m", "correlation", "expected_visible")
    found = experiment.separated
    return {
        "scene": scene.name,
        "inactive_length_m": scene.region.length,
        "targets": [dict(zip(names, one, strict=True)) for one in sorted(targets)],
        "nmse": nmse(found.target, truth),
        "correlation": own[1],
        "correlation_without_model_of_occluder": correlation(found.plain, truth),
        "correlation_single_view": correlation(experiment.single_view, experiment.single_view_truth),
        "correlation_light_field_camera": correlation(experiment.conventional, truth),
        "readings": experiment.rig.camera.readings,
    }
