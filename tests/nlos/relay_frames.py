"""Frames of a camera that looks at a relay wall."""

import numpy as np
from numpy.linalg import norm

from tofclip.camera import Camera
from tofclip.shots import Frames
from tofclip.storage import Field, Record
from tofclip.units import SPEED_OF_LIGHT

BIN_WIDTH = 5e-12
LASER, CAMERA = np.array([0.1, -0.05, 0.02]), np.array([0.9, -0.3, 1.1])
HIDDEN = (-0.12, 0.08, 0.3)
ROW_OFFSET, COLUMN_OFFSET, DELAY_BINS = 2, 3, 40


def wall_of(rows, columns):
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, columns), np.linspace(-0.25, 0.25, rows))
    return np.stack([x, y, 0.03 * np.sin(9 * x)], axis=-1)


def relay_wall(wall, without="", camera=CAMERA, **changes):
    offsets = {"row_offset": ROW_OFFSET, "column_offset": COLUMN_OFFSET}
    fields = {"wall": Field(wall, "m"), "camera": Field(camera, "m"), "laser": Field(LASER, "m")}
    fields.pop(without, None)
    return Record("relay_wall", fields, {**offsets, "receive_delay_bins": DELAY_BINS, **changes})


def frames_of(values, attachments, times=None):
    camera = Camera([50.0], [0.0], values.shape[1:], 100)
    times = BIN_WIDTH * np.arange(len(values)) if times is None else times
    shot = {"shot": 7}
    return Frames(
        values.astype(np.float32), times, camera, attachments=attachments, provenance=shot
    )


def see_by_camera(wall, bins=800):
    """Frames of the hidden point with every wall point late by its own leg to the
    camera, drawn without any shifting; the record begins `DELAY_BINS` bins after light of path 0
    would have arrived by way of the laser spot.
    """
    late = norm(wall - CAMERA, axis=-1) - norm(LASER - CAMERA)
    path = norm(LASER - HIDDEN) + norm(wall - HIDDEN, axis=-1) + late
    arrival_bins = path / (SPEED_OF_LIGHT * BIN_WIDTH) - DELAY_BINS
    rows, columns = wall.shape[:2]
    values = np.zeros((bins, rows + 5, columns + 6))
    shown = values[:, ROW_OFFSET : ROW_OFFSET + rows, COLUMN_OFFSET : COLUMN_OFFSET + columns]
    shown[:] = np.exp(-0.5 * ((np.arange(bins)[:, None, None] - arrival_bins) / 4) ** 2)
    return values
