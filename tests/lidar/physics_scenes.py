"""Streak shots of known scenes by a forward model of its own: it shares no code with the recovery or
with `tofclip.simulate`, so that what both get wrong shows.

    shot = make_shot("room", seed=3, photons=2000)            # or any of SCENES, or surfaces
    frames = tofclip.recover(tofclip.Streak(shot.counts, shot.row_times), shot.camera)
    cloud = tofclip.point_cloud(tofclip.depth(frames))
    shot.score(*shot.locate(cloud.xyz), cloud.range, cloud.range_sigma, cloud.false_alarm)

`shot.camera` is the instrument's as a calibration gives it: gains and sweep are found from the shot
(`shot.true_camera` knows them). `shot.truth` lists every return of every pixel: row, column, range,
number of the surface in `shot.names`, and how much of the pixel it fills. `size` is the side of the
picture, 128 px by default; 48 or 64 do for quick tests.

The instrument: seven lenslets in a row, each with a picture of the scene from where it stands, whose
lines cross the slit at ``centre + X - Y tan(angle)``; rows of 20 ps; a Gaussian response of 60 ps; a
delay that is a continuous function of the slit column; photons. Rays start at random places of each
pixel, meet the nearest surface (what one surface hides differs between the views), and bring light by
Lambert's law and the fall-off with range to the place and the time at which they arrive.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from tofclip.camera import Camera, SkewSweep

SPEED = 299_792_458.0
ROW_S, PULSE_S, ROWS = 20e-12, 60e-12, 1180
FIRST_RANGE_M = 1.3
PITCH_M, FOCUS_M = 2.1e-3, 2.4
ANGLES = np.radians([-44.5, -27.0, -12.0, 1.5, 21.0, 36.0, 46.5])
GAINS = np.array([0.95, 1.06, 1.0, 0.91, 1.03, 0.97, 1.08])
STEPS = np.arange(7) - 3.0  # of the lenslets from the reference
RAYS = 4  # across a pixel
FINE = 4  # parts of a row in which light is gathered before the pulse spreads it
RIM_PX, NEAR_M = 10, 0.03  # of the score: what lies nearer the rim is left out; what is one return
MIN_FILL = 0.3  # of a pixel that a surface fills to count as a return that may be missed


class Hits(NamedTuple):
    """Where rays meet a surface: distance along the ray (infinite: not at all), normal, reflectance."""

    distance: np.ndarray
    normal: np.ndarray
    reflectance: np.ndarray


@dataclass(frozen=True)
class Surface:
    """Something that reflects, within a ball by which rays that pass it are known."""

    name: str
    centre: np.ndarray
    radius: float
    meet: Callable[[np.ndarray, np.ndarray], Hits]
    directed: float = (
        0.0  # of the light, that goes back to where it came from, as multiples of white
    )


def plate(name, centre, size, reflectance, yaw=0.0, pitch=0.0):
    """A rectangle; `reflectance` is a number or a function of (right, down), m; NaN: light passes."""
    right = np.array([np.cos(yaw), 0, np.sin(yaw)])
    down = np.array([np.sin(yaw) * np.sin(pitch), np.cos(pitch), -np.cos(yaw) * np.sin(pitch)])
    normal, middle = np.cross(right, down), np.array(centre, float)

    def meet(origin, rays):
        with np.errstate(divide="ignore"):
            distance = ((middle - origin) @ normal) / (rays @ normal)
        at = origin + distance[:, None] * rays - middle
        u, v = at @ right, at @ down
        value = reflectance(u, v) if callable(reflectance) else np.full(u.shape, reflectance)
        there = (np.abs(u) <= size[0] / 2) & (np.abs(v) <= size[1] / 2) & ~np.isnan(value)
        there &= distance > 0
        return Hits(np.where(there, distance, np.inf), np.broadcast_to(normal, rays.shape), value)

    return Surface(name, middle, float(np.hypot(*size)) / 2, meet)


def sphere(name, centre, radius, reflectance, directed=0.0):
    middle = np.array(centre, float)

    def meet(origin, rays):
        return meet_round(origin - middle, rays, rays, radius, reflectance, lambda at: at)

    return Surface(name, middle, radius, meet, directed)


def ellipsoid(name, centre, radii, reflectance):
    """A body of three half axes, to the right, down and away."""
    middle, half = np.array(centre, float), np.array(radii, float)

    def meet(origin, rays):
        start, ways = (origin - middle) / half, rays / half
        found = meet_round(start, ways, ways, 1.0, reflectance, lambda at: at)
        normal = found.normal / half
        return found._replace(normal=normal / np.linalg.norm(normal, axis=1, keepdims=True))

    return Surface(name, middle, float(half.max()), meet)


def cylinder(name, start, end, radius, reflectance):
    """A round rod between two points, without its ends."""
    first, axis = np.array(start, float), np.array(end, float) - np.array(start, float)
    length = float(np.linalg.norm(axis))
    axis /= length

    def across(vectors):
        return vectors - (vectors @ axis)[..., None] * axis

    def meet(origin, rays):
        found = meet_round(across(origin - first), across(rays), rays, radius, reflectance, across)
        along = (origin - first + found.distance[:, None].clip(0, 1e3) * rays) @ axis
        there = (along >= 0) & (along <= length)
        return found._replace(distance=np.where(there, found.distance, np.inf))

    return Surface(name, first + axis * length / 2, float(np.hypot(length / 2, radius)), meet)


def meet_round(start, across, rays, radius, reflectance, flatten):
    """The nearer meeting with a sphere, or with a rod where all is taken across its axis."""
    a, b = np.sum(across**2, axis=1), across @ start
    root = b * b - a * (start @ start - radius**2)
    distance = np.where(
        root > 0, (-b - np.sqrt(np.maximum(root, 0))) / np.maximum(a, 1e-12), np.inf
    )
    at = flatten(start + np.where(np.isfinite(distance), distance, 0)[:, None] * rays)
    value = reflectance(at[:, 0], at[:, 1]) if callable(reflectance) else reflectance
    there = np.isfinite(distance) & (distance > 0)
    return Hits(np.where(there, distance, np.inf), at / radius, np.broadcast_to(value, a.shape))


def checker(side, dark, bright):
    return lambda u, v: np.where((np.floor(u / side) + np.floor(v / side)) % 2 > 0, bright, dark)


def threads(spacing, width, reflectance):
    """Gauze: threads both ways, light passes between them."""
    return lambda u, v: np.where((u % spacing < width) | (v % spacing < width), reflectance, np.nan)


# --- scenes: about 2 to 4.5 m away; places and turns differ from seed to seed ------------------------


def make_room(r):
    turn, lift = r.uniform(0.9, 1.1), r.uniform(-0.06, 0.06)
    return [
        plate("wall", (0, 0, 4.1), (3, 3), checker(0.4, 0.35, 0.6), yaw=r.uniform(-0.1, 0.1)),
        plate("steep plate", (-0.35, lift, 2.6), (0.7, 0.5), 0.7, yaw=turn),
        sphere("ball", (0.33, 0.25 + lift, 2.7), r.uniform(0.15, 0.2), 0.6),
        sphere("small ball", (0.25, -0.3, 2.2), r.uniform(0.08, 0.11), 0.8),
    ]


def make_wires(r):
    slope = r.uniform(-0.25, 0.25)
    return [
        plate("dark wall", (0, 0, 3.4), (3, 3), r.uniform(0.06, 0.09)),
        sphere("retroreflector", (r.uniform(-0.3, 0.3), -0.35, 3.1), 0.012, 0.1, r.uniform(12, 25)),
        cylinder("wire", (-0.9, -slope, 2.1), (0.9, slope, 2.25), 0.006, 0.7),
        cylinder("thin wire", (0.25 - slope, -0.9, 2.5), (0.25 + slope, 0.9, 2.5), 0.005, 0.7),
        sphere("ball", (-0.3, 0.25, 2.8), r.uniform(0.14, 0.18), 0.5),
    ]


def make_gauze(r):
    spacing = r.uniform(0.006, 0.008)
    return [
        plate(
            "gauze",
            (0, 0, 2.0),
            (0.7, 0.7),
            threads(spacing, 0.2 * spacing, 0.6),
            yaw=r.uniform(-0.2, 0.2),
        ),
        sphere("ball", (0.1, r.uniform(-0.1, 0.1), 2.9), 0.25, checker(0.11, 0.25, 0.8)),
        plate("wall", (0, 0, 3.7), (3, 3), 0.5),
    ]


def make_table(r):
    shift = r.uniform(-0.05, 0.05)
    return [
        plate(
            "table top", (0, 0.35, 2.8), (2.4, 1.4), 0.5, r.uniform(-0.3, 0.3), r.uniform(0.6, 0.8)
        ),
        cylinder("cup", (-0.3, 0.1, 2.6), (-0.3, 0.4, 2.6), r.uniform(0.08, 0.11), 0.7),
        sphere("apple", (0.12 + shift, 0.3, 2.5), 0.09, 0.5),
        sphere("melon", (0.38, 0.14 + shift, 2.9), 0.16, 0.6),
        plate("book", (0, shift - 0.2, 3.1), (0.4, 0.4), checker(0.08, 0.3, 0.8), 0.6, 0.3),
        plate("wall", (0, 0, 4.2), (4, 4), 0.45, yaw=-0.15),
    ]


def make_person(where, r):
    x, y, z = where
    legs = [(-0.09, -0.12, 0.2, 0.75), (0.09, 0.14, 0.2, 0.75)]
    arms = [(-0.16, -0.3, -0.28, 0.05), (0.16, 0.32, -0.28, 0.0)]
    bent = r.uniform(-0.1, 0.1, 4)
    return [
        sphere("head", (x, y - 0.45, z), 0.11, 0.55),
        cylinder("torso", (x, y - 0.33, z), (x, y + 0.25, z), 0.16, 0.4),
        *(
            cylinder("limb", (x + a, y + c, z), (x + b, y + d, z + away), 0.06, 0.5)
            for (a, b, c, d), away in zip(legs + arms, bent, strict=True)
        ),
    ]


def make_bush(r):
    leaves = [
        plate("leaf", (0.36 + dx, 0.2 + dy, 2.3 + dz), (0.06, 0.09), r.uniform(0.3, 0.6), *turns)
        for dx, dy, dz, *turns in r.normal(0, (0.12, 0.16, 0.12, 0.6, 0.6), (70, 5))
    ]
    return [
        *make_person((-0.25, 0.05, 2.6 + r.uniform(-0.1, 0.1)), r),
        *leaves,
        plate("wall", (0, 0, 3.9), (4, 4), 0.5, yaw=r.uniform(-0.1, 0.1)),
    ]


def make_stairs(r):
    steps = []
    for k in range(5):  # each a riser and a tread, further away the higher
        y, z = 0.42 - 0.2 * k, 2.2 + 0.28 * k
        steps.append(plate("riser", (0, y, z), (1.6, 0.16), 0.55))
        steps.append(plate("tread", (0, y - 0.1, z + 0.14), (1.6, 0.28), 0.6, 0.0, 1.45))
    return [
        *steps,
        cylinder("rail", (-0.5, 0.2, 2.1), (-0.4, -0.7, 3.3), r.uniform(0.015, 0.02), 0.6),
        plate("wall", (0, 0, 4.3), (4, 4), 0.45, yaw=r.uniform(-0.15, 0.15)),
    ]


def make_lamp(r):
    x, turn = r.uniform(-0.15, 0.15), r.uniform(-0.5, 0.5)
    return [
        cylinder("cable", (x, -0.9, 2.5), (x, -0.2, 2.5), 0.006, 0.4),
        sphere("lamp", (x, -0.08, 2.5), r.uniform(0.11, 0.14), 0.75),
        sphere("retroreflector", (x - 0.4, 0.3, 3.0), 0.012, 0.1, r.uniform(8, 20)),
        sphere("retroreflector", (x + 0.35, 0.35, 3.5), 0.014, 0.1, r.uniform(8, 20)),
        plate("slanted picture", (-x, 0.4, 3.2), (0.7, 0.4), checker(0.1, 0.2, 0.7), turn, 0.5),
        plate("wall", (0, 0, 3.8), (4, 4), 0.3, yaw=turn / 5),
    ]


def make_fence(r):
    slats = [
        plate("slat", (x, 0.1, 2.4 + 0.3 * x), (0.045, 1.0), 0.6, 0.3)
        for x in np.arange(-0.6, 0.65, 0.1) + r.uniform(-0.03, 0.03)
    ]
    return [
        *slats,
        cylinder("rod", (-0.7, -0.1, 2.15), (0.7, -0.1, 2.6), 0.008, 0.6),
        cylinder("trunk", (0.3, -0.8, 3.2), (0.2, 0.8, 3.2), r.uniform(0.08, 0.12), 0.4),
        plate("wall", (0, 0, 3.9), (4, 4), checker(0.3, 0.3, 0.5), yaw=r.uniform(-0.1, 0.1)),
    ]


SCENES = {
    "room": make_room,
    "wires": make_wires,
    "gauze": make_gauze,
    "table": make_table,
    "bush": make_bush,
    "stairs": make_stairs,
    "lamp": make_lamp,
    "fence": make_fence,
}


# --- the instrument -----------------------------------------------------------------------------------


class Seen(NamedTuple):
    """What rays meet: number of the surface (-1: none), place, light of a pulse of 1."""

    surface: np.ndarray
    place: np.ndarray
    light: np.ndarray


def look(surfaces, origin, x, y, focal, focus_shift):
    """Follow rays through picture places (x, y), px from the axis; (rows, columns) arrays."""
    rays = np.stack([(x - focus_shift) / focal, y / focal, np.ones_like(x)], axis=-1)
    nearest = np.full(x.shape, np.inf)
    number, light = np.full(x.shape, -1), np.zeros(x.shape)
    fine = x.shape[0] / (y.max() - y.min())
    for k, surface in enumerate(surfaces):
        # rays that pass the ball around it are left out
        depths = np.maximum(surface.centre[2] + surface.radius * np.array([-1, 1]), 0.3)
        sides = surface.centre[:2] - origin[:2] + surface.radius * np.array([[-1], [1]])
        ends = focal * sides[:, np.newaxis] / depths[:, np.newaxis] + [focus_shift, 0]
        ends = (ends.reshape(4, 2) - [x.min(), y.min()]) * fine
        low, high = (
            np.maximum(np.rint(edge), 0).astype(int) for edge in (ends.min(0) - 8, ends.max(0) + 8)
        )
        columns, rows = (slice(*edges) for edges in zip(low, high, strict=True))
        own = rays[rows, columns].reshape(-1, 3)
        if not own.size:
            continue
        found = surface.meet(origin, own)
        shape = nearest[rows, columns].shape
        distance = found.distance.reshape(shape)
        closer = distance < nearest[rows, columns]
        at = origin + np.where(np.isfinite(found.distance), found.distance, 1)[:, None] * own
        back = -at / np.linalg.norm(at, axis=1)[:, None]  # to the lamp at the reference lenslet
        facing = np.abs(np.sum(found.normal * back, axis=1))
        bright = (found.reflectance * facing + surface.directed) / np.sum(at**2, axis=1)
        nearest[rows, columns][closer] = distance[closer]
        number[rows, columns][closer] = k
        light[rows, columns][closer] = bright.reshape(shape)[closer]
    place = origin + np.where(np.isfinite(nearest), nearest, 0)[..., None] * rays
    return Seen(number, place, light)


@dataclass(frozen=True)
class Shot:
    """A simulated shot with its truth."""

    counts: np.ndarray  # (rows, columns), photons
    row_times: np.ndarray  # s
    camera: Camera
    true_camera: Camera
    names: list[str]
    # a line for each return: row, column, range (m), surface, how much of the pixel it fills
    truth: np.ndarray

    def locate(self, xyz):
        """Row and column of the pixels in which points lie."""
        (rows, columns), focal = self.camera.image_shape, self.camera.focal_length_px
        away = focal * xyz[:, :2] / xyz[:, 2:]
        return np.rint(away[:, 1] + rows // 2).astype(int), np.rint(
            away[:, 0] + columns // 2
        ).astype(int)

    def score(self, row, column, distance, sigma=None, doubt=None):
        """Of points (n,): `miss`, the fraction of true returns without a point within 30 mm in their
        pixel; `false`, that of points without a true return within 30 mm in 3 x 3 pixels (`is_false`:
        of each of `counted`); `median_mm`; `z` of each surface, robust spread of the errors over the
        stated `sigma`; `calibration`: (lowest, highest, mean stated, true fraction, points) of the
        probabilities of being false, `doubt`. A rim of 10 px is left out.
        """
        at, true, fill = self.truth[:, :2], self.truth[:, 2], self.truth[:, 4]
        of_surface = np.array(self.names)[self.truth[:, 3].astype(int)]
        points = np.stack([row, column], axis=1)

        def find_nearest(places, values, among, ranges, pixel_m):
            """Number of the nearest in range, and how far it is; pixels count as metres."""
            tree = cKDTree(np.column_stack([among * pixel_m, ranges]))
            wanted = np.column_stack([places * pixel_m, values])
            return tree.query(wanted, p=np.inf, distance_upper_bound=NEAR_M)

        def inside(place):
            edge = self.camera.image_shape[0] - RIM_PX
            return np.all((place >= RIM_PX) & (place < edge), axis=1)

        may_be_missed, counted = inside(at) & (fill >= MIN_FILL), inside(points)
        missed = np.isinf(find_nearest(at, true, points, distance, 1.0)[0])
        # the pixels beside are two thirds of the distance away up to which ranges count
        is_false = np.isinf(find_nearest(points, distance, at, true, NEAR_M / 1.5)[0])
        off, which = find_nearest(points, distance, at, true, 1.0)
        found = counted & np.isfinite(off)
        name_of = of_surface[np.where(found, which, 0)]
        result: dict[str, Any] = {
            "miss": float(missed[may_be_missed].mean()),
            "false": float(is_false[counted].mean()),
            "median_mm": 1e3 * float(np.median(off[found])),
            "counted": counted,
            "is_false": is_false,
            "medians_mm": {},
            "z": {},
        }
        for name in dict.fromkeys(self.names):
            own = found & (name_of == name)
            if own.sum() >= 20:
                result["medians_mm"][name] = 1e3 * float(np.median(off[own]))
                if sigma is not None:
                    result["z"][name] = float(np.median((off / sigma)[own]) / 0.6745)
        if doubt is not None:
            edges = np.array([0, 0.025, 0.1, 0.2, 0.45, 0.75, 1.0])
            bins = np.digitize(doubt, edges[1:-1])
            result["calibration"] = [
                (edges[b], edges[b + 1], doubt[own].mean(), is_false[own].mean(), own.sum())
                for b in range(edges.size - 1)
                if (own := counted & (bins == b)).any()
            ]
        return result


def make_shot(
    scene,
    seed=0,
    photons=2000.0,
    size=128,
    background=2.0,
    afterglow=0.0,
    haze=0.0,
    bend=0.0,
    row_s=ROW_S,
    blur=0.0,
):
    """Simulate a shot whose brightest streak pixel expects `photons`. `scene`: one of `SCENES`, or
    surfaces; `background`: photons a pixel; `afterglow`: fraction of the light that comes late, by 400 ps
    in the mean; `haze`: fraction that is scattered along the slit, 10 columns far in the mean; `bend`:
    rows by which the outer views come later than a straight delay has them; `row_s`: duration of a row;
    `blur`: standard deviation of what a streak tube spreads along the slit, px.
    """
    random = np.random.default_rng([seed, 0])
    if isinstance(scene, str):
        scene = SCENES[scene](np.random.default_rng(seed))
    surfaces = list(scene)
    focal = 300.0 * size / 128
    centres = size * (1.19 + 1.36 * np.arange(7)) + np.array([0.3, -1.2, 0.4, 0.0, -0.7, 0.9, 0.2])
    width = round(10.6 * size)
    first = 2 * FIRST_RANGE_M / SPEED  # time of flight at the middle of row 0

    rows = round(ROWS * ROW_S / row_s)

    def delay(column):  # rows
        way = (column - centres[3]) / (3 * 1.36 * size)
        return (12.0 * way + (0.6 + bend) * way**2) * ROW_S / row_s

    gathered = np.zeros((rows * FINE, width))
    for view in range(7):
        origin = np.array([PITCH_M * STEPS[view], 0.0, 0.0])
        grid = np.arange(size * RAYS) / RAYS - size // 2 - 0.5
        x, y = np.meshgrid(grid, grid)
        x, y = (axis + random.uniform(0, 1 / RAYS, x.shape) for axis in (x, y))
        shift = focal * origin[0] / FOCUS_M  # all views' pictures coincide at this depth
        seen = look(surfaces, origin, x, y, focal, shift)
        lit = seen.surface >= 0
        place, light = seen.place[lit], seen.light[lit]
        column = centres[view] + x[lit] - y[lit] * np.tan(ANGLES[view])
        path = np.linalg.norm(place, axis=1) + np.linalg.norm(place - origin, axis=1)
        row = (path / SPEED - first) / row_s + delay(column)
        fine = (row + 0.5) * FINE - 0.5
        below = np.floor(fine).astype(int)
        slit = np.rint(column).astype(int)
        for part, weight in ((below, 1 - (fine - below)), (below + 1, fine - below)):
            there = (part >= 0) & (part < rows * FINE) & (slit >= 0) & (slit < width)
            flat = part[there] * width + slit[there]
            brought = (GAINS[view] * light * weight)[there]
            gathered += np.bincount(flat, brought, gathered.size).reshape(gathered.shape)
    late = (np.arange(-24 * FINE, 200 * FINE)) * row_s / FINE
    shape = np.exp(-4 * np.log(2) * (late / PULSE_S) ** 2)
    shape /= shape.sum()
    if afterglow:
        tail = np.where(late >= 0, np.exp(-late / 400e-12), 0)
        tail = np.convolve(shape, tail / tail.sum())[24 * FINE :][: late.size]
        shape = (1 - afterglow) * shape + afterglow * tail
    if haze:
        away = np.exp(-np.abs(np.arange(-60, 61)) / 10)
        hazy = [np.convolve(row, away / away.sum(), "same") for row in gathered]
        gathered = (1 - haze) * gathered + haze * np.array(hazy)
    if blur:
        gathered = gaussian_filter1d(gathered, blur, axis=1, mode="constant")
    length = rows * FINE + late.size
    spectrum = np.fft.rfft(gathered, length, axis=0) * np.fft.rfft(shape, length)[:, None]
    spread = np.fft.irfft(spectrum, length, axis=0)[24 * FINE :][: rows * FINE]
    expected = np.maximum(spread.reshape(rows, FINE, width).sum(axis=1), 0)
    expected *= photons / expected.max()
    counts = random.poisson(expected + background).astype(np.float32)

    truth = list_truth(surfaces, focal, size, random)
    camera = Camera(
        centres, ANGLES, (size, size), width, time_zero=-first, pulse_fwhm=PULSE_S,
        focal_length_px=focal, lenslet_pitch=PITCH_M, focus_distance=FOCUS_M,
    )  # fmt: skip
    sweep = SkewSweep(centres, delay(centres), np.zeros(7))
    true_camera = camera.replace(gains=GAINS, sweep=sweep)
    names = [surface.name for surface in surfaces]
    return Shot(counts, np.arange(rows) * row_s, camera, true_camera, names, truth)


def list_truth(surfaces, focal, size, random, side=6):
    """Every return of every pixel as the reference lenslet sees it: the mean range of what it sees of
    each surface.
    """
    grid = np.arange(size * side) / side - size // 2 - 0.5
    x, y = np.meshgrid(grid, grid)
    x, y = (axis + random.uniform(0, 1 / side, x.shape) for axis in (x, y))
    seen = look(surfaces, np.zeros(3), x, y, focal, 0.0)
    rows, columns = np.indices(x.shape) // side
    cell = ((rows * size + columns) * len(surfaces) + seen.surface)[seen.surface >= 0]
    distance = np.linalg.norm(seen.place, axis=-1)[seen.surface >= 0]
    filled = np.bincount(cell)
    there = np.flatnonzero(filled)
    mean = np.bincount(cell, distance)[there] / filled[there]
    pixel, number = np.divmod(there, len(surfaces))
    return np.stack([*np.divmod(pixel, size), mean, number, filled[there] / side**2], axis=1)
