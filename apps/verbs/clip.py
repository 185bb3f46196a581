"""`tofclip clip`: what a light-field camera with few readings would recover of a light field."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from apps.options import AsJson

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tofclip.clip_measurement import ClipMeasurement
    from tofclip.recovery import Result

SCORED_BORDER_PX = 12
RELATIVE_CHANGE = 1e-4  # of the objective in an iteration: then the recovery has converged

app = typer.Typer(help="Light fields from few nonlocal readings.", no_args_is_help=True)


@app.command()
def simulate(
    light_field: Annotated[Path, typer.Argument(metavar="LIGHTFIELD", help="NPZ with lf (v, u, y, x), scale, v, u.")],
    encoder: Annotated[str, typer.Option(metavar="NAME", help="line or single-pixel.")],
    out: Annotated[Path, typer.Option(metavar="H5", help="The readings to write.")],
    sampling_ratio: Annotated[float, typer.Option(metavar="SR", help="Readings over pixels of one picture.")] = 0.5,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Of angles, codes, photons and bad readings.")] = 0,
    bad_fraction: Annotated[float, typer.Option(metavar="SHARE", help="Readings set to 0 or to the largest.")] = 0.0,
    photons: Annotated[
        float | None, typer.Option(metavar="N", help="Photons of the largest reading.", show_default="no noise")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure the true views of a light field with a camera of few readings."""
    from apps.files import RECORD_SUFFIXES, history, require_writable
    from apps.report import report
    from tofclip.clip_measurement import Setup, measure, spoilt
    from tofclip.io.light_fields import read_light_field

    require_writable(out, *RECORD_SUFFIXES, inputs=(light_field,))
    known = read_light_field(light_field)
    setup = Setup(encoder, sampling_ratio, seed)
    measurement = spoilt(measure(known, setup), photons, bad_fraction)
    settings = {"verb": "clip simulate", **asdict(setup), "bad_fraction": bad_fraction, "photons": photons or 0.0}
    measurement.to_record(history(settings, light_field)).save(out)
    figures = {"readings": measurement.readings.size, "image_shape": measurement.image_shape, **asdict(setup)}
    report(figures, as_json, [out])


@app.command()
def recover(
    measurement: Annotated[Path, typer.Argument(metavar="H5", help="Readings made by clip simulate.")],
    shear: Annotated[float, typer.Option(metavar="S", help="Depth to focus on, pixels per view step.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The picture: .h5, .png or .exr.")],
    truth: Annotated[Path | None, typer.Option(metavar="LIGHTFIELD", help="Light field to score against.")] = None,
    as_json: AsJson = False,
) -> None:
    """Recover the picture refocused at one depth (total variation)."""
    from apps.files import require_writable
    from apps.report import report
    from tofclip.clip_measurement import ClipMeasurement
    from tofclip.storage import Record

    inputs = (measurement,) if truth is None else (measurement, truth)
    require_writable(out, ".h5", ".png", ".exr", inputs=inputs)
    readings = ClipMeasurement.from_record(Record.load(measurement, "clip_measurement"))
    recovery = _recovered(readings, shear)
    picture = recovery.result.frames[0]
    figures: dict[str, Any] = {} if truth is None else _score(picture, truth, shear)
    figures |= {
        "weight": recovery.weight,
        "iterations": recovery.result.iterations,
        "seconds": recovery.seconds,
        "seconds_setup": recovery.seconds_setup,
        "stopped_because": recovery.result.stopped_because,
    }
    _write(picture, out, measurement, shear)
    report(figures, as_json, [out])


@dataclass(frozen=True)
class _Recovery:
    """A recovered picture, the relative weight of its prior, and the time that both steps took."""

    result: Result
    weight: float
    seconds_setup: float
    seconds: float


def _recovered(measurement: ClipMeasurement, shear: float) -> _Recovery:
    from tofclip.recovery import TotalVariation

    begin = perf_counter()
    model, readings, weight = measurement.problem(shear)
    ready = perf_counter()
    result = TotalVariation(weight, 400, RELATIVE_CHANGE).recover(model, readings[:, None])
    return _Recovery(result, weight, ready - begin, perf_counter() - ready)


def _score(picture: NDArray[Any], truth: Path, shear: float) -> dict[str, float]:
    """Compare with the true views' shift-and-add."""
    from tofclip.io.light_fields import read_light_field
    from tofclip.metrics import nmse, nmse_energy

    refocused = read_light_field(truth).refocus(shear)
    return {
        "nmse": nmse(picture, refocused, SCORED_BORDER_PX),
        "nmse_whole_frame": nmse(picture, refocused),
        "nmse_energy": nmse_energy(picture, refocused, SCORED_BORDER_PX),
    }


def _write(picture: NDArray[Any], out: Path, measurement: Path, shear: float) -> None:
    """Write the picture; a PNG is scaled to the picture's own brightest pixel, the others keep the values."""
    from apps.files import history
    from tofclip.storage import Field, Record, atomic_path

    if out.suffix.lower() == ".h5":
        past = history({"verb": "clip recover", "shear": shear}, measurement)
        Record("picture", {"picture": Field(picture, "", ("y", "x"))}, {"shear": shear}, provenance=past).save(out)
        return
    with atomic_path(out) as temporary:
        if out.suffix.lower() == ".exr":
            import OpenEXR

            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            OpenEXR.File(header, {"Y": picture}).write(str(temporary))
        else:
            from matplotlib.image import imsave

            imsave(temporary, picture, cmap="gray", vmin=0, format="png")
