"""`tofclip lidar photons`: counted photons of a picture to its ranges."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apps.options import PICTURE_FORMATS, arg, flag, name_any, opt
from apps.progress import show_share
from apps.report import build_provenance, report, require_writable, say
from apps.verbs.recover import CLOUD_SUFFIXES, DEPTH_SUFFIX
from tofclip.errors import InputError
from tofclip.files import PICTURE_SUFFIXES
from tofclip.units import NANOSECOND, PICOSECOND

if TYPE_CHECKING:
    import numpy as np

    from tofclip.camera import Camera
    from tofclip.lidar import Pulse
    from tofclip.lidar.photons import PhotonImage, SurfaceImage

RANGE_IMAGE_SUFFIX = ".npz"
POINT_SUFFIXES = tuple(one for one in CLOUD_SUFFIXES if one != RANGE_IMAGE_SUFFIX)
DEFAULT_FIELD_OF_VIEW_DEG = 30.0
MAX_RETURNS = 255  # of a pixel: clouds number them in a byte
# Of the cycles that a photon ended: at 3 photons a cycle (.95) a learnt pulse is .4 mm late, at 5 (.993) 4 mm
# early, of 300 ps.
MAX_LEARNT_SHARE = 0.98

AXES = opt(
    "ORDER", "Order of the axes of a cube of photons, e.g. tyx.", name="--axes", shown="recognised"
)
FOCAL_LENGTH = opt(
    "PX",
    "Of the pinhole camera that sees photons.",
    name="--focal-length-px",
    shown="the camera's, or from the field of view",
)
FIELD_OF_VIEW = opt(
    "DEG",
    "Width of the pinhole's picture, in place of a focal length.",
    DEFAULT_FIELD_OF_VIEW_DEG,
    name="--field-of-view-deg",
)


def photons(
    file: str = arg(
        "FILE",
        "Counted photons: .npy, .npz, .mat, HDF5, multi-page TIFF, .ptu or .sdt; a cube of counts, a list of photon "
        "times for each pixel, or events x, y, time. Or a LinoSPAD2's recording (.dat), one by record, or an "
        "instrument that counts them, such as 'spad512://HOST?mode=gated'.",
        read=True,
    ),
    out: Path = opt(
        "FILE",
        f"Ends in {RANGE_IMAGE_SUFFIX} for a range image, in {name_any(POINT_SUFFIXES)} for a point cloud, in "
        f"{DEPTH_SUFFIX} for a depth picture, in {PICTURE_FORMATS} for a drawing.",
        ...,
    ),
    bin_width: float | None = opt(
        "PS",
        "Duration of a bin, or unit of the photon times.",
        name="--bin-width-ps",
        shown="the file's",
    ),
    pulse_fwhm: float | None = opt(
        "PS",
        "Full width at half maximum of the pulse; its shape is learnt if the photons show another one.",
        name="--pulse-ps",
        shown="learnt",
    ),
    pulse: Path | None = opt(
        "NPY",
        "Measured response: its brightness in successive bins; its highest bin is the arrival.",
        shown="learnt",
    ),
    axes: str | None = AXES,
    camera: Path | None = opt(
        "H5",
        "Made by calibrate range of the same pixels: its time zero, range walk, offsets, reflectance and focal length "
        "are used.",
        shown="a pinhole",
    ),
    focal_length_px: float | None = FOCAL_LENGTH,
    field_of_view_deg: float = FIELD_OF_VIEW,
    time_zero: float | None = opt(
        "NS",
        "When light of range 0 arrives, after the first bin; of an instrument's own time.",
        name="--time-zero-ns",
        shown="the camera's, or 0",
    ),
    single_pixel: bool = flag("--single-pixel", "Judge every pixel by its own photons alone."),
    background: Path | None = opt(
        "NPY",
        "With --single-pixel: shape of the background over the bins, as of a dark frame.",
        shown="what the pixels have in common",
    ),
    cycles: int | None = opt(
        "N",
        "Laser cycles of each pixel, of a detector that counts the first photon of a cycle only: pile-up is corrected.",
        shown="no pile-up",
    ),
    returns: int = opt(
        "N", "Surfaces looked for in each pixel; pictures, .exr among them, show the strongest.", 1
    ),
) -> None:
    """Find the surface that counted photons show, with the deviation of every range.

    Pulse, background and how far neighbours help each other are found from the photons. Hot pixels
    are left out, counted, and marked in a range image (hot_pixels). Of several --returns a range
    image holds the strongest in range_m and all of them in returns_range_m (rows, columns, returns),
    NaN where there is none; likewise range_sigma_m, intensity and outlier_probability, that of a wrong
    range or of a pixel that sends no light back: the neighbours' surface goes on there.

    Example: tofclip lidar photons cube.npy --bin-width-ps 80 --pulse-ps 400 --out range.npz
    """
    import numpy as np

    from tofclip.camera import Camera
    from tofclip.lidar import Pulse, point_cloud, save_depth
    from tofclip.lidar.photons import estimate_pixels, estimate_surface
    from tofclip.notebook import save_figure

    started = time.perf_counter()
    suffix = out.suffix.lower()
    if not single_pixel and background is not None:
        raise InputError("--background goes with --single-pixel")
    suffixes = (*CLOUD_SUFFIXES, DEPTH_SUFFIX, *PICTURE_SUFFIXES)
    require_writable(out, *suffixes, inputs=(file, pulse, background, camera))
    if pulse is not None and pulse_fwhm is not None:
        raise InputError("give the pulse's width (--pulse-ps) or its shape (--pulse), not both")
    if not 1 <= returns <= MAX_RETURNS:
        raise InputError(f"--returns: 1 to {MAX_RETURNS} are looked for in a pixel, got {returns}")
    require_view(focal_length_px, field_of_view_deg)
    known = None if camera is None else Camera.load(camera)
    image, shape, first_time = read_any_photons(file, bin_width, axes)
    if pulse is not None:
        bright = _load_bins(pulse, "the pulse's bins")
        shape = Pulse(bright, image.bin_width, float(np.argmax(bright)))
    if pulse_fwhm is not None:
        shape = Pulse.gaussian(pulse_fwhm)
    if single_pixel:
        shades = None if background is None else _load_bins(background, "the background's bins")
        found = estimate_pixels(image, shape, background=shades, cycles=cycles, max_returns=returns)
    else:
        with show_share("finding surfaces", 1.0) as show:
            found = estimate_surface(
                image, shape, pulse is None, returns, progress=show, cycles=cycles
            )
    seen_by = choose_camera(
        known, image.image_shape, focal_length_px, field_of_view_deg, found.pulse.fwhm
    )
    if time_zero is not None:
        seen_by = seen_by.replace(time_zero=time_zero)
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
    named = (None if "://" in file else Path(file), pulse, background, camera)
    inputs = [path for path in named if path is not None]
    past = build_provenance({"verb": "lidar photons", "source": file, **settings}, *inputs)
    # The ending of the name chooses what is written.
    if suffix == RANGE_IMAGE_SUFFIX:
        save_range_image(found, seen_by, out, returns)
    elif suffix in PICTURE_SUFFIXES:
        from apps.figures.shot import make_range_figure

        save_figure(make_range_figure(found), out)
    elif suffix == DEPTH_SUFFIX:
        save_depth(found.to_returns(seen_by, past), out)
    else:
        point_cloud(found.to_returns(seen_by, past)).save(out)
    seen = np.isfinite(found.range)
    figures = {
        "pixels": seen.size,
        "coverage": seen.mean(),
        "returns": sum(np.isfinite(one.range).sum() for one in (found, *found.further)),
        "outlier_share": found.outlier_probability[seen].mean() if seen.any() else 0.0,
        "seconds": time.perf_counter() - started,
        "settings": settings,
    }
    if doubt := find_doubt(image, found.settings, cycles):
        say("warning", doubt)
    assumed = []
    if camera is None and time_zero is None and not first_time:
        assumed.append("ranges are right up to a constant (--time-zero-ns)")
    if camera is None and focal_length_px is None and suffix in POINT_SUFFIXES:
        view = f"a view of {field_of_view_deg:g} degrees (--field-of-view-deg)"
        assumed.append(f"widths and heights are those of {view}")
    report(figures, [out], "; ".join(assumed))


def find_doubt(
    image: PhotonImage, settings: dict[str, float | str], cycles: int | None
) -> str | None:
    """Say what the photons themselves show of the ranges' faults."""
    import numpy as np

    if missed := settings.get("pile_up"):
        return (
            f"{missed:.0%} of the background is missing behind surfaces: the detector is blind after a photon, and "
            "ranges are too short (pile-up); give --cycles N"
        )
    if cycles is not None and settings["response"] == "learnt":
        ended = np.median(image.photons_per_pixel[image.photons_per_pixel > 0]) / cycles
        if ended > MAX_LEARNT_SHARE:
            return (
                f"a photon ended {ended:.1%} of the cycles: nothing shows the late side of the pulse, and ranges may "
                "be wrong by its width; give --pulse-ps W"
            )
    if uneven := float(settings["uneven_bins_sigma_m"]):
        return (
            "bins are of uneven length, as the background shows: ranges are those of an even time axis, which is "
            f"known to {uneven * 1e3:.2g} mm"
        )
    return None


