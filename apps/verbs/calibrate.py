"""`tofclip calibrate`: four focus-mode pictures of a point source to a camera file; `tofclip
calibrate range`: shots of a target at known distances to a camera whose ranges are true; `tofclip
design`: what an instrument that is not built yet will see.
"""

from __future__ import annotations

import statistics
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apps.options import PICTURE_FORMATS, PREVIEW, SEED, arg, opt
from apps.progress import show_activity, show_progress
from apps.report import choose_preview, make_folder, report, require_writable
from apps.verbs.photons import (
    AXES,
    FIELD_OF_VIEW,
    FOCAL_LENGTH,
    choose_camera,
    read_any_photons,
    require_view,
)
from tofclip.errors import FileFormatError, InputError
from tofclip.files import PICTURE_SUFFIXES
from tofclip.units import MILLIMETRE, NANOSECOND, PICOSECOND

if TYPE_CHECKING:
    from tofclip.camera import Camera
    from tofclip.designs import Design, DesignReport
    from tofclip.lidar.range_calibration import RangeFit, TargetShot


def calibrate(
    line: Path = opt("TIF", "Point source, slit open: a line for each lenslet.", ...),
    line_background: Path = opt("TIF", "The same without the source.", ...),
    dot: Path = opt("TIF", "Point source, slit closed: a dot for each lenslet.", ...),
    dot_background: Path = opt("TIF", "The same without the source.", ...),
    out: Path = opt("H5", "The camera file to write.", ...),
    time_zero: float | None = opt(
        "NS",
        "Reading of the time axis at which light of range 0 would arrive, in ns; e.g. -10.784. These pictures do not "
        "show it; calibrate range finds it.",
        name="--time-zero-ns",
        shown="not known: ranges are right up to one constant",
    ),
    focal_length_px: float | None = opt(
        "PX",
        "Distance from lenslet to picture in pixels, which these pictures do not show. It gives the cloud its width "
        "and height.",
        shown="265, that of similar instruments",
    ),
    pulse_fwhm: float | None = opt(
        "PS",
        "Full width at half maximum of the response to a short pulse.",
        name="--pulse-ps",
        shown="60",
    ),
    preview: Path | None = PREVIEW,
) -> None:
    """Find every view's slit centre and line angle, and draw the fits over the data.

    The uncertainty of every parameter is written as well. `tofclip calibrate range` adds what a
    target at known distances shows of ranges.

    Example: tofclip calibrate --line line.tif --line-background line_background.tif --dot dot.tif
    --dot-background dot_background.tif --out camera.h5
    """
    import numpy as np

    from apps.figures.instrument import make_calibration_figure
    from tofclip.camera.focus_pictures import calibrate_views
    from tofclip.io import read_streak
    from tofclip.notebook import save_figure

    pictures = (line, line_background, dot, dot_background)
    # Both outputs are checked before any picture is read, and neither may replace an input.
    preview = choose_preview(out, preview, pictures)
    lines, no_lines, dots, no_dots = (read_streak(path).counts for path in pictures)
    with show_activity("calibrating"):
        found = calibrate_views(lines, no_lines, dots, no_dots)
    known = {"time_zero": time_zero, "focal_length_px": focal_length_px, "pulse_fwhm": pulse_fwhm}
    # Options that were not given leave the defaults of the camera alone.
    found.camera(**{name: value for name, value in known.items() if value is not None}).save(out)
    save_figure(make_calibration_figure(found), preview)
    figures = {
        "angles_deg": np.rad2deg(found.angles),
        "angle_uncertainty_deg": np.rad2deg(found.angle_uncertainty),
        "centres_px": found.centres_px,
        "centre_uncertainty_px": found.centre_uncertainty_px,
    }
    report(figures, [out, preview])


