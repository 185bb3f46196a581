"""Imaging on other libraries' arrays: the same sums as by the compiled loops, on one device from end
to end, in little memory, and with one plan for many captures.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from array_places import DEVICE_NAMES, FETCHED, find_device
from numpy.testing import assert_allclose
from scenes import (
    HIDDEN,
    JITTER,
    LONG,
    SPOTS,
    THREE_POINTS,
    UNEVEN_DEPTHS,
    curved_wall,
    find_refusal,
    planar_wall,
    relative_error,
    see,
    see_shaped,
)

import nlos.backprojection
import nlos.phasor.propagate
import nlos.phasor.to_depths
from nlos import (
    Backprojection,
    Capture,
    FilteredBackprojection,
    FKMigration,
    Grid,
    Hybrid,
    LightCone,
    PlanarRSD,
    Refinement,
    TransientImaging,
    Volume,
    propagate,
)
from nlos.backprojection import Weighting
from nlos.capture import remove_device_legs
from nlos.compressed import CompressedCapture
from nlos.phasor import wall_to_plane
from nlos.phasor.arrays import ArrayLibrary
from nlos.preparation import crop_capture, rebin_capture, remove_first_bounce
from nlos.simulate import add_poisson_noise
from tofclip.arrays import ComputeDevice, to_numpy
from tofclip.errors import InputError

libraries = pytest.mark.parametrize("library", DEVICE_NAMES)
FINE = Grid(UNEVEN_DEPTHS.x[:4], UNEVEN_DEPTHS.y[:3], 0.4 + np.arange(32) / 64)
# Unevenly spaced; the record (paths up to 1.63 m) ends before the farthest voxels.
UNEVEN = Grid([-0.3, -0.1, 0.05, 0.15, 0.4], np.linspace(-0.4, 0.3, 7), [0.05, 0.4, 0.65, 1.2])
SHAPED = Grid.box((-0.7, 0.6), (-0.5, 0.5), (0.7, 1.1), (0.13, 0.11, 0.1))
RSD, HYBRID, BACKPROJECTION = PlanarRSD(0.125), Hybrid(0.4), Backprojection(0.15)


def see_planar(laser=SPOTS[0]):
    return see(THREE_POINTS, planar_wall(), laser, LONG, JITTER, [1.0, 0.6, 0.3])


def see_curved(laser):
    return see([HIDDEN, (-0.2, 0.1, 0.5)], curved_wall(9, 11), laser)


def mask(capture, *places):
    wall = capture.wall.copy()
    for place in places:
        wall[place] = np.nan
    return replace(capture, wall=wall)


def shuffle(capture):
    """The same wall points as a list in any order."""
    order = np.random.default_rng(5).permutation(len(capture.points))
    return replace(capture, wall=capture.points[order], signal=capture.traces().T[:, order])


def scatter(capture):
    """Move the wall points about, so that they stand above no lattice."""
    wall, confocal = capture.wall.copy(), capture.laser.ndim > 1
    wall[..., :2] += np.random.default_rng(1).uniform(-0.05, 0.05, (*wall.shape[:-1], 2))
    return replace(capture, wall=wall, laser=wall if confocal else capture.laser)


@dataclass(frozen=True)
class Case:
    """What is imaged how, and how far the field may be off that of the compiled loops.

    Both compute the same sums in single precision. Of diffraction 1e-6 is measured, of propagation
    2e-6; paths of back-projection are in single precision to a thousandth of a sample, 1e-4 of a
    wave, and measured 1e-6 to 5e-6.
    """

    method: Any
    capture: Capture
    grid: Grid
    agreement: float
    faster: bool | None = None  # what is said of Fourier transforms from the wall to the plane


def list_cases():
    for name, laser in (("single", SPOTS[0]), ("two spots", SPOTS), ("confocal", "confocal")):
        strict = replace(RSD, tolerance=1e-3 if name == "single" else 1e-2)
        yield f"rsd, {name}", Case(strict, see_planar(laser), UNEVEN_DEPTHS, 1e-5)
        yield f"rsd, fine depths, {name}", Case(RSD, see_planar(laser), FINE, 2e-5)
    masked = mask(see_planar(), (3, 5), (0, 0))
    yield "rsd, masked", Case(RSD, masked, UNEVEN_DEPTHS, 1e-5)
    yield "rsd, listed", Case(RSD, shuffle(masked), UNEVEN_DEPTHS, 1e-5)
    # A single voxel has no spacing, and one straight before the laser no way across.
    yield "rsd, one voxel", Case(RSD, see_planar(), Grid([0.12], [0.05], [0.6]), 1e-5)
    row = Grid(UNEVEN_DEPTHS.x, UNEVEN_DEPTHS.y[3:4], UNEVEN_DEPTHS.z[3:4])
    yield "rsd, one row", Case(RSD, see_planar("confocal"), row, 1e-5)
    spot = np.array([0.1, 0.05, 0.02])
    for shape, laser in (("wavy", spot), ("plates", "confocal"), ("cylinder", "confocal")):
        capture = see_shaped(shape, 12, laser)
        yield f"hybrid, transforms, {shape}", Case(HYBRID, capture, SHAPED, 5e-5, True)
    for laser in (spot, "confocal"):
        capture = scatter(see_shaped("relief", 12, laser))
        yield f"hybrid, direct, {np.ndim(laser)}", Case(HYBRID, capture, SHAPED, 5e-5, False)
    several = see_shaped("cylinder", 12, np.array([[0.1, 0.05, 0.02], [-0.4, 0.1, 0.05]]))
    for faster in (True, False):
        yield f"hybrid, spots, {faster}", Case(HYBRID, several, SHAPED, 5e-5, faster)
    for laser in ("single", "confocal", "paired"):
        yield f"backprojection, {laser}", Case(BACKPROJECTION, see_curved(laser), UNEVEN, 2e-5)
    for weighting in (Weighting(0.0), Weighting(1.0, 1.0), Weighting(2.5, 0.5)):
        weighted = replace(BACKPROJECTION, weighting=weighting)
        yield f"{weighting}", Case(weighted, see_curved("paired"), UNEVEN, 2e-5)
    masked = mask(see_curved("single"), (2, 3))
    yield "backprojection, masked", Case(BACKPROJECTION, masked, UNEVEN, 2e-5)
    x, y, z = masked.wall[4, 5]
    # A lone voxel hears the point that it touches and no other, with that one's error.
    touching = Grid([x], [y], [max(z, 0.04)])
    yield "backprojection, touching", Case(BACKPROJECTION, masked, touching, 3e-4)


CASES = dict(list_cases())


@pytest.fixture
def case(request, monkeypatch):
    """Walls as small as those of these tests would all go by direct sums."""
    case = CASES[request.param]
    if case.faster is not None:
        monkeypatch.setattr(wall_to_plane, "is_faster_than_direct", lambda *_: case.faster)
    return case


@pytest.mark.parametrize("case", CASES, indirect=True)
def test_the_field_is_that_of_the_compiled_loops(case):
    """By PyTorch; `test_fields_stay_on_their_device` compares those of a stricter library."""
    moved = case.capture.on(find_device("torch"))
    found = case.method.phasor_field(moved, case.grid)
    expected = case.method.phasor_field(case.capture, case.grid)
    assert found.device == find_device("torch")
    assert found.provenance == expected.provenance
    assert relative_error(found.values, expected.values) < case.agreement
    assert found.find_brightest() == expected.find_brightest()


@libraries
def test_a_volume_looks_the_same_wherever_it_lives(library, tmp_path):
    expected = RSD.reconstruct(see_planar(), UNEVEN_DEPTHS)
    found = RSD.reconstruct(see_planar().on(find_device(library)), UNEVEN_DEPTHS)
    here = found.on(ComputeDevice())
    projection, front = found.maximum_projection(), expected.maximum_projection()
    assert relative_error(projection.brightness, front.brightness) < 1e-5
    assert found.threshold(0.5).device == find_device(library)
    assert np.array_equal(found.threshold(0.5).magnitude > 0, expected.threshold(0.5).magnitude > 0)
    assert Grid.around(found, 0.05).shape == Grid.around(expected, 0.05).shape
    found.save(tmp_path / "volume.h5")
    found.save_picture(tmp_path / "volume.png")
    assert np.array_equal(Volume.load(tmp_path / "volume.h5").values, here.values)
    for suffix in (".npz", ".vti", ".exr", ".ply"):
        even = Volume(found.values, Grid(UNEVEN_DEPTHS.x, UNEVEN_DEPTHS.y, np.arange(5.0)))
        even.export(tmp_path / f"volume{suffix}")
    assert np.array_equal(np.load(tmp_path / "volume.npz")["values"], here.values)


@libraries
def test_a_capture_is_checked_stored_and_prepared_where_it_lives(library, tmp_path):
    capture, device = see_planar(), find_device(library)
    moved = capture.on(device)
    assert moved.device == device
    assert moved.on(device).signal is moved.signal
    moved.save(tmp_path / "capture.h5")
    assert np.array_equal(Capture.load(tmp_path / "capture.h5").signal, capture.signal)
    whole_numbers = device.put(np.round(1000 * capture.signal).astype(np.int32))
    assert replace(capture, signal=whole_numbers).signal.dtype == moved.signal.dtype
    bad = capture.signal.copy()
    bad[5, 2, 3] = np.nan
    with pytest.raises(InputError, match="1 samples of the signal are NaN"):
        replace(capture, signal=device.put(bad))
    # a masked point may hold anything
    replace(capture, wall=mask(capture, (2, 3)).wall, signal=device.put(bad))
    with pytest.raises(InputError, match="real numbers"):
        replace(capture, signal=device.put(capture.signal.astype(np.complex64)))
    for prepare in PREPARATIONS:
        found, expected = prepare(moved), prepare(capture)
        assert found.device == device
        assert found.axis == expected.axis
        assert_allclose(to_numpy(found.signal), expected.signal, rtol=1e-6, atol=1e-6)


PREPARATIONS = (
    lambda capture: crop_capture(capture, 0.495, 0.805),
    lambda capture: rebin_capture(capture, 8),
    lambda capture: remove_first_bounce(capture, 0.25),
)

# --- plans and memory


@pytest.mark.parametrize("library", ["torch", "numpy"])
@pytest.mark.parametrize(
    "case", ["rsd, single", "hybrid, spots, True", "hybrid, spots, False"], indirect=True
)
def test_what_is_planned_images_many_captures(library, case):
    first = case.capture
    other = replace(first, signal=0.7 * first.signal[:, ::-1])
    device = find_device(library)
    plan = case.method.plan(first.on(device), case.grid)
    for one in (first, other, first):
        found = plan.image(one.on(device))
        expected = case.method.plan(first, case.grid).image(one)
        assert relative_error(found.magnitude, expected.magnitude) < case.agreement
        assert found.provenance == expected.provenance


def test_what_is_planned_refuses_other_captures():
    capture = see_planar().on(find_device("torch"))
    plan = RSD.plan(capture, UNEVEN_DEPTHS)
    for other, reason in (
        (replace(capture, wall=capture.wall + 0.01), "the wall is not"),
        (replace(capture, laser=capture.laser + 0.01), "the laser is not"),
        (replace(capture, start=0.41), "planned for TimeAxis"),
        (capture.on(ComputeDevice()), "planned for signals on torch:cpu, got one on cpu"),
    ):
        with pytest.raises(InputError, match=reason):
            plan.image(other)


@pytest.mark.parametrize("kept", [1 << 30, 0])
@pytest.mark.parametrize("name", ["rsd, single", "hybrid, transforms, wavy", "hybrid, direct, 1"])
def test_little_memory_means_smaller_pieces(name, kept, monkeypatch):
    """Every depth alone, and planned anew for every capture where no tables may be kept."""
    case, counted = CASES[name], list[int]()
    monkeypatch.setattr(wall_to_plane, "is_faster_than_direct", lambda *_: case.faster)
    capture = case.capture.on(find_device("array_api_strict"))
    plan = case.method.plan(capture, case.grid)
    whole = to_numpy(plan.field(capture).values)
    monkeypatch.setattr(ArrayLibrary, "chunk_bytes", 1 if name == "rsd, single" else 1 << 19)
    monkeypatch.setattr(nlos.phasor.to_depths, "MAX_CACHE_BYTES", kept)
    plan = case.method.plan(capture, case.grid)
    for _ in range(2):
        assert relative_error(plan.field(capture, counted.append).values, whole) < 1e-6
    assert sum(counted) == 2 * plan.cost
    assert len(counted) > 2


# --- nothing hides on the processor


@pytest.mark.parametrize(
    ("laser", "method"),
    [
        ("confocal", LightCone()),
        ("confocal", FKMigration()),
        ("single", FilteredBackprojection()),
        ("single", Refinement(Hybrid(0.125))),
        ("single", Hybrid(0.4, propagation="time")),
    ],
)
def test_methods_of_compiled_loops_refuse_in_one_line(laser, method):
    reason = find_refusal(method, see_planar(laser).on(find_device("torch")), UNEVEN_DEPTHS)
    assert "NumPy arrays only" in reason
    assert "\n" not in reason
    assert "NumPy" not in find_refusal(method, see_planar(laser), UNEVEN_DEPTHS)


def test_other_steps_of_compiled_loops_refuse_too():
    capture, spot = see_planar().on(find_device("torch")), np.zeros(3)
    plane = HYBRID.plan(see_planar(), UNEVEN_DEPTHS).plane
    for attempt, reason in (
        (
            lambda: TransientImaging(RSD).image_gate(capture, UNEVEN_DEPTHS, 1e-9, 2e-9),
            "NumPy arrays only",
        ),
        (capture.traces, "works on NumPy arrays"),
        (lambda: propagate(capture, plane, HYBRID.pulse, "time"), "propagation in time works on"),
        (lambda: remove_device_legs(capture, spot, spot), "unwarping works on NumPy arrays"),
        (lambda: add_poisson_noise(capture, 10), "drawing photons works on NumPy arrays"),
        (
            lambda: CompressedCapture(capture.signal, None, capture.wall, spot, 1e-11),
            "compressed measurements works on NumPy arrays",
        ),
    ):
        with pytest.raises(InputError, match=reason):
            attempt()


@pytest.mark.parametrize(
    "case",
    [
        "rsd, masked",
        "rsd, one row",
        f"{Weighting(1.0, 1.0)}",
        "hybrid, transforms, wavy",
        "hybrid, direct, 1",
    ],
    indirect=True,
)
def test_fields_stay_on_their_device(case):
    FETCHED.clear()
    moved = case.capture.on(find_device("array_api_strict"))
    found, fetched = case.method.phasor_field(moved, case.grid).values, [*FETCHED]
    expected = case.method.phasor_field(case.capture, case.grid).values
    assert relative_error(to_numpy(found), expected) < case.agreement
    # On purpose only the sample of phasors that terms are chosen by is fetched.
    assert len(fetched) == (case.faster is not None)
    assert all(size < 1024 * 100 for size in fetched)


@pytest.mark.parametrize("method", [RSD, HYBRID, BACKPROJECTION])
def test_pytorch_differentiates_through_it(method):
    find_device("torch")
    import torch

    capture = see_planar()
    signal = torch.tensor(capture.signal, requires_grad=True)
    brightness = (
        method.phasor_field(replace(capture, signal=signal), UNEVEN_DEPTHS).values[2, 4, 9].real
    )
    brightness.backward()
    # The field is linear in the signal: its gradient, applied to the signal, is the field. Sums in
    # single precision.
    found = float(torch.sum(signal.grad * signal.detach()))
    assert found == pytest.approx(float(brightness.detach()), rel=1e-3)
