"""Compiled inner loops of the simulation: what hides what, and light into time bins."""

from __future__ import annotations

import math

import numpy as np

from nlos.kernels import compiled

# Share of a path at either end where nothing hides: the facet's own triangle begins there.
CONTACT_FRACTION = 1e-4


@compiled
def is_occluded(start, end, triangles):
    """Whether one of the triangles (n, 3, 3) crosses the path between two points (3,) (T. Moller,
    B. Trumbore, J. Graph. Tools 2, 21 (1997)).
    """
    dx, dy, dz = end[0] - start[0], end[1] - start[1], end[2] - start[2]
    near, far = min(start[2], end[2]), max(start[2], end[2])
    for i in range(triangles.shape[0]):
        ax, ay, az = triangles[i, 0, 0], triangles[i, 0, 1], triangles[i, 0, 2]
        bz, cz = triangles[i, 1, 2], triangles[i, 2, 2]
        # Most triangles lie behind the facet: this asks three numbers of them, not nine.
        if (az >= far and bz >= far and cz >= far) or (az <= near and bz <= near and cz <= near):
            continue
        ux, uy, uz = triangles[i, 1, 0] - ax, triangles[i, 1, 1] - ay, triangles[i, 1, 2] - az
        vx, vy, vz = triangles[i, 2, 0] - ax, triangles[i, 2, 1] - ay, triangles[i, 2, 2] - az
        px, py, pz = dy * vz - dz * vy, dz * vx - dx * vz, dx * vy - dy * vx
        determinant = ux * px + uy * py + uz * pz
        # the path runs along the triangle's plane
        if determinant == 0:
            continue
        sx, sy, sz = start[0] - ax, start[1] - ay, start[2] - az
        u = (sx * px + sy * py + sz * pz) / determinant
        if u < 0 or u > 1:
            continue
        qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
        v = (dx * qx + dy * qy + dz * qz) / determinant
        if v < 0 or u + v > 1:
            continue
        along = (vx * qx + vy * qy + vz * qz) / determinant
        # a facet must not hide itself: crossings at the very ends of the path are its own triangle
        if CONTACT_FRACTION < along < 1 - CONTACT_FRACTION:
            return True
    return False


@compiled
def cosine_to_normal(normal, from_point, to_point, distance):
    """Cosine of the angle between a unit normal and a path of some length; 0 behind the surface."""
    inner = 0.0
    for i in range(3):
        inner += normal[i] * (to_point[i] - from_point[i])
    return max(inner / distance, 0.0)


@compiled
def add_facet_light(walls, spots, facets, material, triangles, start, fine, bins):
    """Add the light of facets to fine `bins` (points, n), `start` and `fine` their first path and
    width, m, shared between two; `material` (3,): diffuse and retroreflected fraction, spread in
    rad; `triangles` (m, 3, 3) hide.
    """
    (wall, wall_normals), (lasers, laser_normals) = walls, spots
    positions, normals, areas = facets
    outward = np.empty(positions.shape[0])
    lit = np.empty(positions.shape[0])
    for p in range(wall.shape[0]):
        # What is lit, and the shadows, are found once per spot.
        if p < lasers.shape[0]:
            for f in range(positions.shape[0]):
                way = distance_between(lasers[p], positions[f])
                outward[f] = way
                arriving = cosine_to_normal(normals[f], positions[f], lasers[p], way)
                arriving *= cosine_to_normal(laser_normals[p], lasers[p], positions[f], way)
                if arriving > 0 and is_occluded(positions[f], lasers[p], triangles):
                    arriving = 0.0
                # Irradiance times area: cosines at both ends over the square of the distance.
                lit[f] = arriving * areas[f] / (way * way)
        laser = lasers[min(p, lasers.shape[0] - 1)]
        for f in range(positions.shape[0]):
            if lit[f] <= 0:
                continue
            way = distance_between(wall[p], positions[f])
            leaving = cosine_to_normal(normals[f], positions[f], wall[p], way)
            leaving *= cosine_to_normal(wall_normals[p], wall[p], positions[f], way)
            place = (outward[f] + way - start) / fine
            if leaving <= 0 or place < 0 or place >= bins.shape[1] - 1:
                continue
            if is_occluded(positions[f], wall[p], triangles):
                continue
            brightness = lit[f] * leaving / (way * way)
            lengths = outward[f], way
            brightness *= evaluate_reflectance(material, positions[f], laser, wall[p], lengths)
            index = int(place)
            weight = place - index
            bins[p, index] += brightness * (1 - weight)
            bins[p, index + 1] += brightness * weight


@compiled
def distance_between(one, other):
    """Distance of two points. `one, other` (3,): metres."""
    return math.sqrt((one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2 + (one[2] - other[2]) ** 2)


@compiled
def evaluate_reflectance(material, position, laser, observer, lengths):
    """Reflectance per steradian of a material; see `nlos.simulate.scene.Material`."""
    # Lambert: even radiance, whose integral over the half space is the albedo
    value = material[0] / math.pi
    if material[1] > 0:
        inner = 0.0
        for i in range(3):
            inner += (laser[i] - position[i]) * (observer[i] - position[i])
        angle = math.acos(min(max(inner / (lengths[0] * lengths[1]), -1.0), 1.0))
        width = material[2]
        value += material[1] * math.exp(-0.5 * (angle / width) ** 2) / (2 * math.pi * width * width)
    return value
