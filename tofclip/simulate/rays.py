"""The ray caster: bodies and rays in, first hits, light from lamps, and bins of time out.

Both simulators use it: streak images of lenslets behind a slit (`tofclip.simulate.streak`) and
light fields of camera arrays (`tofclip.simulate.light_fields`). Light goes from a lamp to a
surface and on to a view; interreflections are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.simulate.bodies import Body

Array = NDArray[Any]

NO_BODY = -1
SHADOW_MARGIN = 1e-6  # relative; with less, rounding makes a surface shade itself
FWHM_PER_SIGMA = 2 * np.sqrt(2 * np.log(2))
EXTENT_SIGMAS = 5.0  # a Gaussian leaves 6e-7 of its energy outside


@dataclass(frozen=True)
class FirstHits:
    """What rays meet first."""

    distance: Array  # (rays,), in lengths of the ray's direction; infinite where it meets nothing
    body: Array  # (rays,), number of the body; `NO_BODY` where there is none
    normal: Array  # (rays, 3), of length 1, towards the ray's origin
    pattern_position: Array  # (rays, 2), on the body's pattern


def cast_rays(bodies: Sequence[Body], origin: Array, directions: Array) -> FirstHits:
    """Follow rays from (3,) `origin`, m, along (rays, 3) `directions`, all with z > 0, to the nearest
    surface.
    """
    count = len(directions)
    nearest, number = np.full(count, np.inf), np.full(count, NO_BODY, np.intp)
    normal, place = np.zeros((count, 3)), np.zeros((count, 2))
    for index, body in enumerate(bodies):
        rays = body.select_candidate_rays(origin, directions)
        found = body.intersect(origin, directions[rays])
        # the nearest body so far wins, as in a depth buffer
        closer = found.distance < nearest[rays]
        seen = rays[closer]
        nearest[seen], number[seen] = found.distance[closer], index
        normal[seen], place[seen] = found.normal[closer], found.pattern_position[closer]
    return FirstHits(nearest, number, normal, place)


def look_up_reflectance(bodies: Sequence[Body], hits: FirstHits) -> Array:
    """Return the pattern's value where each ray hits, (rays,) float64; 0 where it hits nothing."""
    found = np.zeros(hits.body.size)
    for number, one in enumerate(bodies):
        own = hits.body == number
        found[own] = one.material.reflectance(hits.pattern_position[own])
    return found


def compute_irradiance(bodies: Sequence[Body], lamp: Array, points: Array, normal: Array) -> Array:
    """Return how strongly a lamp lights points (points, 3), all of larger z, on surfaces that face
    along `normal`: cosine over distance squared, 1 / m^2, nothing in the shadow of a body.
    """
    rays = points - lamp
    distance = np.linalg.norm(rays, axis=1)
    # Lambert's cosine; surfaces that face away from the lamp get nothing
    facing = -np.einsum("ij,ij->i", rays, normal) / distance
    candidates = np.flatnonzero(facing > 0)
    nearest = cast_rays(bodies, lamp, rays[candidates]).distance
    light = np.zeros(len(points))
    # rays end at the points: a hit at 1 is the surface itself, a nearer one a shadow
    lit = candidates[nearest > 1 - SHADOW_MARGIN]
    light[lit] = facing[lit] / distance[lit] ** 2
    return light


def number_ray_pixels(image_shape: tuple[int, int], rays_per_side: int) -> NDArray[np.intp]:
    """Return the raster number of the pixel to which each ray belongs, in raster order of rays over
    the whole picture.
    """
    numbers = np.arange(int(np.prod(image_shape))).reshape(image_shape)
    return numbers.repeat(rays_per_side, axis=0).repeat(rays_per_side, axis=1).ravel()


def accumulate_cells(cell: NDArray[np.intp], amount: Array, shape: tuple[int, ...]) -> Array:
    """Add each amount to its cell, numbered in raster order, of a float64 array of `shape`."""
    total: Any = np.bincount(cell.ravel(), amount.ravel(), minlength=int(np.prod(shape)))
    return np.asarray(total, dtype=np.float64).reshape(shape)


def spread_pulse(position: Array, sigma: Array) -> tuple[NDArray[np.intp], Array]:
    """Integrate Gaussian pulses at `position` (n,), in bins, over the bins around them; bin i
    reaches from i - 1/2 to i + 1/2. Returns the first bin of each pulse, and (n, reach) fractions
    of its energy in that bin and those after it.
    """
    if position.size == 0:
        return np.zeros(0, dtype=np.intp), np.zeros((0, 1))
    half = int(np.ceil(EXTENT_SIGMAS * sigma.max() + 0.5))
    first = np.round(position).astype(np.intp) - half
    edges = first[:, np.newaxis] + np.arange(2 * half + 2) - 0.5
    return first, np.diff(
        scipy.special.ndtr((edges - position[:, np.newaxis]) / sigma[:, np.newaxis]), axis=1
    )


def bin_by_time(
    pixel: NDArray[np.intp], position: Array, light: Array, sigma: float, shape: tuple[int, int]
) -> Array:
    """Add the light of rays to the bins of their pixels, (pixels, bins), each spread over its pulse
    about its arrival, in bins; light outside of the axis is lost.
    """
    first, shares = spread_pulse(position, np.full(position.shape, sigma))
    bins = first[:, np.newaxis] + np.arange(shares.shape[1])
    inside = (bins >= 0) & (bins < shape[1])
    cell = pixel[:, np.newaxis] * shape[1] + bins
    return accumulate_cells(cell[inside], (shares * light[:, np.newaxis])[inside], shape)
