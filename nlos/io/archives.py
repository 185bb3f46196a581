"""NumPy archives: captures, and streak images of the LIFT camera."""

from __future__ import annotations

from pathlib import Path

from nlos.capture import Capture
from nlos.io.fields import NamedArrays


def read_numpy_archive(fields: NamedArrays) -> Capture:
    """Read ``H`` (t, ...), ``wall_xyz`` (..., 3), ``laser_xyz`` ((3,) or (..., 3)), ``delta_t_s``
    and ``t_start_m``.

    Lengths in m, durations in s; bin 0 holds the path ``t_start_m`` from the laser spot to the wall
    point.
    """
    return Capture(
        signal=fields.read_numbers("H"),
        wall=fields.read_coordinates("wall_xyz"),
        laser=fields.read_coordinates("laser_xyz"),
        bin_width=fields.number("delta_t_s"),
        start=fields.number("t_start_m"),
    )


def read_lift_archive(path: str | Path) -> Capture:
    """Recover a LIFT streak image of a relay wall by the linear inverse, and take its wall out."""
    from tofclip.io import read_streak
    from tofclip.recovery import recover

    return Capture.from_frames(recover(read_streak(path), method="linear"))
