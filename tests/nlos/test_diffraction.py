"""Planar diffraction and the hybrid method: what they show, depths that are interpolated, transforms
there and back, progress, and what they refuse.
"""

import subprocess
import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from exact_phasor_field import compute_exact_phasor_field
from scenes import (
    JITTER,
    LONG,
    SHAPED,
    SPOTS,
    THREE_POINTS,
    UNEVEN_DEPTHS,
    curved_wall,
    find_refusal,
    planar_wall,
    relative_error,
    scaled_error,
    see,
    see_shaped,
)

import nlos.method
import nlos.phasor.depth_steps
import nlos.phasor.to_depths_compiled
from nlos import Grid, Hybrid, PlanarRSD
from nlos.phasor import fourier, wall_to_plane
from nlos.plane import Plane
from tofclip.errors import InputError

METHOD, HYBRID = PlanarRSD(wavelength=0.125, cycles=3), Hybrid(wavelength=0.25, cycles=4.24)


def scene(laser=SPOTS[0], wall=None):
    wall = planar_wall() if wall is None else wall
    return see(THREE_POINTS, wall, laser, LONG, JITTER, [1.0, 0.6, 0.3])


@cache
def truth(shape):
    capture = see_shaped(shape, 25)
    return capture, compute_exact_phasor_field(capture, SHAPED, HYBRID.pulse).values


def test_the_plane_may_stand_elsewhere_and_before_it_voxels_stay_sensible():
    capture, exact = truth("planar")
    moved = replace(HYBRID, plane_z=0.7)
    assert moved.plan(capture, SHAPED).plane.z == 0.7
    # As far as the shortest wave is long, within 5 to 10 cm.
    for wavelength, gap in ((0.06, 0.05), (0.6, 0.1)):
        chosen = replace(HYBRID, wavelength=wavelength).plan(capture, SHAPED).plane
        assert chosen.z == pytest.approx(gap)
        assert max(chosen.steps) <= wavelength / 2
    found = moved.phasor_field(capture, SHAPED).values
    # Behind the plane only what passes beside it is missing; before it, the steepest waves are.
    assert scaled_error(found[2:], exact[2:]) < 0.15
    assert scaled_error(found[:1], exact[:1]) < 0.5


UNEVEN = planar_wall()
UNEVEN[:, 4, 0] += 0.02
UNEVEN_VOXELS = Grid([0.0, 0.1, 0.3], UNEVEN_DEPTHS.y, UNEVEN_DEPTHS.z)


@pytest.mark.parametrize(
    ("method", "capture", "grid", "reason"),
    [
        (METHOD, scene(wall=curved_wall()), UNEVEN_DEPTHS, "not a plane"),
        (METHOD, scene(wall=UNEVEN), UNEVEN_DEPTHS, "not evenly spaced along x"),
        (METHOD, scene("paired"), UNEVEN_DEPTHS, "laser spots"),
        (METHOD, scene(), UNEVEN_VOXELS, "voxels are not evenly spaced along x"),
        (
            METHOD,
            scene(),
            Grid(UNEVEN_DEPTHS.x, UNEVEN_DEPTHS.y, [0.0, 0.5]),
            "must begin in front of the wall",
        ),
        (METHOD, scene(wall=planar_wall(1, 30)), UNEVEN_DEPTHS, "two different y"),
        (HYBRID, see_shaped("relief", 9), UNEVEN_VOXELS, "evenly spaced along x"),
        (
            replace(HYBRID, plane_z=0.1),
            see_shaped("relief", 9),
            SHAPED,
            "virtual plane must lie in front",
        ),
    ],
)
def test_what_cannot_be_imaged_is_refused(method, capture, grid, reason):
    assert reason in find_refusal(method, capture, grid)
    with pytest.raises(InputError, match=reason):
        method.reconstruct(capture, grid)


def test_too_many_plane_waves_are_refused(monkeypatch):
    monkeypatch.setattr(nlos.method, "MEMORY_LIMIT_BYTES", 1 << 16)
    assert "plane waves" in find_refusal(METHOD, scene(), UNEVEN_DEPTHS)


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        (([0.0], [0.0, 1.0], 0.0), "axis x"),
        *(((x, [0.0, 1.0], 0.0), "evenly spaced") for x in ([0.0, 1, 3], [1.0, 0], [0.0, np.nan])),
        (([0.0, 1.0], [0.0, 1.0], np.inf), "finite z"),
    ],
)
def test_planes_are_checked(axes, message):
    with pytest.raises(InputError, match=message):
        Plane(*axes)
    assert Plane([0.0, 1.0], [0.0, 2.0, 4.0], 0.5).points[2, 1].tolist() == [1.0, 4.0, 0.5]


# --- transforms


def test_images_without_fftw(monkeypatch):
    monkeypatch.setattr(wall_to_plane, "is_faster_than_direct", lambda *_: True)
    cases = (METHOD, scene(), UNEVEN_DEPTHS), (HYBRID, truth("relief")[0], SHAPED)
    fields = [method.phasor_field(*rest).values for method, *rest in cases]
    monkeypatch.setattr(fourier, "pyfftw", None)
    for (method, *rest), expected in zip(cases, fields, strict=True):
        assert relative_error(method.phasor_field(*rest).values, expected) < 1e-5


def test_transforms_load_neither_dask_nor_pandas():
    pytest.importorskip("pyfftw")
    code = (
        "import sys, nlos.phasor.fourier as plans;"
        "assert plans.pyfftw is not None; assert not {'dask', 'pandas'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