def calibrate_range(
    shots: list[str] = arg(
        "SHOT...",
        "Shots of the target: streak images, recovered frames, or photons as lidar photons takes them.",
        read=True,
    ),
    target_m: list[float] = opt(
        "M",
        "Distance of the target along the optical axis; once for all shots, or again for each.",
        ...,
    ),
    out: Path = opt("H5", "The camera file to write.", ...),
    camera: Path | None = opt(
        "H5", "Camera to calibrate.", shown="the one inside the first shot; of photons a pinhole"
    ),
    reflectance_percent: list[float] | None = opt(
        "PERCENT",
        "Of the target; once for all shots, or again for each, times its filter's transmission.",
        shown="not known",
    ),
    walk: bool | None = opt(
        None,
        "Fit how ranges depend on intensity, or refuse; or leave it.",
        name="--walk/--no-walk",
        shown="where the shots can tell",
    ),
    region: tuple[int, int, int, int] | None = opt(
        "Y0 Y1 X0 X1",
        "Rows and columns where the target is, the last ones not included.",
        shown="everywhere",
    ),
    method: str = opt(
        "NAME",
        "By which streak images are recovered: tv, l1 or linear; that of later shots.",
        "tv",
        choices=("tv", "l1", "linear"),
    ),
    bin_width: float | None = opt(
        "PS", "Duration of a row or bin.", name="--bin-width-ps", shown="the file's"
    ),
    pulse_fwhm: float | None = opt(
        "PS",
        "Of photons: full width at half maximum of the pulse.",
        name="--pulse-ps",
        shown="learnt",
    ),
    axes: str | None = AXES,
    focal_length_px: float | None = FOCAL_LENGTH,
    field_of_view_deg: float = FIELD_OF_VIEW,
    preview: Path | None = PREVIEW,
) -> None:
    """Find time zero, range walk, offsets, response and reflectance from shots of a target.

    The target is flat, faces the camera and fills most of the picture. One shot gives time zero,
    two give each pixel's range offset and brightness, three of different brightness
    (other distances, or grey filters) how ranges depend on intensity. All of it goes into the camera
    file, with standard deviations, and is used wherever that camera is: recover, cloud, stream, view,
    lidar sequence and lidar photons. A shot of anything but a plate is refused.

    Example: tofclip calibrate range --target-m 1.5 plate.h5 --out camera.h5

    Example: tofclip calibrate range --target-m 1 --target-m 2 --target-m 3 near.npy middle.npy far.npy
    --bin-width-ps 80 --reflectance-percent 50 --out camera.h5
    """
    import math

    from apps.figures.instrument import make_range_calibration_figure
    from tofclip.camera import Camera
    from tofclip.lidar import Pulse
    from tofclip.lidar.photons import estimate_pixels
    from tofclip.lidar.range_calibration import TargetShot, fit_range_calibration
    from tofclip.notebook import save_figure

    preview = choose_preview(out, preview, (*shots, camera))
    require_view(focal_length_px, field_of_view_deg)
    distances = _one_each(target_m, len(shots), "--target-m")
    # NaN stands for a target of unknown reflectance; given, it is a mistake.
    if any(map(math.isnan, reflectance_percent or [])):
        raise InputError("--reflectance-percent must be a positive percentage, got nan")
    percents = _one_each(reflectance_percent or [math.nan], len(shots), "--reflectance-percent")
    if not all(0 < distance < math.inf for distance in distances):
        raise InputError(f"--target-m: a distance must be a positive length, got {distances}")
    known = None if camera is None else Camera.load(camera)
    pulse = None if pulse_fwhm is None else Pulse.gaussian(pulse_fwhm)
    seen = []
    with show_progress("looking at the target", len(shots)) as advance:
        for shot, distance, percent in zip(shots, distances, percents, strict=True):
            one = _read_shot(shot, distance, known, method, bin_width)
            if one is None:
                image, own_pulse, first_time = read_any_photons(shot, bin_width, axes)
                found = estimate_pixels(image, pulse or own_pulse)
                view = (focal_length_px, field_of_view_deg, found.pulse.fwhm)
                seen_by = choose_camera(known, image.image_shape, *view)
                # Ranges count from the first bin, as time zero will.
                from_start = seen_by.replace(time_zero=0.0, range_calibration=None)
                returns = found.calibrate(from_start, first_time).to_returns(from_start)
                record = (first_time, first_time + (image.bins - 1) * image.bin_width)
                one = TargetShot(returns, distance, record, shot)
            one = replace(one, reflectance_percent=percent)
            if region is not None:
                (top, bottom, left, right), y, x = region, one.returns.y, one.returns.x
                rows, columns = one.returns.camera.image_shape
                if not (0 <= top < bottom <= rows and 0 <= left < right <= columns):
                    said = f"the picture has rows 0..{rows} and columns 0..{columns}"
                    raise InputError(f"--region: {said}")
                one = one.cut((y >= top) & (y < bottom) & (x >= left) & (x < right))
            seen.append(one)
            advance(1)
    fit = fit_range_calibration(seen, walk=walk)
    fit.camera.save(out)
    save_figure(make_range_calibration_figure(fit, distances), preview)
    report(_list_figures(fit, len(shots)), [out, preview])


