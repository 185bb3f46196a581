"""`tofclip clip`: what a light-field camera with few measurements would recover of a light field."""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import typer

from apps.conventions import (
    RECORD_SUFFIXES,
    JsonOption,
    build_provenance,
    make_completer,
    report,
    require_writable,
)
from apps.progress import show_progress
from tofclip.errors import InputError
from tofclip.files import atomic_path
from tofclip.io.light_fields import read_depth_map, read_light_field
from tofclip.light_field.measurement import (
    CameraSetup,
    ClipMeasurement,
    corrupt_measurement,
    measure,
)
from tofclip.metrics import nmse, nmse_energy
from tofclip.recovery.all_in_focus import (
    AllInFocus,
    count_recoveries,
    make_shear_range,
    recover_all_in_focus,
    recover_on_depth_map,
)
from tofclip.recovery.light_field import ClipRecovery, ClipResult
from tofclip.storage import Field, Record

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tofclip.light_field import LightField


# Views leave the picture there, so that the rim is not scored.
SCORED_BORDER_PX = 12
SURFACES = "surfaces"

app = typer.Typer(help="Light fields from few nonlocal measurements.", no_args_is_help=True)


@app.command()
def simulate(
    light_field: Annotated[
        Path,
        typer.Argument(
            metavar="LIGHTFIELD", help="NPZ, HDF5, EXR with a part per view, or a folder."
        ),
    ],
    encoder: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="line, line-even, single-pixel, coded-line, coded-aperture, cubic-phase or diffuser.",
            autocompletion=make_completer(
                "line",
                "line-even",
                "single-pixel",
                "coded-line",
                "coded-aperture",
                "cubic-phase",
                "diffuser",
            ),
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="H5", help="The measurements to write.")],
    sampling_ratio: Annotated[
        float, typer.Option(metavar="SR", help="Measurements over pixels of one picture.")
    ] = 0.5,
    seed: Annotated[
        int,
        typer.Option(
            metavar="N", min=0, help="For angles, codes, photons and corrupted measurements."
        ),
    ] = 0,
    bad_fraction: Annotated[
        float, typer.Option(metavar="SHARE", help="Measurements set to 0 or to the largest.")
    ] = 0.0,
    photons: Annotated[
        float | None,
        typer.Option(
            metavar="N", help="Photons of the largest measurement.", show_default="no noise"
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure the true views of a light field with a camera of few measurements.

    Example: tofclip clip simulate light_field.npz --encoder line --sampling-ratio 0.5 --out
    measurements.h5
    """
    require_writable(out, *RECORD_SUFFIXES, inputs=(light_field,))
    known = read_light_field(light_field)
    setup = CameraSetup(encoder, sampling_ratio, seed)
    measurement = corrupt_measurement(measure(known, setup), photons, bad_fraction)
    settings = {
        "verb": "clip simulate",
        **asdict(setup),
        "bad_fraction": bad_fraction,
        "photons": photons or 0.0,
    }
    replace(measurement, provenance=build_provenance(settings, light_field)).save(out)
    figures = {
        "readings": measurement.values.size,
        "image_shape": measurement.image_shape,
        **asdict(setup),
    }
    report(figures, as_json, [out])


@app.command()
def recover(
    measurement: Annotated[
        Path, typer.Argument(metavar="H5", help="Measurements made by clip simulate.")
    ],
    shear: Annotated[
        float, typer.Option(metavar="S", help="Depth to focus on, pixels per view step.")
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The picture: .h5, .png or .exr.")],
    prior: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="tv, wavelet or l1; or a denoiser: collaborative, bm3d or nlm.",
            autocompletion=make_completer("tv", "wavelet", "l1", "collaborative", "bm3d", "nlm"),
        ),
    ] = "tv",
    preset: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="fast; quality: a denoiser finishes; surfaces: each pixel at its own depth.",
            autocompletion=make_completer("fast", "quality", "surfaces"),
        ),
    ] = "fast",
    weight: Annotated[
        str,
        typer.Option(metavar="auto|VALUE", help="Of the prior, relative; auto: cross-validation."),
    ] = "auto",
    data_term: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="squares; huber for corrupted measurements; poisson for few photons.",
            autocompletion=make_completer("squares", "huber", "poisson"),
        ),
    ] = "squares",
    truth: Annotated[
        Path | None, typer.Option(metavar="LIGHTFIELD", help="Light field to score against.")
    ] = None,
    all_in_focus: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Picture sharp at all depths to write: .h5 (with its depths), .png or .exr.",
        ),
    ] = None,
    depth_map: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Known shear of each pixel: .npy, or .h5 written by --all-in-focus.",
            show_default="found from the measurements",
        ),
    ] = None,
    shear_range: Annotated[
        tuple[float, float],
        typer.Option(metavar="S S", help="Nearest and farthest shear of surfaces to look for."),
    ] = (-1.4, 1.4),
    as_json: JsonOption = False,
) -> None:
    """Recover the picture refocused at one depth, and one that is sharp at all depths.

    With surfaces one picture explains all measurements, each pixel at its own depth; the picture
    refocused at S is rendered from it. The weight is then that of this picture.

    Example: tofclip clip recover measurements.h5 --shear -0.3 --preset quality --out picture.png
    """
    # No output may replace a file that is read.
    inputs = (measurement, truth, depth_map)
    outputs = [path for path in (out, all_in_focus) if path is not None]
    # A wrong ending is refused before the recovery, not after it.
    for path in outputs:
        require_writable(path, ".h5", ".png", ".exr", inputs=inputs)
    if out == all_in_focus:
        raise InputError("--out and --all-in-focus name the same file; take two")
    if depth_map is not None and preset != SURFACES and all_in_focus is None:
        raise InputError("--depth-map serves --preset surfaces and --all-in-focus only")
    # Surfaces are found with the settings of the fast preset, whichever refocuses.
    surface_settings = ClipRecovery(prior, "fast", _parse_weight(weight), data_term)
    settings = replace(surface_settings, preset="fast" if preset == SURFACES else preset)
    measurements = ClipMeasurement.load(measurement)
    known_field = None if truth is None else read_light_field(truth)
    find_surfaces = partial(
        _find_surfaces, measurements, surface_settings, depth_map=depth_map, shears=shear_range
    )
    if preset == SURFACES:
        found = _refocus_surfaces(measurements, shear, find_surfaces(weight=settings.weight))
    else:
        surfaces = None if all_in_focus is None else find_surfaces(weight=None)
        found = _refocus_measurements(measurements, shear, settings, surfaces)
    past = {
        "verb": "clip recover",
        "shear": shear,
        "prior": prior,
        "preset": preset,
        "data_term": data_term,
    }
    figures: dict[str, Any] = {}
    if known_field is not None:
        figures |= _score_picture(found.picture, known_field.refocus(shear))
    if found.surfaces is not None and all_in_focus is not None:
        figures |= _write_all_in_focus(found.surfaces, known_field, all_in_focus, measurement, past)
    figures |= found.figures
    past |= {"weight": found.figures["weight"]}
    _write_picture({"picture": found.picture}, out, measurement, past)
    report(figures, as_json, outputs)


class _Refocused(NamedTuple):
    """A picture refocused at one depth, and the surfaces if they were looked for."""

    picture: NDArray[Any]
    figures: dict[str, Any]
    surfaces: AllInFocus | None


def _refocus_surfaces(
    measurements: ClipMeasurement, shear: float, surfaces: AllInFocus
) -> _Refocused:
    """Render the picture at one depth from the one that explains all measurements."""
    picture = surfaces.render_views(measurements.views).refocus(shear)
    figures = _describe_recovery(surfaces) | {"seconds": surfaces.seconds}
    return _Refocused(picture, figures, surfaces)


def _refocus_measurements(
    measurements: ClipMeasurement,
    shear: float,
    settings: ClipRecovery,
    surfaces: AllInFocus | None,
) -> _Refocused:
    """Recover the picture at one depth from the measurements, taken to be sheared alike."""
    title = "recovering" if settings.weight is not None else "choosing the weight"
    with show_progress(title, settings.work) as advance:
        found = settings.recover(measurements, shear, advance)
    seconds = {
        "seconds": found.seconds,
        "seconds_setup": found.seconds_setup,
        "seconds_weight": found.seconds_weight,
    }
    return _Refocused(found.picture, _describe_recovery(found) | seconds, surfaces)


def _describe_recovery(found: AllInFocus | ClipResult) -> dict[str, Any]:
    return {
        "weight": found.weight,
        "iterations": found.iterations,
        "stopped_because": found.stop_reason,
    }


def _find_surfaces(
    measurements: ClipMeasurement,
    settings: ClipRecovery,
    depth_map: Path | None,
    shears: tuple[float, float],
    weight: float | None,
) -> AllInFocus:
    """Recover one picture with a depth for each pixel, known or found."""
    if depth_map is not None:
        known = read_depth_map(depth_map)
        with show_progress("recovering at known depths", 1) as advance:
            found = recover_on_depth_map(measurements, known, weight, settings)
            advance(1)
        return found
    tried = make_shear_range(*shears, measurements.views)
    with show_progress("looking for depths", count_recoveries(tried)) as advance:
        return recover_all_in_focus(measurements, tried, weight, settings, advance)


def _write_all_in_focus(
    surfaces: AllInFocus,
    truth: LightField | None,
    out: Path,
    measurement: Path,
    past: dict[str, Any],
) -> dict[str, float]:
    """Write the picture that is sharp everywhere; return how far it is from the reference view."""
    past = past | {"weight": surfaces.weight}
    _write_picture({"picture": surfaces.picture, "shears": surfaces.shears}, out, measurement, past)
    if truth is None:
        return {}
    references = truth.pictures[np.all(truth.views == 0, axis=1)]
    if not len(references):
        return {}
    return {"nmse_all_in_focus": nmse(surfaces.picture, references[0], SCORED_BORDER_PX)}


def _parse_weight(text: str) -> float | None:
    """Return the weight that was asked for, None for `auto`."""
    # No weight lets the recovery choose one by cross-validation.
    if text == "auto":
        return None
    try:
        return float(text)
    except ValueError:
        raise InputError(f"--weight takes 'auto' or a number, not '{text}'") from None


def _score_picture(picture: NDArray[Any], refocused: NDArray[Any]) -> dict[str, float]:
    """Compare with the true views' shift-and-add."""
    return {
        "nmse": nmse(picture, refocused, SCORED_BORDER_PX),
        "nmse_whole_frame": nmse(picture, refocused),
        "nmse_energy": nmse_energy(picture, refocused, SCORED_BORDER_PX),
    }


def _write_picture(
    arrays: dict[str, NDArray[Any]], out: Path, measurement: Path, settings: dict[str, Any]
) -> None:
    """Write the picture; a PNG is scaled to the picture's own brightest pixel, the others keep the
    values, and HDF5 keeps its shears as well.
    """
    picture = arrays["picture"]
    if out.suffix.lower() == ".h5":
        units = {"shears": "px"}
        fields_kept = {
            name: Field(values, units.get(name, ""), ("y", "x")) for name, values in arrays.items()
        }
        past = build_provenance(settings, measurement)
        Record("picture", fields_kept, {"shear": settings["shear"]}, provenance=past).save(out)
        return
    # Both libraries write to the name they get, which is not the final one yet.
    with atomic_path(out) as temporary:
        if out.suffix.lower() == ".exr":
            import OpenEXR

            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            OpenEXR.File(header, {"Y": picture}).write(str(temporary))
        else:
            from matplotlib.image import imsave

            imsave(temporary, picture, cmap="gray", vmin=0, format="png")
