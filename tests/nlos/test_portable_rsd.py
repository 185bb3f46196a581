from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from portable_libraries import LIBRARIES, find_device, relative_error
from refusals import find_refusal
from relay_walls import AXIS, HIDDEN, JITTER, planar_wall

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
)
from nlos.capture import TimeAxis
from nlos.phasor.arrays import ArrayLibrary
from nlos.simulate import PointScene
from tofclip.arrays import ComputeDevice
from tofclip.errors import InputError

pytestmark = pytest.mark.filterwarnings(
    "ignore::nlos.illumination.AliasingWarning"
)  # small walls are coarse ones

LONG = TimeAxis(560, AXIS.bin_width, 0.4)
# Odd and even sizes, off the wall's middle, depths unevenly spaced.
GRID = Grid(np.arange(-0.3, 0.42, 0.05), np.arange(-0.4, 0.25, 0.06), [0.45, 0.5, 0.56, 0.65, 0.8])
SPOTS = np.array([[0.12, 0.05, 0.0], [-0.3, 0.2, 0.0]])
METHOD = PlanarRSD(wavelength=0.125)
AGREEMENT = 1e-5
"""Both ways compute the same sums in single precision; measured 1e-6."""


def scene(laser: str) -> Capture:
    wall = planar_wall()
    points = PointScene([HIDDEN, (-0.2, 0.1, 0.75), (0.05, -0.05, 0.5)], [1.0, 0.6, 0.3])
    if laser == "two spots":
        walls = np.stack([wall, wall])
        return points.simulate_capture(
            walls, np.broadcast_to(SPOTS[:, None, None], walls.shape), LONG, JITTER
        )
    return points.simulate_capture(wall, wall if laser == "confocal" else SPOTS[0], LONG, JITTER)


@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.parametrize("laser", ["single", "two spots", "confocal"])
def test_the_field_is_that_of_the_compiled_loops(laser: str, library: str) -> None:
    capture, device = scene(laser), find_device(library)
    method = replace(METHOD, tolerance=1e-3 if laser == "single" else 1e-2)
    found = method.phasor_field(capture.on(device), GRID)
    assert found.device == device
    assert relative_error(found.values, method.phasor_field(capture, GRID).values) < AGREEMENT


@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.parametrize("laser", ["single", "two spots", "confocal"])
def test_fine_depths_are_interpolated_as_by_the_compiled_loops(laser: str, library: str) -> None:
    capture, grid = scene(laser), Grid(GRID.x[:4], GRID.y[:3], 0.4 + np.arange(32) / 64)
    plan = METHOD.plan(capture.on(find_device(library)), grid)
    assert plan._hold_diffraction(0)._computed_depths.nodes.size < 28
    found = METHOD.phasor_field(capture.on(find_device(library)), grid).values
    assert relative_error(found, METHOD.phasor_field(capture, grid).values) < 2 * AGREEMENT


@pytest.mark.parametrize("library", LIBRARIES)
def test_a_volume_looks_the_same_wherever_it_lives(library: str, tmp_path: Path) -> None:
    capture = scene("single")
    expected = METHOD.reconstruct(capture, GRID)
    found = METHOD.reconstruct(capture.on(find_device(library)), GRID)
    assert found.device == find_device(library)
    assert found.find_brightest() == expected.find_brightest()
    assert found.provenance == expected.provenance
    projection, front = found.maximum_projection(), expected.maximum_projection()
    assert relative_error(projection.brightness, front.brightness) < AGREEMENT
    assert found.threshold(0.5).device == find_device(library)
    assert np.array_equal(found.threshold(0.5).magnitude > 0, expected.threshold(0.5).magnitude > 0)
    assert Grid.around(found, 0.05).shape == Grid.around(expected, 0.05).shape
    found.save(tmp_path / "volume.h5")
    found.save_picture(tmp_path / "volume.png")
    assert np.array_equal(
        Volume.load(tmp_path / "volume.h5").values, found.on(ComputeDevice()).values
    )
    for suffix in (".npz", ".vti", ".exr", ".ply"):
        even = Volume(found.values, Grid(GRID.x, GRID.y, np.arange(5.0)))
        even.export(tmp_path / f"volume{suffix}")
    assert np.array_equal(
        np.load(tmp_path / "volume.npz")["values"], found.on(ComputeDevice()).values
    )


@pytest.mark.parametrize("library", LIBRARIES)
def test_masked_and_shuffled_wall_points(library: str) -> None:
    capture = scene("single")
    wall = capture.wall.copy()
    wall[3, 5] = wall[0, 0, 1] = np.nan
    masked = replace(capture, wall=wall)
    shuffled = np.random.default_rng(5).permutation(len(masked.points))
    listed = replace(masked, wall=masked.points[shuffled], signal=masked.traces().T[:, shuffled])
    expected = METHOD.phasor_field(masked, GRID).values
    for one in (masked, listed):
        found = METHOD.phasor_field(one.on(find_device(library)), GRID).values
        assert relative_error(found, expected) < AGREEMENT


