"""`tofclip lidar photons`: counted photons of a picture to its ranges."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from apps.conventions import (
    PICTURE_SUFFIXES,
    JsonOption,
    build_provenance,
    report,
    require_writable,
)
from apps.figures.photons import make_range_figure
from apps.figures.style import save_figure
from apps.progress import show_progress
from apps.verbs.cloud import CLOUD_SUFFIXES, DEPTH_SUFFIX
from devices.counted_photons import find_address
from devices.counted_photons import read_photons as read_counted_photons
from tofclip.camera import Camera
from tofclip.errors import InputError
from tofclip.files import atomic_path
from tofclip.lidar import Pulse, point_cloud, save_depth
from tofclip.lidar.photons import (
    PhotonImage,
    SurfaceImage,
    estimate_pixels,
    estimate_surface,
    make_pinhole,
)
from tofclip.lidar.photons.files import read_photons
from tofclip.units import NANOSECOND, PICOSECOND

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Any

RANGE_IMAGE_SUFFIX = ".npz"
DEFAULT_FIELD_OF_VIEW_DEG = 30.0

MAX_RETURNS = 255
"""Of a pixel: clouds number them in a byte."""


def photons(
    file: Annotated[
        str,
        typer.Argument(
            metavar="FILE",
            help="Counted photons: .npy, .npz, .mat, HDF5, multi-page TIFF, .ptu or .sdt; a cube of counts, a list of "
            "photon times for each pixel, or events x, y, time. Or a LinoSPAD2's recording (.dat), one by record, or "
            "an instrument that counts them, such as 'spad512://HOST?mode=gated'.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE",
            help="Ends in .npz for a range image, in .ply, .pcd, .csv, .las, .laz or .h5 for a point cloud, in .exr "
            "for a depth picture, in .png, .pdf or .svg for a drawing.",
        ),
    ],
    bin_width_ps: Annotated[
        float | None,
        typer.Option(
            metavar="PS",
            help="Duration of a bin, or unit of the photon times.",
            show_default="the file's",
        ),
    ] = None,
    pulse_ps: Annotated[
        float | None,
        typer.Option(
            metavar="PS",
            help="Full width at half maximum of the pulse; its shape is learnt if the photons show another one.",
            show_default="learnt",
        ),
    ] = None,
    pulse: Annotated[
        Path | None,
        typer.Option(
            metavar="NPY",
            help="Measured response: its brightness in successive bins; its highest bin is the arrival.",
            show_default="learnt",
        ),
    ] = None,
    axes: Annotated[
        str | None,
        typer.Option(
            metavar="ORDER", help="Order of a cube's axes, e.g. tyx.", show_default="recognised"
        ),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            metavar="H5",
            help="Made by calibrate range of the same pixels: its time zero, range walk, offsets, reflectance and "
            "focal length are used.",
            show_default="a pinhole",
        ),
    ] = None,
    focal_length_px: Annotated[
        float | None,
        typer.Option(
            metavar="PX",
            help="Of the pinhole camera.",
            show_default="the camera's, or from the field of view",
        ),
    ] = None,
    field_of_view_deg: Annotated[
        float,
        typer.Option(metavar="DEG", help="Width of the picture, in place of a focal length."),
    ] = DEFAULT_FIELD_OF_VIEW_DEG,
    time_zero_ns: Annotated[
        float | None,
        typer.Option(
            metavar="NS",
            help="When light of range 0 arrives, after the first bin; of an instrument's own time.",
            show_default="the camera's, or 0",
        ),
    ] = None,
    single_pixel: Annotated[
        bool, typer.Option("--single-pixel", help="Judge every pixel by its own photons alone.")
    ] = False,
    background: Annotated[
        Path | None,
        typer.Option(
            metavar="NPY",
            help="With --single-pixel: shape of the background over the bins, as of a dark frame.",
            show_default="what the pixels have in common",
        ),
    ] = None,
    cycles: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="With --single-pixel: laser cycles of each pixel, of a detector that counts the first photon of a "
            "cycle only; pile-up is corrected.",
            show_default="no pile-up",
        ),
    ] = None,
    returns: Annotated[
        int,
        typer.Option(
            metavar="N",
            help="Surfaces looked for in each pixel; pictures, .exr among them, show the strongest.",
        ),
    ] = 1,
    as_json: JsonOption = False,
) -> None:
    """Find the surface that counted photons show, with the deviation of every range.

    Pulse, background and how far neighbours help each other are found from the photons. Hot pixels
    are left out, counted, and marked in a range image (hot_pixels). Of several --returns a range
    image holds the strongest in range_m and all of them in returns_range_m (rows, columns, returns),
    NaN where there is none; likewise range_sigma_m, intensity and outlier_probability.

    Example: tofclip lidar photons cube.npy --bin-width-ps 80 --pulse-ps 400 --out range.npz
    """
    started = time.perf_counter()
    suffix = out.suffix.lower()
    inputs = _list_inputs(file, pulse, background, camera)
    if not single_pixel and (background is not None or cycles is not None):
        raise InputError("--background and --cycles go with --single-pixel")
    require_writable(
        out,
        *CLOUD_SUFFIXES,
        DEPTH_SUFFIX,
        *PICTURE_SUFFIXES,
        inputs=(file, pulse, background, camera),
    )
    if pulse is not None and pulse_ps is not None:
        raise InputError("give the pulse's width (--pulse-ps) or its shape (--pulse), not both")
    if not 1 <= returns <= MAX_RETURNS:
        raise InputError(f"--returns: 1 to {MAX_RETURNS} are looked for in a pixel, got {returns}")
    require_view(focal_length_px, field_of_view_deg)
    known = None if camera is None else Camera.load(camera)
    width = None if bin_width_ps is None else bin_width_ps * PICOSECOND
    image, shape, first_time = read_any_photons(file, width, axes)
    shape = _load_pulse(pulse, image.bin_width) or shape
    if pulse_ps is not None:
        shape = Pulse.gaussian(pulse_ps * PICOSECOND)
    found = (
        estimate_pixels(
            image,
            shape,
            background=_load_background(background),
            cycles=cycles,
            max_returns=returns,
        )
        if single_pixel
        else _find_surfaces(image, shape, pulse is None, returns)
    )
    seen_by = choose_camera(
        known, image.image_shape, focal_length_px, field_of_view_deg, found.pulse.fwhm
    )
    if time_zero_ns is not None:
        seen_by = seen_by.replace(time_zero=time_zero_ns * NANOSECOND)
    found = found.calibrate(seen_by, first_time)
    settings = {
        "bin_width_ps": image.bin_width / PICOSECOND,
        "bins": image.bins,
        "image_shape": list(image.image_shape),
        **({"axes": image.axes} if image.axes else {}),
        "focal_length_px": seen_by.focal_length_px,
        "time_zero_ns": seen_by.time_zero / NANOSECOND,
        **({} if camera is None else {"camera": str(camera)}),
        "single_pixel": single_pixel,
        "returns": returns,
        **({} if cycles is None else {"cycles": cycles}),
        **found.settings,
    }
    past = build_provenance({"verb": "lidar photons", "source": file, **settings}, *inputs)
    # The ending of the name chooses what is written.
    if suffix == RANGE_IMAGE_SUFFIX:
        save_range_image(found, seen_by, out, returns)
    elif suffix in PICTURE_SUFFIXES:
        save_figure(make_range_figure(found), out)
    elif suffix == DEPTH_SUFFIX:
        save_depth(found.to_returns(seen_by, past), out)
    else:
        point_cloud(found.to_returns(seen_by, past)).save(out)
    seen = np.isfinite(found.range)
    report(_make_figures(found, seen, time.perf_counter() - started, settings), as_json, [out])


def _find_surfaces(
    image: PhotonImage, pulse: Pulse | None, learn: bool, max_returns: int
) -> SurfaceImage:
    """Find the surface of every pixel, and show how much of the work is done."""
    shown = 0
    with show_progress("finding surfaces", 100) as advance:

        def show(fraction: float) -> None:
            nonlocal shown
            percent = round(100 * fraction)
            advance(percent - shown)
            shown = percent

        return estimate_surface(image, pulse, learn, max_returns, progress=show)


def _list_inputs(file: str, *further: Path | None) -> tuple[Path, ...]:
    named = () if "://" in file else (Path(file),)
    return (*named, *(path for path in further if path is not None))


def read_any_photons(
    file: str, bin_width: float | None, axes: str | None
) -> tuple[PhotonImage, Pulse | None, float]:
    """Read a file or an instrument; return its photons, its response where it knows that, and the
    time of its first bin, s.
    """
    address = file if "://" in file else find_address(file)
    if address is None:
        return read_photons(Path(file), bin_width, axes), None, 0.0
    if axes is not None:
        raise InputError(f"{file}: an instrument knows its own axes")
    counted = read_counted_photons(address, bin_width)
    return counted.to_image(), counted.pulse, float(counted.times[0])


def _make_figures(
    found: SurfaceImage, seen: np.ndarray[Any, Any], seconds: float, settings: Mapping[str, Any]
) -> dict[str, Any]:
    return {
        "pixels": seen.size,
        "coverage": float(seen.mean()),
        "returns": sum(int(np.isfinite(one.range).sum()) for one in (found, *found.further)),
        "outlier_share": float(found.outlier_probability[seen].mean()) if seen.any() else 0.0,
        "seconds": seconds,
        "settings": dict(settings),
    }


def _load_pulse(path: Path | None, bin_width: float) -> Pulse | None:
    """Read a measured response, one value for each bin."""
    if path is None:
        return None
    bright = _load_bins(path, "the pulse's bins")
    return Pulse(bright, bin_width, float(np.argmax(bright)))


def _load_background(path: Path | None) -> np.ndarray[Any, Any] | None:
    return None if path is None else _load_bins(path, "the background's bins")


def _load_bins(path: Path, what: str) -> np.ndarray[Any, Any]:
    """Read one number for each bin."""
    try:
        samples = np.load(path, mmap_mode="r", allow_pickle=False)
    except OSError as fault:
        raise InputError(f"{path}: cannot be read: {fault.strerror or fault}") from fault
    except Exception as fault:  # whatever the decoder stumbles over
        raise InputError(f"{path}: is not a NumPy file with {what}") from fault
    if samples.ndim != 1 or samples.dtype.kind not in "uif" or not 3 <= samples.size <= 1 << 20:
        raise InputError(f"{path}: must hold one number for each bin, found {samples.shape}")
    return np.asarray(samples, dtype=np.float64)


def require_view(focal_length_px: float | None, field_of_view_deg: float) -> None:
    """Refuse a focal length or a field of view that no camera has."""
    if not 0 < field_of_view_deg < 180 or (focal_length_px is not None and not focal_length_px > 0):
        raise InputError("the focal length must be positive, the field of view within 0..180")


def choose_camera(
    known: Camera | None,
    image_shape: tuple[int, int],
    focal_length_px: float | None,
    field_of_view_deg: float,
    pulse_fwhm: float,
) -> Camera:
    """Return a known camera, or a pinhole.

    `image_shape`: rows and columns of the pinhole; `focal_length_px`: in place of the camera's, or
    of that of the field of view; `field_of_view_deg`: width of a pinhole's picture; `pulse_fwhm`:
    of a return, s.
    """
    if known is not None:
        return known if focal_length_px is None else known.replace(focal_length_px=focal_length_px)
    # Half the width over the tangent of half the field of view.
    usual = image_shape[1] / 2 / np.tan(np.deg2rad(field_of_view_deg) / 2)
    return make_pinhole(image_shape, float(focal_length_px or usual), pulse_fwhm)


def save_range_image(found: SurfaceImage, camera: Camera, path: Path, returns: int = 1) -> None:
    """Write ranges, deviations, photons and outlier probabilities to an NPZ file, whole or not at
    all; reflectances too, where the camera knows them, and the mask of hot pixels, if any. Where
    several returns were looked for, the same of all of them, the strongest first, behind the
    picture's rows and columns: (rows, columns, returns).
    """
    known = camera.range_calibration
    further: dict[str, Any] = {}
    if found.hot_pixels is not None and found.hot_pixels.any():
        further["hot_pixels"] = found.hot_pixels
    if known is not None and np.isfinite(known.reflectance_scale):
        further["reflectance_percent"] = known.compute_reflectance(
            found.intensity * found.range**2, *np.indices(found.range.shape)
        )
    layers: list[dict[str, Any]] = [
        {
            "range_m": one.range,
            "range_sigma_m": one.range_sigma,
            "intensity": one.intensity,
            "outlier_probability": one.outlier_probability,
        }
        for one in (found, *found.further)
    ]
    if returns > 1:
        for name in layers[0]:
            further[f"returns_{name}"] = np.stack([one[name] for one in layers], axis=-1)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **layers[0], **further)
