"""Every wave method gives the exact sum over frequencies and wall points within its tolerance, with
no scale factor fitted: amplitude and phase are those of the definition.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from exact_phasor_field import compute_exact_phasor_field
from scenes import (
    AXIS,
    FINE_DEPTHS,
    HIDDEN,
    JITTER,
    LONG,
    SHAPED,
    SHAPED_JITTER,
    SHAPED_POINTS,
    SHAPED_SPOT,
    SPOTS,
    THREE_POINTS,
    UNEVEN_DEPTHS,
    planar_wall,
    relative_error,
    see,
    see_shaped,
)

from nlos import Capture, Grid, Hybrid, PlanarRSD
from nlos.capture import TimeAxis
from nlos.simulate import WALLS, build_relay_wall

RSD, HYBRID = PlanarRSD(wavelength=0.125, cycles=3), Hybrid(wavelength=0.25, cycles=4.24)
TOLERANCES = (1e-2, 1e-3)
WIDE = Grid(np.linspace(-1.2, 1.2, 13), np.linspace(-1.2, 1.2, 13), [0.5, 0.7])
ACCEPTANCE = Grid([-0.6, -0.1, 0.4, 0.9], [-0.8, -0.2, 0.4], [0.62, 0.9, 1.4])
RIM = Grid([-0.3, -0.05, 0.2, 0.45], [-0.4, -0.1, 0.2], [0.31, 0.45, 0.7])
# Close before a plane the windows are narrowest, and far from it the phases turn slowest.
NEAR = Grid(np.linspace(-0.9, 0.9, 13), np.linspace(-0.8, 0.8, 9), [0.6, 0.7, 0.9])
FAR = Grid(np.linspace(-0.5, 0.7, 9), np.linspace(-0.6, 0.4, 7), [2.0, 2.3])


@dataclass(frozen=True)
class Case:
    """What is imaged how, and within which tolerances times `fraction`."""

    method: PlanarRSD | Hybrid
    see: Callable[[], Capture]
    grid: Grid = UNEVEN_DEPTHS
    tolerances: tuple[float, ...] = TOLERANCES
    fraction: float = 1.0


def see_planar(laser, points=THREE_POINTS, axis=LONG):
    return see(points, planar_wall(), laser, axis, JITTER, [1.0, 0.6, 0.3][: len(points)])


def see_scan(wall, laser, bins=640, points=SHAPED_POINTS):
    return see(points, wall, laser, TimeAxis(bins, 32e-12), SHAPED_JITTER)


def see_behind(shape, grid):
    """Two hidden points towards the corners of a grid."""
    hidden = [[grid.x[2], grid.y[-2], grid.z[0]], [grid.x[-1], grid.y[0], grid.z[1]]]
    return see_scan(build_relay_wall(shape, 32), SHAPED_SPOT, 700, hidden)


def list_cases():
    for name, laser in (("single", SPOTS[0]), ("two spots", SPOTS), ("confocal", "confocal")):
        yield f"rsd, {name}", Case(RSD, lambda laser=laser: see_planar(laser))
    # Points two wavelengths apart: the spectrum repeats itself inside the waves that travel.
    coarse = lambda: see([HIDDEN], planar_wall(5, 6), SPOTS[0], LONG)  # noqa: E731
    yield "rsd, coarse wall", Case(RSD, coarse, tolerances=(1e-2,))
    long = TimeAxis(1100, AXIS.bin_width, 0.4)
    wide = Case(RSD, lambda: see_planar(SPOTS[0], [HIDDEN], long), WIDE, (1e-2,))
    yield "rsd, a field of view wider than the wall", wide
    for name, laser in (("on the wall", SPOTS[0]), ("ahead", [0.1, 0.0, 0.3])):
        fine = Case(RSD, lambda laser=laser: see_planar(laser, THREE_POINTS[:2]), FINE_DEPTHS)
        yield f"rsd, fine depths, laser {name}", fine
    row = Grid(UNEVEN_DEPTHS.x, UNEVEN_DEPTHS.y[3:4], UNEVEN_DEPTHS.z[3:4])
    for name, grid in (("a row", row), ("a voxel", Grid(UNEVEN_DEPTHS.x[9:10], row.y, row.z))):
        yield f"rsd, {name}", Case(RSD, lambda: see_planar(SPOTS[0]), grid, (1e-2,))
    for shape in WALLS:
        shaped = Case(HYBRID, lambda shape=shape: see_shaped(shape, 25), SHAPED)
        yield f"hybrid, {shape}", shaped
    wavy, two = build_relay_wall("wavy", 17), np.array([SHAPED_SPOT, [-0.4, 0.3, 0.0]])
    for name, laser in (("confocal", "confocal"), ("two spots", two)):
        scan = Case(HYBRID, lambda laser=laser: see_scan(wavy, laser), SHAPED, (1e-2,))
        yield f"hybrid, {name}", scan
    cloud = np.random.default_rng(3).uniform([-1, -1, 0], [1, 1, 0.2], (400, 3))
    scattered = Case(HYBRID, lambda: see_scan(cloud, SHAPED_SPOT, 512), SHAPED, (1e-2,))
    yield "hybrid, scattered points", scattered
    for shape in ("planar", "relief"):
        for name, grid in (("near", NEAR), ("far", FAR)):
            behind = Case(
                HYBRID, lambda *_, s=shape, g=grid: see_behind(s, g), grid, TOLERANCES, 0.5
            )
            yield f"hybrid, {shape}, narrow windows, {name}", behind
    # A plane cut off sharply two or four Fresnel zones beside the wall errs by 1.0 and 0.6 %; the
    # wavelength is little more than two wall points.
    rim = lambda: see(  # noqa: E731
        0.5 * SHAPED_POINTS,
        0.5 * build_relay_wall("planar", 32),
        0.5 * SHAPED_SPOT,
        TimeAxis(300, 32e-12),
        SHAPED_JITTER,
    )
    yield (
        "hybrid, rim of the virtual plane",
        Case(Hybrid(0.07, 4.24), rim, RIM, (*TOLERANCES, 1e-4)),
    )
    for shape in ("cylinder", "planar", "relief"):
        # 64 x 64 points over 2 m, at a wavelength of four points.
        accepted = lambda shape=shape: see_shaped(shape, 64)  # noqa: E731
        case = Case(Hybrid(0.125, 4.24), accepted, ACCEPTANCE, (1e-3,))
        yield f"hybrid, {shape}, 64 x 64 points", case


CASES = dict(list_cases())


@pytest.mark.parametrize("name", CASES)
def test_the_field_is_the_exact_sum_within_the_tolerance(name):
    case = CASES[name]
    capture = case.see()
    exact = compute_exact_phasor_field(capture, case.grid, case.method.pulse).values
    for tolerance in case.tolerances:
        method = replace(case.method, tolerance=tolerance)
        field = method.phasor_field(capture, case.grid).values
        assert field.dtype == np.complex64
        assert relative_error(field, exact) < case.fraction * tolerance
    image = method.reconstruct(capture, case.grid).values
    assert image.dtype == np.float32
    assert relative_error(image, np.abs(field)) < 1e-6