@pytest.mark.parametrize("library", LIBRARIES)
def test_few_voxels_and_a_laser_beside_the_grid(library: str) -> None:
    """A single voxel has no spacing, and one straight before the laser no way across."""
    for laser, grid in (
        ("single", Grid([0.12], [0.05], [0.6])),
        ("confocal", Grid(GRID.x, GRID.y[3:4], GRID.z[3:4])),
    ):
        capture = scene(laser)
        found = METHOD.phasor_field(capture.on(find_device(library)), grid).values
        assert relative_error(found, METHOD.phasor_field(capture, grid).values) < AGREEMENT


@pytest.mark.parametrize("kept", [1 << 30, 0])
def test_depths_may_be_treated_one_by_one_and_planned_anew(
    kept: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = scene("single").on(find_device("array_api_strict"))
    whole = METHOD.reconstruct(capture, GRID)
    monkeypatch.setattr(ArrayLibrary, "chunk_bytes", 1)
    monkeypatch.setattr(nlos.phasor.to_depths, "MAX_CACHE_BYTES", kept)
    counted: list[int] = []
    plan = METHOD.plan(capture, GRID)
    for _ in range(2):
        assert relative_error(plan.image(capture, counted.append).magnitude, whole.magnitude) < 1e-6
    assert counted == [GRID.size // 5] * 10  # every depth alone, twice


@pytest.mark.parametrize("library", [*LIBRARIES, "numpy"])
def test_what_is_planned_images_many_captures(library: str) -> None:
    first = scene("single")
    other = replace(first, signal=np.random.default_rng(3).normal(size=first.signal.shape))
    device = ComputeDevice() if library == "numpy" else find_device(library)
    plan = METHOD.plan(first.on(device), GRID)
    for one in (first, other, first):
        found = plan.image(one.on(device))
        assert relative_error(found.magnitude, METHOD.reconstruct(one, GRID).magnitude) < AGREEMENT
        assert found.provenance["imaging"] == METHOD.settings


def test_what_is_planned_refuses_other_captures() -> None:
    capture = scene("single").on(find_device("torch"))
    plan = METHOD.plan(capture, GRID)
    for other, reason in (
        (replace(capture, wall=capture.wall + 0.01), "the wall is not"),
        (replace(capture, laser=capture.laser + 0.01), "the laser is not"),
        (replace(capture, start=0.41), "planned for TimeAxis"),
        (capture.on(ComputeDevice()), "planned for signals on torch:cpu, got one on cpu"),
    ):
        with pytest.raises(InputError, match=reason):
            plan.image(other)
    with pytest.raises(InputError, match="behind the hindmost"):
        METHOD.plan(capture, Grid(GRID.x, GRID.y, [-1.0]))


@pytest.mark.parametrize("library", LIBRARIES)
def test_a_capture_elsewhere_is_checked_and_stored_like_any_other(
    library: str, tmp_path: Path
) -> None:
    capture, device = scene("single"), find_device(library)
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
    masked = capture.wall.copy()
    masked[2, 3] = np.nan
    replace(capture, wall=masked, signal=device.put(bad))  # a masked point may hold anything
    with pytest.raises(InputError, match="real numbers"):
        replace(capture, signal=device.put(capture.signal.astype(np.complex64)))


def test_methods_of_compiled_loops_refuse_in_one_line() -> None:
    for laser, method in (
        ("confocal", LightCone()),
        ("confocal", FKMigration()),
        ("single", FilteredBackprojection()),
        ("single", Refinement(Hybrid(0.125))),
    ):
        capture = scene(laser).on(find_device("torch"))
        reason = find_refusal(method, capture, GRID)
        assert "NumPy arrays only, and this capture's signal is on torch:cpu" in reason
        assert "\n" not in reason
    with pytest.raises(InputError, match="NumPy arrays only"):
        TransientImaging(METHOD).image_gate(capture, GRID, 1e-9, 2e-9)
    with pytest.raises(InputError, match="works on NumPy arrays"):
        capture.traces()


@pytest.mark.parametrize("method", [METHOD, Hybrid(0.4), Backprojection(0.15)])
def test_pytorch_differentiates_through_it(method: PlanarRSD | Hybrid | Backprojection) -> None:
    find_device("torch")
    import torch

    capture = scene("single")
    signal = torch.tensor(capture.signal, requires_grad=True)
    brightness = method.phasor_field(replace(capture, signal=signal), GRID).values[2, 4, 9].real
    brightness.backward()
    # The field is linear in the signal: its gradient, applied to the signal, is the field. Sums in
    # single precision.
    assert float(torch.sum(signal.grad * signal.detach())) == pytest.approx(
        float(brightness.detach()), rel=1e-3
    )