def _one_each(values: list[float], shots: int, option: str) -> list[float]:
    """Give every shot its value."""
    if len(values) not in (1, shots):
        raise InputError(
            f"{option}: give one for all {shots} shots or one for each, got {len(values)}"
        )
    return values * shots if len(values) == 1 else values


def _read_shot(
    shot: str, distance: float, camera: Camera | None, method: str, bin_width: float | None
) -> TargetShot | None:
    """Find the returns of a shot of a target at a distance, m, as they were measured, in frames or a
    streak image; None of counted photons.
    """
    from devices.transients import find_address
    from tofclip.files import translate_read_errors
    from tofclip.io import read_streak
    from tofclip.lidar import depth
    from tofclip.lidar.photons.files import PHOTON_SUFFIXES
    from tofclip.lidar.range_calibration import TargetShot
    from tofclip.recovery import make_method, open_shot, parse_focus, plan_recovery
    from tofclip.shots import Frames
    from tofclip.storage import HDF5_SIGNATURE, read_outline

    if "://" in shot or Path(shot).suffix.lower() in PHOTON_SUFFIXES or find_address(shot):
        return None
    with translate_read_errors(shot), open(shot, "rb") as file:
        ours = file.read(len(HDF5_SIGNATURE)) == HDF5_SIGNATURE
    try:
        is_frames = ours and read_outline(shot).kind == Frames.RECORD_KIND
        streak = None if is_frames else read_streak(shot, bin_width)
    except FileFormatError:
        return None
    if streak is None:
        frames = Frames.load(shot)
    else:
        known = camera or streak.camera
        if known is None:
            raise InputError(f"{streak.source} carries no camera: give one (`camera`)")
        known = known.replace(range_calibration=None)
        # Before anything that comes back, so that no return is lost to a time zero not yet known.
        first, last = streak.times[[0, -1]]
        opened = open_shot(streak, known, float(2 * first - last))
        # The target's distance is known, and so is where the views see it.
        focus = parse_focus(f"fixed:{float(known.shear_at(distance)):.9g}")
        frames = plan_recovery(opened, make_method(method), focus, "cpu").run()
    if frames.returns is not None and frames.camera.range_calibration is not None:
        raise InputError(
            f"{shot}: its returns are corrected already: recover it with a camera without a "
            "range calibration"
        )
    bare = frames.camera.replace(range_calibration=None)
    returns = depth(frames, bare if frames.returns is None else None)
    record = frames.times[0], frames.times[-1]
    return TargetShot(replace(returns, camera=bare), distance, record, shot)


def _list_figures(found: RangeFit, shots: int) -> dict[str, Any]:
    """List what was found; what was not is None, with the reason in a note."""
    import numpy as np

    known = found.calibration
    has_walk = known.walk.size
    has_offsets = known.offsets.size
    figures: dict[str, Any] = {
        "shots": shots,
        "target_share": found.target_fraction,
        "time_zero_ns": found.camera.time_zero / NANOSECOND,
        "time_zero_sigma_ps": known.time_zero_sigma / PICOSECOND,
        "shot_jitter_ps": found.jitter / PICOSECOND,
        "intensity_counts": known.signal_range,
        "walk_mm_per_decade": known.walk[0] / MILLIMETRE if has_walk else None,
        "walk_sigma_mm": np.sqrt(known.walk_covariance[0, 0]) / MILLIMETRE if has_walk else None,
        "offset_rms_mm": found.offset_spread / MILLIMETRE,
        "offset_sigma_mm": np.median(known.offset_sigma) / MILLIMETRE if has_offsets else None,
        "response_rms": np.std(known.response) if known.response.size else None,
        "reflectance_percent_of_one_count_at_1_m": known.reflectance_scale,
        "reflectance_relative_sigma": known.reflectance_scale_sigma,
    }
    notes = {"walk": found.walk_note, "offsets": found.offsets_note}
    return figures | {f"{name}_note": note for name, note in notes.items() if note}


SCENE_NAMES = ("letters", "plates", "poles")


