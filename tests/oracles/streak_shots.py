"""Streak shots by plain sums: a forward model written apart from the package's.

A scene is a range and a brightness for each of 4 x 4 points of every picture pixel, which all views
see alike. A point's light falls on one slit column of each view and, as a Gaussian pulse integrated
over each row, on the rows around its arrival. Then the photons are counted and the camera goes
wrong as real ones do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

SPEED_OF_LIGHT_M_PER_S = 299_792_458.0
SIDE = 4
PICTURE = 64
ROWS = 240
ROW_S = 20e-12
PULSE_S = 60e-12
FIRST_ROW_S = 9e-9
CENTRES = np.array([50.2, 130.4, 215.1, 300.3, 386.0, 470.6, 552.7])
DEGREES = np.array([-43.0, -26.0, -13.0, 1.0, 23.0, 37.0, 48.0])
GAINS = np.array([0.92, 1.08, 1.02, 0.90, 1.02, 0.96, 1.10])
LATE_ROWS = np.array([-6.3, -4.2, -1.8, 0.0, 1.6, 3.2, 5.1])
SLIT = 602
FOCAL_PX = 280.0


@dataclass
class Scene:
    """Range along the line of sight, m (NaN: nothing), and reflectance, (256, 256) each."""

    distance: np.ndarray
    reflectance: np.ndarray

    @property
    def pixel_range(self):
        """Median range of each pixel whose points all lie on one surface; NaN elsewhere."""
        points = _by_pixel(self.distance)
        spread = points.max(axis=-1) - points.min(axis=-1)
        return np.where(spread < 0.02, np.median(points, axis=-1), np.nan)

    @property
    def nearby_ranges(self):
        """Ranges of all points within a pixel, (64, 64, n): what a true return may show."""
        padded = np.pad(self.distance, SIDE, constant_values=np.nan)
        side = 3 * SIDE
        windows = np.lib.stride_tricks.sliding_window_view(padded, (side, side))[::SIDE, ::SIDE]
        return windows.reshape(PICTURE, PICTURE, side * side)


def make_room(wall=0.3):
    """A wall at 2.0 m, a tilted board, a ball and a bar in front of it."""
    place = (np.arange(PICTURE * SIDE) + 0.5) / SIDE - 0.5 - PICTURE // 2
    y, x = np.meshgrid(place, place, indexing="ij")
    slant = np.sqrt(1 + (x / FOCAL_PX) ** 2 + (y / FOCAL_PX) ** 2)
    distance, reflectance = 2.0 * slant, np.full(x.shape, wall)
    for inside, range_m, bright in (
        ((np.abs(x + 14) < 12) & (np.abs(y - 6) < 16), (1.75 + 0.004 * (x + 14)) * slant, 0.7),
        (np.hypot(x - 15, y + 12) < 10, 1.5 + 0.0005 * ((x - 15) ** 2 + (y + 12) ** 2), 0.5),
        ((np.abs(x - 14) < 14) & (np.abs(y - 18) < 4), 1.62 * slant, 0.9),
    ):
        distance = np.where(inside, range_m, distance)
        reflectance = np.where(inside, bright, reflectance)
    return Scene(distance, reflectance)


def make_steps(wall=0.25):
    """A slanted wall, two steps, a disc and thin poles: no threshold was set on them."""
    place = (np.arange(PICTURE * SIDE) + 0.5) / SIDE - 0.5 - PICTURE // 2
    y, x = np.meshgrid(place, place, indexing="ij")
    slant = np.sqrt(1 + (x / FOCAL_PX) ** 2 + (y / FOCAL_PX) ** 2)
    distance, reflectance = (1.93 - 0.003 * x + 0.001 * y) * slant, np.full(x.shape, wall)
    for inside, range_m, bright in (
        ((x > 8) & (y > 2), 1.9 * slant, 0.45),
        ((x > 18) & (y > 14), 1.7 * slant, 0.8),
        (np.hypot(x + 16, y - 14) < 9, (1.6 - 0.003 * (y - 14)) * slant, 0.35),
        ((np.abs(x + 4) < 2) & (y < 4), 1.8 * slant, 0.7),
        ((np.abs(y + 20) < 2.5) & (np.abs(x - 14) < 14), 1.83 * slant, 0.6),
    ):
        distance = np.where(inside, range_m, distance)
        reflectance = np.where(inside, bright, reflectance)
    return Scene(distance, reflectance)


def add_retroreflector(scene, brightness=40.0, corner=(-22, -22)):
    """Two by two pixels that send back far more than anything else."""
    reflectance = scene.reflectance.copy()
    y, x = ((PICTURE // 2 + place) * SIDE for place in corner)
    reflectance[y : y + 2 * SIDE, x : x + 2 * SIDE] = brightness
    return Scene(scene.distance, reflectance)


def compute_light(scene):
    """Expected light of each row and column, (240, 602), for reflectance 1 at 1 m and a pixel."""
    place = (np.arange(PICTURE * SIDE) + 0.5) / SIDE - 0.5 - PICTURE // 2
    y, x = (axis.ravel() for axis in np.meshgrid(place, place, indexing="ij"))
    seen = np.isfinite(scene.distance.ravel()) & (scene.reflectance.ravel() > 0)
    distance = scene.distance.ravel()[seen]
    bright = scene.reflectance.ravel()[seen] / distance**2 / SIDE**2
    arrival = (2 * distance / SPEED_OF_LIGHT_M_PER_S - FIRST_ROW_S) / ROW_S
    sigma = PULSE_S / ROW_S / np.sqrt(8 * np.log(2))
    light = np.zeros((ROWS + 24, SLIT))
    for view in range(CENTRES.size):
        column = CENTRES[view] + x[seen] - y[seen] * np.tan(np.radians(DEGREES[view]))
        nearest = np.rint(column).astype(int)
        inside = (nearest >= 0) & (nearest < SLIT)
        row = arrival + _skew(column)
        first = np.floor(row).astype(int) - 6
        for step in range(13):
            number = first + step
            share = ndtr((number + 0.5 - row) / sigma) - ndtr((number - 0.5 - row) / sigma)
            there = inside & (number >= -12) & (number < ROWS + 12)
            amount = GAINS[view] * bright * share
            np.add.at(light, (number[there] + 12, nearest[there]), amount[there])
    return light[12:-12]


def _skew(column):
    """Rows by which the sweep is late: known at the views' centres, straight between and beyond."""
    part = np.clip(np.searchsorted(CENTRES, column) - 1, 0, CENTRES.size - 2)
    rise = np.diff(LATE_ROWS) / np.diff(CENTRES)
    return LATE_ROWS[part] + rise[part] * (column - CENTRES[part])


