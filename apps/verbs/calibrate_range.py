"""`tofclip calibrate range`: shots of a target at known distances to a camera whose ranges are true."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from apps.conventions import JsonOption, PreviewOption, choose_preview, make_completer, report
from apps.figures.range_calibration import make_range_calibration_figure
from apps.figures.style import save_figure
from apps.progress import show_progress
from apps.verbs.photons import (
    DEFAULT_FIELD_OF_VIEW_DEG,
    choose_camera,
    read_any_photons,
    require_view,
)
from devices.counted_photons import find_address
from tofclip.camera import Camera
from tofclip.errors import FileFormatError, InputError
from tofclip.files import translate_read_errors
from tofclip.io import read_streak
from tofclip.lidar import Pulse, depth
from tofclip.lidar.photons import estimate_pixels
from tofclip.lidar.range_calibration import RangeFit, TargetShot, fit_range_calibration
from tofclip.recovery import make_method, open_shot, parse_focus, plan_recovery
from tofclip.shots import Frames
from tofclip.storage import HDF5_SIGNATURE, read_outline
from tofclip.units import MILLIMETRE, NANOSECOND, PICOSECOND

if TYPE_CHECKING:
    from tofclip.shots import Streak

PHOTON_SUFFIXES = (".npy", ".mat", ".ptu", ".sdt")


def calibrate_range(
    shots: Annotated[
        list[str],
        typer.Argument(
            metavar="SHOT...",
            help="Shots of the target: streak images, recovered frames, or photons as lidar photons takes them.",
        ),
    ],
    target_m: Annotated[
        list[float],
        typer.Option(
            metavar="M",
            help="Distance of the target along the optical axis; once for all shots, or again for each.",
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="H5", help="The camera file to write.")],
    camera: Annotated[
        Path | None,
        typer.Option(
            metavar="H5",
            help="That is calibrated.",
            show_default="the one inside the first shot; of photons a pinhole",
        ),
    ] = None,
    reflectance_percent: Annotated[
        list[float] | None,
        typer.Option(
            metavar="PERCENT",
            help="Of the target; once for all shots, or again for each, times its filter's transmission.",
            show_default="not known",
        ),
    ] = None,
    walk: Annotated[
        bool | None,
        typer.Option(
            "--walk/--no-walk",
            help="Fit how ranges depend on intensity, or refuse; or leave it.",
            show_default="where the shots can tell",
        ),
    ] = None,
    region: Annotated[
        tuple[int, int, int, int] | None,
        typer.Option(
            metavar="Y0 Y1 X0 X1",
            help="Rows and columns where the target is, the last ones not included.",
            show_default="everywhere",
        ),
    ] = None,
    method: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="By which streak images are recovered: tv, l1 or linear; that of later shots.",
            autocompletion=make_completer("tv", "l1", "linear"),
        ),
    ] = "tv",
    bin_width_ps: Annotated[
        float | None,
        typer.Option(metavar="PS", help="Duration of a row or bin.", show_default="the file's"),
    ] = None,
    pulse_ps: Annotated[
        float | None,
        typer.Option(
            metavar="PS",
            help="Of photons: full width at half maximum of the pulse.",
            show_default="learnt",
        ),
    ] = None,
    axes: Annotated[
        str | None,
        typer.Option(
            metavar="ORDER",
            help="Of photons: order of a cube's axes, e.g. tyx.",
            show_default="recognised",
        ),
    ] = None,
    focal_length_px: Annotated[
        float | None,
        typer.Option(
            metavar="PX",
            help="Of photons: of the pinhole camera.",
            show_default="the camera's, or from the field of view",
        ),
    ] = None,
    field_of_view_deg: Annotated[
        float, typer.Option(metavar="DEG", help="Of photons: width of the picture.")
    ] = DEFAULT_FIELD_OF_VIEW_DEG,
    preview: PreviewOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find time zero, range walk, offsets, response and reflectance from shots of a target.

    The target is flat, faces the camera and fills most of the picture. One shot gives time zero,
    two give what each pixel measures too long and how bright it is, three of different brightness
    (other distances, or grey filters) how ranges depend on intensity. All of it goes into the camera
    file, with standard deviations, and is used wherever that camera is: recover, cloud, stream, view,
    lidar sequence and lidar photons. A shot of anything but a plate is refused.

    Example: tofclip calibrate range --target-m 1.5 plate.h5 --out camera.h5

    Example: tofclip calibrate range --target-m 1 --target-m 2 --target-m 3 near.npy middle.npy far.npy
    --bin-width-ps 80 --reflectance-percent 50 --out camera.h5
    """
    preview = choose_preview(out, preview, (*shots, camera))
    require_view(focal_length_px, field_of_view_deg)
    distances = _one_each(target_m, len(shots), "--target-m")
    # NaN stands for a target of unknown reflectance; given, it is a mistake.
    if reflectance_percent and np.isnan(reflectance_percent).any():
        raise InputError("--reflectance-percent must be a positive percentage, got nan")
    percents = _one_each(reflectance_percent or [np.nan], len(shots), "--reflectance-percent")
    reader = _ShotReader(
        None if camera is None else Camera.load(camera),
        method,
        None if bin_width_ps is None else bin_width_ps * PICOSECOND,
        None if pulse_ps is None else Pulse.gaussian(pulse_ps * PICOSECOND),
        axes,
        (focal_length_px, field_of_view_deg),
    )
    seen = []
    with show_progress("looking at the target", len(shots)) as advance:
        for shot, distance, percent in zip(shots, distances, percents, strict=True):
            one = replace(reader.read(shot, distance), reflectance_percent=percent)
            seen.append(one if region is None else _cut(one, region))
            advance(1)
    found = fit_range_calibration(seen, walk=walk)
    found.camera.save(out)
    save_figure(make_range_calibration_figure(found), preview)
    report(_make_figures(found, len(shots)), as_json, [out, preview])