def design(
    camera: Path = arg("TOML", "The instrument; keys as in tofclip.designs.Design.", read=True),
    out: Path = opt(
        "PNG", f"The picture, {PICTURE_FORMATS}; with --simulate a folder.", Path("design.png")
    ),
    compare: Path | None = opt("TOML", "Another instrument to draw below.", shown="none"),
    optimise: str | None = opt(
        "WHAT",
        "angles: find better ones up to max_angle_deg for the range near_m to far_m, compare, and write them "
        "beside --out, .toml.",
        shown="nothing",
        choices=("angles",),
    ),
    simulate: str | None = opt(
        "SCENE",
        f"Write shots with their camera and truth instead: {', '.join(SCENE_NAMES)}.",
        shown="none",
        choices=SCENE_NAMES,
    ),
    shots: int = opt("N", "Simulated shots of each scene; 0: predictions alone.", 20, min=0),
    seed: int = SEED,
) -> None:
    """Say what a CLIP instrument will see before it is built, by theory and by simulated shots.

    Picture errors (NMSE) and range deviations are those of the linear inverse, bias and noise apart;
    methods with a prior do better. They are computed from the camera's operator and, beside them, found
    in shots of three scenes that the ray caster draws. range_offset_m is what other pixels' rays do to
    a range in all shots alike.

    With --simulate, recover takes the shots of a slit or a 1d sensor, and clip recover those of a 2d or
    0d sensor, whose instants are summed.

    Example: tofclip design camera.toml --out camera.png

    Example: tofclip design camera.toml --optimise angles --out better.png

    Example: tofclip design camera.toml --simulate plates --shots 3 --out shots/
    """
    from tofclip.designs import Design, optimise_angles
    from tofclip.designs import design as examine

    if optimise not in (None, "angles"):
        raise InputError(f"'{optimise}' cannot be optimised; take angles")
    if simulate is None:
        require_writable(out, *PICTURE_SUFFIXES, inputs=(camera, compare))
    known = {camera.stem: Design.load(camera)}
    if simulate is not None:
        if compare or optimise:
            raise InputError("--simulate writes shots of one instrument; leave the others out")
        if out.suffix in PICTURE_SUFFIXES:
            raise InputError("--simulate writes a folder of shots; name it by --out")
        written = _write_shots(known[camera.stem], simulate, shots, seed, out)
        report({"scene": simulate, "shots": shots, "seed": seed}, written)
        return
    written = [out]
    if compare is not None:
        known[compare.stem if compare.stem not in known else str(compare)] = Design.load(compare)
    with show_activity("examining"):
        if optimise:
            better, file = optimise_angles(known[camera.stem]), out.with_suffix(".toml")
            require_writable(file, inputs=(camera, compare))
            better.save(file)
            known["optimised"] = better
            written.append(file)
        reports = {name: examine(one, shots, seed) for name, one in known.items()}
    from apps.figures.instrument import make_design_figure
    from tofclip.notebook import save_figure

    save_figure(make_design_figure(reports), out)
    told = {name: _list_design_figures(one) for name, one in reports.items()}
    if len(told) == 1:
        told = told[camera.stem]
    else:  # side by side, their scenes below
        scenes = {f"{name}_scenes": one.pop("scenes") for name, one in told.items()}
        told |= scenes
    report(told, written)


def _list_design_figures(found: DesignReport) -> dict[str, Any]:
    """Figures by name; those of the scenes by theirs."""
    figures = {"angles_deg": list(found.design.angles_deg), **found.figures}
    names = {
        "picture_error": "picture_error",
        "picture_bias": "picture_bias",
        "range_deviation_m": "median_deviation",
        "range_offset_m": "median_offset",
    }
    scenes = {
        scene: {
            f"{name}_{kind}": getattr(known.get(scene), field, None)
            for name, field in names.items()
            for kind, known in (("predicted", found.predicted), ("simulated", found.simulated))
        }
        for scene in found.predicted
    }
    seconds = [one.seconds for one in found.simulated.values()]
    pace = statistics.median(seconds) if seconds else None
    return {**figures, "seconds_per_shot": pace, "scenes": scenes}


def _write_shots(known: Design, name: str, shots: int, seed: int, out: Path) -> list[Path]:
    """Write shots, camera and true frames into a folder."""
    from tofclip.design_description import make_scene
    from tofclip.designs import take_shots
    from tofclip.simulate import render_true_frames

    if shots < 1:
        raise InputError("--simulate takes --shots 1 or more")
    scene = make_scene(name, known)
    make_folder(out / "shots")
    exposure, taken = take_shots(known, scene, shots, seed)
    written = []
    for number, shot in enumerate(taken):
        written.append(out / "shots" / f"shot_{number:03}.h5")
        shot.save(written[-1])
    truth, camera = out / "truth.h5", out / "camera.h5"
    render_true_frames(scene, known.instrument, exposure).save(truth)
    known.camera.save(camera)
    return [*written, truth, camera]
