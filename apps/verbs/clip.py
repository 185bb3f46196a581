"""`tofclip clip`: what a light-field camera with few measurements would recover of a light field."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
from tofclip.io.light_fields import read_light_field
from tofclip.light_field.measurement import (
    CameraSetup,
    ClipMeasurement,
    corrupt_measurement,
    measure,
)
from tofclip.metrics import nmse, nmse_energy
from tofclip.recovery.light_field import ClipRecovery
from tofclip.storage import Field, Record, atomic_path

if TYPE_CHECKING:
    from numpy.typing import NDArray


# Views leave the picture there, so that the rim is not scored.
SCORED_BORDER_PX = 12

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
            help="fast, or quality: a denoiser finishes.",
            autocompletion=make_completer("fast", "quality"),
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
    as_json: JsonOption = False,
) -> None:
    """Recover the picture refocused at one depth.

    Example: tofclip clip recover measurements.h5 --shear -0.3 --preset quality --out picture.png
    """
    # No output may replace a file that is read.
    inputs = (measurement,) if truth is None else (measurement, truth)
    # A wrong ending is refused before the recovery, not after it.
    require_writable(out, ".h5", ".png", ".exr", inputs=inputs)
    settings = ClipRecovery(prior, preset, _parse_weight(weight), data_term)
    measurements = ClipMeasurement.load(measurement)
    title = "recovering" if settings.weight is not None else "choosing the weight"
    with show_progress(title, settings.work) as advance:
        recovered = settings.recover(measurements, shear, advance)
    figures: dict[str, Any] = (
        {} if truth is None else _score_picture(recovered.picture, truth, shear)
    )
    figures |= {
        "weight": recovered.weight,
        "iterations": recovered.iterations,
        "stopped_because": recovered.stop_reason,
        "seconds": recovered.seconds,
        "seconds_setup": recovered.seconds_setup,
        "seconds_weight": recovered.seconds_weight,
    }
    past = {
        "verb": "clip recover",
        "shear": shear,
        "prior": prior,
        "preset": preset,
        "data_term": data_term,
    }
    _write_picture(recovered.picture, out, measurement, past | {"weight": recovered.weight})
    report(figures, as_json, [out])


def _parse_weight(text: str) -> float | None:
    """Return the weight that was asked for, None for `auto`."""
    # No weight lets the recovery choose one by cross-validation.
    if text == "auto":
        return None
    try:
        return float(text)
    except ValueError:
        raise InputError(f"--weight takes 'auto' or a number, not '{text}'") from None


def _score_picture(picture: NDArray[Any], truth: Path, shear: float) -> dict[str, float]:
    """Compare with the true views' shift-and-add."""
    refocused = read_light_field(truth).refocus(shear)
    return {
        "nmse": nmse(picture, refocused, SCORED_BORDER_PX),
        "nmse_whole_frame": nmse(picture, refocused),
        "nmse_energy": nmse_energy(picture, refocused, SCORED_BORDER_PX),
    }


def _write_picture(
    picture: NDArray[Any], out: Path, measurement: Path, settings: dict[str, Any]
) -> None:
    """Write the picture; a PNG is scaled to the picture's own brightest pixel, the others keep the
    values.
    """
    if out.suffix.lower() == ".h5":
        fields_kept = {"picture": Field(picture, "", ("y", "x"))}
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