def _one_each(values: list[float], shots: int, option: str) -> list[float]:
    """Give every shot its value."""
    if len(values) not in (1, shots):
        raise InputError(
            f"{option}: give one for all {shots} shots or one for each, got {len(values)}"
        )
    return values * shots if len(values) == 1 else values


def _cut(shot: TargetShot, region: tuple[int, int, int, int]) -> TargetShot:
    """Leave the returns within some rows and columns."""
    top, bottom, left, right = region
    rows, columns = shot.returns.camera.image_shape
    if not (0 <= top < bottom <= rows and 0 <= left < right <= columns):
        raise InputError(f"--region: the picture has rows 0..{rows} and columns 0..{columns}")
    y, x = shot.returns.y, shot.returns.x
    return shot.cut((y >= top) & (y < bottom) & (x >= left) & (x < right))


@dataclass(frozen=True)
class _ShotReader:
    """How shots of the target are read."""

    camera: Camera | None
    method: str
    bin_width: float | None  # s
    pulse: Pulse | None
    axes: str | None
    # (float or None, float), focal length, px, and field of view, degrees, of a pinhole
    view: tuple[float | None, float]

    def read(self, shot: str, distance: float) -> TargetShot:
        """Find the returns of a shot, as they were measured.

        `shot`: file or address; `distance`: of the target, m.
        """
        if not (np.isfinite(distance) and distance > 0):
            raise InputError(f"--target-m: a distance must be a positive length, got {distance}")
        frames = self._load_frames(shot, distance)
        if frames is None:
            return self._read_photons(shot, distance)
        if frames.returns is not None and frames.camera.range_calibration is not None:
            raise InputError(
                f"{shot}: its returns are corrected already: recover it with a camera without a "
                "range calibration"
            )
        bare = frames.camera.replace(range_calibration=None)
        returns = depth(frames, bare) if frames.returns is None else frames.returns
        record = float(frames.times[0]), float(frames.times[-1])
        return TargetShot(replace(returns, camera=bare), distance, record, shot)

    def _load_frames(self, shot: str, distance: float) -> Frames | None:
        """Load frames or recover them; None of counted photons."""
        if "://" in shot or Path(shot).suffix.lower() in PHOTON_SUFFIXES or find_address(shot):
            return None
        with translate_read_errors(shot), open(shot, "rb") as file:
            ours = file.read(len(HDF5_SIGNATURE)) == HDF5_SIGNATURE
        try:
            if ours and read_outline(shot).kind == Frames.RECORD_KIND:
                return Frames.load(shot)
            streak = read_streak(shot, self.bin_width)
        except FileFormatError:
            return None
        return self._recover(streak, distance)

    def _recover(self, streak: Streak, distance: float) -> Frames:
        known = self.camera or streak.camera
        if known is None:
            raise InputError(f"{streak.source} carries no camera: give one (`camera`)")
        known = known.replace(range_calibration=None)
        # Before anything that comes back, so that no return is lost to a time zero not yet known.
        first, last = streak.times[[0, -1]]
        opened = open_shot(streak, known, float(2 * first - last))
        # The target's distance is known, and so is where the views see it.
        focus = parse_focus(f"fixed:{float(known.shear_at(distance)):.9g}")
        return plan_recovery(opened, make_method(self.method), focus, "cpu").run()

    def _read_photons(self, shot: str, distance: float) -> TargetShot:
        image, pulse, first_time = read_any_photons(shot, self.bin_width, self.axes)
        found = estimate_pixels(image, self.pulse or pulse)
        seen_by = choose_camera(self.camera, image.image_shape, *self.view, found.pulse.fwhm)
        # Ranges count from the first bin, as time zero will.
        from_start = seen_by.replace(time_zero=0.0, range_calibration=None)
        returns = found.calibrate(from_start, first_time).to_returns(from_start)
        last_time = first_time + (image.bins - 1) * image.bin_width
        return TargetShot(returns, distance, (first_time, last_time), shot)


def _make_figures(found: RangeFit, shots: int) -> dict[str, Any]:
    """List what was found; what was not is None, with the reason in a note."""
    known = found.calibration
    figures: dict[str, Any] = {
        "shots": shots,
        "target_share": found.target_fraction,
        "time_zero_ns": found.camera.time_zero / NANOSECOND,
        "time_zero_sigma_ps": known.time_zero_sigma / PICOSECOND,
        "shot_jitter_ps": found.jitter / PICOSECOND,
        "intensity_counts": known.signal_range,
        "walk_mm_per_decade": known.walk[0] / MILLIMETRE if known.walk.size else None,
        "walk_sigma_mm": np.sqrt(known.walk_covariance[0, 0]) / MILLIMETRE
        if known.walk.size
        else None,
        "offset_rms_mm": found.offset_spread / MILLIMETRE,
        "offset_sigma_mm": np.median(known.offset_sigma) / MILLIMETRE
        if known.offsets.size
        else None,
        "response_rms": np.std(known.response) if known.response.size else None,
        "reflectance_percent_of_one_count_at_1_m": known.reflectance_scale,
        "reflectance_relative_sigma": known.reflectance_scale_sigma,
    }
    notes = {"walk": found.walk_note, "offsets": found.offsets_note}
    return figures | {f"{name}_note": note for name, note in notes.items() if note}
