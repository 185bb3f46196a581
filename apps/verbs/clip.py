"""`tofclip clip`: what a light-field camera with few measurements would recover of a light field."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apps.cli import make_group
from apps.options import arg, name_any, opt
from apps.progress import show_progress
from apps.report import RECORD_SUFFIXES, build_provenance, report, require_writable, with_past
from tofclip.errors import InputError
from tofclip.plugins import DENOISERS

if TYPE_CHECKING:
    from tofclip.arrays import AnyArray
    from tofclip.light_field.views import ClipMeasurement
    from tofclip.recovery.light_field import AllInFocus, ClipRecovery

SCORED_BORDER_PX = 12  # views leave the picture there, so that the rim is not scored
ENCODERS = (
    *("line", "line-even", "single-pixel", "coded-line"),
    *("coded-aperture", "cubic-phase", "diffuser"),
)
SURFACES = "surfaces"
READABLE = "NPZ, HDF5, EXR with a part per view, or a folder."
WRITABLE = (".h5", ".png", ".exr")

app = make_group("Light fields from few nonlocal measurements.")


@app.command()
def simulate(
    light_field: Path = arg("LIGHTFIELD", READABLE, read=True),
    encoder: str = opt(
        "NAME",
        f"{name_any(ENCODERS)}.",
        ...,
        choices=ENCODERS,
    ),
    out: Path = opt("H5", "The measurements to write.", ...),
    sampling_ratio: float = opt("SR", "Measurements over pixels of one picture.", 0.5),
    seed: int = opt("N", "For angles, codes, photons and corrupted measurements.", 0, min=0),
    bad_fraction: float = opt("SHARE", "Measurements set to 0 or to the largest.", 0.0),
    photons: float | None = opt("N", "Photons of the largest measurement.", shown="no noise"),
) -> None:
    """Measure the true views of a light field with a camera of few measurements.

    Example: tofclip clip simulate light_field.npz --encoder line --sampling-ratio 0.5 --out
    measurements.h5
    """
    from tofclip.io.light_fields import read_light_field
    from tofclip.light_field.views import CameraSetup, corrupt_measurement, measure

    require_writable(out, *RECORD_SUFFIXES, inputs=(light_field,))
    known = read_light_field(light_field)
    setup = CameraSetup(encoder, sampling_ratio, seed)
    measurement = corrupt_measurement(measure(known, setup), photons, bad_fraction)
    noise = {"bad_fraction": bad_fraction, "photons": photons or 0.0}
    past = {"verb": "clip simulate", **asdict(setup), **noise}
    with_past(measurement, past, light_field).save(out)
    figures = {"readings": measurement.values.size, "image_shape": measurement.image_shape}
    report({**figures, **asdict(setup)}, [out])


@app.command()
def recover(
    measurement: Path = arg("H5", "Measurements made by clip simulate.", read=True),
    shear: float = opt("S", "Depth to focus on, pixels per view step.", ...),
    out: Path = opt("FILE", f"The picture: {name_any(WRITABLE)}.", ...),
    prior: str = opt(
        "NAME",
        f"A method with a prior, such as tv, wavelet or l1, or a denoiser, such as {name_any(DENOISERS.own)}.",
        "tv",
        choices=("tv", "wavelet", "l1", *DENOISERS.own),
    ),
    preset: str = opt(
        "NAME",
        "fast; quality: a denoiser finishes; surfaces: each pixel at its own depth.",
        "fast",
        choices=("fast", "quality", SURFACES),
    ),
    weight: str = opt("auto|VALUE", "Of the prior, relative; auto: cross-validation.", "auto"),
    data_term: str = opt(
        "NAME",
        "squares; huber for corrupted measurements; poisson for few photons.",
        "squares",
        choices=("squares", "huber", "poisson"),
    ),
    truth: Path | None = opt("LIGHTFIELD", "Light field to score against."),
    all_in_focus: Path | None = opt(
        "FILE",
        f"Picture sharp at all depths to write: {name_any(WRITABLE)}; .h5 with its depths.",
    ),
    depth_map: Path | None = opt(
        "FILE",
        "Known shear of each pixel: .npy, or .h5 written by --all-in-focus.",
        shown="found from the measurements",
    ),
    shear_range: tuple[float, float] = opt(
        "S S", "Nearest and farthest shear of surfaces to look for.", (-1.4, 1.4)
    ),
) -> None:
    """Recover the picture refocused at one depth, and one that is sharp at all depths.

    With surfaces one picture explains all measurements, each pixel at its own depth; the picture
    refocused at S is rendered from it. The weight is then that of this picture.

    Example: tofclip clip recover measurements.h5 --shear -0.3 --preset quality --out picture.png
    """
    import numpy as np

    from tofclip.io.light_fields import read_light_field
    from tofclip.light_field.views import ClipMeasurement
    from tofclip.metrics import nmse, nmse_energy
    from tofclip.recovery.light_field import ClipRecovery

    outputs = [path for path in (out, all_in_focus) if path is not None]
    # A wrong ending is refused before the recovery, not after it; no output replaces an input.
    for path in outputs:
        require_writable(path, *WRITABLE, inputs=(measurement, truth, depth_map))
    if out == all_in_focus:
        raise InputError("--out and --all-in-focus name the same file; take two")
    if depth_map is not None and preset != SURFACES and all_in_focus is None:
        raise InputError("--depth-map serves --preset surfaces and --all-in-focus only")
    # Surfaces are found with the settings of the fast preset, whichever refocuses.
    quick = ClipRecovery(prior, "fast", _parse_weight(weight), data_term)
    settings = replace(quick, preset="fast" if preset == SURFACES else preset)
    measurements = ClipMeasurement.load(measurement)
    known = None if truth is None else read_light_field(truth)
    surfaces = None
    if preset == SURFACES or all_in_focus is not None:
        own_weight = settings.weight if preset == SURFACES else None
        surfaces = _find_surfaces(measurements, quick, depth_map, shear_range, own_weight)
    found: Any = surfaces
    seconds = ["seconds"]
    if surfaces is not None and preset == SURFACES:
        picture = surfaces.render_views(measurements.views).refocus(shear)
    else:
        title = "recovering" if settings.weight is not None else "choosing the weight"
        with show_progress(title, settings.work) as advance:
            found = settings.recover(measurements, shear, advance)
        picture = found.picture
        seconds += ["seconds_setup", "seconds_weight"]
    figures: dict[str, Any] = {}
    if known is not None:
        refocused = known.refocus(shear)
        figures = {
            "nmse": nmse(picture, refocused, SCORED_BORDER_PX),
            "nmse_whole_frame": nmse(picture, refocused),
            "nmse_energy": nmse_energy(picture, refocused, SCORED_BORDER_PX),
        }
    past = {"verb": "clip recover", "shear": shear, "prior": prior}
    past |= {"preset": preset, "data_term": data_term}
    if surfaces is not None and all_in_focus is not None:
        arrays = {"picture": surfaces.picture, "shears": surfaces.shears}
        _write_picture(arrays, all_in_focus, measurement, past | {"weight": surfaces.weight})
        if known is not None and np.all(known.views == 0, axis=1).any():
            truth_picture = known.pictures[np.all(known.views == 0, axis=1)][0]
            score = nmse(surfaces.picture, truth_picture, SCORED_BORDER_PX)
            figures["nmse_all_in_focus"] = score
    figures |= {
        "weight": found.weight,
        "iterations": found.iterations,
        "stopped_because": found.stop_reason,
        **{name: getattr(found, name) for name in seconds},
    }
    _write_picture({"picture": picture}, out, measurement, past | {"weight": found.weight})
    report(figures, outputs)


def _find_surfaces(
    measurements: ClipMeasurement,
    settings: ClipRecovery,
    depth_map: Path | None,
    shears: tuple[float, float],
    weight: float | None,
) -> AllInFocus:
    """Recover one picture with a depth for each pixel, known or found."""
    from tofclip.io.light_fields import read_depth_map
    from tofclip.recovery import light_field as recovery

    if depth_map is not None:
        known = read_depth_map(depth_map)
        with show_progress("recovering at known depths", 1) as advance:
            found = recovery.recover_on_depth_map(measurements, known, weight, settings)
            advance(1)
        return found
    tried = recovery.make_shear_range(*shears, measurements.views)
    with show_progress("looking for depths", recovery.count_recoveries(tried)) as advance:
        return recovery.recover_all_in_focus(measurements, tried, weight, settings, advance)


def _parse_weight(text: str) -> float | None:
    """Return the weight that was asked for, None for `auto`: cross-validation chooses it."""
    if text == "auto":
        return None
    try:
        return float(text)
    except ValueError:
        raise InputError(f"--weight takes 'auto' or a number, not '{text}'") from None


def _write_picture(
    arrays: dict[str, AnyArray], out: Path, measurement: Path, settings: dict[str, Any]
) -> None:
    """Write the picture: a PNG scaled to its brightest pixel, else its values."""
    from matplotlib.image import imsave

    from tofclip.files import atomic_path
    from tofclip.io.light_fields import write_exr_parts
    from tofclip.storage import Field, Record

    picture, suffix = arrays["picture"], out.suffix.lower()
    if suffix == ".h5":
        units = {"picture": "", "shears": "px"}
        fields = {name: Field(arrays[name], units[name], ("y", "x")) for name in arrays}
        past = build_provenance(settings, measurement)
        Record("picture", fields, {"shear": settings["shear"]}, provenance=past).save(out)
        return
    if suffix == ".exr":
        write_exr_parts({"": {"Y": picture}}, out)
        return
    with atomic_path(out) as temporary:  # the library writes to the name that it gets
        imsave(temporary, picture, cmap="gray", vmin=0, format="png")