def count_photons(light, peak=2000.0, background=2.0, seed=0):
    """Photons of one shot whose brightest pixel expects `peak` of signal."""
    noise = np.random.default_rng(seed)
    return noise.poisson(light * (peak / light.max()) + background).astype(np.float32)


def add_afterglow(light, fraction=0.15, rows=12.0):
    """A screen that gives a part of its light back later, exponentially."""
    fading = np.exp(-np.arange(ROWS) / rows)
    late = np.apply_along_axis(lambda column: np.convolve(column, fading)[:ROWS], 0, light)
    return (1 - fraction) * light + fraction * late / fading.sum()


def add_hot_pixels(counts, number, seed=0):
    """Pixels thirty times as bright as the brightest."""
    noise, hot = np.random.default_rng(seed), counts.copy()
    hot[noise.integers(2, ROWS - 2, number), noise.integers(0, SLIT, number)] = 30 * counts.max()
    return hot


def add_tracks(counts, number, seed=0):
    """Straight traces of particles, 4 to 15 pixels long."""
    noise, struck = np.random.default_rng(seed), counts.copy()
    for _ in range(number):
        row, column = (noise.integers(20, size - 20) for size in counts.shape)
        angle, length = noise.uniform(0, np.pi), noise.integers(4, 15)
        for step in np.arange(0, length, 0.5):
            place = int(row + step * np.sin(angle)), int(column + step * np.cos(angle))
            struck[place] += counts.max() * noise.uniform(0.5, 3)
    return struck


def _by_pixel(points):
    cells = points.reshape(PICTURE, SIDE, PICTURE, SIDE).transpose(0, 2, 1, 3)
    return cells.reshape(PICTURE, PICTURE, SIDE * SIDE)


def score(y, x, distance, scene, tolerance_m=0.009):
    """Fractions of the pixels that are missed, and of the returns that are false.

    A return is true if some point of the scene within a pixel of it is as far away, to the pulse's
    length in range.
    """
    expected = scene.pixel_range
    found = np.zeros(expected.shape, bool)
    near = np.abs(distance[:, None] - scene.nearby_ranges[y, x]) < tolerance_m
    true = near.any(axis=1)
    own = np.abs(distance - expected[y, x]) < tolerance_m
    found[y[own], x[own]] = True
    known = np.isfinite(expected)
    return float(1 - found[known].mean()), float(1 - true.mean()) if len(y) else 0.0
