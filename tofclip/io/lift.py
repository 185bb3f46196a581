"""LIFT archives: streak images of the 7-lenslet light-field-tomography camera, with the calibration
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
from pathlib import Path

import numpy as np

from tofclip.camera import Camera, PolynomialSweep, ProjectiveSweep, SkewSweep, Sweep
from tofclip.errors import CalibrationError, FileFormatError, InputError
from tofclip.io.archive import Archive
from tofclip.io.relay_wall import read_relay_wall
from tofclip.shots import Streak, outline_streak
from tofclip.storage import Record

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
