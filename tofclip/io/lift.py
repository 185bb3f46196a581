"""The relay wall of a non-line-of-sight shot, and the focal length that it gives away.

LIFT archives: streak images of the 7-lenslet light-field-tomography camera, with the calibration
of each one.

Source: X. Feng and L. Gao, Nat. Commun. 12, 2179 (2021). The archives keep MATLAB's 1-based pixels;
here they become 0-based.

**Angles.** The archive's projection angle is ``theta = 90 deg - lens_angle`` and view k puts the
  picture's point
(X, Y), in pixels from its centre, on slit column ``centre_k + (X cos(theta) + Y sin(theta)) /
cos(theta) = centre_k + X + Y tan(theta)``. Our `Camera` has ``centre_k + X - Y tan(angle)``; hence
``tan(angle) = -tan(90 deg - lens_angle)``, that is ``angle = lens_angle - 90 deg``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera, PolynomialSweep, ProjectiveSweep, SkewSweep, Sweep
from tofclip.errors import CalibrationError, FileFormatError, InputError
from tofclip.io.archive import Archive
from tofclip.shots import Streak, outline_streak
from tofclip.storage import Field, Record

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class RelayWall:
    """The wall as a window of the picture sees it."""

    # (rows, columns, 3), the wall point seen by each pixel of the window, m; NaN where unknown
    points: FloatArray
    # (3,), position of the camera and of the laser spot on the wall, m, in the same frame
    camera: FloatArray
    # (3,), position of the camera and of the laser spot on the wall, m, in the same frame
    laser: FloatArray
    offset_px: tuple[int, int]  # first row and column of the window in the picture
    axis_px: tuple[int, int]  # row and column of the optical axis in the picture
    # bins by which the record starts late: bin i stands for (i + delay) bin widths of travel
    receive_delay_bins: float

    def to_record(self) -> Record:
        """Return the attachment that travels with the shot."""
        return Record(
            "relay_wall",
            {
                "wall": Field(self.points, "m", ("y", "x", "xyz")),
                "camera": Field(self.camera, "m", ("xyz",)),
                "laser": Field(self.laser, "m", ("xyz",)),
            },
            {
                "row_offset": self.offset_px[0],
                "column_offset": self.offset_px[1],
                "receive_delay_bins": self.receive_delay_bins,
            },
        )

    def fit_focal_length(self) -> tuple[float, float]:
        """Fit a pinhole camera, free to turn, to the directions in which the pixels see the wall.

        A pixel at (X, Y) from the optical axis looks along (X, Y, f). For each trial f the rotation
        that aligns these directions best with the measured ones follows from a singular value
        decomposition, and the sum of the singular values tells how well they align (G. Wahba, SIAM
        Review 7, 409 (1965)); f is then found by zooming in.

        Returns `focal_length_px, residual_px`: in pixels of the picture; the residual is the root
        mean square distance on the picture.
        """
        pixels, directions = self._sight_lines()
        # From a fisheye of one pixel to a telephoto lens: any camera lies in between.
        low, high = 1.0, 1e5
        while high / low > 1 + 1e-6:
            # a geometric grid, narrowed about its best value until both ends agree
            trials = np.geomspace(low, high, 33)
            best = int(np.argmax([_align_directions(f, pixels, directions)[0] for f in trials]))
            low, high = trials[max(best - 1, 0)], trials[min(best + 1, trials.size - 1)]
        focal_length_px = float(np.sqrt(low * high))
        seen = _align_directions(focal_length_px, pixels, directions)[1] @ directions
        error_px = focal_length_px * seen[:2] / seen[2] - pixels
        return focal_length_px, float(np.sqrt(np.mean(np.sum(error_px**2, axis=0))))

    def _sight_lines(self) -> tuple[FloatArray, FloatArray]:
        """(X, Y) of the pixels from the optical axis and the unit vectors towards the wall; columns
        are pixels.
        """
        known = np.all(np.isfinite(self.points), axis=-1)
        row, column = np.nonzero(known)
        pixels = np.stack(
            [
                column + float(self.offset_px[1] - self.axis_px[1]),
                row + float(self.offset_px[0] - self.axis_px[0]),
            ]
        )
        directions = (self.points[known] - self.camera).T
        return pixels, directions / np.linalg.norm(directions, axis=0)


def read_relay_wall(archive: Archive, image_shape: tuple[int, int]) -> RelayWall:
    """Take the relay wall out of a LIFT archive; its window has the picture's middle pixel in its
    own middle.

    `archive`: A LIFT shot; `image_shape`: rows and columns of the recovered picture. Returns points
    (rows, columns, 3), m.
    """
    points = np.moveaxis(archive.array("wall_grid_m", 3, None, None), 0, -1).astype(np.float64)
    axis_px = (image_shape[0] // 2, image_shape[1] // 2)
    offset_px = (axis_px[0] - points.shape[0] // 2, axis_px[1] - points.shape[1] // 2)
    fits = min(offset_px) >= 0 and all(np.add(offset_px, points.shape[:2]) <= image_shape)
    if not fits or np.count_nonzero(np.all(np.isfinite(points), axis=-1)) < 4:
        raise FileFormatError(
            archive.path,
            f"field 'wall_grid_m' must hold wall points for at most {image_shape} pixels",
        )
    return RelayWall(
        points=np.ascontiguousarray(points),
        camera=archive.finite_array("camera_pos_m", 3),
        laser=archive.finite_array("laser_pos_m", 3),
        offset_px=offset_px,
        axis_px=axis_px,
        receive_delay_bins=float(archive.finite_array("receive_delay_bins")),
    )


def _align_directions(
    focal_length_px: float, pixels: FloatArray, directions: FloatArray
) -> tuple[float, FloatArray]:
    """How well the pixels' directions align with `directions` (1: exactly), and the rotation that
    does it.
    """
    looking = np.vstack([pixels, np.full(pixels.shape[1], focal_length_px)])
    looking /= np.linalg.norm(looking, axis=0)
    # Wahba's problem: the rotation that maximises the trace is the product of the singular vectors.
    left, values, right = np.linalg.svd(looking @ directions.T)
    return float(values.sum()) / pixels.shape[1], left @ right


EXPECTED_FLAGS = {"resample_flag": 1, "image_inverted_flag": 0}
"""Flags of the archive and the only value whose meaning is known."""


def read_lift(path: str | Path) -> Streak:
    """Read a LIFT archive; see `tofclip.io.read_streak`.

    Its camera travels along, with the slit centres of the nominal depth. Archives of
    non-line-of-sight scenes also bring their relay wall, as the attachment ``"relay_wall"``, and
    from it the camera's focal length.
    """
    archive = _open_archive(path)
    counts = archive.array("streak_raw", None, None)
    # Where background was taken off, noise is negative as often as not; light never is.
    if counts.size and -float(np.min(counts)) > float(np.max(counts)):
        raise InputError(
            f"{path}: streak_raw is more negative than positive; give brightness, not its negative"
        )
    camera, metadata, attachments = _read_calibration(archive)
    streak = Streak(
        counts=counts, metadata=metadata, camera=camera, attachments=attachments, source=str(path)
    )
    bin_width = _read_bin_width(archive)
    return streak if bin_width is None else streak.with_bin_width(bin_width)


def outline_lift(path: str | Path) -> Record:
    """Describe what `read_lift` would read, without reading a pixel of the streak image."""
    archive = _open_archive(path)
    camera, metadata, attachments = _read_calibration(archive)
    shape = archive.describe("streak_raw").shape
    return outline_streak(
        shape, _read_bin_width(archive) is not None, False, metadata, camera, attachments
    )


def _open_archive(path: str | Path) -> Archive:
    archive = Archive(path)
    for flag, meant in EXPECTED_FLAGS.items():
        if archive.array(flag) != meant:
            raise FileFormatError(
                path, f"field '{flag}' is {archive.array(flag)}; only {meant} has a known meaning"
            )
    archive.require_numbers("streak_raw", None, None)
    return archive


def _read_calibration(archive: Archive) -> tuple[Camera, dict[str, str], dict[str, Record]]:
    """Return the camera, what the archive says in words, and the relay wall where there is one."""
    try:
        camera = _read_camera(archive, archive.describe("streak_raw").shape)
    except CalibrationError as fault:
        raise CalibrationError(f"{archive.path}: {fault}") from fault
    metadata, attachments = archive.scalars(), {}
    if "wall_grid_m" in archive:
        wall = read_relay_wall(archive, camera.image_shape)
        attachments["relay_wall"] = wall.to_record()
        focal_length_px, residual_px = wall.fit_focal_length()
        camera = camera.replace(focal_length_px=focal_length_px)
        metadata["focal_length_residual_px"] = f"{residual_px:.3g}"
    return camera, metadata, attachments


def _read_bin_width(archive: Archive) -> float | None:
    """Duration of a row, s; None where the sweep speed was not recorded."""
    bin_width = float(archive.array("dt_s"))
    # NaN is how the archive says that it does not know.
    if math.isnan(bin_width):
        return None
    if not 0 < bin_width < math.inf:
        raise FileFormatError(
            archive.path, f"field 'dt_s' must be positive, or NaN where unknown, found {bin_width}"
        )
    return bin_width


def _read_camera(archive: Archive, shape: tuple[int, ...]) -> Camera:
    centres_px = archive.finite_array("lens_centre_px", None) - 1.0
    return Camera(
        centres_px=centres_px,
        angles=np.deg2rad(archive.finite_array("lens_angle_deg", centres_px.size) - 90.0),
        image_shape=(_read_image_width_px(archive),) * 2,
        slit_width_px=shape[1],
        # A single row is a line taken in focus mode: nothing was swept, so that there is nothing to
        # rectify.
        sweep=_read_sweep(archive) if shape[0] > 1 else SkewSweep(*np.zeros((3, 1))),
    )


def _read_image_width_px(archive: Archive) -> int:
    """``2 * round(R / 2)``, where MATLAB rounds a half up and Python would round it to even."""
    width_px = float(archive.finite_array("region_size_px"))
    if not 1 <= width_px <= 1 << 14:
        raise FileFormatError(
            archive.path, f"field 'region_size_px' must be a picture width, found {width_px:g}"
        )
    return 2 * math.floor(width_px / 2 + 0.5)


def _read_sweep(archive: Archive) -> Sweep:
    kind = archive.text("rectify_kind")
    if kind == "polynomial2":
        return _read_polynomial_sweep(archive)
    if kind == "projective":
        return _read_projective_sweep(archive)
    raise FileFormatError(
        archive.path, f"field 'rectify_kind' must be 'polynomial2' or 'projective', found '{kind}'"
    )


def _read_polynomial_sweep(archive: Archive) -> PolynomialSweep:
    rectified, raw = (archive.finite_array(f"rectify_norm_{plane}", 3, 3) for plane in ("xy", "uv"))
    return PolynomialSweep(
        column_coefficients=archive.finite_array("rectify_poly_u", 6),
        row_coefficients=archive.finite_array("rectify_poly_v", 6),
        # MATLAB keeps transformations for row vectors: the offset is in the third row.
        rectified_origin=rectified[2, :2] - 1.0,
        rectified_scale=np.diag(rectified)[:2],
        raw_origin=raw[2, :2] - 1.0,
        raw_scale=np.diag(raw)[:2],
    )


def _read_projective_sweep(archive: Archive) -> ProjectiveSweep:
    """The archive maps raw to rectified rows of 1-based pixels; turned around, on columns of
    0-based ones.
    """
    from_one = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    try:
        # Transposed because MATLAB multiplies row vectors from the left.
        rectified_to_raw = np.linalg.inv(archive.finite_array("rectify_matrix", 3, 3).T)
    except np.linalg.LinAlgError as fault:
        raise FileFormatError(archive.path, "field 'rectify_matrix' is singular") from fault
    return ProjectiveSweep(np.linalg.inv(from_one) @ rectified_to_raw @ from_one)