def read_any_photons(
    file: str, bin_width: float | None, axes: str | None
) -> tuple[PhotonImage, Pulse | None, float]:
    """Read a file or an instrument: photons, response if known, time of the first bin, s."""
    from devices.transients import find_address
    from devices.transients import read_photons as read_instrument
    from tofclip.lidar.photons.files import read_photons

    address = file if "://" in file else find_address(file)
    if address is None:
        return read_photons(Path(file), bin_width, axes), None, 0.0
    if axes is not None:
        raise InputError(f"{file}: an instrument knows its own axes")
    counted = read_instrument(address, bin_width)
    return counted.to_image(), counted.pulse, counted.times[0]


def _load_bins(path: Path, what: str) -> np.ndarray[Any, Any]:
    """Read one number for each bin."""
    import numpy as np

    from tofclip.files import guard

    with guard(path, f"is not a NumPy file with {what}"):
        samples = np.load(path, mmap_mode="r", allow_pickle=False)
    if samples.ndim != 1 or samples.dtype.kind not in "uif" or not 3 <= samples.size <= 1 << 20:
        raise InputError(f"{path}: must hold one number for each bin, found {samples.shape}")
    return np.asarray(samples, dtype=np.float64)


def require_view(focal_length_px: float | None, field_of_view_deg: float) -> None:
    """Refuse a focal length or a field of view that no camera has, before anything is read."""
    from tofclip.camera import Camera

    Camera.pinhole((1, 1), focal_length_px, field_of_view_deg=field_of_view_deg)


