"""NumPy archives: captures, and streak images of the LIFT camera."""

from __future__ import annotations

from pathlib import Path

from nlos.capture import Capture
from nlos.io.fields import Fields


def read_numpy_archive(fields: Fields) -> Capture:
    """Read ``H`` (t, ...), ``wall_xyz`` (..., 3), ``laser_xyz`` ((3,) or (..., 3)), ``delta_t_s`` and ``t_start_m``.

    Lengths in m, durations in s; bin 0 holds the path ``t_start_m`` from the laser spot to the wall point.
    """
    return Capture(
        signal=fields.any_shape("H"),
        wall=fields.places("wall_xyz"),
        laser=fields.places("laser_xyz"),
        bin_width=fields.number("delta_t_s"),
        start=fields.number("t_start_m"),
    )


def read_lift_archive(path: str | Path) -> Capture:
    """Recover a LIFT streak image of a relay wall by the linear inverse, and take its wall out."""
    from tofclip.io import read_streak
    from tofclip.recovery import recover

    return Capture.from_frames(recover(read_streak(path), method="linear"))
