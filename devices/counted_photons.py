"""Photons counted in time for each pixel of a picture, from an instrument's address or a recording:
what `tofclip lidar photons` takes.
"""

from __future__ import annotations

from pathlib import Path

from devices.address import Uri
from devices.recording.read import read_head_if_recording
from devices.transients import read_shot
from tofclip.lidar.photons import PhotonCube

STAMPS_SUFFIX = ".dat"


def find_address(file: str) -> str | None:
    """Return the address of a file that holds an instrument's records, None of any other file."""
    path = Path(file)
    is_stamps = path.suffix.lower() == STAMPS_SUFFIX
    return f"file://{file}" if is_stamps or read_head_if_recording(path) is not None else None


def read_photons(address: str, bin_width: float | None = None) -> PhotonCube:
    """Read a shot as `devices.read_transient` does; a line of pixels that count photons is a picture of
    one row.
    """
    found = read_shot(Uri.parse(address), bin_width, line=True)
    assert isinstance(found, PhotonCube)
    return found
