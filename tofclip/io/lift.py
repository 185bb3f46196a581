"""LIFT archives: streak images of the 7-lenslet light-field-tomography camera, with the calibration
of each one, and the relay wall of non-line-of-sight shots, which gives the focal length away.

Source: X. Feng and L. Gao, Nat. Commun. 12, 2179 (2021). The archives keep MATLAB's 1-based pixels;
here they become 0-based.

**Angles.** The archive's projection angle is ``theta = 90 deg - lens_angle`` and view k puts the
picture's point (X, Y), in pixels from its centre, on slit column ``centre_k + (X cos(theta) + Y
sin(theta)) / cos(theta) = centre_k + X + Y tan(theta)``. Our `Camera` has ``centre_k + X - Y
tan(angle)``; hence ``angle = lens_angle - 90 deg``.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from tofclip.arrays import FloatArray
from tofclip.camera import Camera, PolynomialSweep, ProjectiveSweep, SkewSweep, Sweep
from tofclip.errors import CalibrationError, FileFormatError, InputError
from tofclip.io.archive import Archive
from tofclip.io.hamamatsu import StreakFile
from tofclip.shots import RELAY_WALL, Streak, outline_streak
from tofclip.storage import Field, Record

# Flags of the archive and the only value whose meaning is known.
EXPECTED_FLAGS = {"resample_flag": 1, "image_inverted_flag": 0}


@dataclass(frozen=True)
class RelayWall:
    """The wall as a window of the picture sees it."""

    # (rows, columns, 3), the wall point seen by each pixel of the window, m; NaN where unknown
    points: FloatArray
    camera: FloatArray  # (3,), position, m, in the same frame
    laser: FloatArray  # (3,), position of the laser spot on the wall, m, in the same frame
    offset_px: tuple[int, int]  # first row and column of the window in the picture
    axis_px: tuple[int, int]  # row and column of the optical axis in the picture
    # bins by which the record starts late: bin i stands for (i + delay) bin widths of travel
    receive_delay_bins: float

    def to_record(self) -> Record:
        """Return the attachment that travels with the shot."""
        fields = {
            "wall": Field(self.points, "m", ("y", "x", "xyz")),
            "camera": Field(self.camera, "m", ("xyz",)),
            "laser": Field(self.laser, "m", ("xyz",)),
        }
        row, column = self.offset_px
        delay = self.receive_delay_bins
        attributes = {"row_offset": row, "column_offset": column, "receive_delay_bins": delay}
        return Record(RELAY_WALL, fields, attributes)

    def fit_focal_length(self) -> tuple[float, float]:
        """Fit a pinhole camera, free to turn, to the directions in which the pixels see the wall;
        return the focal length and the root mean square distance that is left, pixels.

        A pixel at (X, Y) from the optical axis looks along (X, Y, f). For each trial f the rotation
        that aligns these directions best with the measured ones follows from a singular value
        decomposition, and the sum of the singular values tells how well they align (G. Wahba, SIAM
        Review 7, 409 (1965)); f is then found by zooming in.
        """
        known = np.all(np.isfinite(self.points), axis=-1)
        places = np.argwhere(known) + np.subtract(self.offset_px, self.axis_px)
        pixels = places[:, ::-1].T.astype(np.float64)
        sight = (self.points[known] - self.camera).T
        sight /= np.linalg.norm(sight, axis=0)
        # From a fisheye of one pixel to a telephoto lens: any camera lies in between.
        low, high = 1.0, 1e5
        while high / low > 1 + 1e-6:
            # a geometric grid, narrowed about its best value until both ends agree
            trials = np.geomspace(low, high, 33)
            best = int(np.argmax([_align_directions(f, pixels, sight)[0] for f in trials]))
            low, high = trials[max(best - 1, 0)], trials[min(best + 1, trials.size - 1)]
        focal_length_px = float(np.sqrt(low * high))
        seen = _align_directions(focal_length_px, pixels, sight)[1] @ sight
        error_px = focal_length_px * seen[:2] / seen[2] - pixels
        return focal_length_px, float(np.sqrt(np.mean(np.sum(error_px**2, axis=0))))


def _align_directions(
    focal_length_px: float, pixels: FloatArray, directions: FloatArray
) -> tuple[float, FloatArray]:
    """How well pixels align with `directions` (1: exactly), and the rotation that does it."""
    looking = np.vstack([pixels, np.full(pixels.shape[1], focal_length_px)])
    looking /= np.linalg.norm(looking, axis=0)
    # Wahba's problem: the rotation that maximises the trace is the product of the singular vectors.
    left, values, right = np.linalg.svd(looking @ directions.T)
    return float(values.sum()) / pixels.shape[1], left @ right


def read_relay_wall(archive: Archive, image_shape: tuple[int, int]) -> RelayWall:
    """Take the wall out of a LIFT archive; the picture's middle is its window's as well."""
    points = np.moveaxis(archive.array("wall_grid_m", 3, None, None), 0, -1).astype(np.float64)
    axis_px = (image_shape[0] // 2, image_shape[1] // 2)
    offset_px = (axis_px[0] - points.shape[0] // 2, axis_px[1] - points.shape[1] // 2)
    fits = min(offset_px) >= 0 and all(np.add(offset_px, points.shape[:2]) <= image_shape)
    if not fits or np.count_nonzero(np.all(np.isfinite(points), axis=-1)) < 4:
        raise FileFormatError(
            archive.path,
            f"field 'wall_grid_m' must hold wall points for at most {image_shape} pixels",
        )
    camera, laser = (archive.finite_array(f"{name}_pos_m", 3) for name in ("camera", "laser"))
    delay = float(archive.finite_array("receive_delay_bins"))
    return RelayWall(np.ascontiguousarray(points), camera, laser, offset_px, axis_px, delay)


@contextlib.contextmanager
def open_lift(path: str | Path) -> Iterator[StreakFile]:
    """Open a LIFT archive.

    Its camera travels along, with the slit centres of the nominal depth. Archives of
    non-line-of-sight scenes also bring their relay wall, as the attachment ``"relay_wall"``, and
    from it the camera's focal length.
    """
    archive = Archive(path)
    if "streak_raw" not in archive:
        found = ", ".join(sorted(archive.names)[:8])
        problem = "has no field 'streak_raw', so it is no streak image"
        raise FileFormatError(path, f"{problem}; it holds {found}")
    for flag, meant in EXPECTED_FLAGS.items():
        if archive.array(flag) != meant:
            raise FileFormatError(
                path, f"field '{flag}' is {archive.array(flag)}; only {meant} has a known meaning"
            )
    archive.require_numbers("streak_raw", None, None)
    bin_width = float(archive.array("dt_s"))  # NaN where the sweep speed was not recorded
    if not (0 < bin_width < math.inf or math.isnan(bin_width)):
        raise FileFormatError(
            archive.path, f"field 'dt_s' must be positive, or NaN where unknown, found {bin_width}"
        )
    shape = archive.describe("streak_raw").shape
    try:
        camera = _read_camera(archive, shape)
    except CalibrationError as fault:
        raise CalibrationError(f"{archive.path}: {fault}") from fault
    metadata, attachments = archive.scalars(), {}
    if "wall_grid_m" in archive:
        wall = read_relay_wall(archive, camera.image_shape)
        attachments[RELAY_WALL] = wall.to_record()
        focal_length_px, residual_px = wall.fit_focal_length()
        camera = camera.replace(focal_length_px=focal_length_px)
        metadata["focal_length_residual_px"] = f"{residual_px:.3g}"

    def read() -> Streak:
        counts = archive.array("streak_raw", None, None)
        # Where background was taken off, noise is negative as often as not; light never is.
        if -float(np.min(counts)) > float(np.max(counts)):
            raise InputError(
                f"{path}: streak_raw is more negative than positive; give brightness, not its negative"
            )
        streak = Streak(
            counts, None, None, metadata, camera, attachments=attachments, source=str(path)
        )
        return streak if math.isnan(bin_width) else streak.with_bin_width(bin_width)

    has_times = not math.isnan(bin_width)
    yield partial(outline_streak, shape, has_times, False, metadata, camera, attachments), read


def _read_camera(archive: Archive, shape: tuple[int, ...]) -> Camera:
    centres_px = archive.finite_array("lens_centre_px", None) - 1.0
    width_px = float(archive.finite_array("region_size_px"))
    if not 1 <= width_px <= 1 << 14:
        raise FileFormatError(
            archive.path, f"field 'region_size_px' must be a picture width, found {width_px:g}"
        )
    return Camera(
        centres_px=centres_px,
        angles=np.deg2rad(archive.finite_array("lens_angle_deg", centres_px.size) - 90.0),
        # ``2 * round(R / 2)``: MATLAB rounds a half up, Python would round it to even.
        image_shape=(2 * math.floor(width_px / 2 + 0.5),) * 2,
        slit_width_px=shape[1],
        # A single row is a line taken in focus mode: nothing was swept, so that there is nothing to
        # rectify.
        sweep=_read_sweep(archive) if shape[0] > 1 else SkewSweep(*np.zeros((3, 1))),
    )


def _read_sweep(archive: Archive) -> Sweep:
    kind = archive.text("rectify_kind")
    # MATLAB keeps transformations for row vectors: the offset is in the third row.
    if kind == "polynomial2":
        rectified, raw = (
            archive.finite_array(f"rectify_norm_{name}", 3, 3) for name in ("xy", "uv")
        )
        return PolynomialSweep(
            column_coefficients=archive.finite_array("rectify_poly_u", 6),
            row_coefficients=archive.finite_array("rectify_poly_v", 6),
            rectified_origin=rectified[2, :2] - 1.0,
            rectified_scale=np.diag(rectified)[:2],
            raw_origin=raw[2, :2] - 1.0,
            raw_scale=np.diag(raw)[:2],
        )
    if kind != "projective":
        raise FileFormatError(
            archive.path,
            f"field 'rectify_kind' must be 'polynomial2' or 'projective', found '{kind}'",
        )
    # The archive maps raw to rectified rows of 1-based pixels; turned around, on columns of 0-based
    # ones.
    from_one = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    try:
        rectified_to_raw = np.linalg.inv(archive.finite_array("rectify_matrix", 3, 3).T)
    except np.linalg.LinAlgError as fault:
        raise FileFormatError(archive.path, "field 'rectify_matrix' is singular") from fault
    return ProjectiveSweep(np.linalg.inv(from_one) @ rectified_to_raw @ from_one)