def choose_camera(
    known: Camera | None,
    image_shape: tuple[int, int],
    focal_length_px: float | None,
    field_of_view_deg: float,
    pulse_fwhm: float,
) -> Camera:
    """Return a known camera, or a pinhole of this response, s."""
    from tofclip.camera import Camera

    if known is not None:
        return known if focal_length_px is None else known.replace(focal_length_px=focal_length_px)
    return Camera.pinhole(image_shape, focal_length_px, pulse_fwhm, field_of_view_deg)


def save_range_image(found: SurfaceImage, camera: Camera, path: Path, returns: int = 1) -> None:
    """Write ranges, deviations, photons and outlier probabilities to an NPZ file, whole or not at
    all; reflectances too, where the camera knows them, and the mask of hot pixels, if any. Where
    several returns were looked for, the same of all of them, the strongest first, behind the
    picture's rows and columns: (rows, columns, returns).
    """
    import numpy as np

    from tofclip.files import atomic_path

    known = camera.range_calibration
    names = {"range_m": "range", "range_sigma_m": "range_sigma"}
    names |= {name: name for name in ("intensity", "outlier_probability")}
    arrays: dict[str, Any] = {key: getattr(found, name) for key, name in names.items()}
    if found.hot_pixels is not None and found.hot_pixels.any():
        arrays["hot_pixels"] = found.hot_pixels
    if known is not None and np.isfinite(known.reflectance_scale):
        arrays["reflectance_percent"] = known.compute_reflectance(
            found.intensity * found.range**2, *np.indices(found.range.shape)
        )
    if returns > 1:
        for key, name in names.items():
            layers = [getattr(one, name) for one in (found, *found.further)]
            arrays[f"returns_{key}"] = np.stack(layers, axis=-1)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **arrays)
